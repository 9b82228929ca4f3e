//! Instruction counts of the agent's stages: `cargo instructions`.
//!
//! It needs QEMU with `-icount shift=0`, where every instruction takes one nanosecond of the
//! emulated clock, and semihosting to print its table. It counts instructions, not cycles: the
//! same number in every run, whatever the host.
#![no_std]
#![no_main]

use core::{hint::black_box, panic::PanicInfo};

use cortex_m::{
    Peripherals, asm,
    peripheral::{SYST, syst::SystClkSource},
};
use cortex_m_rt::entry;
use cortex_m_semihosting::{debug, hprintln};
// For its table of interrupt vectors.
use stm32f4xx_hal as _;

/// SysTick's clock in the emulator.
const CORE_HZ: u64 = 168_000_000;

/// One instruction is one nanosecond.
const INSTRUCTIONS_PER_SECOND: u64 = 1_000_000_000;

/// SysTick's period, the longest it has: 99.8 million instructions.
const PERIOD: u32 = 1 << 24;

#[entry]
fn main() -> ! {
    match Peripherals::take() {
        Some(core) => {
            run(&mut Bench::new(core.SYST));
            debug::exit(debug::EXIT_SUCCESS);
        }
        None => debug::exit(debug::EXIT_FAILURE),
    }
    loop {
        asm::wfi();
    }
}

/// The table.
fn run(bench: &mut Bench) {
    hprintln!("{:>12}  stage", "instructions");
    for rounds in [0u32, 1, 1_000, 1_000_000] {
        bench.measure(format_args!("{rounds} rounds of a shift register"), || {
            let mut state = black_box(1u32);
            for _ in 0..black_box(rounds) {
                state = state >> 1 ^ (state & 1).wrapping_neg() & 0xD000_0001;
            }
            black_box(state);
        });
    }
}

/// Measures by SysTick.
struct Bench {
    systick: SYST,
    /// What measuring nothing takes.
    overhead: u32,
}

impl Bench {
    fn new(mut systick: SYST) -> Self {
        systick.set_clock_source(SystClkSource::Core);
        systick.set_reload(PERIOD - 1);
        systick.clear_current();
        systick.enable_counter();
        // From zero it steps to the top.
        while SYST::get_current() == 0 {}
        let mut bench = Self { systick, overhead: 0 };
        bench.overhead = bench.ticks(|| ()).unwrap_or(0);
        bench
    }

    /// Runs a stage once and prints a line of the table, exact to a tick: six instructions.
    fn measure(&mut self, name: impl core::fmt::Display, stage: impl FnOnce()) {
        match self.ticks(stage) {
            Some(ticks) => {
                let net = u64::from(ticks.saturating_sub(self.overhead));
                hprintln!("{:>12}  {}", net * INSTRUCTIONS_PER_SECOND / CORE_HZ, name);
            }
            None => hprintln!("{:>12}  {}", "too many", name),
        }
    }

    /// The ticks that a stage takes; `None` if they may be more than a period.
    fn ticks(&mut self, stage: impl FnOnce()) -> Option<u32> {
        // It counts down, and wraps at most once within a period.
        self.systick.has_wrapped();
        let start = SYST::get_current();
        stage();
        let end = SYST::get_current();
        let wrapped = self.systick.has_wrapped();
        match (wrapped, start.checked_sub(end)) {
            (false, ticks) => ticks,
            (true, None) => Some(start + PERIOD - end),
            (true, Some(_)) => None,
        }
    }
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    debug::exit(debug::EXIT_FAILURE);
    loop {
        asm::wfi();
    }
}
