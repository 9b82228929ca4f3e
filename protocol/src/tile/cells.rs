//! Codes the cells of one part of a tile: an unchanged row in one decision, other rows cell by
//! cell.
//!
//! The context of a cell depends on the planes of its row and of the row to the south. Transposing
//! these planes gives one byte for each cell of the row; this byte and the state of the cell to the
//! west are the index into a small table. Equal bytes in a run share a context, so the decisions of
//! a run need no further look-ups: a cell that stays unknown costs nine instructions.

use super::{
    Row, TILE_SIDE, Tile,
    context::{self, Models},
    header::TileHeader,
    range_coder::{Decoder, Encoder, Model},
};

/// The codes to which a known cell may change, most likely first, by its old code (1 to 3).
const OTHERS: [[u8; 3]; 3] = [[2, 3, 0], [1, 3, 0], [1, 2, 0]];

/// Additional bytes in the header of a part that ends before the tile does.
const PART_HEADER: usize = 2;

/// Codes the cells of a part and returns the cell after the last that fitted; `part.end` if all
/// did. If the tile does not fit, room is left for the header of a part, and runs of equal cells
/// are not split.
pub(super) fn put(
    coder: &mut Encoder<'_>,
    models: &mut Models,
    part: &TileHeader,
    old: &Tile,
    new: &Tile,
) -> u16 {
    let spare = if part.ends_tile() { PART_HEADER } else { 0 };
    let mut fitted = part.start;
    let mut hot = coder.by_value();
    let mut south = South::of(part, new);
    for y in part.rows() {
        let (was, is) = (old.row(y), new.row(y));
        let columns = part.columns(y);
        let changed = changes(was, is) & columns.mask() != 0;
        hot.bit_inlined(south.row_model(models), changed);
        if changed {
            let cells = Cells::new(south.planes(was, is));
            let x;
            (hot, x) = put_row(hot, models, &cells, columns, columns.west(is), spare);
            fitted = x.map_or(fitted, |x| (y * TILE_SIDE + x) as u16);
        }
        if hot.fits(spare) {
            fitted = (y * TILE_SIDE + columns.to) as u16;
        } else if !hot.fits(0) {
            return fitted;
        }
        south = South { was, is };
    }
    let state = hot.state();
    coder.resume(state);
    part.end
}

// The models of a run's shared contexts are held by value until the run ends. Rare cases are in
// separate functions that take the coder by value and return it, because a reference to the coder
// would keep its state out of registers everywhere.

/// Codes a row and returns the column after the last cell that fitted, `None` if none did.
#[inline(always)]
fn put_row<'a>(
    mut coder: Encoder<'a>,
    models: &mut Models,
    cells: &Cells,
    columns: Columns,
    mut west: West,
    spare: usize,
) -> (Encoder<'a>, Option<usize>) {
    let mut fitted = None;
    let mut x = columns.from;
    while x < columns.to {
        let cell = cells.at(x);
        let now = cell.seen_from_east();
        // The western neighbour of a run's first cell may differ from that of the other cells.
        let count = if now == west { cells.alike(x, columns) } else { 1 };
        let at = cell.context(west);
        match cell.change() {
            Change::None => {
                let mut changed = models[usize::from(at)];
                (0..count).for_each(|_| coder.bit_inlined(&mut changed, false));
                models[usize::from(at)] = changed;
            }
            Change::NewlyFree => {
                let at_occupied = context::occupied(at);
                let mut known = models[usize::from(at)];
                let mut occupied = models[usize::from(at_occupied)];
                for _ in 0..count {
                    coder.bit_inlined(&mut known, true);
                    coder.bit_inlined(&mut occupied, false);
                }
                models[usize::from(at)] = known;
                models[usize::from(at_occupied)] = occupied;
            }
            Change::Other => {
                for _ in 0..count {
                    coder.bit_inlined(&mut models[usize::from(at)], true);
                    coder = put_change(coder, models, cell, at);
                }
            }
        }
        west = now;
        x += count;
        if coder.fits(spare) {
            fitted = Some(x);
        }
    }
    (coder, fitted)
}

