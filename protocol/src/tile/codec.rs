//! Tile updates: the changes of some tiles since a base version, or whole tiles.
//!
//! An update is one range-coder stream that holds up to [`MAX_TILES_PER_UPDATE`] tiles. A tile that
//! does not fit is cut: the rest travels in a later frame, as a further part of the same version.

use core::fmt;

use super::{
    BaseCheck, Epoch, Stamp, TILE_SIDE, Tile, TileId, Version, cells,
    context::{self, Models},
    header::{TILE_CELLS, TileHeader},
    range_coder::{Decoder, Encoder},
};

/// Number of cells in a row of a tile.
const SIDE: u16 = TILE_SIDE as u16;

/// Maximum number of tiles in one update: bounds the work of a decoder.
pub const MAX_TILES_PER_UPDATE: usize = 32;

/// Orders of the Exp-Golomb codes in a tile's header.
const FIRST_ID_ORDER: u32 = 3;
const EPOCH_ORDER: u32 = 4;
const VERSION_ORDER: u32 = 3;

/// Writes one tile update into the caller's buffer.
#[derive(Debug)]
pub struct TileEncoder<'a> {
    coder: Encoder<'a>,
    models: Models,
    previous: Option<(TileId, Epoch)>,
    tiles: usize,
    check: BaseCheck,
}

impl<'a> TileEncoder<'a> {
    /// Writes to `out` from its start.
    pub fn new(out: &'a mut [u8]) -> Self {
        Self {
            coder: Encoder::new(out),
            models: context::models(),
            previous: None,
            tiles: 0,
            check: BaseCheck::default(),
        }
    }

    /// Number of tiles in the update.
    pub fn tiles(&self) -> usize {
        self.tiles
    }

    /// Adds the cells of `new` from `start` on (`stamp.version` and `base` as in [`TileHeader`]).
    /// `old` is the tile as the receiver holds it: from `start` on the base version, or unknown
    /// without a base, and before `start` the same as `new`.
    ///
    /// Returns the cell after the last that fitted. Returns `None` if no cell fitted, if the update
    /// is full ([`MAX_TILES_PER_UPDATE`]), or if a version is invalid: the base must be above 0 and
    /// below `stamp.version`. Only the first tile of an update is ever cut; it is then coded twice.
    /// Cost on a Cortex-M4 (`cargo instructions`): 58,000 instructions for a whole new tile with
    /// 600 known cells, 15,000 for the mean update of a robot in an office.
    pub fn push(
        &mut self,
        id: TileId,
        stamp: Stamp,
        base: Option<Version>,
        start: u16,
        old: &Tile,
        new: &Tile,
    ) -> Option<u16> {
        if self.tiles >= MAX_TILES_PER_UPDATE || start >= TILE_CELLS {
            return None;
        }
        let min = base.unwrap_or(Version(0));
        if base == Some(Version(0)) || stamp.version <= min {
            return None;
        }
        let (before, models) = (self.coder.checkpoint(), self.models);
        let mut end = TILE_CELLS;
        loop {
            let header = TileHeader { id, stamp, base, start, end };
            let fitted = self.try_push(&header, old, new);
            if fitted >= end {
                self.previous = Some((id, stamp.epoch));
                self.tiles += 1;
                if header.names_base() {
                    self.check.add(old);
                }
                return Some(end);
            }
            self.coder.rewind(before);
            self.models = models;
            // If not even the first run of equal cells fits, try half a row at most.
            end = if fitted > start { fitted } else { start + (end - start).min(SIDE) / 2 };
            if self.tiles > 0 || end <= start {
                return None;
            }
        }
    }

    /// Ends the update. Returns its length in bytes; `None` if it holds no tile or does not fit.
    pub fn finish(self) -> Option<usize> {
        if self.tiles == 0 {
            return None;
        }
        let (mut coder, mut models) = (self.coder, self.models);
        coder.bit(&mut models[context::MORE], false);
        if let Some(check) = self.check.value() {
            coder.plain(check, 16);
        }
        coder.finish()
    }

    /// Codes a part and returns the cell after the last that fitted.
    fn try_push(&mut self, header: &TileHeader, old: &Tile, new: &Tile) -> u16 {
        self.put_header(header);
        cells::put(&mut self.coder, &mut self.models, header, old, new)
    }

