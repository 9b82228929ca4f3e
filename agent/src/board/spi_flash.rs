//! The slots of the robot's identity in a Pico's flash: its last two sectors, of 4 KiB each.
//!
//! The image runs from this flash, which can't be read while it is written. So the ROM's routines write it, called by
//! a function in RAM, with interrupts masked: up to 3 ms for a page, and 45 to 400 ms for a sector (W25Q16JV), every
//! 245 boots. USB is not served in that time (by the data sheet its controller tells the host to wait), nor are the
//! ports: the slots are written before these start, and when parameters are stored, while the wheels stand.
//!
//! Tried in the emulator rp2040js for the RP2040, with stand-ins for the ROM (`tests/tests/pico.rs`); never on a board.

use core::{mem, ptr};

use cortex_m::{
    asm,
    interrupt::{self as interrupts},
};
use ubimap_agent::flash::{PAGE, Paged, PagedFlash, Slot};

use super::chip::{SETUP_WORDS, flash_setup, hal::rom_data};

/// The last two sectors of the flash.
pub(crate) struct Sectors;

/// The slots.
pub(crate) type Slots = Paged<Sectors>;

/// Size of a sector in bytes.
const SECTOR: usize = 4 << 10;

/// Where the flash begins: the ROM's routines count from there.
const FLASH: usize = 0x1000_0000;

#[allow(unsafe_code, reason = "memory.x says where they are")]
// SAFETY: they are the linker's, in flash that no image reaches, and only their address is used.
unsafe extern "C" {
    safe static SLOTS: [[u8; SECTOR]; 2];
}

/// The address of a slot.
fn start(slot: Slot) -> usize {
    (&raw const SLOTS).addr() + slot as usize * SECTOR
}

impl PagedFlash for Sectors {
    fn slot_len(&self) -> usize {
        SECTOR
    }

    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]) {
        let len = bytes.len().min(SECTOR.saturating_sub(at));
        for (offset, byte) in bytes.iter_mut().take(len).enumerate() {
            #[allow(unsafe_code, reason = "flash is read at its address")]
            // SAFETY: the address is within the slot, which can be read except within `write`.
            let value = unsafe { ptr::read_volatile((start(slot) + at + offset) as *const u8) };
            *byte = value;
        }
    }

    fn program(&mut self, slot: Slot, at: usize, page: &[u8; PAGE]) {
        if at < SECTOR {
            change(start(slot) + at, page.as_ptr());
        }
    }

    fn erase(&mut self, slot: Slot) {
        change(start(slot), ptr::null());
    }
}

type Routine = unsafe extern "C" fn();

/// What writes the flash, all of it out of the flash.
struct Routines {
    connect: Routine,
    leave_reading: Routine,
    erase: unsafe extern "C" fn(u32, usize, u32, u8),
    program: unsafe extern "C" fn(u32, *const u8, usize),
    flush_cache: Routine,
    enter_reading: Routine,
}

/// Programs a page of a slot, or erases a sector if `page` is null, at this address.
fn change(address: usize, page: *const u8) {
    // A copy in RAM of what makes the flash readable; it may be anywhere.
    let setup: [u32; SETUP_WORDS] = flash_setup();
    #[allow(unsafe_code, reason = "the copy is code")]
    // SAFETY: it is a function that takes nothing and returns, entered at its beginning, in Thumb state.
    let enter_reading = unsafe { mem::transmute::<usize, Routine>(setup.as_ptr().addr() | 1) };
    let routines = Routines {
        connect: rom_data::connect_internal_flash::ptr(),
        leave_reading: rom_data::flash_exit_xip::ptr(),
        erase: rom_data::flash_range_erase::ptr(),
        program: rom_data::flash_range_program::ptr(),
        flush_cache: rom_data::flash_flush_cache::ptr(),
        enter_reading,
    };
    let offset = (address - FLASH) as u32;
    interrupts::free(|_| {
        // The copy is complete before it is run.
        asm::dsb();
        asm::isb();
        #[allow(unsafe_code, reason = "nothing may read the flash meanwhile")]
        // SAFETY: no interrupt, no other core and no DMA runs; a slot holds neither code nor data of the image.
        unsafe {
            write(&routines, offset, page);
        }
    });
}

/// Writes the flash, as the chips' data sheets describe it. It runs in RAM, where the start-up code copies it to.
///
/// # Safety
/// Nothing else may read the flash meanwhile, and nothing may rely on what is there.
#[allow(unsafe_code, reason = "it must not be in the flash")]
#[inline(never)]
#[unsafe(link_section = ".data.write_flash")]
unsafe extern "C" fn write(routines: &Routines, offset: u32, page: *const u8) {
    /// A larger piece that is erased at once, and the command for it: not used for one sector.
    const BLOCK: (u32, u8) = (64 << 10, 0xD8);
    // SAFETY: by the caller. These are calls by address, and what they need was read before.
    unsafe {
        (routines.connect)();
        (routines.leave_reading)();
        if page.is_null() {
            (routines.erase)(offset, SECTOR, BLOCK.0, BLOCK.1);
        } else {
            (routines.program)(offset, page, PAGE);
        }
        (routines.flush_cache)();
        (routines.enter_reading)();
    }
}