#[inline(never)]
fn put_change<'a>(mut coder: Encoder<'a>, models: &mut Models, cell: Cell, at: u8) -> Encoder<'a> {
    let mut put = |at: usize, bit: bool| coder.bit(&mut models[at & 0xFF], bit);
    if cell.was_known() {
        let (kind, [usual, second, _]) = others(cell);
        put(context::USUAL + kind, cell.after() == usual);
        if cell.after() != usual {
            put(context::SECOND + kind, cell.after() == second);
        }
    } else {
        put(context::occupied(at).into(), true);
        put(context::MOVABLE, cell.after() == 3);
    }
    coder
}

/// Reads the cells of a part into `tile`.
pub(super) fn take(
    coder: &mut Decoder<'_>,
    models: &mut Models,
    part: &TileHeader,
    tile: &mut Tile,
) {
    let mut hot = coder.clone();
    let mut south = South::of(part, tile);
    for y in part.rows() {
        let was = tile.row(y);
        let mut is = was;
        if hot.bit_inlined(south.row_model(models)) {
            let cells = Cells::new(south.planes(was, Row::default()));
            (hot, is) = take_row(hot, models, &cells, part.columns(y), was);
            tile.set_row(y, is);
        }
        south = South { was, is };
    }
    *coder = hot;
}

/// Reads the cells of a row in `columns`.
#[inline(always)]
fn take_row<'a>(
    mut coder: Decoder<'a>,
    models: &mut Models,
    cells: &Cells,
    columns: Columns,
    mut row: Row,
) -> (Decoder<'a>, Row) {
    let mut west = columns.west(row);
    let mut x = columns.from;
    while x < columns.to {
        let cell = cells.at(x);
        let at = cell.context(west);
        // The context stays the same as long as the cells turn out equal to the one west of the
        // first.
        let alike = x + cells.alike(x, columns);
        let mut changed = models[usize::from(at)];
        let same = West::of(cell.before(), false);
        let end = if same == west { alike } else { x + 1 };
        while x < end && !coder.bit_inlined(&mut changed) {
            x += 1;
        }
        if x == end {
            models[usize::from(at)] = changed;
            west = same;
            continue;
        }
        if cell.was_known() {
            models[usize::from(at)] = changed;
            let new;
            (coder, new) = take_change(coder, models, cell);
            let flips = u32::from(new ^ cell.before());
            row.low ^= (flips & 1) << (x % TILE_SIDE);
            row.high ^= (flips >> 1) << (x % TILE_SIDE);
            west = West::of(new, true);
            x += 1;
            continue;
        }
        let from = x;
        let end = if west == West::NEWLY_FREE { alike } else { x + 1 };
        let is_occupied;
        (coder, x, is_occupied) = take_free(coder, models, at, changed, from, end);
        row.low |= Columns { from, to: x }.mask();
        west = West::NEWLY_FREE;
        if is_occupied {
            let movable;
            (coder, movable) = take_movable(coder, models);
            row.high |= 1 << (x % TILE_SIDE);
            row.low |= u32::from(movable) << (x % TILE_SIDE);
            west = West::NEWLY_OCCUPIED;
            x += 1;
        } else if x != end {
            west = West::UNKNOWN;
            x += 1;
        }
    }
    (coder, row)
}

/// Reads a run of cells in context `at` that were unknown and are now free, in the columns `from`
/// to at most `end`. The caller has already read, with the model `changed`, that the first one
/// changed. Returns the column of the first cell that is not free, and whether that cell is
/// occupied.
#[inline(always)]
fn take_free<'a>(
    mut coder: Decoder<'a>,
    models: &mut Models,
    at: u8,
    mut changed: Model,
    from: usize,
    end: usize,
) -> (Decoder<'a>, usize, bool) {
    let at_occupied = context::occupied(at);
    let mut occupied = models[usize::from(at_occupied)];
    let mut is_occupied = coder.bit_inlined(&mut occupied);
    let mut x = from;
    while !is_occupied {
        x += 1;
        if x == end || !coder.bit_inlined(&mut changed) {
            break;
        }
        is_occupied = coder.bit_inlined(&mut occupied);
    }
    models[usize::from(at)] = changed;
    models[usize::from(at_occupied)] = occupied;
    (coder, x, is_occupied)
}

