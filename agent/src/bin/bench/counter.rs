//! Counts instructions by SysTick.

use core::hint::black_box;

use cortex_m::peripheral::{SYST, syst::SystClkSource};

/// SysTick's clock in the emulator.
const CORE_HZ: u64 = 168_000_000;

/// One instruction is one nanosecond.
const INSTRUCTIONS_PER_SECOND: u64 = 1_000_000_000;

/// SysTick's period, the longest it has: 99.8 million instructions.
const PERIOD: u32 = 1 << 24;

/// Instructions in so many ticks.
pub(crate) fn instructions(ticks: u64) -> u64 {
    ticks * INSTRUCTIONS_PER_SECOND / CORE_HZ
}

/// Measures by SysTick.
pub(crate) struct Bench {
    systick: SYST,
    /// What measuring nothing takes.
    overhead: u32,
}

impl Bench {
    /// Starts SysTick.
    pub(crate) fn new(mut systick: SYST) -> Self {
        systick.set_clock_source(SystClkSource::Core);
        systick.set_reload(PERIOD - 1);
        systick.clear_current();
        systick.enable_counter();
        // From zero it steps to the top.
        while SYST::get_current() == 0 {}
        let mut bench = Self { systick, overhead: 0 };
        bench.overhead = bench.ticks(|| ()).1.unwrap_or(0);
        bench
    }

    /// Runs a stage once: what it gives, and the ticks that it takes, of six instructions each;
    /// `None` if they may be more than a period.
    pub(crate) fn count<T>(&mut self, stage: impl FnOnce() -> T) -> (T, Option<u32>) {
        let (result, ticks) = self.ticks(stage);
        (result, ticks.map(|ticks| ticks.saturating_sub(self.overhead)))
    }

    /// The same, what measuring takes included.
    fn ticks<T>(&mut self, stage: impl FnOnce() -> T) -> (T, Option<u32>) {
        // It counts down, and wraps at most once within a period.
        self.systick.has_wrapped();
        let start = SYST::get_current();
        let result = black_box(stage());
        let end = SYST::get_current();
        let wrapped = self.systick.has_wrapped();
        let ticks = match (wrapped, start.checked_sub(end)) {
            (false, ticks) => ticks,
            (true, None) => Some(start + PERIOD - end),
            (true, Some(_)) => None,
        };
        (result, ticks)
    }
}
