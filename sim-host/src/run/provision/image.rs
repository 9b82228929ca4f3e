//! The places of a robot's seed and of its network in an ELF, BIN or UF2 image.
//!
//! The magic is searched in what is loaded: an ELF's segments, a UF2's blocks in the order of their
//! addresses, all of a BIN.

use std::ops::Range;

/// Why an image has no place for a seed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ImageFault {
    /// There is no magic.
    #[error("has no place for a robot's number; build it with `cargo firmware --features flash`")]
    NoPlace,
    /// There is no magic of a network.
    #[error("has no place for a Wi-Fi network; `cargo esp32c3` builds an image with one")]
    NoNetwork,
    /// The magic is there more than once, or the image ends within its seed.
    #[error("has several places for what was given, or an incomplete one; build it anew")]
    WrongPlace,
    /// An image file of Espressif's, whose checksum would no longer fit.
    #[error(
        "has a checksum, so a robot's number can't be written into it; give the ELF that it is made of"
    )]
    Summed,
    /// An ELF for a chip that takes no UF2 files, or another kind of file.
    #[error("can't become a UF2 file: it is not an ELF image for an RP2040 or RP2350")]
    NoUf2,
    /// An ELF or UF2 whose tables lead nowhere.
    #[error("is damaged: its {0} do not fit its length; build it anew")]
    Damaged(&'static str),
}

/// Length of the magic at the beginning of a place.
const MAGIC_LEN: usize = 16;

/// Writes bytes, such as a seed, over those in the image that begin with the same magic. The image is
/// unchanged if that fails.
pub(super) fn patch(image: &mut [u8], bytes: &[u8]) -> Result<(), ImageFault> {
    let magic = bytes.get(..MAGIC_LEN).ok_or(ImageFault::NoPlace)?;
    let pieces = if image.starts_with(ELF_MAGIC) {
        let segments = segments(image).ok_or(ImageFault::Damaged("segments"))?;
        segments.into_iter().map(|(_, range)| vec![range]).collect()
    } else if word(image, 0) == Some(UF2_MAGIC[0]) {
        blocks(image).ok_or(ImageFault::Damaged("blocks"))?
    } else if image.first() == Some(&ESPRESSIF_MAGIC) {
        return Err(ImageFault::Summed);
    } else {
        vec![vec![0..image.len()]]
    };
    let mut places = Vec::new();
    for ranges in pieces {
        // Where each loaded byte is in the file.
        let at: Vec<usize> = ranges.into_iter().flatten().collect();
        let loaded: Vec<u8> = at.iter().map(|&at| image[at]).collect();
        for (first, window) in loaded.windows(MAGIC_LEN).enumerate() {
            if window == magic {
                let place = at.get(first..first + bytes.len()).ok_or(ImageFault::WrongPlace)?;
                places.push(place.to_vec());
            }
        }
    }
    match &places[..] {
        [] => Err(ImageFault::NoPlace),
        [place] => {
            place.iter().zip(bytes).for_each(|(&at, &byte)| image[at] = byte);
            Ok(())
        }
        _ => Err(ImageFault::WrongPlace),
    }
}

/// The first byte of Espressif's image files. The others begin with the address of a stack, which is even.
const ESPRESSIF_MAGIC: u8 = 0xE9;

/// The first bytes of an ELF.
pub(super) const ELF_MAGIC: &[u8] = b"\x7FELF";

/// The parts of the file that an ELF (32 bits, little-endian) loads, each with its physical address.
pub(super) fn segments(elf: &[u8]) -> Option<Vec<(usize, Range<usize>)>> {
    const LOAD: usize = 1;
    if elf.get(4..6)? != [1, 1] {
        return None;
    }
    let (table, size, count) = (word(elf, 28)?, half(elf, 42)?, half(elf, 44)?);
    let mut found = Vec::new();
    for index in 0..count {
        let header = table + index * size;
        let [kind, from, address, len] =
            [0, 4, 12, 16].map(|field| word(elf, header.checked_add(field)?));
        let (kind, from, len) = (kind?, from?, len?);
        if kind == LOAD {
            let range = from..from.checked_add(len)?;
            elf.get(range.clone())?;
            found.push((address?, range));
        }
    }
    Some(found)
}

/// The first, second and last word of a UF2 block.
pub(super) const UF2_MAGIC: [usize; 3] = [0x0A32_4655, 0x9E5D_5157, 0x0AB1_6F30];

/// Size of a UF2 block, its header and its last word, in bytes.
pub(super) const UF2_BLOCK: usize = 512;

