//! The RP2040 and the RP2350: clocks, time, two UARTs, and a serial port over USB.
//!
//! By their HALs, which are alike. The RP2040 says Hello in an emulator (`tests/tests/pico.rs`); never tried on a board.

use core::{cell::Cell, sync::atomic::AtomicU8};

use cortex_m::{
    interrupt::{self as interrupts, Mutex},
    peripheral::{NVIC, SYST, syst::SystClkSource},
    singleton,
};
use cortex_m_rt::exception;
use embedded_hal::delay::DelayNs;
#[cfg(feature = "pico2")]
pub(super) use rp235x_hal as hal;
#[cfg(feature = "pico")]
pub(super) use rp2040_hal as hal;
use ubimap_protocol::time::Instant;
use usb_device::{
    bus::UsbBusAllocator,
    device::{StringDescriptors, UsbDevice, UsbDeviceBuilder, UsbVidPid},
};
use usbd_serial::{SerialPort, USB_CLASS_CDC};

pub(super) use self::hal::pac::Interrupt;
use self::hal::{
    Clock as _, Sio, Timer,
    clocks::init_clocks_and_plls,
    fugit::{ExtU32, HertzU32, RateExtU32},
    gpio::Pins,
    pac::{self, RESETS, ROSC, UART0, UART1, interrupt},
    uart::{DataBits, Enabled, StopBits, UartConfig, UartDevice, UartPeripheral, ValidUartPinout},
    usb::UsbBus,
};
use super::{
    mix,
    serial::{Queues, SERVER_QUEUES, Serial},
    unmask,
};

/// The second stage of the boot loader: the ROM runs it to set up the flash.
#[cfg(feature = "pico")]
#[allow(unsafe_code, reason = "the ROM looks for it at the start of the flash")]
#[unsafe(link_section = ".boot2")]
#[used]
static BOOT2: [u8; 256] = rp2040_boot2::BOOT_LOADER_W25Q080;

/// Size of [`flash_setup`] in words.
pub(super) const SETUP_WORDS: usize = 64;

/// The code, for any place, that makes the flash readable after it was written: the second stage of the boot loader,
/// which returns if it is called.
#[cfg(feature = "pico")]
pub(super) fn flash_setup() -> [u32; SETUP_WORDS] {
    let mut words = [0; SETUP_WORDS];
    let code = BOOT2.as_chunks().0;
    words.iter_mut().zip(code).for_each(|(word, bytes)| *word = u32::from_le_bytes(*bytes));
    words
}

/// The code, for any place, that makes the flash readable after it was written: the ROM has left it in its own RAM, from
/// which nothing runs.
#[cfg(feature = "pico2")]
pub(super) fn flash_setup() -> [u32; SETUP_WORDS] {
    const BOOT_RAM: *const [u32; SETUP_WORDS] = 0x400E_0000 as *const _;
    #[allow(unsafe_code, reason = "it is read at its address")]
    // SAFETY: the address is that of the boot RAM, which is always readable.
    unsafe {
        BOOT_RAM.read_volatile()
    }
}

/// The ROM looks for this within the first 4 KiB of the flash: an image for the Arm cores.
#[cfg(feature = "pico2")]
#[allow(unsafe_code, reason = "the ROM looks for it near the start of the flash")]
#[unsafe(link_section = ".start_block")]
#[used]
static IMAGE: hal::block::ImageDef = hal::block::ImageDef::secure_exe();

/// The frequency of both boards' crystals.
const CRYSTAL_HZ: u32 = 12_000_000;

/// The chip with its clocks running.
pub(super) struct Chip {
    pub(super) clock: Clock,
    pub(super) watchdog: Watchdog,
    pub(super) was_reset_by_watchdog: bool,
    pub(super) nonce: u64,
    pub(super) resets: RESETS,
    pub(super) pins: Pins,
    /// The clock of the UARTs.
    pub(super) uart_clock: HertzU32,
    pub(super) uart0: UART0,
    pub(super) uart1: UART1,
    pub(super) usb: UsbBusAllocator<UsbBus>,
    #[cfg(feature = "motors")]
    pub(super) pwm: pac::PWM,
    #[cfg(feature = "vl53")]
    pub(super) i2c: pac::I2C0,
    /// The clock of the core and of I2C.
    #[cfg(feature = "vl53")]
    pub(super) system_clock: HertzU32,
}