#[inline(never)]
fn take_movable<'a>(mut coder: Decoder<'a>, models: &mut Models) -> (Decoder<'a>, bool) {
    let movable = coder.bit(&mut models[context::MOVABLE]);
    (coder, movable)
}

#[inline(never)]
fn take_change<'a>(mut coder: Decoder<'a>, models: &mut Models, cell: Cell) -> (Decoder<'a>, u8) {
    let (kind, [usual, second, third]) = others(cell);
    let new = if coder.bit(&mut models[context::USUAL + kind]) {
        usual
    } else if coder.bit(&mut models[context::SECOND + kind]) {
        second
    } else {
        third
    };
    (coder, new)
}

/// The index of the cell's old code among known codes, and the codes to which it may change.
fn others(cell: Cell) -> (usize, [u8; 3]) {
    match cell.before() {
        3 => (2, OTHERS[2]),
        2 => (1, OTHERS[1]),
        _ => (0, OTHERS[0]),
    }
}

/// The cells that differ between two rows, as a mask.
fn changes(was: Row, is: Row) -> u32 {
    was.low ^ is.low | was.high ^ is.high
}

/// The row to the south, before and after the update.
#[derive(Clone, Copy)]
struct South {
    was: Row,
    is: Row,
}

impl South {
    /// The row to the south of a part's first row, which counts as unchanged.
    fn of(part: &TileHeader, tile: &Tile) -> Self {
        let south = part.rows().start.checked_sub(1);
        let row = south.map_or(Row::default(), |y| tile.row(y));
        Self { was: row, is: row }
    }

    fn row_model<'m>(&self, models: &'m mut Models) -> &'m mut Model {
        &mut models[context::ROW + usize::from(self.was != self.is)]
    }

    /// A row's planes, in the order of the bits of a [`Cell`]. The decoder does not know `is` and
    /// passes an empty row.
    fn planes(&self, was: Row, is: Row) -> [u32; 8] {
        let Self { is: south, was: south_was } = *self;
        let known = was.known();
        // Selects for each cell the bit of `unknown` if the cell was unknown, otherwise that of
        // `other`.
        let either = |unknown: u32, other: u32| unknown & !known | other & known;
        let south_free = south.low & !south.high;
        [
            is.low,
            is.high,
            known,
            either(south_free, was.low),
            either(south.high, was.high),
            either(south_free >> 1, south.high),
            either(south.high >> 1, was.high >> 1),
            either(known >> 1, changes(south_was, south)),
        ]
    }
}

/// A cell and its surroundings as known to both sides, without the cell to the west. From the
/// lowest bit: its new code (2 bits), whether it was known, and the five high bits of its index in
/// [`context::OF_UNKNOWN`] or [`context::OF_KNOWN`].
#[derive(Clone, Copy)]
struct Cell(u8);

impl Cell {
    /// The new code.
    fn after(self) -> u8 {
        self.0 & 3
    }

    fn was_known(self) -> bool {
        self.0 & 4 != 0
    }

    fn before(self) -> u8 {
        if self.was_known() { self.0 >> 3 & 3 } else { 0 }
    }

    /// The context of the decision whether the cell has changed.
    #[inline(always)]
    fn context(self, west: West) -> u8 {
        let around = usize::from(self.0 >> 1 & 0x7C);
        match self.was_known() {
            true => context::OF_KNOWN[around | usize::from(west.0 >> 1 & 3)],
            false => context::OF_UNKNOWN[around | usize::from(west.0 & 3)],
        }
    }

    #[inline(always)]
    fn change(self) -> Change {
        match self.after() {
            new if new == self.before() => Change::None,
            1 if !self.was_known() => Change::NewlyFree,
            _ => Change::Other,
        }
    }

    /// The cell as the west neighbour of the next one, once its new code is known.
    #[inline(always)]
    fn seen_from_east(self) -> West {
        West::of(self.after(), self.change() != Change::None)
    }
}

