//! The Raspberry Pi Pico (RP2040) and Pico 2 (RP2350), whose pins are the same.
//!
//! | printed | pin | use |
//! |---|---|---|
//! | USB | USB | serial port (CDC-ACM), to and from the server |
//! | GP0, GP1 | GPIO0, GPIO1 | UART0, to and from the depth sensor |
//! | GP4, GP5 | GPIO4, GPIO5 | UART1, to and from the wheels |
//! | GP8, GP9 | GPIO8, GPIO9 | with `vl53`: SDA and SCL of the sensor, pulled up |
//! | GP10, GP11 | GPIO10, GPIO11 | with `motors`: A and B of the left encoder, pulled up |
//! | GP12, GP13 | GPIO12, GPIO13 | with `motors`: A and B of the right encoder, pulled up |
//! | GP16, GP17 | GPIO16, GPIO17 | with `motors`: PWM of the left and of the right motor (PWMA, PWMB) |
//! | GP18, GP19 | GPIO18, GPIO19 | with `motors`: direction of the left motor (AIN1, AIN2) |
//! | GP20, GP21 | GPIO20, GPIO21 | with `motors`: direction of the right motor (BIN1, BIN2) |
//! | LED | GPIO25 | status LED (green), lit by a high level |

use ubimap_agent::flash::Paged;

use super::{
    Board, JournalPort,
    chip::{
        self,
        hal::gpio::{FunctionSioOutput, Pin, PullDown, bank0::Gpio25},
        port,
    },
    flash::Sectors,
    identity::identity,
    serial::DEVICE_QUEUES,
};

/// The status LED.
pub(crate) type Led = Pin<Gpio25, FunctionSioOutput, PullDown>;

impl Board {
    /// Sets up the board, with the baud rates of the sensor and the wheels; USB needs none. `None` if it was
    /// set up before, or the crystal does not start.
    pub(crate) fn take([_, sensor, wheels]: [u32; 3]) -> Option<Self> {
        let mut chip = chip::start()?;
        // First, because nothing else runs while flash is written: no USB, no wheels, no watchdog.
        let mut flash = Paged(Sectors);
        let identity = identity(&mut flash);
        let pins = chip.pins;
        let server = chip::start_usb(chip.usb)?;
        let parts = (chip.uart0, pins.gpio0, pins.gpio1);
        let sensor = port!(UART0, UART0_IRQ, Gpio0, Gpio1, parts, sensor, DEVICE_QUEUES, chip)?;
        let parts = (chip.uart1, pins.gpio4, pins.gpio5);
        let wheels = port!(UART1, UART1_IRQ, Gpio4, Gpio5, parts, wheels, DEVICE_QUEUES, chip)?;

        let led = pins.gpio25.into_push_pull_output();
        #[cfg(feature = "motors")]
        let motors = super::motors::start(
            chip.pwm,
            &mut chip.resets,
            (pins.gpio16, pins.gpio17),
            (pins.gpio18, pins.gpio19),
            (pins.gpio20, pins.gpio21),
        );
        #[cfg(feature = "motors")]
        let encoders = super::motors::Encoders::start([
            [pins.gpio10.reconfigure().into_dyn_pin(), pins.gpio11.reconfigure().into_dyn_pin()],
            [pins.gpio12.reconfigure().into_dyn_pin(), pins.gpio13.reconfigure().into_dyn_pin()],
        ]);
        #[cfg(feature = "vl53")]
        let zones = super::vl53::ZoneSensor::start(
            chip.i2c,
            (pins.gpio8, pins.gpio9),
            &mut chip.resets,
            chip.system_clock,
            chip.clock,
        );
        chip.watchdog.begin();
        Some(Self {
            clock: chip.clock,
            ports: [server, sensor, wheels],
            journal: JournalPort,
            led,
            watchdog: chip.watchdog,
            was_reset_by_watchdog: chip.was_reset_by_watchdog,
            nonce: chip.nonce,
            identity,
            flash,
            #[cfg(feature = "motors")]
            motors: Some(motors),
            #[cfg(feature = "motors")]
            encoders,
            #[cfg(feature = "vl53")]
            zones,
        })
    }
}