/// Starts the clocks by the crystal: the RP2040's core at 125 MHz, the RP2350's at 150 MHz, USB at 48 MHz.
/// `None` if that was done before, or the crystal does not start.
pub(super) fn start() -> Option<Chip> {
    let core = cortex_m::Peripherals::take()?;
    let pac::Peripherals {
        CLOCKS,
        IO_BANK0,
        PADS_BANK0,
        PLL_SYS,
        PLL_USB,
        #[cfg(feature = "motors")]
            PWM: pwm,
        #[cfg(feature = "vl53")]
            I2C0: i2c,
        RESETS: mut resets,
        ROSC,
        SIO,
        UART0,
        UART1,
        WATCHDOG,
        XOSC,
        #[cfg(feature = "pico")]
            TIMER: timer,
        #[cfg(feature = "pico2")]
            TIMER0: timer,
        #[cfg(feature = "pico")]
            USBCTRL_REGS: usb,
        #[cfg(feature = "pico")]
            USBCTRL_DPRAM: usb_dpram,
        #[cfg(feature = "pico2")]
            USB: usb,
        #[cfg(feature = "pico2")]
            USB_DPRAM: usb_dpram,
        ..
    } = pac::Peripherals::take()?;

    let was_reset_by_watchdog = WATCHDOG.reason().read().timer().bit_is_set();
    let mut watchdog = hal::Watchdog::new(WATCHDOG);
    let clocks = init_clocks_and_plls(
        CRYSTAL_HZ,
        XOSC,
        CLOCKS,
        PLL_SYS,
        PLL_USB,
        &mut resets,
        &mut watchdog,
    )
    .ok()?;
    #[cfg(feature = "pico")]
    let clock = Clock(Timer::new(timer, &mut resets, &clocks));
    #[cfg(feature = "pico2")]
    let clock = Clock(Timer::new_timer0(timer, &mut resets, &clocks));
    start_alarm(core.SYST, clocks.system_clock.freq());
    Some(Chip {
        clock,
        watchdog: Watchdog(watchdog),
        was_reset_by_watchdog,
        nonce: boot_nonce(&ROSC),
        pins: Pins::new(IO_BANK0, PADS_BANK0, Sio::new(SIO).gpio_bank0, &mut resets),
        uart_clock: clocks.peripheral_clock.freq(),
        uart0: UART0,
        uart1: UART1,
        usb: UsbBusAllocator::new(UsbBus::new(usb, usb_dpram, clocks.usb_clock, true, &mut resets)),
        resets,
        #[cfg(feature = "motors")]
        pwm,
        #[cfg(feature = "vl53")]
        i2c,
        #[cfg(feature = "vl53")]
        system_clock: clocks.system_clock.freq(),
    })
}

/// SysTick wakes the core every millisecond, so that it can sleep and still meet its deadlines.
fn start_alarm(mut systick: SYST, core: HertzU32) {
    systick.set_clock_source(SystClkSource::Core);
    systick.set_reload(core.to_kHz() - 1);
    systick.clear_current();
    systick.enable_counter();
    systick.enable_interrupt();
}

#[exception]
fn SysTick() {}

/// The time since boot, by the chip's microsecond timer.
#[derive(Clone, Copy)]
pub(crate) struct Clock(
    #[cfg(feature = "pico")] Timer,
    #[cfg(feature = "pico2")] Timer<hal::timer::CopyableTimer0>,
);

impl Clock {
    /// The time since boot; monotonic.
    pub(crate) fn now(self) -> Instant {
        Instant::from_micros(self.0.get_counter().ticks())
    }
}

impl DelayNs for Clock {
    fn delay_ns(&mut self, ns: u32) {
        self.0.delay_ns(ns);
    }
}

