//! The STM32F405: clocks, time, and three serial ports.
//!
//! The same image runs on the chip and in QEMU's `netduinoplus2`, which does not model the clock
//! control (RCC): its core always runs at 168 MHz, and no ready bit is ever set.

use core::cell::Cell;

#[cfg(feature = "flash")]
use cortex_m::peripheral::{DCB, DWT};
use cortex_m::{
    interrupt::{self as interrupts, Mutex},
    peripheral::{SCB, SYST, syst::SystClkSource},
};
use cortex_m_rt::exception;
use embedded_hal::delay::DelayNs;
pub(super) use stm32f4xx_hal::pac::Interrupt;
use stm32f4xx_hal::{
    interrupt,
    pac::{FLASH, IWDG, RCC, RNG, TIM2, UART4, usart1},
    rcc::{Enable, Rcc},
    signature::Uid,
};
use ubimap_protocol::time::Instant;

#[cfg(not(feature = "journal"))]
use super::JournalPort;
use super::{
    mix,
    serial::{Queues, Serial},
};

/// The core clock: set by the PLL on the chip, fixed in the emulator.
const CORE_HZ: u32 = 168_000_000;

/// The clock of the peripherals on bus APB1, such as USART2 and USART3.
pub(super) const APB1_HZ: u32 = CORE_HZ / 4;

/// The clock of the peripherals on bus APB2, such as USART1 and USART6.
pub(super) const APB2_HZ: u32 = CORE_HZ / 2;

/// The clock of TIM2: a quarter of the core clock (bus APB1), doubled for timers.
const TIMER_HZ: u32 = CORE_HZ / 2;

/// Sets the clocks by the PLL: the core to 168 MHz, APB1 to 42 MHz, APB2 to 84 MHz, and the random
/// number generator to 48 MHz. The source is the internal oscillator, which every board has.
///
/// The oscillator is accurate to 1 % at room temperature and to 4.5 % up to 105 degrees; use a
/// crystal for higher accuracy over temperature.
///
/// Returns the clock of TIM2. In the emulator there is nothing to set.
///
/// Writes the registers directly, because the HAL's search for divisors adds panics to the image.
pub(super) fn start_pll(rcc: &RCC, flash: &FLASH) -> u32 {
    // After a reset the chip runs on this oscillator, and its ready bit is set.
    if rcc.cr().read().hsirdy().bit_is_clear() {
        return EMULATED_TIMER_HZ;
    }
    flash.acr().write(|w| w.latency().ws5().prften().enabled().icen().enabled().dcen().enabled());
    rcc.pllcfgr().write(|w| {
        w.pllsrc().hsi().pllp().div2();
        // 16 MHz / 16 * 336 = 336 MHz: divided by two for the core, by seven for the noise
        // generator.
        #[allow(unsafe_code, reason = "the register has values that overclock the chip")]
        // SAFETY: these values are in range: the VCO's input is 1 to 2 MHz, its output 100 to 432
        // MHz.
        unsafe {
            w.pllm().bits(16).plln().bits(336).pllq().bits(7)
        }
    });
    rcc.cr().modify(|_, w| w.pllon().on());
    while rcc.cr().read().pllrdy().bit_is_clear() {}
    rcc.cfgr().modify(|_, w| w.hpre().div1().ppre1().div4().ppre2().div2());
    rcc.cfgr().modify(|_, w| w.sw().pll());
    while !rcc.cfgr().read().sws().is_pll() {}
    TIMER_HZ
}

/// The time since boot: complete periods of SysTick, counted by its interrupt, plus its count in
/// the current period.
#[derive(Clone, Copy)]
pub(crate) struct Clock(());

/// SysTick's period in microseconds, at most 99,864. A longer period lets an emulator be delayed
/// longer by its host before a period is missed.
const PERIOD_MICROS: u32 = 90_000;

/// SysTick counts per microsecond.
const PER_MICRO: u32 = CORE_HZ / 1_000_000;

/// SysTick counts per period.
const PERIOD: u32 = PERIOD_MICROS * PER_MICRO;

