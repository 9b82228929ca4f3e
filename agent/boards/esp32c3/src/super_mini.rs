//! The ESP32-C3 Super Mini. Other boards with this chip have the same pins, but often another LED.
//!
//! | printed | pin | use |
//! |---|---|---|
//! | USB | USB | power, flashing, and what the robot says at its start |
//! | antenna | antenna | Wi-Fi at 2.4 GHz: UDP, to and from the server |
//! | 4, 5 | GPIO4, GPIO5 | UART0, to and from the depth sensor |
//! | 6, 7 | GPIO6, GPIO7 | UART1, to and from the wheels |
//! | 8 | GPIO8 | status LED (blue), lit by a low level |

use alloc::boxed::Box;
use core::{
    convert::Infallible,
    pin::Pin,
    task::{Context, Waker},
};

use esp_hal::{
    clock::CpuClock,
    gpio::{Level, Output, OutputConfig},
    peripherals::{FROM_CPU_INTR0, TIMG1, WIFI},
    rng::{Trng, TrngSource},
    rtc_cntl::SocResetReason,
    system, time,
    timer::timg::{MwdtStage, Timer, TimerGroup, Wdt},
    uart::{self, RxConfig, Uart},
};
use esp_println::println;
use esp_rtos::CurrentThreadHandle;
use ubimap_agent::{
    Port,
    firmware::{self, Board as _},
    flash::store,
    journal::Entry,
};
use ubimap_protocol::{message::ParameterValue, time::Instant};
use udp_link::{Change, Link};

use crate::{
    flash::Sectors,
    radio::Radio,
    serial::{SENSOR, Serial, WHEELS, serve_sensor, serve_wheels},
};

/// Number of received bytes at which a port's interrupt comes: a quarter of what the hardware holds.
const RX_THRESHOLD: u16 = 32;

/// The devices that the main loop uses.
pub(crate) struct Board {
    led: Output<'static>,
    watchdog: Wdt<TIMG1<'static>>,
    /// The link to the server, once the radio runs.
    pub(crate) link: Option<Link<Radio>>,
    /// Where the robot's parameters are stored.
    pub(crate) flash: Sectors,
    /// What keeps the radio connected.
    pub(crate) connection: Option<Pin<Box<dyn Future<Output = Infallible>>>>,
}

/// The rest of the chip, for the start.
pub(crate) struct Chip {
    pub(crate) radio: WIFI<'static>,
    pub(crate) scheduler_timer: Timer<'static>,
    pub(crate) scheduler_interrupt: FROM_CPU_INTR0<'static>,
    /// A random number.
    pub(crate) nonce: u32,
    /// Whether the watchdog caused the last reset.
    pub(crate) was_reset_by_watchdog: bool,
}

impl Board {
    /// Sets up the board, with the baud rates of the sensor and the wheels; Wi-Fi needs none. `None` if a port
    /// can't have its rate.
    pub(crate) fn take([_, sensor, wheels]: [u32; 3]) -> Option<(Self, Chip)> {
        let was_reset_by_watchdog = system::reset_reason() == Some(SocResetReason::CoreMwdt1);
        let chip = esp_hal::init(esp_hal::Config::default().with_cpu_clock(CpuClock::max()));
        let rx = RxConfig::default().with_fifo_full_threshold(RX_THRESHOLD);
        let port = |baud| uart::Config::default().with_baudrate(baud).with_rx(rx);
        let uart = Uart::new(chip.UART0, port(sensor)).ok()?;
        SENSOR.open(uart.with_tx(chip.GPIO4).with_rx(chip.GPIO5), serve_sensor);
        let uart = Uart::new(chip.UART1, port(wheels)).ok()?;
        WHEELS.open(uart.with_tx(chip.GPIO6).with_rx(chip.GPIO7), serve_wheels);
        let led = Output::new(chip.GPIO8, Level::High, OutputConfig::default());

        let noise = TrngSource::new(chip.RNG, chip.ADC1);
        let nonce = Trng::try_new().ok()?.random();
        drop(noise);
        let watchdog = TimerGroup::new(chip.TIMG1).wdt;
        let flash = Sectors::new(chip.FLASH);
        let chip = Chip {
            radio: chip.WIFI,
            scheduler_timer: TimerGroup::new(chip.TIMG0).timer0,
            scheduler_interrupt: chip.FROM_CPU_INTR0,
            nonce,
            was_reset_by_watchdog,
        };
        Some((Self { led, watchdog, link: None, flash, connection: None }, chip))
    }
}

impl Board {
    /// Starts the watchdog, which resets the robot if the main loop has not run for this time, or changes its
    /// time.
    pub(crate) fn watch(&mut self, time: time::Duration) {
        self.watchdog.set_timeout(MwdtStage::Stage0, time);
        self.watchdog.enable();
        self.watchdog.feed();
    }

    /// Lets the radio and the link do what is due.
    fn poll(&mut self) {
        if let Some(connection) = &mut self.connection {
            let _ = connection.as_mut().poll(&mut Context::from_waker(Waker::noop()));
        }
        let now = self.now();
        while let Some(change) = self.link.as_mut().and_then(|link| link.poll(now)) {
            match change {
                Change::Up => println!("ubimap: Wi-Fi is connected"),
                Change::Down => println!("ubimap: Wi-Fi is disconnected"),
                Change::Address(address) => println!("ubimap: the robot's address is {address}"),
                Change::NoAddress => println!("ubimap: the robot has no address"),
            }
        }
    }
}

/// The serial port of a device.
fn serial(port: Port) -> Option<&'static Serial> {
    match port {
        Port::Server => None,
        Port::Sensor => Some(&SENSOR),
        Port::Wheels => Some(&WHEELS),
    }
}

impl firmware::Board for Board {
    const STORES: bool = true;

    fn now(&self) -> Instant {
        Instant::from_micros(time::Instant::now().duration_since_epoch().as_micros())
    }

    fn read(&mut self, port: Port, bytes: &mut [u8]) -> usize {
        if let Some(serial) = serial(port) {
            return serial.read(bytes);
        }
        self.poll();
        self.link.as_mut().map_or(0, |link| link.read(bytes))
    }

    fn room(&mut self, port: Port) -> usize {
        match (serial(port), &mut self.link) {
            (Some(serial), _) => serial.room(),
            (None, Some(link)) => link.room(),
            (None, None) => 0,
        }
    }

    fn write(&mut self, port: Port, bytes: &[u8]) {
        match (serial(port), &mut self.link) {
            (Some(serial), _) => serial.write(bytes),
            (None, Some(link)) => link.write(bytes),
            (None, None) => {}
        }
    }

    fn note(&mut self, _: Instant, _: Entry<'_>) {}

    fn feed_watchdog(&mut self) {
        self.watchdog.feed();
    }

    fn show(&mut self, lit: bool) {
        self.led.set_level(if lit { Level::Low } else { Level::High });
    }

    // Interrupts, and with them the radio, wait up to 0.4 s: less than the watchdog's time.
    fn store(&mut self, parameters: &[ParameterValue]) -> bool {
        self.watchdog.feed();
        store(&mut self.flash, parameters)
    }

    fn wait(&mut self) {
        // Sends what was written.
        self.poll();
        let has_frame = self.link.as_mut().is_some_and(|link| !link.is_empty());
        if !has_frame && SENSOR.is_empty() && WHEELS.is_empty() {
            CurrentThreadHandle::get().delay(time::Duration::from_millis(1));
        }
    }
}
