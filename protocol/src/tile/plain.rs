//! Reference coder for tests: follows SPEC.md literally, cell by cell, with the interval as one
//! long number. `cells` and `range_coder` are compared with it.

use std::{vec, vec::Vec};

use proptest::prelude::*;

use super::{
    Cell, Epoch, Row, Stamp, TILE_CELLS, TILE_SIDE, Tile, TileHeader, TileId, Version, cells,
    context::{self, Models, Surroundings},
    range_coder::{Decoder, Encoder, Model},
};

/// The codes to which a known cell may change, most likely first.
fn others(old: u8) -> [u8; 3] {
    match old {
        1 => [2, 3, 0],
        2 => [1, 3, 0],
        _ => [1, 2, 0],
    }
}

/// A part of a tile, with the tile before and after the update.
struct CodedPart<'a> {
    part: &'a TileHeader,
    old: &'a Tile,
    new: &'a Tile,
}

impl CodedPart<'_> {
    fn holds(&self, x: usize, y: usize) -> bool {
        let at = y * TILE_SIDE + x;
        (usize::from(self.part.start)..usize::from(self.part.end)).contains(&at)
    }

    fn has_changed(&self, x: usize, y: usize) -> bool {
        self.old.cell(x, y) != self.new.cell(x, y)
    }

    fn row_context(&self, y: usize) -> usize {
        // The row south of a part's first row counts as unchanged.
        let first = usize::from(self.part.start) / TILE_SIDE;
        context::ROW + usize::from(y > first && (0..TILE_SIDE).any(|x| self.has_changed(x, y - 1)))
    }

    fn around(&self, x: usize, y: usize) -> Surroundings {
        let first = usize::from(self.part.start) / TILE_SIDE;
        let kind = |tile: &Tile, x: usize, y: usize| usize::from(tile.cell(x, y).code().min(2));
        let east = x + 1 < TILE_SIDE;
        Surroundings {
            west: if x > 0 { kind(self.new, x - 1, y) } else { 0 },
            south: if y > 0 { kind(self.new, x, y - 1) } else { 0 },
            south_east: if y > 0 && east { kind(self.new, x + 1, y - 1) } else { 0 },
            east: if east { kind(self.old, x + 1, y) } else { 0 },
            west_changed: x > 0 && self.has_changed(x - 1, y),
            south_changed: y > first && self.has_changed(x, y - 1),
        }
    }
}

fn put(coder: &mut Encoder<'_>, models: &mut Models, coded: &CodedPart<'_>) -> u16 {
    let part = coded.part;
    let spare = if part.end == TILE_CELLS { 2 } else { 0 };
    let mut fitted = part.start;
    for y in 0..TILE_SIDE {
        let columns: Vec<_> = (0..TILE_SIDE).filter(|&x| coded.holds(x, y)).collect();
        let Some(&last) = columns.last() else { continue };
        let changed = columns.iter().any(|&x| coded.has_changed(x, y));
        coder.bit(&mut models[coded.row_context(y)], changed);
        for x in columns.into_iter().filter(|_| changed) {
            put_cell(coder, models, coded, x, y);
            if coder.fits(spare) {
                fitted = (y * TILE_SIDE + x + 1) as u16;
            }
        }
        if coder.fits(spare) {
            fitted = (y * TILE_SIDE + last + 1) as u16;
        } else if !coder.fits(0) {
            return fitted;
        }
    }
    part.end
}

fn put_cell(
    coder: &mut Encoder<'_>,
    models: &mut Models,
    coded: &CodedPart<'_>,
    x: usize,
    y: usize,
) {
    let around = coded.around(x, y);
    let (old, new) = (coded.old.cell(x, y).code(), coded.new.cell(x, y).code());
    if old == 0 {
        let at = around.of_unknown();
        coder.bit(&mut models[at], new != 0);
        if new != 0 {
            coder.bit(&mut models[at - context::KNOWN + context::OCCUPIED], new >= 2);
        }
        if new >= 2 {
            coder.bit(&mut models[context::MOVABLE], new == 3);
        }
        return;
    }
    coder.bit(&mut models[around.of_known(old.into())], new != old);
    if new != old {
        let kind = usize::from(old) - 1;
        let [usual, second, _] = others(old);
        coder.bit(&mut models[context::USUAL + kind], new == usual);
        if new != usual {
            coder.bit(&mut models[context::SECOND + kind], new == second);
        }
    }
}