/// Number of complete periods of SysTick.
static PERIODS: Mutex<Cell<u64>> = Mutex::new(Cell::new(0));

impl Clock {
    pub(super) fn start(mut systick: SYST) -> Self {
        systick.set_clock_source(SystClkSource::Core);
        systick.set_reload(PERIOD - 1);
        systick.clear_current();
        systick.enable_counter();
        systick.enable_interrupt();
        // SysTick starts at zero and reloads: the first period begins then.
        while SYST::get_current() == 0 {}
        Self(())
    }

    /// The time since boot; monotonic.
    pub(crate) fn now(self) -> Instant {
        interrupts::free(|cs| {
            let whole = PERIODS.borrow(cs).get();
            // SysTick counts down. The step to zero ends a period and sets the interrupt pending.
            // If the emulator is delayed, the counter stays at zero until then.
            let left = SYST::get_current();
            let (whole, part) = if SCB::is_pendst_pending() {
                // The period has ended but has not been counted yet. `left` may be from before its
                // end, so the counter is read again.
                (whole + 1, (PERIOD - SYST::get_current()) % PERIOD)
            } else {
                (whole, PERIOD - left)
            };
            let micros = whole * u64::from(PERIOD_MICROS) + u64::from(part / PER_MICRO);
            Instant::from_micros(micros)
        })
    }
}

#[cfg(feature = "flash")]
impl Clock {
    /// Lets a debugger's counter of cycles run, which goes on while the core stands still.
    pub(super) fn count_cycles(dcb: &mut DCB, dwt: &mut DWT) {
        dcb.enable_trace();
        dwt.enable_cycle_counter();
    }

    /// Counts the periods whose ends nobody has seen since a time and its cycle, less than 25 s ago.
    fn catch_up(self, (time, cycle): (Instant, u32)) {
        let (now, cycles) = (self.now(), DWT::cycle_count().wrapping_sub(cycle));
        let counted = now.since(time).micros();
        let missed = u64::from(cycles / PER_MICRO).saturating_sub(counted);
        let periods = (missed + u64::from(PERIOD_MICROS / 2)) / u64::from(PERIOD_MICROS);
        interrupts::free(|cs| {
            let whole = PERIODS.borrow(cs);
            whole.set(whole.get() + periods);
        });
    }
}

#[exception]
fn SysTick() {
    interrupts::free(|cs| {
        let periods = PERIODS.borrow(cs);
        periods.set(periods.get() + 1);
    });
}

impl DelayNs for Clock {
    fn delay_ns(&mut self, ns: u32) {
        // One more, because the current microsecond has partly passed.
        let end = self.now().micros() + u64::from(ns.div_ceil(1_000)) + 1;
        while self.now().micros() < end {}
    }
}

/// TIM2 wakes the core every millisecond, so that it can sleep and still meet its deadlines.
pub(super) fn start_alarm(timer: TIM2, timer_hz: u32, rcc: &mut Rcc) {
    TIM2::enable(rcc);
    timer.psc().write(|w| w.psc().set((timer_hz / 1_000_000 - 1) as u16));
    timer.arr().write(|w| w.arr().set(1_000 - 1));
    // Loads the prescaler. This also sets the update flag, which serves as the first alarm.
    timer.egr().write(|w| w.ug().set_bit());
    timer.dier().write(|w| w.uie().set_bit());
    timer.cr1().write(|w| w.cen().set_bit());
    interrupts::free(|cs| ALARM.borrow(cs).set(Some(timer)));
    super::unmask(Interrupt::TIM2);
}

/// TIM2's clock in the emulator. The timer only wakes the core, so a different value in another
/// version of the emulator does no harm.
const EMULATED_TIMER_HZ: u32 = 1_000_000_000;

/// Hands TIM2 from the setup to the interrupt.
static ALARM: Mutex<Cell<Option<TIM2>>> = Mutex::new(Cell::new(None));

#[interrupt]
fn TIM2() {
    static mut OWNED: Option<TIM2> = None;
    if OWNED.is_none() {
        *OWNED = interrupts::free(|cs| ALARM.borrow(cs).take());
    }
    if let Some(timer) = OWNED {
        timer.sr().modify(|_, w| w.uif().clear_bit());
    }
}