/// The watchdog resets the robot if the main loop has not run for 2 s.
pub(crate) struct Watchdog(hal::Watchdog);

impl Watchdog {
    /// Starts the watchdog.
    pub(super) fn begin(&mut self) {
        self.0.start(2_000_000.micros());
    }

    /// Restarts the watchdog's time.
    pub(crate) fn feed(&mut self) {
        self.0.feed();
    }
}

/// Does what may take half a second.
pub(super) fn stand_still<T>(_: Clock, watchdog: &mut Watchdog, work: impl FnOnce() -> T) -> T {
    watchdog.feed();
    let done = work();
    watchdog.feed();
    done
}

/// A number that differs from boot to boot: bits of the ring oscillator, sampled by the crystal's clock.
fn boot_nonce(noise: &ROSC) -> u64 {
    // Neighbouring samples are alike; a thousand are not.
    (0..1_000).fold(0, |nonce, _| mix(nonce, noise.randombit().read().bits()))
}

/// Starts a UART, which has queues of 32 bytes itself.
pub(super) fn start_port<D: UartDevice, P: ValidUartPinout<D>>(
    device: D,
    pins: P,
    baud: u32,
    clock: HertzU32,
    resets: &mut RESETS,
) -> Option<UartPeripheral<Enabled, D, P>> {
    let config = UartConfig::new(baud.Hz(), DataBits::Eight, None, StopBits::One);
    UartPeripheral::new(device, pins, resets).enable(config, clock).ok()
}

/// Moves bytes between a UART and its queues: its interrupt.
pub(super) fn serve<D: UartDevice, P: ValidUartPinout<D>>(
    uart: &mut UartPeripheral<Enabled, D, P>,
    queues: &Queues,
) {
    let Queues { received, queued } = queues;
    while received.room() > 0 {
        let mut byte = [0];
        match uart.read_raw(&mut byte) {
            Ok(_) => received.put(byte[0]),
            // The checksums of the protocols detect the loss.
            Err(nb::Error::Other(_)) => continue,
            Err(nb::Error::WouldBlock) => break,
        };
    }
    while uart.uart_is_writable() {
        let Some(byte) = queued.take() else { break };
        let _ = uart.write_raw(&[byte]);
    }
    // If the queue is full, bytes stay in the UART; `read` makes room and triggers the interrupt again.
    if received.room() > 0 {
        uart.enable_rx_interrupt();
    } else {
        uart.disable_rx_interrupt();
    }
    // The interrupt comes when a full UART has sent half of its bytes.
    if queued.is_empty() {
        uart.disable_tx_interrupt();
    } else {
        uart.enable_tx_interrupt();
    }
}

/// Starts a UART as a port with queues, whose sizes are given in bytes, and an interrupt of its own. Needs
/// the UART with its pins, TX first, the baud rate and the [`Chip`]; returns an `Option<Serial>`. Use it once
/// per UART.
macro_rules! port {
    ($uart:ident, $irq:ident, $tx:ident, $rx:ident, $parts:expr, $baud:expr, $sizes:expr, $chip:ident) => {{
        use core::{cell::Cell, sync::atomic::AtomicU8};
        use cortex_m::interrupt::{self as interrupts, Mutex};

        use crate::board::{
            chip::{
                hal::{
                    gpio::{FunctionUart, Pin, PullNone, PullUp, bank0},
                    pac::{Interrupt, interrupt, $uart},
                    uart::{Enabled, UartPeripheral},
                },
                serve, start_port,
            },
            serial::{Queues, Serial},
            unmask,
        };

        /// The receiving pin is pulled up, so that nothing is received if nothing is connected.
        type Pins =
            (Pin<bank0::$tx, FunctionUart, PullNone>, Pin<bank0::$rx, FunctionUart, PullUp>);
        type Uart = UartPeripheral<Enabled, $uart, Pins>;
        const SIZES: [usize; 2] = $sizes;
        static RECEIVED: [AtomicU8; SIZES[0]] = [const { AtomicU8::new(0) }; _];
        static QUEUED: [AtomicU8; SIZES[1]] = [const { AtomicU8::new(0) }; _];
        static QUEUES: Queues = Queues::new(&RECEIVED, &QUEUED);
        /// Hands the UART from the setup to the interrupt, which then owns it.
        static UART: Mutex<Cell<Option<Uart>>> = Mutex::new(Cell::new(None));

        #[interrupt]
        fn $irq() {
            static mut OWNED: Option<Uart> = None;
            if OWNED.is_none() {
                *OWNED = interrupts::free(|cs| UART.borrow(cs).take());
            }
            if let Some(uart) = OWNED {
                serve(uart, &QUEUES);
            }
        }

        let (device, tx, rx) = $parts;
        let pins: Pins = (tx.reconfigure(), rx.reconfigure());
        start_port(device, pins, $baud, $chip.uart_clock, &mut $chip.resets).map(|uart| {
            interrupts::free(|cs| UART.borrow(cs).set(Some(uart)));
            unmask(Interrupt::$irq);
            let port = Serial::new(&QUEUES, Interrupt::$irq);
            port.serve_soon();
            port
        })
    }};
}
pub(super) use port;

