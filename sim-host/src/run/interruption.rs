//! SIGINT (Ctrl-C) and SIGTERM: the first one ends a run in order, the second one at once.
//!
//! Signals concern the whole process, so the flag is a static like the logger.

use std::sync::atomic::{AtomicBool, Ordering};

/// The exit code of a program that SIGINT has ended, by the convention of shells.
const ENDED_AT_ONCE: i32 = 130;

static IS_REQUESTED: AtomicBool = AtomicBool::new(false);

/// Handles both signals from now on. Until it is called, they end the process at once.
pub fn listen() {
    let handler = || {
        if IS_REQUESTED.swap(true, Ordering::Relaxed) {
            std::process::exit(ENDED_AT_ONCE);
        }
    };
    if let Err(error) = ctrlc::set_handler(handler) {
        log::warn!("Ctrl-C will end the program without results: {error}");
    }
}

/// Whether a signal has arrived.
pub fn is_requested() -> bool {
    IS_REQUESTED.load(Ordering::Relaxed)
}