/// Starts a USART and the interrupt that serves it.
pub(super) fn start_port(
    usart: &usart1::RegisterBlock,
    hz: u32,
    baud: u32,
    queues: &'static Queues,
    interrupt: Interrupt,
) -> Option<Serial> {
    // With oversampling by 16, the register holds the quotient of the clock and the baud rate, in
    // which the lower four bits are the fraction.
    let divisor = (hz + baud / 2).checked_div(baud)?;
    usart.brr().write(|w| {
        w.div_mantissa().set((divisor >> 4) as u16).div_fraction().set((divisor & 0xF) as u8)
    });
    usart.cr1().write(|w| w.ue().set_bit().te().set_bit().re().set_bit().rxneie().set_bit());
    Some(Serial::new(queues, interrupt))
}

/// Moves bytes between a USART and its queues: its interrupt.
pub(super) fn serve(usart: &usart1::RegisterBlock, queues: &Queues) {
    let Queues { received, queued } = queues;
    while received.room() > 0 {
        let status = usart.sr().read();
        // An overrun means that the byte after this one is lost; these two reads also clear that
        // flag. The checksums of the protocols detect the loss.
        if status.rxne().bit_is_clear() && status.ore().bit_is_clear() {
            break;
        }
        let byte = usart.dr().read().dr().bits() as u8;
        if status.rxne().bit_is_set() {
            received.put(byte);
        }
    }
    while usart.sr().read().txe().bit_is_set() {
        let Some(byte) = queued.take() else { break };
        usart.dr().write(|w| w.dr().set(byte.into()));
    }
    // If the queue is full, the byte stays in the USART. A sender that can wait, such as the
    // emulator's, then waits; `read` makes room and triggers the interrupt again.
    usart.cr1().modify(|_, w| w.rxneie().bit(received.room() > 0).txeie().bit(!queued.is_empty()));
}

/// Starts a USART as a port with queues, whose sizes are given in bytes, and an interrupt of its own.
/// Needs `Rcc` and the baud rate; returns an `Option<Serial>`. Use it once per USART.
macro_rules! port {
    ($usart:ident, $hz:expr, $chip:expr, $baud:expr, $sizes:expr, $rcc:expr) => {{
        use core::{cell::Cell, sync::atomic::AtomicU8};
        use cortex_m::interrupt::{self as interrupts, Mutex};
        use stm32f4xx_hal::{
            interrupt,
            pac::{Interrupt, $usart},
            rcc::Enable,
        };

        use crate::board::{
            chip::{serve, start_port},
            serial::Queues,
            unmask,
        };

        const SIZES: [usize; 2] = $sizes;
        static RECEIVED: [AtomicU8; SIZES[0]] = [const { AtomicU8::new(0) }; _];
        static QUEUED: [AtomicU8; SIZES[1]] = [const { AtomicU8::new(0) }; _];
        static QUEUES: Queues = Queues::new(&RECEIVED, &QUEUED);
        /// Hands the USART from the setup to the interrupt, which then owns it.
        static USART: Mutex<Cell<Option<$usart>>> = Mutex::new(Cell::new(None));

        #[interrupt]
        fn $usart() {
            static mut OWNED: Option<$usart> = None;
            if OWNED.is_none() {
                *OWNED = interrupts::free(|cs| USART.borrow(cs).take());
            }
            if let Some(usart) = OWNED {
                serve(usart, &QUEUES);
            }
        }

        $usart::enable($rcc);
        let usart: $usart = $chip;
        let port = start_port(&usart, $hz, $baud, &QUEUES, Interrupt::$usart);
        interrupts::free(|cs| USART.borrow(cs).set(Some(usart)));
        unmask(Interrupt::$usart);
        port
    }};
}
pub(super) use port;

/// The port that a journal is written to: UART4, at 2,000,000 baud. The main loop waits for it. No
/// pin is set up, so it leads out of an emulator alone.
#[cfg(feature = "journal")]
pub(crate) struct JournalPort(UART4);

#[cfg(feature = "journal")]
impl JournalPort {
    pub(crate) const IS_OPEN: bool = true;