/// The serial port over USB.
struct Usb {
    device: UsbDevice<'static, UsbBus>,
    port: SerialPort<'static, UsbBus>,
}

/// The shared number of serial ports of USB that have no manufacturer's own.
const USB_ID: UsbVidPid = UsbVidPid(0x16C0, 0x27DD);

static USB_RECEIVED: [AtomicU8; SERVER_QUEUES[0]] = [const { AtomicU8::new(0) }; _];
static USB_QUEUED: [AtomicU8; SERVER_QUEUES[1]] = [const { AtomicU8::new(0) }; _];
static USB_QUEUES: Queues = Queues::new(&USB_RECEIVED, &USB_QUEUED);

/// Hands the port from the setup to the interrupt, which then owns it.
static USB_PORT: Mutex<Cell<Option<Usb>>> = Mutex::new(Cell::new(None));

/// Starts the serial port over USB; `None` if that was done before.
pub(super) fn start_usb(bus: UsbBusAllocator<UsbBus>) -> Option<Serial> {
    let bus: &'static _ = singleton!(: UsbBusAllocator<UsbBus> = bus)?;
    let port = SerialPort::new(bus);
    let words = StringDescriptors::default().manufacturer("ubimap").product("ubimap robot");
    let device = UsbDeviceBuilder::new(bus, USB_ID)
        .strings(&[words])
        .ok()?
        .device_class(USB_CLASS_CDC)
        .build();
    interrupts::free(|cs| USB_PORT.borrow(cs).set(Some(Usb { device, port })));
    unmask(Interrupt::USBCTRL_IRQ);
    Some(Serial::new(&USB_QUEUES, Interrupt::USBCTRL_IRQ))
}

#[interrupt]
fn USBCTRL_IRQ() {
    static mut OWNED: Option<Usb> = None;
    if OWNED.is_none() {
        *OWNED = interrupts::free(|cs| USB_PORT.borrow(cs).take());
    }
    if let Some(usb) = OWNED {
        usb.serve(&USB_QUEUES);
        // The controller asks until its packet is taken: the main loop must run, which makes room.
        if USB_QUEUES.received.room() == 0 {
            NVIC::mask(Interrupt::USBCTRL_IRQ);
        }
    }
}

impl Usb {
    /// Moves bytes between the port and its queues. Without a reader at the other end, the queue stays full.
    fn serve(&mut self, queues: &Queues) {
        self.device.poll(&mut [&mut self.port]);
        let Queues { received, queued } = queues;
        let mut byte = [0];
        while received.room() > 0 && self.port.read(&mut byte) == Ok(1) {
            received.put(byte[0]);
        }
        let mut packet = [0; 64];
        loop {
            let waiting = queued.copy(&mut packet);
            let Ok(count) = self.port.write(waiting) else { break };
            queued.skip(count);
        }
    }
}