fn take(coder: &mut Decoder<'_>, models: &mut Models, part: &TileHeader, tile: &mut Tile) {
    let old = *tile;
    for y in 0..TILE_SIDE {
        let holds = |x: usize| CodedPart { part, old: &old, new: &old }.holds(x, y);
        let columns: Vec<_> = (0..TILE_SIDE).filter(|&x| holds(x)).collect();
        let row = CodedPart { part, old: &old, new: tile }.row_context(y);
        if columns.is_empty() || !coder.bit(&mut models[row]) {
            continue;
        }
        for x in columns {
            let around = CodedPart { part, old: &old, new: tile }.around(x, y);
            let code = take_cell(coder, models, around, old.cell(x, y).code());
            tile.set(x, y, Cell::from_code(code));
        }
    }
}

fn take_cell(coder: &mut Decoder<'_>, models: &mut Models, around: Surroundings, old: u8) -> u8 {
    if old == 0 {
        let at = around.of_unknown();
        return if !coder.bit(&mut models[at]) {
            0
        } else if !coder.bit(&mut models[at - context::KNOWN + context::OCCUPIED]) {
            1
        } else {
            2 + u8::from(coder.bit(&mut models[context::MOVABLE]))
        };
    }
    if !coder.bit(&mut models[around.of_known(old.into())]) {
        return old;
    }
    let kind = usize::from(old) - 1;
    let [usual, second, third] = others(old);
    if coder.bit(&mut models[context::USUAL + kind]) {
        usual
    } else if coder.bit(&mut models[context::SECOND + kind]) {
        second
    } else {
        third
    }
}

/// The range coder with its interval as one long number, without carry handling.
struct Exact {
    low: Vec<u8>,
    range: u32,
    models: [u16; 4],
}

impl Exact {
    fn code(decisions: &[(Option<usize>, bool)]) -> Vec<u8> {
        let mut exact = Self { low: vec![0; 4], range: u32::MAX, models: [32_768; 4] };
        for &(model, bit) in decisions {
            exact.decide(model, bit);
        }
        exact.raise(exact.range - 1);
        let whole = exact.low.len() - 3;
        exact.low.truncate(whole);
        while exact.low.last() == Some(&0) {
            exact.low.pop();
        }
        exact.low
    }

    fn decide(&mut self, model: Option<usize>, bit: bool) {
        let p = model.map_or(32_768, |model| self.models[model]);
        let split = match model {
            Some(_) => (self.range / 4096) * u32::from(p / 16),
            None => self.range / 2,
        };
        if let Some(model) = model {
            let up = ((65_536 - u32::from(p)) / 32) as u16;
            self.models[model] = if bit { p - p / 32 } else { p + up };
        }
        if bit {
            self.raise(split);
        }
        self.range = if bit { self.range - split } else { split };
        while self.range < 1 << 24 {
            self.range *= 256;
            self.low.push(0);
        }
    }

    fn raise(&mut self, by: u32) {
        let mut carry = u64::from(by);
        for byte in self.low.iter_mut().rev() {
            carry += u64::from(*byte);
            *byte = carry as u8;
            carry >>= 8;
        }
    }
}

/// Rows with runs (as in maps), with few cells, or of noise.
fn row() -> impl Strategy<Value = Row> {
    let run = (0u32..33, 0u32..33).prop_map(|(from, to)| {
        ((1u64 << from.max(to)) - 1) as u32 & !((1u64 << from.min(to)) - 1) as u32
    });
    let sparse = (any::<u32>(), any::<u32>(), any::<u32>()).prop_map(|(a, b, c)| a & b & c);
    let word =
        || prop_oneof![3 => run.clone(), 1 => sparse.clone(), 1 => Just(0), 1 => any::<u32>()];
    (word(), word()).prop_map(|(low, high)| Row { low, high })
}

/// A tile before and after an update; rows differ in few cells or many.
fn pair() -> impl Strategy<Value = (Tile, Tile)> {
    let rows = prop_oneof![
        2 => row().prop_map(|row| (row, row)),
        2 => (row(), row()),
        2 => row().prop_map(|row| (Row::default(), row)),
        1 => (row(), 0u32..32).prop_map(|(row, x)| (row, Row { low: row.low ^ 1 << x, ..row })),
    ];
    proptest::collection::vec(rows, TILE_SIDE).prop_map(|rows| {
        let (mut old, mut new) = (Tile::UNKNOWN, Tile::UNKNOWN);
        for (y, (was, is)) in rows.into_iter().enumerate() {
            old.set_row(y, was);
            new.set_row(y, is);
        }
        (old, new)
    })
}

