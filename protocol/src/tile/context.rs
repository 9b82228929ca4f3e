//! What the coder of tiles expects: which context a decision falls into, and how likely it is
//! there before anything has been coded. The table is part of the format.

use super::range_coder::Model;

/// Context of "one more tile follows".
pub(super) const MORE: usize = 0;
/// Context of "the epoch is the previous tile's".
pub(super) const SAME_EPOCH: usize = 1;
/// Context of "there is a base version".
pub(super) const HAS_BASE: usize = 2;
/// Context of "the part starts at the first cell".
pub(super) const FROM_START: usize = 3;
/// Context of "the part ends at the last cell".
pub(super) const TO_END: usize = 4;
/// Contexts of "the row has changed", by whether the row before has.
pub(super) const ROW: usize = 5;
/// Contexts of "an unknown cell is now known", by surroundings.
pub(super) const KNOWN: usize = ROW + 2;
/// Contexts of "a newly known cell is occupied", by surroundings.
pub(super) const OCCUPIED: usize = KNOWN + 54;
/// Context of "a newly occupied cell is movable".
pub(super) const MOVABLE: usize = OCCUPIED + 54;
/// Contexts of "a known cell has changed".
pub(super) const CHANGED: usize = MOVABLE + 1;
/// Contexts of "a changed cell went to the likelier of its other codes", by its old code.
pub(super) const USUAL: usize = CHANGED + 36;
/// Contexts of "a changed cell went to the second likeliest of them", by its old code.
pub(super) const SECOND: usize = USUAL + 3;
/// How many contexts there are.
pub(super) const CONTEXTS: usize = SECOND + 3;

/// What stands around a cell, as far as both sides know it when the cell is coded.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Surroundings {
    /// The new code of the cell to the west (0 at the edge).
    pub(super) west: u8,
    /// The new code of the cell to the south (0 at the edge).
    pub(super) south: u8,
    /// The new code of the cell to the south-east (0 at the edge).
    pub(super) south_east: u8,
    /// The old code of the cell to the east (0 at the edge).
    pub(super) east: u8,
    /// Whether the cell to the west has changed.
    pub(super) west_changed: bool,
    /// Whether the cell to the south has changed, as far as this part tells.
    pub(super) south_changed: bool,
}

impl Surroundings {
    /// 0 to 53: for a cell that was unknown.
    pub(super) fn of_unknown(self) -> usize {
        // Fixed and movable things look alike here.
        let kind = |code: u8| usize::from(code.min(2));
        let known_east = usize::from(self.east != 0);
        ((kind(self.west) * 3 + kind(self.south)) * 3 + kind(self.south_east)) * 2 + known_east
    }

    /// 0 to 35: for a cell that was known, by its old code (1 to 3).
    pub(super) fn of_known(self, old: u8) -> usize {
        let kinds = [self.west, self.south, self.east];
        let occupied = kinds.iter().filter(|&&code| code >= 2).count().min(2);
        let changed = usize::from(self.west_changed) + 2 * usize::from(self.south_changed);
        (usize::from(old.saturating_sub(1)).min(2) * 3 + occupied) * 4 + changed
    }
}

/// A fresh set of models.
pub(super) fn models() -> [Model; CONTEXTS] {
    PRIORS.map(|prior| Model(u16::from(prior) << 8 | 0x80))
}

/// The probability of 0 in each context at the start, in 1/256: the averages over updates of
/// several recorded logs and a simulated room.
#[rustfmt::skip]
pub(super) const PRIORS: [u8; CONTEXTS] = [
    162, 199, 51, 2, 8, 234, 35, 252, 234, 193, 223, 224, 228, 157, 206, 90, 145, 125,
    158, 203, 205, 94, 102, 180, 176, 101, 122, 113, 183, 79, 137, 50, 142, 2, 25, 11,
    60, 61, 92, 19, 72, 11, 74, 173, 145, 119, 168, 106, 144, 94, 124, 22, 67, 53,
    82, 103, 129, 20, 72, 42, 80, 190, 157, 231, 212, 52, 42, 247, 245, 249, 240, 155,
    167, 58, 70, 38, 44, 37, 24, 247, 244, 253, 249, 212, 186, 253, 251, 253, 253, 223,
    215, 85, 151, 189, 192, 175, 158, 28, 31, 142, 96, 52, 54, 144, 167, 153, 143, 68,
    104, 20, 81, 77, 108, 22, 33, 248, 253, 253, 253, 253, 232, 189, 169, 210, 180, 114,
    68, 26, 199, 122, 108, 71, 218, 170, 114, 100, 243, 221, 222, 200, 51, 2, 2, 2,
    25, 8, 2, 2, 239, 186, 131, 67, 108, 2, 25, 2, 2, 234,
];