/// The parts of the file that a UF2 flashes, in the order of their addresses: blocks that follow each
/// other in flash are one piece.
fn blocks(uf2: &[u8]) -> Option<Vec<Vec<Range<usize>>>> {
    const NOT_FLASHED: usize = 1;
    if !uf2.len().is_multiple_of(UF2_BLOCK) {
        return None;
    }
    let mut found = Vec::new();
    for at in (0..uf2.len()).step_by(UF2_BLOCK) {
        if [word(uf2, at)?, word(uf2, at + 4)?, word(uf2, at + 508)?] != UF2_MAGIC {
            return None;
        }
        let (flags, address, len) = (word(uf2, at + 8)?, word(uf2, at + 12)?, word(uf2, at + 16)?);
        if len > 476 {
            return None;
        }
        if flags & NOT_FLASHED == 0 {
            found.push((address, at + 32..at + 32 + len));
        }
    }
    found.sort_by_key(|(address, _)| *address);
    let mut pieces: Vec<Vec<Range<usize>>> = Vec::new();
    let mut end = None;
    for (address, range) in found {
        let next = Some(address + range.len());
        match pieces.last_mut() {
            Some(piece) if end == Some(address) => piece.push(range),
            _ => pieces.push(vec![range]),
        }
        end = next;
    }
    Some(pieces)
}

fn word(bytes: &[u8], at: usize) -> Option<usize> {
    let word = bytes.get(at..at.checked_add(4)?)?;
    usize::try_from(u32::from_le_bytes(word.try_into().ok()?)).ok()
}

fn half(bytes: &[u8], at: usize) -> Option<usize> {
    let half = bytes.get(at..at.checked_add(2)?)?;
    Some(u16::from_le_bytes(half.try_into().ok()?).into())
}

#[cfg(test)]
mod tests {
    use super::{super::uf2, *};
    use ubimap_agent::flash::{MAGIC, SEED_LEN, UNPROVISIONED};

    const SEED: [u8; SEED_LEN] = {
        let mut seed = [0x5A; SEED_LEN];
        seed.split_at_mut(MAGIC.len()).0.copy_from_slice(&MAGIC);
        seed
    };

    fn flash() -> Vec<u8> {
        [&[1; 200][..], &UNPROVISIONED, &[2; 300]].concat()
    }

    fn provisioned() -> Vec<u8> {
        [&[1; 200][..], &SEED, &[2; 300]].concat()
    }

    fn uf2(flash: &[u8]) -> Vec<u8> {
        let pages = flash.chunks(256).enumerate();
        uf2::file(&pages.map(|(index, page)| (256 * index as u32, page.to_vec())).collect(), 1)
    }

    /// An ELF with one segment, and the magic once more behind it, as debug information.
    fn elf(flash: &[u8]) -> Vec<u8> {
        let mut file = vec![0; 52 + 32];
        file[..6].copy_from_slice(b"\x7FELF\x01\x01");
        let mut put = |at: usize, value: u32| {
            file[at..at + 4].copy_from_slice(&value.to_le_bytes());
        };
        put(28, 52);
        put(40, 32 << 16);
        put(44, 1);
        put(52, 1);
        put(56, 84);
        put(68, flash.len() as u32);
        [&file, flash, &MAGIC].concat()
    }

    #[test]
    fn the_seed_is_written_and_nothing_else() {
        type Form = fn(&[u8]) -> Vec<u8>;
        let forms: [Form; 3] = [<[u8]>::to_vec, uf2, elf];
        for (index, form) in forms.into_iter().enumerate() {
            let mut image = form(&flash());
            patch(&mut image, &SEED).unwrap();
            assert!(image == form(&provisioned()), "form {index}");
            // There is no second place, and no place without the magic.
            for (flash, fault) in [
                ([flash(), flash()].concat(), ImageFault::WrongPlace),
                (vec![7; 999], ImageFault::NoPlace),
                (flash()[..300].to_vec(), ImageFault::WrongPlace),
            ] {
                let image = form(&flash);
                let mut patched = image.clone();
                assert_eq!(patch(&mut patched, &SEED), Err(fault), "form {index}");
                assert!(patched == image);
            }
        }
    }

    #[test]
    fn images_with_a_checksum_are_refused() {
        let mut image = [&[ESPRESSIF_MAGIC, 5, 2, 0x20][..], &flash()].concat();
        let given = image.clone();
        assert_eq!(patch(&mut image, &SEED), Err(ImageFault::Summed));
        assert!(image == given);
    }

    #[test]
    fn blocks_may_come_in_any_order() {
        let (image, wanted) = (uf2(&flash()), uf2(&provisioned()));
        let reversed = |file: &[u8]| file.chunks(UF2_BLOCK).rev().collect::<Vec<_>>().concat();
        let mut image = reversed(&image);
        patch(&mut image, &SEED).unwrap();
        assert!(image == reversed(&wanted));
    }

    #[test]
    fn cut_images_are_refused() {
        for (whole, least) in [(uf2(&flash()), 4), (elf(&flash()), 4)] {
            for len in (least..whole.len() - MAGIC.len()).step_by(7) {
                let mut image = whole[..len].to_vec();
                let found = patch(&mut image, &SEED);
                if len % UF2_BLOCK != 0 {
                    assert!(matches!(found, Err(ImageFault::Damaged(_))), "{len}: {found:?}");
                }
            }
        }
    }
}
