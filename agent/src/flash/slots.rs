//! Two slots of flash: the newest valid one counts.
//!
//! | at | bytes | content |
//! |---|---|---|
//! | 0 | 16 | the first word is 0 once the slot is complete |
//! | 16 | 4 | number of the writing: of two slots, the higher one is newer |
//! | 20 | 4 | CRC-32 of the seed that the record is from |
//! | 24 | 8 | zeros |
//! | 32 | 124 | [`Record`] |
//! | 156 | 4 | CRC-32 of bytes 16 to 155 |
//! | 160 | | log: one word per boot, 0 once it is used |
//! | end | one word | 0 once the other slot is void until a boot is logged in it |
//!
//! A writing erases the older slot, programs everything but its first word, reads it back, and then
//! programs that word: until then the newer slot counts. A boot programs a word of the log. A word
//! during which the power was cut may read differently at each boot, so the log ends after its last
//! word that is not erased, and a slot's first word is programmed again before anything follows it. A writing that was
//! cut at its first word, or while it was erased again, may look complete at one boot and damaged at the next: once a boot
//! has found it damaged, the other slot's last word says that it is void.

use ubimap_protocol::{checksum::crc32, message::ParameterValue};

use super::record::{CRC_LEN, RECORD_LEN, Record, Seed, copy};

/// NOR flash: erasing sets all bits of a slot, programming clears bits of whole words.
///
/// Failures are found when the words are read back.
pub trait NorFlash {
    /// Size of a word in bytes: the unit of programming. It divides 16. A word that has been
    /// programmed before is only ever programmed to zero.
    const WORD: usize;

    /// Size of a slot in bytes, which is erased as a whole: [`HEAD`] and two words at least.
    fn slot_len(&self) -> usize;

    /// Reads from a slot. The range is within the slot.
    fn read(&self, slot: Slot, at: usize, bytes: &mut [u8]);

    /// Clears the bits that are 0 in `bytes`, in whole words within the slot, from the first on.
    fn program(&mut self, slot: Slot, at: usize, bytes: &[u8]);

    /// Sets all bits of a slot.
    fn erase(&mut self, slot: Slot);
}

/// One of the two slots.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Slot {
    /// The first.
    First,
    /// The second.
    Second,
}

impl Slot {
    fn other(self) -> Self {
        match self {
            Self::First => Self::Second,
            Self::Second => Self::First,
        }
    }
}

/// Largest size of a word in bytes.
const MAX_WORD: usize = 16;

/// Size of a slot before its log, in bytes.
pub const HEAD: usize = BODY + BODY_LEN;

/// Where a slot's body begins.
const BODY: usize = MAX_WORD;

/// Size of a slot's body: all but the first word and the log.
const BODY_LEN: usize = RECORD + RECORD_LEN + CRC_LEN;

/// Where the record begins in the body.
const RECORD: usize = 16;

const _: () = assert!(BODY_LEN.is_multiple_of(MAX_WORD));

/// The flash does not keep what is written, or all boot numbers are used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct NotKept;

/// A slot's content.
#[derive(Clone, Debug)]
enum Content {
    Erased,
    /// A writing that was not finished, or failed bits.
    Damaged,
    Complete(Writing),
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Writing {
    slot: Slot,
    number: u32,
    /// The CRC of the seed that the record is from.
    seed: u32,
    record: Record,
}

pub(super) struct Slots<'f, F> {
    flash: &'f mut F,
}

impl<'f, F: NorFlash> Slots<'f, F> {
    pub(super) fn new(flash: &'f mut F) -> Self {
        const { assert!(F::WORD > 0 && MAX_WORD.is_multiple_of(F::WORD)) }
        Self { flash }
    }

    /// The record that counts.
    pub(super) fn record(&self) -> Option<Record> {
        Some(self.newest().0?.record)
    }

    /// Takes over a new seed, and counts a boot. Returns the record and the number of this boot;
    /// `None` if there is no record.
    pub(super) fn boot(&mut self, seed: Option<&Seed>) -> Result<Option<(Record, u32)>, NotKept> {
        let (newest, is_damaged) = self.newest();
        let known = newest.as_ref().map(|newest| newest.seed);
        let new = seed.filter(|seed| known != Some(seed.crc));
        let new = new.map(|seed| (seed.crc, &seed.record));
        self.advance((newest, is_damaged), new)
    }

    /// Changes parameters of the record that counts, which uses up the number of a boot.
    pub(super) fn store(&mut self, changed: &[ParameterValue]) -> Result<(), NotKept> {
        let (newest, is_damaged) = self.newest();
        let (seed, mut record) = newest.clone().map(|it| (it.seed, it.record)).ok_or(NotKept)?;
        for &new in changed {
            let old = record.parameters.iter_mut().find(|old| old.parameter == new.parameter);
            match old {
                Some(old) => *old = new,
                None => record.parameters.push(new).map_err(|_| NotKept)?,
            }
        }
        self.advance((newest, is_damaged), Some((seed, &record)))?;
        Ok(())
    }