    pub(super) fn open(usart: UART4, rcc: &mut Rcc) -> Self {
        UART4::enable(rcc);
        let divisor = APB1_HZ / 2_000_000;
        usart.brr().write(|w| {
            w.div_mantissa().set((divisor >> 4) as u16).div_fraction().set((divisor & 0xF) as u8)
        });
        usart.cr1().write(|w| w.ue().set_bit().te().set_bit());
        Self(usart)
    }

    pub(crate) fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            while self.0.sr().read().txe().bit_is_clear() {}
            self.0.dr().write(|w| w.dr().set(byte.into()));
        }
    }
}

/// There is no journal.
#[cfg(not(feature = "journal"))]
impl JournalPort {
    pub(super) fn open(_: UART4, _: &mut Rcc) -> Self {
        Self
    }
}

/// The watchdog's usual time, in units of 2 ms.
const USUAL_RELOAD: u16 = 1_000;

/// The watchdog resets the robot if the main loop has not run for 2 s.
pub(crate) struct Watchdog(IWDG);

impl Watchdog {
    /// Starts the watchdog, which can't be stopped. Its clock is 32 kHz, accurate to a half.
    pub(super) fn start(watchdog: IWDG) -> Self {
        watchdog.kr().write(|w| w.key().start());
        watchdog.kr().write(|w| w.key().unlock());
        watchdog.pr().write(|w| w.pr().divide_by64());
        watchdog.rlr().write(|w| w.rl().set(USUAL_RELOAD));
        Self(watchdog)
    }

    /// Changes the watchdog's time, in units of 2 ms up to 4,095, and restarts it.
    #[cfg(feature = "flash")]
    fn set(&mut self, reload: u16) {
        self.0.kr().write(|w| w.key().unlock());
        self.0.rlr().write(|w| w.rl().set(reload));
        // It counts once it has crossed to the watchdog's own clock: some 0.2 ms.
        while self.0.sr().read().rvu().bit_is_set() {}
        self.feed();
    }

    /// Restarts the watchdog's time.
    pub(crate) fn feed(&mut self) {
        self.0.kr().write(|w| w.key().feed());
    }
}

/// Does what stops the core, with its interrupts, for up to 2 s.
#[cfg(feature = "flash")]
pub(super) fn stand_still<T>(clock: Clock, watchdog: &mut Watchdog, work: impl FnOnce() -> T) -> T {
    watchdog.set(2 * USUAL_RELOAD);
    let before = (clock.now(), DWT::cycle_count());
    let done = work();
    clock.catch_up(before);
    watchdog.set(USUAL_RELOAD);
    done
}

/// Whether the watchdog caused the last reset; clears the record of it. In the emulator never.
pub(super) fn was_reset_by_watchdog(rcc: &RCC) -> bool {
    let was = rcc.csr().read().wdgrstf().bit_is_set();
    rcc.csr().modify(|_, w| w.rmvf().set_bit());
    was
}

/// A number that differs from boot to boot. It combines the chip's random number generator, its
/// unique id, and the phase of the clock. In the emulator only the phase is available. In real time that
/// depends on the host's speed: it distinguishes boots, but is not secret. In step with a simulation each boot has the
/// same.
pub(super) fn boot_nonce(noise: &RNG, rcc: &mut Rcc) -> u64 {
    RNG::enable(rcc);
    noise.cr().modify(|_, w| w.rngen().set_bit());
    let mut nonce = 0;
    // A word takes 40 cycles at 48 MHz; the limit lets the robot boot even if the generator is
    // defective.
    for _ in 0..10_000 {
        if noise.sr().read().drdy().bit_is_set() {
            nonce = mix(nonce, noise.dr().read().bits());
        }
    }
    // Only on the chip: in the emulator, reading the id would fault.
    if nonce != 0 {
        let uid = Uid::get();
        nonce = mix(nonce, u32::from(uid.x()) << 16 | u32::from(uid.y()));
        nonce = uid.lot_num().bytes().fold(nonce, |nonce, byte| mix(nonce, byte.into()));
    }
    mix(nonce, SYST::get_current())
}
