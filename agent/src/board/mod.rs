//! The boards that the firmware runs on, chosen by a cargo feature: the Feather STM32F405, with
//! `crazyflie` the Crazyflie 2.1, with `pico` the Raspberry Pi Pico, with `pico2` the Pico 2.
//!
//! Another board with one of these chips is a file as thin as `feather_f405.rs`.

#[cfg(all(feature = "pico", feature = "pico2"))]
compile_error!("pico and pico2 are different chips: choose one of these features");
#[cfg(all(feature = "ld06", feature = "vl53"))]
compile_error!("the robot has one sensor: choose one of the features ld06 and vl53");

#[cfg_attr(feature = "rp2", path = "rp2.rs")]
#[cfg_attr(not(feature = "rp2"), path = "stm32f405.rs")]
mod chip;
#[cfg(feature = "flash")]
#[cfg_attr(feature = "rp2", path = "spi_flash.rs")]
mod flash;
#[cfg(feature = "flash")]
mod identity;
#[cfg(feature = "in-step")]
mod in_step;
#[cfg(feature = "motors")]
mod motors;
#[cfg_attr(feature = "crazyflie", path = "crazyflie21.rs")]
#[cfg_attr(feature = "rp2", path = "pico.rs")]
#[cfg_attr(not(any(feature = "crazyflie", feature = "rp2")), path = "feather_f405.rs")]
mod pins;
mod ring;
mod serial;
#[cfg(feature = "vl53")]
mod vl53;

use cortex_m::peripheral::NVIC;
#[cfg(feature = "flash")]
use ubimap_protocol::message::ParameterValue;

#[cfg(feature = "journal")]
pub(crate) use chip::JournalPort;
pub(crate) use chip::{Clock, Watchdog};
#[cfg(feature = "motors")]
pub(crate) use motors::{LeftMotor, RightMotor};
pub(crate) use pins::Led;
pub(crate) use serial::{Serial, wait};

/// The devices of a board that the firmware uses.
pub(crate) struct Board {
    /// The time since boot.
    pub(crate) clock: Clock,
    /// The serial ports to the server, the depth sensor and the wheels.
    pub(crate) ports: [Serial; 3],
    /// The port that a journal is written to, if the image is built with it.
    pub(crate) journal: JournalPort,
    /// The simulation that the ports lead to.
    #[cfg(feature = "in-step")]
    pub(crate) simulation: in_step::Simulation,
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
    /// Where they are kept.
    #[cfg(feature = "flash")]
    pub(crate) flash: flash::Slots,
    /// The motors until the robot takes them, and their encoders.
    #[cfg(feature = "motors")]
    pub(crate) motors: Option<motors::Motors>,
    #[cfg(feature = "motors")]
    pub(crate) encoders: motors::Encoders,
    /// The sensor of 8 x 8 zones; `None` if it does not answer.
    #[cfg(feature = "vl53")]
    pub(crate) zones: Option<vl53::ZoneSensor>,
}

#[cfg(feature = "in-step")]
impl Board {
    /// Exchanges bytes with the simulation.
    pub(crate) fn step(&mut self) {
        self.simulation.exchange(&mut self.ports, self.clock.now());
    }
}

#[cfg(feature = "flash")]
impl Board {
    /// Stores parameters for later boots. The core may stand still for 2 s. Returns whether they are stored.
    pub(crate) fn store(&mut self, parameters: &[ParameterValue]) -> bool {
        let Self { clock, watchdog, flash, .. } = self;
        chip::stand_still(*clock, watchdog, || ubimap_agent::flash::store(flash, parameters))
    }
}

/// No port, because the image is built without a journal.
#[cfg(not(feature = "journal"))]
pub(crate) struct JournalPort;

#[cfg(not(feature = "journal"))]
impl JournalPort {
    pub(crate) const IS_OPEN: bool = false;

    pub(crate) fn write(&mut self, _: &[u8]) {}
}

#[allow(unsafe_code, reason = "unmasking is unsafe for those whose critical sections mask it")]
fn unmask(interrupt: chip::Interrupt) {
    // SAFETY: critical sections here mask all interrupts, so none relies on the mask of this one.
    unsafe { NVIC::unmask(interrupt) }
}

/// Mixes a word into a number: the multiplication spreads low bits upwards, and the shift brings
/// high bits down again.
fn mix(number: u64, word: u32) -> u64 {
    let spread = (number ^ u64::from(word)).wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    spread ^ spread >> 32
}
