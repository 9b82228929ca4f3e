//! No slots: writing the flash that the code runs from was not built for this chip.
//!
//! The robot takes number and parameters from its image. One with a key refuses to run, as nothing keeps the
//! number of its boots.

use ubimap_agent::flash::{NorFlash, Slot};

/// Flash that reads as erased and ignores writing.
pub(super) struct NoFlash;

impl NorFlash for NoFlash {
    const WORD: usize = 4;

    fn slot_len(&self) -> usize {
        4_096
    }

    fn read(&self, _: Slot, _: usize, bytes: &mut [u8]) {
        bytes.fill(0xFF);
    }

    fn program(&mut self, _: Slot, _: usize, _: &[u8]) {}

    fn erase(&mut self, _: Slot) {}
}
