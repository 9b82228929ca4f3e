//! Reads an update as SPEC.md describes it, decision by decision, and records every one. It shares
//! nothing with the code of the project, so that the first steps of a newcomer have an oracle.

use serde_json::{Value, json};
use ubimap_protocol::tile::{Cell, Tile};

/// An update with one tile, and how it was read.
pub(super) struct Trace {
    /// Name, context (`null` for an even decision), p, range, code and bit of each decision.
    pub(super) decisions: Vec<Value>,
    /// For each cell that was coded: x, y, was; west, south and south-east as they are and east as
    /// it was; whether west and south have changed; the context; is.
    pub(super) cells: Vec<Value>,
    pub(super) header: Value,
    pub(super) after: Tile,
}

struct Tracer<'a> {
    input: &'a [u8],
    at: usize,
    range: u32,
    code: u32,
    models: Vec<u32>,
    decisions: Vec<Value>,
}

/// The first contexts of each kind (SPEC.md, 8.3 and 8.5).
const MORE: usize = 0;
const HAS_BASE: usize = 2;
const FROM_START: usize = 3;
const TO_END: usize = 4;
const ROW: usize = 5;
const KNOWN: usize = 7;
const OCCUPIED: usize = 61;
const MOVABLE: usize = 115;
const CHANGED: usize = 116;
const USUAL: usize = 152;
const SECOND: usize = 155;

impl<'a> Tracer<'a> {
    fn new(input: &'a [u8], priors: &[u32]) -> Self {
        let models = priors.iter().map(|prior| 256 * prior + 128).collect();
        let mut tracer =
            Self { input, at: 0, range: u32::MAX, code: 0, models, decisions: Vec::new() };
        (0..4).for_each(|_| tracer.pull());
        tracer
    }

    fn pull(&mut self) {
        let byte = self.input.get(self.at).copied().unwrap_or(0);
        self.at += 1;
        self.code = self.code << 8 | u32::from(byte);
    }

    fn decide(&mut self, about: &str, context: Option<usize>) -> u8 {
        let p = context.map_or(32_768, |context| self.models[context]);
        let split = match context {
            None => self.range >> 1,
            Some(_) => (self.range >> 12) * (p >> 4).max(1),
        };
        let bit = u8::from(self.code >= split);
        let p_told = context.map(|_| p);
        self.decisions.push(json!([about, context, p_told, self.range, self.code, bit]));
        if bit == 1 {
            (self.code, self.range) = (self.code - split, self.range - split);
        } else {
            self.range = split;
        }
        if let Some(context) = context {
            self.models[context] = if bit == 1 { p - (p >> 5) } else { p + ((65_536 - p) >> 5) };
        }
        while self.range < 1 << 24 {
            self.range <<= 8;
            self.pull();
        }
        bit
    }

    fn plain(&mut self, about: &str, bits: u32) -> u32 {
        (0..bits).fold(0, |value, _| value << 1 | u32::from(self.decide(about, None)))
    }

    fn golomb(&mut self, about: &str, order: u32) -> u32 {
        let mut bits = order;
        while self.decide(about, None) == 1 {
            bits += 1;
        }
        self.plain(about, bits) + (1 << bits) - (1 << order)
    }

    fn signed(&mut self, about: &str, order: u32) -> i32 {
        let zigzag = self.golomb(about, order);
        (zigzag >> 1) as i32 ^ -((zigzag & 1) as i32)
    }
}

