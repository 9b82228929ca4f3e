//! Ends an image for the emulator with an exit code.

use core::panic::PanicInfo;

use cortex_m::asm;
use cortex_m_semihosting::debug;

/// Exits the emulator; `None` is a failure.
pub(crate) fn end(outcome: Option<()>) -> ! {
    let status = if outcome.is_some() { debug::EXIT_SUCCESS } else { debug::EXIT_FAILURE };
    debug::exit(status);
    loop {
        asm::wfi();
    }
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    end(None)
}
