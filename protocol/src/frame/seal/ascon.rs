//! Authenticated encryption: Ascon-AEAD128 (NIST SP 800-232).
//!
//! Without the feature `seals` a [`Key`] has no value, so the compiler removes everything that
//! handles one.

use core::fmt;

#[cfg(feature = "seals")]
use ascon_aead::{
    AsconAead128,
    aead::{AeadInOut, KeyInit},
};

/// Size of a key in bytes.
pub const KEY_LEN: usize = 16;
/// Size of an authentication tag in bytes.
pub const TAG_LEN: usize = 16;
/// Size of a nonce in bytes.
pub(super) const NONCE_LEN: usize = 16;

#[cfg(feature = "seals")]
type Secret = [u8; KEY_LEN];
#[cfg(feature = "seals")]
type Present = ();
#[cfg(not(feature = "seals"))]
type Secret = core::convert::Infallible;
#[cfg(not(feature = "seals"))]
type Present = core::convert::Infallible;

/// Proof that this build can seal: it has no value without the feature `seals`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SealSupport(Present);

#[cfg(feature = "seals")]
impl SealSupport {
    /// The proof.
    pub const PRESENT: Self = Self(());
}

/// A secret key of 128 bits. Its bytes are not printed.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Key(Secret);

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Key(..)")
    }
}

#[cfg(feature = "seals")]
impl Key {
    /// A key from its bytes, which must be random.
    pub const fn new(bytes: [u8; KEY_LEN]) -> Self {
        Self(bytes)
    }

    /// The key's bytes, to store them.
    pub fn bytes(&self) -> &[u8; KEY_LEN] {
        &self.0
    }

    /// Proof that this build can seal.
    pub fn support(&self) -> SealSupport {
        SealSupport::PRESENT
    }

    /// Encrypts `text` in place. Returns the tag, which also covers `clear`. A nonce must not
    /// be used twice with one key.
    // Not inlined: it is called for several kinds of frames, and flash is scarce.
    #[inline(never)]
    pub(super) fn seal(
        &self,
        nonce: &[u8; NONCE_LEN],
        clear: &[u8],
        text: &mut [u8],
    ) -> [u8; TAG_LEN] {
        let cipher = AsconAead128::new(&self.0.into());
        let tag = cipher.encrypt_inout_detached(&(*nonce).into(), clear, text.into());
        // It fails only beyond 2^64 bytes.
        tag.map_or([0; TAG_LEN], Into::into)
    }

    /// Decrypts `text` in place if the tag is good. Otherwise returns false, and `text` is
    /// zeroed.
    #[inline(never)]
    pub(super) fn open(
        &self,
        nonce: &[u8; NONCE_LEN],
        clear: &[u8],
        text: &mut [u8],
        tag: &[u8; TAG_LEN],
    ) -> bool {
        let cipher = AsconAead128::new(&self.0.into());
        let (nonce, tag) = ((*nonce).into(), (*tag).into());
        cipher.decrypt_inout_detached(&nonce, clear, text.into(), &tag).is_ok()
    }

    /// A key that was derived from this one.
    pub(super) fn derived(&self, bytes: [u8; KEY_LEN]) -> Self {
        Self(bytes)
    }
}

#[cfg(not(feature = "seals"))]
impl Key {
    /// Proof that this build can seal.
    pub fn support(&self) -> SealSupport {
        match self.0 {}
    }

    pub(super) fn seal(&self, _: &[u8; NONCE_LEN], _: &[u8], _: &mut [u8]) -> [u8; TAG_LEN] {
        match self.0 {}
    }

    pub(super) fn open(
        &self,
        _: &[u8; NONCE_LEN],
        _: &[u8],
        _: &mut [u8],
        _: &[u8; TAG_LEN],
    ) -> bool {
        match self.0 {}
    }

    pub(super) fn derived(&self, _: [u8; KEY_LEN]) -> Self {
        match self.0 {}
    }
}

#[cfg(test)]
#[cfg(feature = "seals")]
mod tests {
    use super::*;

    const BYTES: [u8; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];
    const NONCE: [u8; 16] = [16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31];

    /// Known answers of Ascon-AEAD128 from `tests/python/ubimap_seals.py`, a plain implementation of
    /// NIST SP 800-232 that shares nothing with this crate.
    #[test]
    fn texts_of_all_lengths_have_the_tags_of_another_implementation() {
        // Lengths of text and clear bytes; the last eight bytes of the ciphertext, and the tag, as
        // little-endian numbers. The first two are known answers of the standard's authors.
        let known = [
            (0, 0, 0x0000000000000000, 0xc62e8bee468ff66b31c9be1182279c4f),
            (0, 1, 0x0000000000000000, 0xc07556b311abd685a2098ae14f67cbcc),
            (1, 0, 0x00000000000000e8, 0x8895b7ed2ae04d70fce6d31cba6a57dd),
            (8, 5, 0xbbf38bba8c657630, 0x169b39d0b80a9ec0867c02d3ee924f09),
            (15, 16, 0x3ec199f30c09ac9b, 0x488917d648eb41037704040bc8e06b64),
            (16, 15, 0x1360ac4dd321a649, 0xb6552278abc1f9f5a7c46cd4b78b2472),
            (17, 33, 0x8d4e714b110c0066, 0xf51e1c8661e811a5fd831c4ff426da6c),
            (226, 6, 0xea5483872e99418c, 0xe3d1628049503d127fe9ec6a38468ad5),
        ];
        let bytes = |first: u8, len: usize| (0..len).map(move |at| first.wrapping_add(at as u8));
        for (len, clear, end, tag) in known {
            let mut text: std::vec::Vec<u8> = bytes(0x20, len).collect();
            let clear: std::vec::Vec<u8> = bytes(0x30, clear).collect();
            let found = Key::new(BYTES).seal(&NONCE, &clear, &mut text);
            assert_eq!(u128::from_le_bytes(found), tag, "{len}");
            let last = text.iter().rev().take(8).fold(0, |all, &byte| all << 8 | u64::from(byte));
            assert_eq!(last, end, "{len}");
            assert!(Key::new(BYTES).open(&NONCE, &clear, &mut text, &found));
            assert!(text.iter().copied().eq(bytes(0x20, len)));
        }
    }
}
