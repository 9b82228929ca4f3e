//! The slots of the robot's identity in the STM32F405's flash: its last two sectors, of 128 KiB each.
//! Erasing one takes 1 to 2 s, in which the core stands still: every 32,727 boots, and when parameters are stored.
//!
//! The emulator ignores writing, so there a robot with a key refuses to run.

use core::ptr;

use cortex_m::asm;
use stm32f4xx_hal::pac::FLASH;
use ubimap_agent::flash::{NorFlash, Slot};

/// The last two sectors of the flash.
pub(crate) struct Sectors(pub(super) FLASH);

/// The slots.
pub(crate) type Slots = Sectors;

/// Size of a sector in bytes.
const SECTOR: usize = 128 << 10;

/// The number and the address of a slot's sector.
fn sector(slot: Slot) -> (u8, usize) {
    match slot {
        Slot::First => (10, 0x080C_0000),
        Slot::Second => (11, 0x080E_0000),
    }
}

impl Sectors {
    fn unlock(&self) {
        if self.0.cr().read().lock().bit_is_set() {
            for key in [0x4567_0123, 0xCDEF_89AB] {
                self.0.keyr().write(|w| w.key().set(key));
            }
        }
    }

    /// Waits for the end of an operation, and locks.
    fn finish(&self) {
        asm::dsb();
        while self.0.sr().read().bsy().bit_is_set() {}
        self.0.cr().write(|w| w.lock().set_bit());
    }

    /// Discards what the data cache holds of an erased sector.
    fn clear_cache(&self) {
        let acr = self.0.acr();
        if acr.read().dcen().bit_is_set() {
            acr.modify(|_, w| w.dcen().clear_bit());
            acr.modify(|_, w| w.dcrst().set_bit());
            acr.modify(|_, w| w.dcrst().clear_bit());
            acr.modify(|_, w| w.dcen().set_bit());
        }
    }
}

impl NorFlash for Sectors {
    const WORD: usize = 4;

    fn slot_len(&self) -> usize {
        SECTOR
    }

    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]) {
        let (_, start) = sector(slot);
        let len = bytes.len().min(SECTOR.saturating_sub(at));
        for (offset, byte) in bytes.iter_mut().take(len).enumerate() {
            #[allow(unsafe_code, reason = "flash is read at its address")]
            // SAFETY: the address is within the sector, which is always readable.
            let value = unsafe { ptr::read_volatile((start + at + offset) as *const u8) };
            *byte = value;
        }
    }

    fn program(&mut self, slot: Slot, at: usize, bytes: &[u8]) {
        let (_, start) = sector(slot);
        let words = bytes.as_chunks::<4>().0;
        for (offset, word) in (at..SECTOR).step_by(4).zip(words) {
            self.unlock();
            // By 32 bits, for which the chip needs 2.7 V.
            self.0.cr().write(|w| w.pg().set_bit().psize().psize32());
            #[allow(unsafe_code, reason = "flash is programmed at its address")]
            // SAFETY: the address is within a sector that holds neither code nor data of the image.
            unsafe {
                ptr::write_volatile((start + offset) as *mut u32, u32::from_le_bytes(*word));
            }
            self.finish();
        }
    }

    fn erase(&mut self, slot: Slot) {
        let (number, _) = sector(slot);
        self.unlock();
        #[allow(unsafe_code, reason = "a sector's number is not checked")]
        // SAFETY: the sector holds neither code nor data of the image.
        self.0.cr().write(|w| unsafe { w.ser().set_bit().psize().psize32().snb().bits(number) });
        self.0.cr().modify(|_, w| w.strt().set_bit());
        self.finish();
        self.clear_cache();
    }
}
