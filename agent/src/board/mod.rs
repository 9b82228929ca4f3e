//! The boards that the firmware runs on, chosen by a cargo feature: the Feather STM32F405, or, with
//! `crazyflie`, the Crazyflie 2.1. Both have an STM32F405.

mod chip;
#[cfg(feature = "flash")]
mod flash;
#[cfg(feature = "crazyflie")]
#[path = "crazyflie21.rs"]
mod pins;
#[cfg(not(feature = "crazyflie"))]
#[path = "feather_f405.rs"]
mod pins;
mod ring;

pub(crate) use chip::{Clock, JournalPort, Serial, Watchdog, wait};
pub(crate) use pins::Led;

/// The devices of a board that the firmware uses.
pub(crate) struct Board {
    /// The time since boot.
    pub(crate) clock: Clock,
    /// The serial ports to the server, the depth sensor and the wheels.
    pub(crate) ports: [Serial; 3],
    /// The port that a journal is written to, if the image is built with it.
    pub(crate) journal: JournalPort,
    /// The status LED.
    pub(crate) led: Led,
    /// Resets the robot if the main loop hangs.
    pub(crate) watchdog: Watchdog,
    /// Whether the watchdog caused the last reset.
    pub(crate) was_reset_by_watchdog: bool,
    /// A random number, different at each boot.
    pub(crate) nonce: u64,
    /// The robot's number, key and parameters.
    #[cfg(feature = "flash")]
    pub(crate) identity: ubimap_agent::flash::Identity,
}