    /// Writes a record that is `new`, with the CRC of its seed, and counts a boot.
    fn advance(
        &mut self,
        (newest, is_damaged): (Option<Writing>, bool),
        new: Option<(u32, &Record)>,
    ) -> Result<Option<(Record, u32)>, NotKept> {
        let old = newest.as_ref();
        let known = old.map(|old| (old.seed, &old.record));
        let Some((seed, record)) = new.or(known) else { return Ok(None) };
        let logged = old.map_or(0, |old| self.logged(old.slot));
        if let (Some(old), 0) = (old, logged) {
            // Its first word may have been cut; before the other slot is erased, it must last.
            self.clear(old.slot, 0)?;
        }
        let current = if new.is_some() || is_damaged || logged >= self.log_len() {
            let slot = old.map_or(Slot::First, |old| old.slot.other());
            if is_damaged {
                self.clear(slot.other(), self.last_word())?;
            }
            let used = old.map_or(Some(0), |old| old.record.boots.checked_add(logged));
            // If the damaged slot was the newer one, its log has counted boots as well.
            let lost = if is_damaged { self.log_len() } else { 0 };
            let boots = used.ok_or(NotKept)?.max(record.boots).checked_add(lost).ok_or(NotKept)?;
            let number = old.map_or(0, |old| old.number.wrapping_add(1));
            self.write(Writing { slot, number, seed, record: Record { boots, ..record.clone() } })?
        } else {
            newest.ok_or(NotKept)?
        };
        let logged = self.logged(current.slot);
        self.clear(current.slot, HEAD + logged as usize * F::WORD)?;
        let boot = current.record.boots.checked_add(logged + 1).ok_or(NotKept)?;
        Ok(Some((current.record, boot)))
    }

    /// The slot that counts, and whether a slot is damaged.
    fn newest(&self) -> (Option<Writing>, bool) {
        match (self.content(Slot::First), self.content(Slot::Second)) {
            (Content::Complete(first), Content::Complete(second)) => {
                let is_second_newer = second.number.wrapping_sub(first.number) as i32 > 0;
                (Some(if is_second_newer { second } else { first }), false)
            }
            (Content::Complete(one), other) | (other, Content::Complete(one)) => {
                (Some(one), matches!(other, Content::Damaged))
            }
            (Content::Erased, Content::Erased) => (None, false),
            _ => (None, true),
        }
    }

    fn content(&self, slot: Slot) -> Content {
        let mut start = [0; BODY];
        self.flash.read(slot, 0, &mut start);
        let body = self.body(slot);
        if start.iter().chain(&body).all(|&byte| byte == ERASED) {
            return Content::Erased;
        }
        let is_finished = start.iter().take(F::WORD).all(|&byte| byte == 0) && !self.is_void(slot);
        let writing = Writing::parse(slot, &body).filter(|_| is_finished);
        writing.map_or(Content::Damaged, Content::Complete)
    }

    /// Whether a boot has found a slot damaged, and none has used it since.
    fn is_void(&self, slot: Slot) -> bool {
        !self.is(slot.other(), self.last_word(), ERASED) && self.logged(slot) == 0
    }

    fn body(&self, slot: Slot) -> [u8; BODY_LEN] {
        let mut body = [0; BODY_LEN];
        self.flash.read(slot, BODY, &mut body);
        body
    }

    /// Writes a slot. Returns what it holds then.
    fn write(&mut self, writing: Writing) -> Result<Writing, NotKept> {
        let (slot, body) = (writing.slot, writing.to_body());
        self.flash.erase(slot);
        self.flash.program(slot, BODY, &body);
        if self.body(slot) != body || self.logged(slot) != 0 {
            return Err(NotKept);
        }
        self.clear(slot, 0)?;
        Ok(writing)
    }

    /// Number of words in a slot's log.
    fn log_len(&self) -> u32 {
        (self.flash.slot_len().saturating_sub(HEAD) / F::WORD).saturating_sub(1) as u32
    }

    /// Where a slot's last word begins, behind the log.
    fn last_word(&self) -> usize {
        HEAD + self.log_len() as usize * F::WORD
    }

    /// Number of words of a slot's log that are used.
    fn logged(&self, slot: Slot) -> u32 {
        let is_used = |index: &u32| !self.is(slot, HEAD + *index as usize * F::WORD, ERASED);
        (0..self.log_len()).rev().find(is_used).map_or(0, |last| last + 1)
    }

    /// Programs a word to zero.
    fn clear(&mut self, slot: Slot, at: usize) -> Result<(), NotKept> {
        let zeros = [0; MAX_WORD];
        self.flash.program(slot, at, zeros.get(..F::WORD).unwrap_or_default());
        if self.is(slot, at, 0) { Ok(()) } else { Err(NotKept) }
    }

    /// Whether all bytes of a word have this value.
    fn is(&self, slot: Slot, at: usize, value: u8) -> bool {
        let mut word = [value; MAX_WORD];
        self.flash.read(slot, at, word.get_mut(..F::WORD).unwrap_or_default());
        word.iter().all(|&byte| byte == value)
    }
}

/// The value of an erased byte.
const ERASED: u8 = 0xFF;

impl Writing {
    fn to_body(&self) -> [u8; BODY_LEN] {
        let mut body = [0; BODY_LEN];
        copy(&mut body[..4], &self.number.to_le_bytes());
        copy(&mut body[4..8], &self.seed.to_le_bytes());
        copy(&mut body[RECORD..], &self.record.to_bytes());
        let crc = crc32(&[&body[..BODY_LEN - CRC_LEN]]);
        copy(&mut body[BODY_LEN - CRC_LEN..], &crc.to_le_bytes());
        body
    }

    fn parse(slot: Slot, body: &[u8; BODY_LEN]) -> Option<Self> {
        let (content, crc) = body.split_last_chunk::<CRC_LEN>()?;
        if crc32(&[content]).to_le_bytes() != *crc {
            return None;
        }
        let &[a, b, c, d, e, f, g, h, ..] = body;
        Some(Self {
            slot,
            number: u32::from_le_bytes([a, b, c, d]),
            seed: u32::from_le_bytes([e, f, g, h]),
            record: Record::parse(body[RECORD..].first_chunk()?)?,
        })
    }
}