/// Reads an update of one tile; `before` are the cells that its receiver holds.
pub(super) fn trace(coded: &[u8], before: &Tile, priors: &[u32]) -> Trace {
    let mut tracer = Tracer::new(coded, priors);
    let (x, y) = (tracer.signed("x", 3), tracer.signed("y", 3));
    let epoch = tracer.golomb("epoch", 4);
    let has_base = tracer.decide("HAS_BASE", Some(HAS_BASE)) == 1;
    let version = tracer.golomb("version", 3);
    let base = has_base.then(|| version - 1 - tracer.golomb("base", 0));
    let from_start = tracer.decide("FROM_START", Some(FROM_START)) == 1;
    let start = if from_start { 0 } else { tracer.plain("start", 10) };
    let to_end = tracer.decide("TO_END", Some(TO_END)) == 1;
    let end = if to_end { 1024 } else { tracer.plain("end", 10) };
    let (mut after, mut cells) = (*before, Vec::new());
    for row in start / 32..=(end - 1) / 32 {
        let columns = start.max(32 * row)..end.min(32 * row + 32);
        read_row(&mut tracer, (start, columns), before, &mut after, &mut cells);
    }
    assert_eq!(tracer.decide("MORE", Some(MORE)), 0, "the trace is of one tile");
    if has_base && start == 0 {
        tracer.plain("check", 16);
    }
    let header = json!({
        "x": x, "y": y, "epoch": epoch, "version": version, "base": base, "start": start, "end": end,
    });
    Trace { decisions: tracer.decisions, cells, header, after }
}

fn read_row(
    tracer: &mut Tracer<'_>,
    (start, columns): (u32, std::ops::Range<u32>),
    before: &Tile,
    after: &mut Tile,
    cells: &mut Vec<Value>,
) {
    let y = (columns.start / 32) as i32;
    let first = (start / 32) as i32;
    let code = |tile: &Tile, x: i32, y: i32| match (0..32).contains(&x) && y >= 0 {
        true => tile.cell(x as usize, y as usize).code(),
        false => 0,
    };
    let changed = |after: &Tile, x: i32, y: i32| {
        u8::from(y >= first && code(before, x, y) != code(after, x, y))
    };
    let south = (0..32).map(|x| changed(after, x, y - 1)).max().unwrap_or(0);
    if tracer.decide("ROW", Some(ROW + usize::from(south))) == 0 {
        return;
    }
    for at in columns {
        let x = (at % 32) as i32;
        let was = code(before, x, y);
        let [west, south, south_east] =
            [(x - 1, y), (x, y - 1), (x + 1, y - 1)].map(|(x, y)| code(after, x, y));
        let east = code(before, x + 1, y);
        let (west_new, south_new) = (changed(after, x - 1, y), changed(after, x, y - 1));
        let kind = |code: u8| usize::from(code.min(2));
        let context = if was == 0 {
            let around = (kind(west) * 3 + kind(south)) * 3 + kind(south_east);
            KNOWN + around * 2 + usize::from(east != 0)
        } else {
            let occupied = [west, south, east].iter().filter(|code| **code >= 2).count().min(2);
            let around = (usize::from(was) - 1) * 3 + occupied;
            CHANGED + around * 4 + usize::from(west_new) + 2 * usize::from(south_new)
        };
        let is = read_cell(tracer, was, context);
        after.set(x as usize, y as usize, Cell::from_code(is));
        cells.push(json!([
            x, y, was, west, south, south_east, east, west_new, south_new, context, is
        ]));
    }
}

fn read_cell(tracer: &mut Tracer<'_>, was: u8, context: usize) -> u8 {
    if was == 0 {
        return if tracer.decide("KNOWN", Some(context)) == 0 {
            0
        } else if tracer.decide("OCCUPIED", Some(context - KNOWN + OCCUPIED)) == 0 {
            1
        } else {
            2 + tracer.decide("MOVABLE", Some(MOVABLE))
        };
    }
    if tracer.decide("CHANGED", Some(context)) == 0 {
        return was;
    }
    let kind = usize::from(was) - 1;
    let [first, second, third] = [[2, 3, 0], [1, 3, 0], [1, 2, 0]][kind];
    if tracer.decide("USUAL", Some(USUAL + kind)) == 1 {
        first
    } else if tracer.decide("SECOND", Some(SECOND + kind)) == 1 {
        second
    } else {
        third
    }
}