/// How a cell has changed. The two frequent cases have variants of their own.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Change {
    None,
    NewlyFree,
    Other,
}

/// The state of the cell to the west: 0 for unknown, 1 for free, 2 for occupied or movable, plus 4
/// if it has changed.
#[derive(Clone, Copy, PartialEq, Eq)]
struct West(u8);

impl West {
    const UNKNOWN: Self = Self(0);
    const NEWLY_FREE: Self = Self(1 | 4);
    const NEWLY_OCCUPIED: Self = Self(2 | 4);

    #[inline(always)]
    fn of(code: u8, changed: bool) -> Self {
        Self(code.min(2) | u8::from(changed) << 2)
    }
}

/// A range of columns of one row.
#[derive(Clone, Copy)]
struct Columns {
    from: usize,
    to: usize,
}

impl Columns {
    fn mask(self) -> u32 {
        let below = |column: usize| ((1u64 << column) - 1) as u32;
        below(self.to) & !below(self.from)
    }

    /// The cell to the west of the first column, which counts as unchanged.
    fn west(self, row: Row) -> West {
        let Some(x) = self.from.checked_sub(1) else { return West::UNKNOWN };
        West::of((row.low >> x & 1 | (row.high >> x & 1) << 1) as u8, false)
    }
}

impl TileHeader {
    /// The columns of row `y` that the part holds.
    fn columns(&self, y: usize) -> Columns {
        let first = y * TILE_SIDE;
        Columns {
            from: usize::from(self.start).saturating_sub(first).min(TILE_SIDE),
            to: usize::from(self.end).saturating_sub(first).min(TILE_SIDE),
        }
    }
}

/// The cells of a row, one byte each.
struct Cells {
    /// Cell `x` is byte `x / 8` of word `x % 8`.
    words: [u32; 8],
    /// Mask of the cells that end a run: the cell to the east differs.
    last: u32,
}

impl Cells {
    /// Transposes planes (the lowest bit of every cell first) into cells.
    #[inline(always)]
    fn new(planes: [u32; 8]) -> Self {
        let last = planes.iter().fold(0, |last, plane| last | plane ^ plane >> 1);
        let [mut a, mut b, mut c, mut d, mut e, mut f, mut g, mut h] = planes;
        // Transposes four 8 x 8 bit squares at once.
        exchange(&mut a, &mut e, 4, 0x0F0F_0F0F);
        exchange(&mut b, &mut f, 4, 0x0F0F_0F0F);
        exchange(&mut c, &mut g, 4, 0x0F0F_0F0F);
        exchange(&mut d, &mut h, 4, 0x0F0F_0F0F);
        exchange(&mut a, &mut c, 2, 0x3333_3333);
        exchange(&mut b, &mut d, 2, 0x3333_3333);
        exchange(&mut e, &mut g, 2, 0x3333_3333);
        exchange(&mut f, &mut h, 2, 0x3333_3333);
        exchange(&mut a, &mut b, 1, 0x5555_5555);
        exchange(&mut c, &mut d, 1, 0x5555_5555);
        exchange(&mut e, &mut f, 1, 0x5555_5555);
        exchange(&mut g, &mut h, 1, 0x5555_5555);
        Self { words: [a, b, c, d, e, f, g, h], last }
    }

    #[inline(always)]
    fn at(&self, x: usize) -> Cell {
        Cell((self.words[x % 8] >> (x & 24)) as u8)
    }

    /// Length of the run of equal cells that starts at `x`; at least one.
    #[inline(always)]
    fn alike(&self, x: usize, columns: Columns) -> usize {
        let count = (self.last >> (x % TILE_SIDE)).trailing_zeros() as usize + 1;
        count.min(columns.to.saturating_sub(x))
    }
}

/// Exchanges the high `shift` bits of each group of `2 * shift` bits in `first` with the low
/// `shift` bits of the same group in `second`. `low` masks the low bits of all groups.
#[inline(always)]
fn exchange(first: &mut u32, second: &mut u32, shift: u32, low: u32) {
    let differ = (*first >> shift ^ *second) & low;
    *second ^= differ;
    *first ^= differ << shift;
}
