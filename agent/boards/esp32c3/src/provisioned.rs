//! What `ubimap provision` has written into the image.

use core::ptr;

use ubimap_agent::flash::{Seed, UNPROVISIONED, WITHOUT_NETWORK, Wireless};

/// `ubimap provision` finds these places by their first bytes.
static SEED: [u8; UNPROVISIONED.len()] = UNPROVISIONED;
static WIRELESS: [u8; WITHOUT_NETWORK.len()] = WITHOUT_NETWORK;

/// The robot's number, key and parameters.
pub(crate) fn seed() -> Option<Seed> {
    Seed::parse(&read(&SEED))
}

/// The robot's network and server.
pub(crate) fn wireless() -> Option<Wireless> {
    Wireless::parse(&read(&WIRELESS))
}

fn read<const N: usize>(place: &'static [u8; N]) -> [u8; N] {
    #[allow(unsafe_code, reason = "the compiler must not assume the static's value")]
    // SAFETY: the pointer is that of a static.
    unsafe {
        ptr::read_volatile(&raw const *place)
    }
}
