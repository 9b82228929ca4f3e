//! The contexts of the tile coder's decisions, and the initial probability in each. The tables are
//! part of the wire format.

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
/// Contexts of "the row has changed", by whether the row to the south has.
pub(super) const ROW: usize = 5;
/// Contexts of "an unknown cell is now known", by surroundings.
pub(super) const KNOWN: usize = ROW + 2;
/// Contexts of "a newly known cell is occupied", by surroundings.
pub(super) const OCCUPIED: usize = KNOWN + 54;
/// Context of "a newly occupied cell is movable".
pub(super) const MOVABLE: usize = OCCUPIED + 54;
/// Contexts of "a known cell has changed".
pub(super) const CHANGED: usize = MOVABLE + 1;
/// Contexts of "a changed cell took the likeliest of its other codes", by its old code.
pub(super) const USUAL: usize = CHANGED + 36;
/// Contexts of "a changed cell took the second likeliest of its other codes", by its old code.
pub(super) const SECOND: usize = USUAL + 3;
/// Total number of contexts.
pub(super) const CONTEXTS: usize = SECOND + 3;

/// The models of all contexts, padded to 256 so that any byte is a valid index.
pub(super) type Models = [Model; 256];

/// A fresh set of models.
pub(super) fn models() -> Models {
    let mut models = [Model(0x8080); 256];
    for (model, prior) in models.iter_mut().zip(PRIORS) {
        *model = Model(u16::from(prior) << 8 | 0x80);
    }
    models
}

/// The surroundings of a cell as known to both sides when the cell is coded. Each neighbour is 0 if
/// it is unknown or beyond the edge, 1 if it is free, 2 if it is occupied or movable.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Surroundings {
    /// The cell to the west after the update.
    pub(super) west: usize,
    /// The cell to the south after the update.
    pub(super) south: usize,
    /// The cell to the south-east after the update.
    pub(super) south_east: usize,
    /// The cell to the east before the update.
    pub(super) east: usize,
    /// Whether the cell to the west has changed.
    pub(super) west_changed: bool,
    /// Whether the cell to the south has changed; false in the first row of a part.
    pub(super) south_changed: bool,
}

impl Surroundings {
    /// The context of "a cell that was unknown is now known".
    pub(super) const fn of_unknown(self) -> usize {
        let known_east = (self.east != 0) as usize;
        KNOWN + ((self.west * 3 + self.south) * 3 + self.south_east) * 2 + known_east
    }

    /// The context of "a cell that was known has changed", by its old code (1 to 3).
    pub(super) const fn of_known(self, old: usize) -> usize {
        let occupied =
            (self.west == 2) as usize + (self.south == 2) as usize + (self.east == 2) as usize;
        let occupied = if occupied > 2 { 2 } else { occupied };
        let changed = self.west_changed as usize + 2 * self.south_changed as usize;
        CHANGED + ((old - 1) * 3 + occupied) * 4 + changed
    }
}

/// [`Surroundings::of_unknown`] as a table. Bits of the index from the lowest: the cell to the west
/// (2 bits), to the south (2), to the south-east (2), whether the cell to the east was known.
pub(super) static OF_UNKNOWN: [u8; 128] = {
    let mut contexts = [KNOWN as u8; 128];
    let mut index = 0;
    while index < 128 {
        let (west, south, south_east) = (index & 3, index >> 2 & 3, index >> 4 & 3);
        let (west_changed, south_changed) = (false, false);
        if west < 3 && south < 3 && south_east < 3 {
            let east = index >> 6;
            let around =
                Surroundings { west, south, south_east, east, west_changed, south_changed };
            contexts[index] = around.of_unknown() as u8;
        }
        index += 1;
    }
    contexts
};

