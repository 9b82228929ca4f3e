//! The CRC-32 that seals frames and identifies the contents of tiles.

use crc::{CRC_32_ISO_HDLC, Crc};

/// Without a table on a microcontroller, which has no kibibyte of flash to spare for one and seals
/// only some 4 kB a second.
#[cfg(target_os = "none")]
type Table = crc::NoTable;
#[cfg(not(target_os = "none"))]
type Table = crc::Table<1>;

pub(crate) const CRC: Crc<u32, Table> = Crc::<u32, Table>::new(&CRC_32_ISO_HDLC);

/// The CRC-32 (ISO-HDLC) of the concatenation of `parts`.
pub fn crc32(parts: &[&[u8]]) -> u32 {
    let mut digest = CRC.digest();
    for part in parts {
        digest.update(part);
    }
    digest.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_crc_matches_the_catalogues_check_value() {
        assert_eq!(crc32(&[b"123456789"]), 0xCBF4_3926);
    }
}