/// A part with any start and end, or the rest of a tile.
fn part() -> impl Strategy<Value = TileHeader> {
    let start = prop_oneof![Just(0), 0..TILE_CELLS];
    (start, prop_oneof![Just(TILE_CELLS), 1..=TILE_CELLS]).prop_map(|(start, end)| TileHeader {
        id: TileId::default(),
        stamp: Stamp { epoch: Epoch(1), version: Version(2) },
        base: Some(Version(1)),
        start,
        end: if end > start { end } else { TILE_CELLS },
    })
}

proptest! {
    #[test]
    fn the_range_coder_writes_the_bytes_of_the_reference(
        decisions in proptest::collection::vec(
            (prop::option::weighted(0.8, 0usize..4), prop::bool::weighted(0.2)), 0..3000,
        ),
    ) {
        let mut out = [0u8; 4096];
        let mut encoder = Encoder::new(&mut out);
        let mut models = [Model(32_768); 4];
        for &(model, bit) in &decisions {
            match model {
                Some(model) => encoder.bit(&mut models[model], bit),
                None => encoder.plain(bit.into(), 1),
            }
        }
        let len = encoder.finish().unwrap();
        prop_assert_eq!(&out[..len], Exact::code(&decisions));
    }

    #[test]
    fn cells_are_coded_as_by_the_reference((mut old, new) in pair(), part in part(), room in 0usize..700) {
        // The receiver holds the new cells before the part.
        for cell in 0..usize::from(part.start) {
            let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
            old.set(x, y, new.cell(x, y));
        }
        let coded = CodedPart { part: &part, old: &old, new: &new };
        let (mut out, mut plain_out) = ([0; 700], [0; 700]);
        let (mut coder, mut plain) =
            (Encoder::new(&mut out[..room]), Encoder::new(&mut plain_out[..room]));
        let (mut models, mut plain_models) = (context::models(), context::models());
        let fitted = cells::put(&mut coder, &mut models, &part, &old, &new);
        let plain_fitted = put(&mut plain, &mut plain_models, &coded);
        // The fast coder does not split runs; a run lies within one row.
        prop_assert!(fitted <= plain_fitted && plain_fitted - fitted < TILE_SIDE as u16);
        prop_assert_eq!(fitted == part.end, plain_fitted == part.end);
        if fitted < part.end || !coder.fits(0) {
            return Ok(());
        }
        prop_assert_eq!(models, plain_models);
        let len = coder.finish().unwrap();
        prop_assert_eq!(plain.finish(), Some(len));
        prop_assert_eq!(&out, &plain_out);

        let mut read = old;
        let mut models = context::models();
        cells::take(&mut Decoder::new(&out[..len]), &mut models, &part, &mut read);
        prop_assert_eq!(models, plain_models);
        for cell in 0..usize::from(TILE_CELLS) {
            let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
            let holder = if cell < usize::from(part.end) { &new } else { &old };
            prop_assert_eq!(read.cell(x, y), holder.cell(x, y));
        }
    }

    #[test]
    fn any_bytes_are_decoded_as_by_the_reference(
        (old, _) in pair(),
        part in part(),
        coded in proptest::collection::vec(prop_oneof![any::<u8>(), Just(0), Just(0xFF)], 0..300),
    ) {
        let (mut tile, mut plain_tile) = (old, old);
        let (mut coder, mut plain) = (Decoder::new(&coded), Decoder::new(&coded));
        let (mut models, mut plain_models) = (context::models(), context::models());
        cells::take(&mut coder, &mut models, &part, &mut tile);
        take(&mut plain, &mut plain_models, &part, &mut plain_tile);
        prop_assert_eq!(tile, plain_tile);
        prop_assert_eq!(models, plain_models);
        prop_assert_eq!(coder.is_exhausted(), plain.is_exhausted());
        for cell in (0..part.start).chain(part.end..TILE_CELLS).map(usize::from) {
            let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
            prop_assert_eq!(tile.cell(x, y), old.cell(x, y), "written outside the part");
        }
    }
}
