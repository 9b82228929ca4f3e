//! Counts instructions with SysTick.

use core::hint::black_box;

use cortex_m::peripheral::{SYST, syst::SystClkSource};

/// SysTick's clock in the emulated STM32F405; in the emulated Cortex-M33, for which the image is built
/// without `cortex`.
const SYSTICK_HZ: u64 = if cfg!(feature = "cortex") { 168_000_000 } else { 20_000_000 };

/// In the emulator one instruction takes one nanosecond.
const INSTRUCTIONS_PER_SECOND: u64 = 1_000_000_000;

/// SysTick's maximum period: at least 99.8 million instructions.
const PERIOD: u32 = 1 << 24;

/// Converts ticks to instructions.
pub(crate) fn instructions(ticks: u64) -> u64 {
    ticks * INSTRUCTIONS_PER_SECOND / SYSTICK_HZ
}

/// Measures with SysTick.
pub(crate) struct Bench {
    systick: SYST,
    /// Ticks of an empty measurement.
    overhead: u32,
}

impl Bench {
    /// Starts SysTick.
    pub(crate) fn new(mut systick: SYST) -> Self {
        systick.set_clock_source(SystClkSource::Core);
        systick.set_reload(PERIOD - 1);
        systick.clear_current();
        systick.enable_counter();
        // SysTick starts at zero and reloads.
        while SYST::get_current() == 0 {}
        let mut bench = Self { systick, overhead: 0 };
        bench.overhead = bench.ticks(|| ()).1.unwrap_or(0);
        bench
    }

    /// Runs a stage once. Returns its result and its duration in ticks, `None` instead
    /// of the duration if it may exceed SysTick's period.
    pub(crate) fn count<T>(&mut self, stage: impl FnOnce() -> T) -> (T, Option<u32>) {
        let (result, ticks) = self.ticks(stage);
        (result, ticks.map(|ticks| ticks.saturating_sub(self.overhead)))
    }

    /// Like `count`, including the overhead of measuring.
    fn ticks<T>(&mut self, stage: impl FnOnce() -> T) -> (T, Option<u32>) {
        // SysTick counts down, and wraps at most once within a period. It sets the flag at zero, one tick
        // before it reloads; the emulator may set it a little after that.
        self.systick.has_wrapped();
        let start = SYST::get_current();
        let result = black_box(stage());
        let has_wrapped = self.systick.has_wrapped();
        let end = SYST::get_current();
        let has_just_wrapped = start > PERIOD - 64;
        let wrapped = has_wrapped && !has_just_wrapped && end != 0;
        let ticks = match start.checked_sub(end) {
            None => Some(start + PERIOD - end),
            Some(_) if wrapped => None,
            ticks => ticks,
        };
        (result, ticks)
    }
}