/// [`Surroundings::of_known`] as a table. Bits of the index from the lowest: whether the cell to
/// the west is occupied, whether it has changed, the old code (2 bits), whether the cell to the
/// south is occupied, whether the cell to the east was, whether the cell to the south has changed.
pub(super) static OF_KNOWN: [u8; 128] = {
    let mut contexts = [CHANGED as u8; 128];
    let mut index = 0;
    while index < 128 {
        let old = index >> 2 & 3;
        if old > 0 {
            let around = Surroundings {
                west: (index & 1) * 2,
                south: (index >> 4 & 1) * 2,
                south_east: 0,
                east: (index >> 5 & 1) * 2,
                west_changed: index & 2 != 0,
                south_changed: index >> 6 != 0,
            };
            contexts[index] = around.of_known(old) as u8;
        }
        index += 1;
    }
    contexts
};

/// The context of "a newly known cell is occupied" that belongs to the context `known`.
pub(super) const fn occupied(known: u8) -> u8 {
    known.wrapping_add((OCCUPIED - KNOWN) as u8)
}

/// The initial probability of 0 in each context, in 1/256: averages over the updates of several
/// recorded logs and a simulated room.
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

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: Surroundings = Surroundings {
        west: 0,
        south: 0,
        south_east: 0,
        east: 0,
        west_changed: false,
        south_changed: false,
    };

    /// The contexts are numbered without gaps, in the order of the loops (SPEC 8.6).
    #[test]
    fn contexts_are_numbered_in_order() {
        let mut next = KNOWN;
        for (west, south) in (0..3).flat_map(|west| (0..3).map(move |south| (west, south))) {
            for south_east in 0..3 {
                for is_east_known in [false, true] {
                    for east in if is_east_known { 1..3 } else { 0..1 } {
                        let around = Surroundings { west, south, south_east, east, ..NONE };
                        assert_eq!(around.of_unknown(), next, "{around:?}");
                        let entry = west | south << 2 | south_east << 4;
                        let entry = OF_UNKNOWN[entry | usize::from(is_east_known) << 6];
                        assert_eq!(usize::from(entry), next, "{around:?}");
                    }
                    next += 1;
                }
            }
        }
        assert_eq!(next, OCCUPIED);

        let mut next = CHANGED;
        for old in 1..4 {
            for occupied in 0..3 {
                for south_changed in [false, true] {
                    for west_changed in [false, true] {
                        for [west, south, east] in with_occupied(occupied) {
                            let changed = Surroundings { west_changed, south_changed, ..NONE };
                            let around = Surroundings { west, south, east, ..changed };
                            assert_eq!(around.of_known(old), next, "{around:?}, {old}");
                            let is = |code| usize::from(code == 2);
                            let entry = is(west)
                                | usize::from(west_changed) << 1
                                | old << 2
                                | is(south) << 4
                                | is(east) << 5
                                | usize::from(south_changed) << 6;
                            assert_eq!(usize::from(OF_KNOWN[entry]), next, "{around:?}, {old}");
                        }
                        next += 1;
                    }
                }
            }
        }
        assert_eq!(next, USUAL);
    }

    /// The neighbours with this number of occupied ones; 2 stands for two or three.
    fn with_occupied(number: usize) -> impl Iterator<Item = [usize; 3]> {
        let codes = || 0..3usize;
        let all =
            codes().flat_map(move |a| codes().flat_map(move |b| codes().map(move |c| [a, b, c])));
        all.filter(move |all| all.iter().filter(|code| **code == 2).count().min(2) == number)
    }

    #[test]
    fn entries_of_impossible_neighbours_are_valid() {
        // 3 stands for no code of a neighbour, and 0 for none of a known cell.
        for index in 0..128 {
            let [west, south, south_east] = [0, 2, 4].map(|shift| index >> shift & 3);
            if [west, south, south_east].contains(&3) {
                assert_eq!(usize::from(OF_UNKNOWN[index]), KNOWN);
            }
            if index >> 2 & 3 == 0 {
                assert_eq!(usize::from(OF_KNOWN[index]), CHANGED);
            }
        }
    }
}
