//! UF2 files of ELF images for the RP2040 and the RP2350, whose boot loaders take them by drag and drop.
//!
//! A UF2 file is a series of blocks of 512 bytes, each with a page of 256 bytes of the flash.

use std::collections::BTreeMap;

use super::image::{self, ImageFault, UF2_BLOCK, UF2_MAGIC};

/// Size of a page in bytes.
const PAGE: usize = 256;

/// The start of the flash, and the largest one.
const FLASH: u32 = 0x1000_0000;
const FLASH_END: u32 = FLASH + (16 << 20);

/// The pages of a flash by their addresses.
type Pages = BTreeMap<u32, Vec<u8>>;

/// The UF2 file of an ELF image.
pub(super) fn from_elf(elf: &[u8]) -> Result<Vec<u8>, ImageFault> {
    if !elf.starts_with(image::ELF_MAGIC) {
        return Err(ImageFault::NoUf2);
    }
    let segments = image::segments(elf).ok_or(ImageFault::Damaged("segments"))?;
    let mut pages = Pages::new();
    for (address, range) in segments.into_iter().filter(|(_, range)| !range.is_empty()) {
        let first = u32::try_from(address).map_err(|_| ImageFault::NoUf2)?;
        let len = u32::try_from(range.len()).map_err(|_| ImageFault::NoUf2)?;
        if first < FLASH || first.checked_add(len).is_none_or(|end| end > FLASH_END) {
            return Err(ImageFault::NoUf2);
        }
        for (address, &byte) in (first..).zip(&elf[range]) {
            let offset = address as usize % PAGE;
            pages.entry(address - offset as u32).or_insert_with(|| vec![0; PAGE])[offset] = byte;
        }
    }
    let family = family(&pages).ok_or(ImageFault::NoUf2)?;
    Ok(file(&pages, family))
}

/// The family of chips that a flash is for, by what the chip's ROM looks for.
fn family(pages: &Pages) -> Option<u32> {
    const RP2040: u32 = 0xE48B_FF56;
    const RP2350_ARM: u32 = 0xE48B_FF59;
    /// The first word of a block of the RP2350's, which is within the first 4 KiB.
    const BLOCK: u32 = 0xFFFF_DED3;
    let first = pages.get(&FLASH)?;
    let words = |page: &[u8]| -> Vec<u32> {
        page.as_chunks::<4>().0.iter().map(|&word| u32::from_le_bytes(word)).collect()
    };
    if words(first).last() == Some(&crc32_mpeg2(&first[..PAGE - 4])) {
        return Some(RP2040);
    }
    let mut near = pages.range(FLASH..FLASH + 4096);
    near.any(|(_, page)| words(page).contains(&BLOCK)).then_some(RP2350_ARM)
}

/// The checksum that the RP2040's ROM expects at the end of the first page: CRC-32/MPEG-2.
fn crc32_mpeg2(bytes: &[u8]) -> u32 {
    bytes.iter().fold(!0, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte) << 24, |crc: u32, _| {
            crc << 1 ^ if crc >> 31 == 1 { 0x04C1_1DB7 } else { 0 }
        })
    })
}

/// The UF2 file of pages, for a family of chips.
pub(super) fn file(pages: &Pages, family: u32) -> Vec<u8> {
    const HAS_FAMILY: u32 = 0x2000;
    let [first, second, last] = UF2_MAGIC.map(|word| word as u32);
    let mut file = Vec::with_capacity(pages.len() * UF2_BLOCK);
    for (index, (&address, page)) in pages.iter().enumerate() {
        let (index, count, len) = (index as u32, pages.len() as u32, page.len() as u32);
        let header = [first, second, HAS_FAMILY, address, len, index, count, family];
        header.iter().for_each(|word| file.extend(word.to_le_bytes()));
        file.extend(page);
        file.resize((index as usize + 1) * UF2_BLOCK - 4, 0);
        file.extend(last.to_le_bytes());
    }
    file
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// An ELF with one segment.
    fn elf(address: u32, content: &[u8]) -> Vec<u8> {
        let mut file = vec![0; 84];
        file[..6].copy_from_slice(b"\x7FELF\x01\x01");
        let len = content.len() as u32;
        // The table with its entry's size and their number; the segment's type, place, address and length.
        for (at, word) in [(28, 52), (42, 32), (44, 1), (52, 1), (56, 84), (64, address), (68, len)]
        {
            file[at..at + 4].copy_from_slice(&u32::to_le_bytes(word));
        }
        [&file, content].concat()
    }

    proptest! {
        #[test]
        fn segments_anywhere_become_a_file_or_an_error(
            near in prop::sample::select(vec![0, FLASH, FLASH + 4_000, FLASH_END, u32::MAX - 700]),
            offset in 0..700_u32,
            content in prop::collection::vec(any::<u8>(), 0..700),
        ) {
            let (address, len) = (near + offset, content.len() as u32);
            // A block that makes it an RP2350's image, where there is room for it.
            let mut content = content;
            if let Some(words) = content.first_chunk_mut() {
                *words = u32::to_le_bytes(0xFFFF_DED3);
            }
            match from_elf(&elf(address, &content)) {
                Ok(file) => {
                    let first = address / PAGE as u32;
                    let pages = (address + len - 1) / PAGE as u32 - first + 1;
                    prop_assert_eq!(file.len(), pages as usize * UF2_BLOCK);
                    let flash: Vec<u8> =
                        file.chunks(UF2_BLOCK).flat_map(|block| &block[32..32 + PAGE]).copied().collect();
                    let start = address as usize % PAGE;
                    prop_assert_eq!(&flash[start..start + content.len()], &content[..]);
                }
                Err(fault) => prop_assert_eq!(fault, ImageFault::NoUf2),
            }
        }
    }

    #[test]
    fn the_checksum_is_crc_32_mpeg_2() {
        // The check value of the catalogue of CRCs.
        assert_eq!(crc32_mpeg2(b"123456789"), 0x0376_E6E7);
    }

    #[test]
    fn other_images_become_no_uf2() {
        assert_eq!(from_elf(&[0; 600]), Err(ImageFault::NoUf2));
        assert_eq!(from_elf(b"\x7FELF"), Err(ImageFault::Damaged("segments")));
        let pages = Pages::from([(FLASH, vec![7; PAGE])]);
        assert_eq!(family(&pages), None);
    }
}
