//! The slots of the robot's identity: the first two sectors of the partition `nvs`, at 0x9000 and 0xA000.
//!
//! The partition table is before them, and an image begins at 0x10000 at the earliest. The radio's driver
//! writes nothing there. By the usual flash chips' data sheets erasing one takes 50 to 400 ms, every 984 boots, and when
//! parameters are stored.

use core::cell::RefCell;

use esp_hal::peripherals::FLASH;
use esp_storage::FlashStorage;
use ubimap_agent::flash::{NorFlash, Slot};

/// Size of a sector in bytes.
const SECTOR: u32 = FlashStorage::SECTOR_SIZE;

/// Flash with the two slots.
pub(crate) struct Sectors(RefCell<FlashStorage<'static>>);

impl Sectors {
    pub(crate) fn new(flash: FLASH<'static>) -> Self {
        Self(RefCell::new(FlashStorage::new(flash)))
    }
}

/// The address of a slot's sector.
fn start(slot: Slot) -> u32 {
    match slot {
        Slot::First => 0x9000,
        Slot::Second => 0xA000,
    }
}

// What fails is found when it is read back.
impl NorFlash for Sectors {
    const WORD: usize = FlashStorage::WRITE_SIZE;

    fn slot_len(&self) -> usize {
        SECTOR as usize
    }

    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]) {
        if self.0.borrow_mut().read_nor(start(slot) + at as u32, bytes).is_err() {
            bytes.fill(0xFF);
        }
    }

    fn program(&mut self, slot: Slot, at: usize, bytes: &[u8]) {
        let _ = self.0.get_mut().write_nor(start(slot) + at as u32, bytes);
    }

    fn erase(&mut self, slot: Slot) {
        let _ = self.0.get_mut().erase(start(slot), start(slot) + SECTOR);
    }
}
