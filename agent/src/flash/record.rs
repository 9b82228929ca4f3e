//! A robot's record and its bytes, in the slots and in an image.
//!
//! All numbers are little-endian:
//!
//! | at | bytes | content |
//! |---|---|---|
//! | 0 | 1 | format: 1 |
//! | 1 | 1 | 1 with a key, 0 without |
//! | 2 | 2 | robot number |
//! | 4 | 4 | boot numbers up to this one are used up |
//! | 8 | 16 | key; zeros without |
//! | 24 | 1 | number of parameters |
//! | 25 | 3 | zeros |
//! | 28 | 96 | parameters: number (2), value (4); zeros after the last |
//!
//! A seed in an image is [`MAGIC`], the record, and the CRC-32 of both.

use heapless::Vec;
use ubimap_protocol::{
    checksum::crc32,
    frame::{KEY_LEN, Key},
    message::{MAX_PARAMETERS, ParameterValue},
    units::RobotId,
};

/// Size of a record in bytes.
pub(super) const RECORD_LEN: usize = 28 + MAX_PARAMETERS * VALUE_LEN;

/// Size of a parameter in a record, in bytes.
const VALUE_LEN: usize = 6;

/// Size of a CRC-32 in bytes.
pub(super) const CRC_LEN: usize = 4;

/// The version of the record's format.
const FORMAT: u8 = 1;

/// Where the bytes of a seed begin in an image.
pub const MAGIC: [u8; 16] = *b"ubimap seed 1\r\n\0";

/// Size of a seed in bytes, with its magic.
pub const SEED_LEN: usize = MAGIC.len() + RECORD_LEN + CRC_LEN;

/// A seed's place in an image that is not provisioned: magic, then erased flash.
pub const UNPROVISIONED: [u8; SEED_LEN] = {
    let mut bytes = [0xFF; SEED_LEN];
    let (magic, _) = bytes.split_at_mut(MAGIC.len());
    magic.copy_from_slice(&MAGIC);
    bytes
};

/// What distinguishes a robot from others with the same image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    /// The robot's number.
    pub robot: RobotId,
    /// The key of its link; `None` for an open link.
    pub key: Option<Key>,
    /// Boot numbers up to this one are used up.
    pub boots: u32,
    /// Parameters that differ from the image's. The robot skips those that it does not know.
    pub parameters: Vec<ParameterValue, MAX_PARAMETERS>,
}

impl Record {
    pub(super) fn to_bytes(&self) -> [u8; RECORD_LEN] {
        let mut bytes = [0; RECORD_LEN];
        bytes[0] = FORMAT;
        bytes[1] = self.key.is_some().into();
        copy(&mut bytes[2..4], &self.robot.0.to_le_bytes());
        copy(&mut bytes[4..8], &self.boots.to_le_bytes());
        if let Some(key) = &self.key {
            copy(&mut bytes[8..24], key.bytes());
        }
        bytes[24] = self.parameters.len() as u8;
        let places = bytes[28..].chunks_exact_mut(VALUE_LEN);
        for (place, &ParameterValue { parameter, value }) in places.zip(&self.parameters) {
            let (number, rest) = place.split_at_mut(2);
            copy(number, &parameter.to_le_bytes());
            copy(rest, &value.to_le_bytes());
        }
        bytes
    }

    /// The record in these bytes; `None` if they are none of this version.
    pub(super) fn parse(bytes: &[u8; RECORD_LEN]) -> Option<Self> {
        let &[FORMAT, has_key @ 0..=1, a, b, c, d, e, f, ..] = bytes else { return None };
        let key: [u8; KEY_LEN] = *bytes[8..].first_chunk()?;
        let count = usize::from(bytes[24]);
        if count > MAX_PARAMETERS {
            return None;
        }
        let mut parameters = Vec::new();
        for value in bytes[28..].chunks_exact(VALUE_LEN).take(count) {
            let &[a, b, c, d, e, f] = value else { return None };
            let parameter = u16::from_le_bytes([a, b]);
            let value = i32::from_le_bytes([c, d, e, f]);
            parameters.push(ParameterValue { parameter, value }).ok()?;
        }
        Some(Self {
            robot: RobotId(u16::from_le_bytes([a, b])),
            key: (has_key == 1).then(|| Key::new(key)),
            boots: u32::from_le_bytes([c, d, e, f]),
            parameters,
        })
    }
}

/// The record of an image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Seed {
    /// The record.
    pub record: Record,
    /// The CRC-32 of its bytes, which tells seeds apart.
    pub(super) crc: u32,
}

impl Seed {
    /// The bytes of a seed, for an image.
    pub fn to_bytes(record: &Record) -> [u8; SEED_LEN] {
        let mut bytes = UNPROVISIONED;
        copy(&mut bytes[MAGIC.len()..], &record.to_bytes());
        let crc = crc32(&[&bytes[..SEED_LEN - CRC_LEN]]);
        copy(&mut bytes[SEED_LEN - CRC_LEN..], &crc.to_le_bytes());
        bytes
    }

    /// The seed in these bytes of an image; `None` if the image is not provisioned.
    pub fn parse(bytes: &[u8; SEED_LEN]) -> Option<Self> {
        let crc = crc32(&[&bytes[..SEED_LEN - CRC_LEN]]);
        if bytes[SEED_LEN - CRC_LEN..] != crc.to_le_bytes() {
            return None;
        }
        let record = Record::parse(bytes[MAGIC.len()..].first_chunk()?)?;
        Some(Self { record, crc })
    }
}

/// Copies `from` to the beginning of `to`. Unlike `copy_from_slice` it can't panic.
pub(super) fn copy(to: &mut [u8], from: &[u8]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
}