    fn put_header(&mut self, header: &TileHeader) {
        let Self { coder, models, previous, .. } = self;
        match *previous {
            None => {
                coder.signed(i32::from(header.id.x), FIRST_ID_ORDER);
                coder.signed(i32::from(header.id.y), FIRST_ID_ORDER);
                coder.golomb(header.stamp.epoch.0, EPOCH_ORDER);
            }
            Some((id, epoch)) => {
                coder.bit(&mut models[context::MORE], true);
                coder.signed(i32::from(header.id.x) - i32::from(id.x), 0);
                coder.signed(i32::from(header.id.y) - i32::from(id.y), 0);
                let same = header.stamp.epoch == epoch;
                coder.bit(&mut models[context::SAME_EPOCH], same);
                if !same {
                    coder.golomb(header.stamp.epoch.0, EPOCH_ORDER);
                }
            }
        }
        coder.bit(&mut models[context::HAS_BASE], header.base.is_some());
        coder.golomb(header.stamp.version.0, VERSION_ORDER);
        if let Some(base) = header.base {
            // The base is nearly always the version before.
            coder.golomb(header.stamp.version.0.wrapping_sub(base.0).wrapping_sub(1), 0);
        }
        let from_start = header.start == 0;
        coder.bit(&mut models[context::FROM_START], from_start);
        if !from_start {
            coder.plain(u32::from(header.start), 10);
        }
        let to_end = header.end == TILE_CELLS;
        coder.bit(&mut models[context::TO_END], to_end);
        if !to_end {
            coder.plain(u32::from(header.end), 10);
        }
    }
}

/// Why an update cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TileError {
    /// A value that no encoder writes, or unread bytes after the last tile.
    Malformed,
    /// More than [`MAX_TILES_PER_UPDATE`] tiles.
    TooManyTiles,
    /// The update builds upon other cells than this side holds, so the tiles read from it are
    /// wrong. Request them whole.
    WrongBase,
}

impl fmt::Display for TileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Malformed => f.write_str("the tile update is malformed"),
            Self::WrongBase => f.write_str("the tile update builds upon other cells"),
            Self::TooManyTiles => {
                write!(f, "the tile update has more than {MAX_TILES_PER_UPDATE} tiles")
            }
        }
    }
}

impl core::error::Error for TileError {}

/// Reads a tile update of at most [`MAX_TILES_PER_UPDATE`] tiles, which bounds the work.
#[derive(Debug)]
pub struct TileDecoder<'a> {
    coder: Decoder<'a>,
    models: Models,
    previous: Option<(TileId, Epoch)>,
    tiles: usize,
    check: BaseCheck,
}

impl<'a> TileDecoder<'a> {
    /// Reads an update written by a [`TileEncoder`].
    pub fn new(coded: &'a [u8]) -> Self {
        Self {
            coder: Decoder::new(coded),
            models: context::models(),
            previous: None,
            tiles: 0,
            check: BaseCheck::default(),
        }
    }

    /// The header of the next tile, `None` after the last. Call [`TileDecoder::cells`] for its
    /// cells before asking for the next header.
    pub fn header(&mut self) -> Result<Option<TileHeader>, TileError> {
        let Self { coder, models, previous, tiles, .. } = self;
        let (id, epoch) = match *previous {
            None => (
                tile_id(coder.signed(FIRST_ID_ORDER), coder.signed(FIRST_ID_ORDER))?,
                Epoch(number(coder.golomb(EPOCH_ORDER))?),
            ),
            Some((id, epoch)) => {
                if !coder.bit(&mut models[context::MORE]) {
                    if self.check.value().is_some_and(|check| coder.plain(16) != check) {
                        return Err(TileError::WrongBase);
                    }
                    let whole = coder.is_exhausted();
                    return if whole { Ok(None) } else { Err(TileError::Malformed) };
                }
                if *tiles >= MAX_TILES_PER_UPDATE {
                    return Err(TileError::TooManyTiles);
                }
                let x = coder.signed(0).and_then(|step| step.checked_add(i32::from(id.x)));
                let y = coder.signed(0).and_then(|step| step.checked_add(i32::from(id.y)));
                let id = tile_id(x, y)?;
                let same = coder.bit(&mut models[context::SAME_EPOCH]);
                let epoch = if same { epoch } else { Epoch(number(coder.golomb(EPOCH_ORDER))?) };
                (id, epoch)
            }
        };
        let has_base = coder.bit(&mut models[context::HAS_BASE]);
        let version = Version(number(coder.golomb(VERSION_ORDER))?);
        let base = match has_base {
            true => {
                let steps = coder.golomb(0).and_then(|between| between.checked_add(1));
                Some(Version(version.0.checked_sub(number(steps)?).ok_or(TileError::Malformed)?))
            }
            false => None,
        };
        if version == Version(0) || base == Some(Version(0)) {
            return Err(TileError::Malformed);
        }
        let from_start = coder.bit(&mut models[context::FROM_START]);
        let start = if from_start { 0 } else { coder.plain(10) as u16 };
        let to_end = coder.bit(&mut models[context::TO_END]);
        let end = if to_end { TILE_CELLS } else { coder.plain(10) as u16 };
        if start >= end || from_start == (start != 0) {
            return Err(TileError::Malformed);
        }
        *previous = Some((id, epoch));
        *tiles += 1;
        Ok(Some(TileHeader { id, stamp: Stamp { epoch, version }, base, start, end }))
    }

