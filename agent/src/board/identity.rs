//! What the image and the flash say of the robot.

use core::ptr;

use ubimap_agent::flash::{Identity, NorFlash, Seed, UNPROVISIONED, identify};

/// Where `ubimap provision` writes; it finds the place by its first bytes.
static SEED: [u8; UNPROVISIONED.len()] = UNPROVISIONED;

/// Reads the robot's identity and counts the boot: usually some milliseconds.
pub(super) fn identity(flash: &mut impl NorFlash) -> Identity {
    #[allow(unsafe_code, reason = "the compiler must not assume the static's value")]
    // SAFETY: the pointer is that of a static.
    let seed = unsafe { ptr::read_volatile(&raw const SEED) };
    identify(flash, Seed::parse(&seed))
}
