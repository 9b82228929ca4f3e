//! Flash that is programmed by whole pages, such as the SPI flash of a Raspberry Pi Pico by the chip's ROM.

use super::slots::{NorFlash, Slot};

/// Size of a page in bytes.
pub const PAGE: usize = 256;

/// Flash whose slots are erased as a whole and programmed by pages. Each bit of a page can be cleared on its own.
pub trait PagedFlash {
    /// Size of a slot in bytes, a multiple of [`PAGE`].
    fn slot_len(&self) -> usize;

    /// Reads from a slot. The range is within the slot.
    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]);

    /// Clears the bits that are 0 in `page`. It begins `at` a multiple of [`PAGE`] and is within the slot.
    fn program(&mut self, slot: Slot, at: usize, page: &[u8; PAGE]);

    /// Sets all bits of a slot.
    fn erase(&mut self, slot: Slot);
}

/// Programs words of 16 bytes: the pages that they are in have ones around them. SPI flashes that correct errors do so
/// by words of this size, so no such word is programmed twice, except to zero.
#[derive(Clone, Debug)]
pub struct Paged<F>(pub F);

impl<F: PagedFlash> NorFlash for Paged<F> {
    const WORD: usize = 16;

    fn slot_len(&self) -> usize {
        self.0.slot_len()
    }

    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]) {
        self.0.read(slot, at, bytes);
    }

    fn program(&mut self, slot: Slot, mut at: usize, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let offset = at % PAGE;
            let (these, later) = bytes.split_at(bytes.len().min(PAGE - offset));
            let mut page = [0xFF; PAGE];
            page.iter_mut().skip(offset).zip(these).for_each(|(to, from)| *to = *from);
            self.0.program(slot, at - offset, &page);
            (at, bytes) = (at + these.len(), later);
        }
    }

    fn erase(&mut self, slot: Slot) {
        self.0.erase(slot);
    }
}