    /// Reads the cells of the part described by `header` into `tile`. From `header.start` on,
    /// `tile` must hold the base (or unknown cells without one), and before it the new cells.
    pub fn cells(&mut self, header: &TileHeader, tile: &mut Tile) {
        if header.names_base() {
            self.check.add(tile);
        }
        cells::take(&mut self.coder, &mut self.models, header, tile);
    }
}

fn number(value: Option<u32>) -> Result<u32, TileError> {
    value.ok_or(TileError::Malformed)
}

fn tile_id(x: Option<i32>, y: Option<i32>) -> Result<TileId, TileError> {
    let side = |value: Option<i32>| i16::try_from(value?).ok();
    let id = side(x).and_then(|x| Some(TileId { x, y: side(y)? }));
    id.ok_or(TileError::Malformed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tile::{Cell, Row};
    use proptest::prelude::*;

    /// A tile in which some rows have runs, like a map, and some are noise.
    fn tile() -> impl Strategy<Value = Tile> {
        let row = prop_oneof![
            4 => Just(Row { low: u32::MAX, high: 0 }),
            4 => Just(Row::default()),
            2 => (0u32..32).prop_map(|x| Row { low: !(u32::MAX << x), high: 1u32 << x }),
            1 => (any::<u32>(), any::<u32>()).prop_map(|(low, high)| Row { low, high }),
        ];
        proptest::collection::vec(row, TILE_SIDE).prop_map(|rows| {
            let mut tile = Tile::UNKNOWN;
            rows.into_iter().enumerate().for_each(|(y, row)| tile.set_row(y, row));
            tile
        })
    }

    fn stamp(epoch: u32, version: u32) -> Stamp {
        Stamp { epoch: Epoch(epoch), version: Version(version) }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn updates_of_several_tiles_read_back(
            pairs in proptest::collection::vec((tile(), tile(), any::<bool>(), -40i16..40, -40i16..40, prop_oneof![0u32..3, u32::MAX - 40..=u32::MAX], prop_oneof![2u32..900, u32::MAX - 9..=u32::MAX]), 1..6),
        ) {
            let mut out = [0u8; 4096];
            let mut encoder = TileEncoder::new(&mut out);
            for (old, new, whole, x, y, epoch, version) in &pairs {
                let old = if *whole { &Tile::UNKNOWN } else { old };
                let base = (!whole).then_some(Version(version - 1));
                let end = encoder.push(TileId { x: *x, y: *y }, stamp(*epoch, *version), base, 0, old, new);
                prop_assert_eq!(end, Some(TILE_CELLS));
            }
            let len = encoder.finish().unwrap();
            let mut decoder = TileDecoder::new(&out[..len]);
            for (old, new, whole, x, y, epoch, version) in &pairs {
                let header = decoder.header().unwrap().unwrap();
                prop_assert_eq!(header.id, TileId { x: *x, y: *y });
                prop_assert_eq!(header.stamp, stamp(*epoch, *version));
                prop_assert_eq!(header.base.is_none(), *whole);
                let mut tile = if *whole { Tile::UNKNOWN } else { *old };
                decoder.cells(&header, &mut tile);
                prop_assert_eq!(&tile, new);
            }
            prop_assert_eq!(decoder.header(), Ok(None));
        }

        #[test]
        fn parts_of_any_size_assemble_to_the_tile(old in tile(), new in tile(), whole: bool, room in 18usize..60) {
            let base = if whole { Tile::UNKNOWN } else { old };
            let version = (!whole).then_some(Version(4));
            let mut sent = base;
            let mut held = base;
            let mut start = 0;
            while start < TILE_CELLS {
                let mut out = [0u8; 64];
                let mut encoder = TileEncoder::new(&mut out[..room]);
                let end = encoder
                    .push(TileId { x: 500, y: -500 }, stamp(700, 5), version, start, &sent, &new)
                    .expect("at least one cell fits");
                let len = encoder.finish().unwrap();
                prop_assert!(len <= room);
                let mut decoder = TileDecoder::new(&out[..len]);
                let header = decoder.header().unwrap().unwrap();
                prop_assert_eq!((header.start, header.end), (start, end));
                decoder.cells(&header, &mut held);
                prop_assert_eq!(decoder.header(), Ok(None));
                for cell in usize::from(start)..usize::from(end) {
                    let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
                    sent.set(x, y, new.cell(x, y));
                }
                prop_assert_eq!(&held, &sent);
                start = end;
            }
            prop_assert_eq!(&held, &new);
        }

        #[test]
        fn decoding_any_bytes_ends_within_the_tile_limit(coded in proptest::collection::vec(any::<u8>(), 0..300)) {
            let mut decoder = TileDecoder::new(&coded);
            let mut tiles = 0;
            while let Ok(Some(header)) = decoder.header() {
                let mut tile = Tile::UNKNOWN;
                decoder.cells(&header, &mut tile);
                tiles += 1;
            }
            prop_assert!(tiles <= MAX_TILES_PER_UPDATE);
        }
    }

    #[test]
    fn versions_start_at_one_and_exceed_their_base() {
        let mut out = [0u8; 60];
        let mut encoder = TileEncoder::new(&mut out);
        let tile = Tile::UNKNOWN;
        for (version, base) in [(0, None), (1, Some(0)), (4, Some(4)), (4, Some(5))] {
            let base = base.map(Version);
            let pushed = encoder.push(TileId::default(), stamp(1, version), base, 0, &tile, &tile);
            assert_eq!(pushed, None, "{version} on {base:?}");
        }
    }

    /// The maximum numbers of parts are measured values. A higher number means that some part
    /// leaves room unused.
    #[test]
    fn parts_in_small_frames_use_their_room() {
        let mut noise = Tile::UNKNOWN;
        for y in 0..TILE_SIDE {
            let word = 0x9E37_79B9u32.wrapping_mul(y as u32 + 1);
            noise.set_row(y, Row { low: word, high: word.rotate_left(13) });
        }
        for (room, most) in [(19, 172), (25, 46), (38, 17)] {
            let (mut sent, mut start, mut parts) = (Tile::UNKNOWN, 0, 0);
            while start < TILE_CELLS {
                let mut out = [0u8; 40];
                let mut encoder = TileEncoder::new(&mut out[..room]);
                let id = TileId { x: 500, y: -500 };
                let end = encoder.push(id, stamp(700, 5), None, start, &sent, &noise).unwrap();
                for cell in usize::from(start)..usize::from(end) {
                    let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
                    sent.set(x, y, noise.cell(x, y));
                }
                (start, parts) = (end, parts + 1);
            }
            assert!(parts <= most, "{parts} parts of {room} bytes");
        }
        for start in [0, 40] {
            let mut out = [0u8; 12];
            let mut encoder = TileEncoder::new(&mut out);
            let id = TileId { x: 500, y: -500 };
            let pushed = encoder.push(id, stamp(700, 5), None, start, &Tile::UNKNOWN, &noise);
            assert_eq!(pushed, None, "no cell fits");
        }
    }

    #[test]
    fn an_update_has_a_limited_number_of_tiles() {
        let mut tile = Tile::UNKNOWN;
        tile.set(3, 3, Cell::Free);
        let mut out = [0u8; 400];
        let mut encoder = TileEncoder::new(&mut out);
        let push = |encoder: &mut TileEncoder<'_>, x: usize, start: u16| {
            let id = TileId { x: x as i16, y: 0 };
            encoder.push(id, stamp(1, 1), None, start, &Tile::UNKNOWN, &tile)
        };
        assert_eq!(push(&mut encoder, 0, TILE_CELLS), None, "it has no cells");
        for count in 0..MAX_TILES_PER_UPDATE {
            assert_eq!(encoder.tiles(), count);
            assert_eq!(push(&mut encoder, count, 0), Some(TILE_CELLS));
        }
        assert_eq!(push(&mut encoder, 40, 0), None);
        assert_eq!(encoder.tiles(), MAX_TILES_PER_UPDATE);
    }

    #[test]
    fn a_tile_that_does_not_fit_leaves_the_update_unchanged() {
        let mut noise = Tile::UNKNOWN;
        for y in 0..TILE_SIDE {
            let word = 0x9E37_79B9u32.wrapping_mul(y as u32 + 1);
            noise.set_row(y, Row { low: word, high: word.rotate_left(13) });
        }
        let mut small = Tile::UNKNOWN;
        small.set(3, 3, Cell::Free);
        let mut out = [0u8; 60];
        let mut encoder = TileEncoder::new(&mut out);
        let id = TileId::default();
        assert_eq!(
            encoder.push(id, stamp(1, 1), None, 0, &Tile::UNKNOWN, &small),
            Some(TILE_CELLS)
        );
        assert_eq!(encoder.push(id, stamp(1, 1), None, 0, &Tile::UNKNOWN, &noise), None);
        let len = encoder.finish().unwrap();
        let mut decoder = TileDecoder::new(&out[..len]);
        let header = decoder.header().unwrap().unwrap();
        let mut tile = Tile::UNKNOWN;
        decoder.cells(&header, &mut tile);
        assert_eq!(tile, small);
        assert_eq!(decoder.header(), Ok(None));
    }
}

#[cfg(test)]
#[path = "vectors.rs"]
mod vectors;
