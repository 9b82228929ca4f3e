//! The shortest way across a window: A* over 16 directions, in 6.1 KiB, some cells at a time.
//!
//! Steps go to the eight neighbours and, like a knight's, to the eight cells between those
//! directions. Straight, diagonal and knight's steps cost 17, 24 and 38: within 0.2 % of their
//! lengths, so that in any direction a way of steps is between 0.998 and 1.028 of the straight
//! line. The shortest way of steps is therefore at most 1.03 of the shortest way there is, before
//! its corners are cut (see [`Path`]).
//!
//! What is left to the goal without obstacles is a consistent heuristic, so a cell that has been
//! expanded is done. Open cells then differ little in what they promise: a byte holds each cell's
//! way from the start modulo 256, 128 lists suffice in a circle, and a list is a word of the rows
//! in which cells of that promise are open. Nobody's predecessor is kept: the way back is where the
//! differences fit.

use super::{
    path::{Path, WayBack},
    plane::{Place, Plane, SIDE},
    window::Window,
};

/// A straight step, a diagonal one, a knight's.
const STRAIGHT: u8 = 17;
const DIAGONAL: u8 = 24;
const KNIGHT: u8 = 38;
/// What it costs more to enter a cell where something movable may stand: a straight step is three
/// times as dear.
const DEAR: u8 = 2 * STRAIGHT;

/// By rows from the south and columns from the west of the 5 x 5 cells about one.
const COSTS: [[u8; 5]; 5] = {
    const K: u8 = KNIGHT;
    const D: u8 = DIAGONAL;
    const S: u8 = STRAIGHT;
    [[0, K, 0, K, 0], [K, D, S, D, K], [0, S, 0, S, 0], [K, D, S, D, K], [0, K, 0, K, 0]]
};

/// More than a promise can grow in a step: twice the dearest step, and what is dear.
const LISTS: usize = 128;
const _: () = assert!(2 * KNIGHT as usize + (DEAR as usize) < LISTS);

const CELLS: usize = SIDE * SIDE;

/// A frontier cell is worth so much of a way, and so many count at the most: 30 cells of way.
const WORTH: u32 = 2;
const MOST_WORTH: u32 = 256;

/// Where to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// A cell.
    Place(Place),
    /// Columns and rows from the corner, outside the window: through the rim by the cell that
    /// promises most.
    Beyond(i32, i32),
    /// The frontier that is worth most: cells from where blind ground is near against the way.
    Frontier,
}

/// Why there is no way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlanError {
    /// The robot does not stand near any free ground.
    StartBlocked,
    /// The goal is within a wall, too near to one, or on unknown ground.
    GoalBlocked,
    /// Nothing leads there: a closed door.
    Unreachable,
    /// No frontier can be reached: all is mapped.
    NoFrontier,
}

/// How far a search is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// More steps are needed.
    Searching,
    /// This is the end of the way.
    Found(Place),
    /// There is no way.
    Failed(PlanError),
}

/// A search that goes on from call to call.
#[derive(Clone, Debug)]
pub struct Planner {
    /// The way from the start to each cell that has been reached, modulo 256.
    ways: [u8; CELLS],
    /// Reached and not yet expanded.
    open: Plane,
    /// What can be reached from the start and has not been expanded.
    ahead: Plane,
    /// By promise (way and heuristic) modulo 128: the rows in which such cells may be open.
    lists: [u64; LISTS],
    /// The promise whose list is worked off.
    promise: u32,
    start: Place,
    target: Target,
    /// What is worth most so far: what it costs less what it is worth.
    best: Option<(i64, Place)>,
    expanded: u32,
}

const _: () = assert!(size_of::<Planner>() + size_of::<Window>() <= 8 * 1024);

impl Default for Planner {
    fn default() -> Self {
        Self {
            ways: [0; CELLS],
            open: Plane::EMPTY,
            ahead: Plane::EMPTY,
            lists: [0; LISTS],
            promise: 0,
            start: Place::default(),
            target: Target::Frontier,
            best: None,
            expanded: 0,
        }
    }
}

impl Planner {
    /// Begins a search in a window that must stay as it is until the search ends. It floods the
    /// free cells first, so a closed door is found here. A start among blocked cells is moved to
    /// the nearest free one; about 20,000 instructions.
    ///
    /// # Errors
    /// [`PlanError`], but [`PlanError::NoFrontier`] only if there is none at all.
    pub fn begin(
        &mut self,
        window: &Window,
        start: Place,
        target: Target,
    ) -> Result<(), PlanError> {
        let start = window.nearest_free(start).ok_or(PlanError::StartBlocked)?;
        self.ahead = Plane::EMPTY;
        self.ahead.insert(start);
        self.ahead.flood(&window.free);
        match target {
            Target::Place(goal) if !window.free.has(goal) => return Err(PlanError::GoalBlocked),
            Target::Place(goal) if !self.ahead.has(goal) => return Err(PlanError::Unreachable),
            Target::Frontier if window.frontier.is_empty() => return Err(PlanError::NoFrontier),
            _ => {}
        }
        (self.start, self.target) = (start, target);
        self.open = Plane::EMPTY;
        self.lists = [0; LISTS];
        (self.best, self.expanded) = (None, 0);
        self.promise = self.heuristic(start);
        self.reach(start, 0, self.promise);
        Ok(())
    }

    /// How many cells the search has expanded.
    pub fn expanded(&self) -> u32 {
        self.expanded
    }

    /// Expands so many cells at the most, about 350 instructions each. The frontiers that a search
    /// has weighed are taken out of the window.
    pub fn step(&mut self, window: &mut Window, most: usize) -> Progress {
        let dear = !window.dear.is_empty();
        for _ in 0..most {
            let Some(place) = self.pop() else {
                let failure = match self.target {
                    Target::Frontier => PlanError::NoFrontier,
                    _ => PlanError::Unreachable,
                };
                return self.best.map_or(Progress::Failed(failure), |it| Progress::Found(it.1));
            };
            if self.is_end(place, window) {
                return Progress::Found(self.best.map_or(place, |it| it.1));
            }
            self.expand(place, window, dear);
        }
        Progress::Searching
    }

    /// Whether the search ends with this cell.
    fn is_end(&mut self, place: Place, window: &mut Window) -> bool {
        match self.target {
            Target::Place(goal) => place == goal,
            Target::Beyond(..) => {
                let rim = |it: u8| it <= 1 || usize::from(it) >= SIDE - 2;
                rim(place.x) || rim(place.y)
            }
            Target::Frontier => {
                let way = i64::from(self.promise);
                if window.frontier.has(place) {
                    let worth = WORTH * take_cluster(&mut window.frontier, place).min(MOST_WORTH);
                    let price = way - i64::from(worth);
                    if self.best.is_none_or(|(best, _)| price < best) {
                        self.best = Some((price, place));
                    }
                }
                let cheapest = way - i64::from(WORTH * MOST_WORTH);
                window.frontier.is_empty() || self.best.is_some_and(|(best, _)| best <= cheapest)
            }
        }
    }

    /// Takes an open cell of the least promise.
    #[inline(always)]
    fn pop(&mut self) -> Option<Place> {
        let mut tried = 0;
        while tried < LISTS {
            let list = &mut self.lists[self.promise as usize % LISTS];
            if *list == 0 {
                self.promise = self.promise.wrapping_add(1);
                tried += 1;
                continue;
            }
            let y = list.trailing_zeros() as u8;
            let mut cells = self.open.row(y.into());
            while cells != 0 {
                let place = Place { x: cells.trailing_zeros() as u8, y };
                let way = u32::from(self.ways[index(place)]);
                if way.wrapping_add(self.heuristic(place)) as u8 == self.promise as u8 {
                    self.open.remove(place);
                    self.ahead.remove(place);
                    self.expanded += 1;
                    return Some(place);
                }
                cells &= cells - 1;
            }
            let list = &mut self.lists[self.promise as usize % LISTS];
            *list &= *list - 1;
        }
        None
    }

    /// Reaches the cells around one that is done.
    #[inline(always)]
    fn expand(&mut self, place: Place, window: &Window, dear: bool) {
        let way = self.ways[index(place)];
        let rest = self.promise.wrapping_sub(self.heuristic(place));
        let rows = steps(place, &window.free, |dy| self.ahead.five(place.x, dy));
        for ((cells, costs), row) in rows.into_iter().zip(&COSTS).zip(0u8..) {
            let mut cells = cells;
            while cells != 0 {
                let column = cells.trailing_zeros() as u8 & 7;
                cells &= cells - 1;
                let to = at(place, column, row);
                let mut cost = costs.get(usize::from(column)).copied().unwrap_or(0);
                if dear && window.dear.has(to) {
                    cost += DEAR;
                }
                let new = way.wrapping_add(cost);
                let known = self.ways[index(to)];
                if self.open.has(to) && new.wrapping_sub(known) < 128 {
                    continue;
                }
                let promise = rest.wrapping_add(cost.into()).wrapping_add(self.heuristic(to));
                self.reach(to, new, promise);
            }
        }
    }

    #[inline(always)]
    fn reach(&mut self, place: Place, way: u8, promise: u32) {
        self.ways[index(place)] = way;
        self.open.insert(place);
        self.lists[promise as usize % LISTS] |= 1 << (place.y % 64);
    }

    /// The way that is left if nothing stands in it.
    #[inline(always)]
    fn heuristic(&self, place: Place) -> u32 {
        let (x, y) = match self.target {
            Target::Place(goal) => goal.column_and_row(),
            Target::Beyond(x, y) => (x, y),
            Target::Frontier => return 0,
        };
        let (across, up) = (x.abs_diff(place.x.into()), y.abs_diff(place.y.into()));
        let (long, short) = if across > up { (across, up) } else { (up, across) };
        // Straight and knight's steps, or knight's and diagonal ones: what is more.
        let (straight, diagonal) = (u32::from(STRAIGHT), u32::from(DIAGONAL));
        let knight = u32::from(KNIGHT);
        let flat =
            straight.wrapping_mul(long).wrapping_add((knight - 2 * straight).wrapping_mul(short));
        let steep = (knight - diagonal)
            .wrapping_mul(long)
            .wrapping_add((2 * diagonal - knight).wrapping_mul(short));
        flat.max(steep)
    }

    /// The way to a cell that the search has found, its corners cut.
    pub fn path(&self, window: &Window, to: Place) -> Path {
        let mut way = WayBack::from(to);
        let dear = !window.dear.is_empty();
        let mut at = to;
        // No cell is on it twice.
        for _ in 0..CELLS {
            if at == self.start {
                break;
            }
            let Some(before) = self.before(at, window, dear) else { break };
            way.lead(before, window);
            at = before;
        }
        way.finish(window)
    }

    /// The cell from where a done cell was reached.
    fn before(&self, place: Place, window: &Window, dear: bool) -> Option<Place> {
        let way = self.ways[index(place)];
        let extra = if dear && window.dear.has(place) { DEAR } else { 0 };
        let done = |dy| window.free.five(place.x, dy) & !self.ahead.five(place.x, dy);
        let rows = steps(place, &window.free, done);
        for ((cells, costs), row) in rows.into_iter().zip(&COSTS).zip(0u8..) {
            for (column, &cost) in costs.iter().enumerate() {
                let from = at(place, column as u8, row);
                let reached = || self.ways[index(from)].wrapping_add(cost + extra);
                if cells >> column & 1 != 0 && reached() == way {
                    return Some(from);
                }
            }
        }
        None
    }
}

#[inline(always)]
fn index(place: Place) -> usize {
    (usize::from(place.y) * SIDE + usize::from(place.x)) % CELLS
}

/// A cell by its column and row of the 5 x 5 about another.
#[inline(always)]
fn at(place: Place, column: u8, row: u8) -> Place {
    let along = |it: u8, at: u8| it.wrapping_add(at).wrapping_sub(2);
    Place { x: along(place.x, column), y: along(place.y, row) }
}

/// The cells one step away, of the five of each row about a cell that `wanted` has (given the row):
/// by rows from the south, five bits each. A knight's step crosses two cells, both free.
#[inline(always)]
fn steps(place: Place, free: &Plane, wanted: impl Fn(i32) -> u32) -> [u32; 5] {
    let y = i32::from(place.y);
    let [south, here, north] = [y - 1, y, y + 1].map(|y| free.five(place.x, y));
    let beside = |cells: u32| {
        let both = cells & here;
        0b0_1110 | (both & 0b0_1000) << 1 | (both & 0b0_0010) >> 1
    };
    let beyond = |cells: u32| if cells & 0b0_0100 != 0 { cells & 0b0_1010 } else { 0 };
    [
        wanted(y - 2) & beyond(south),
        wanted(y - 1) & beside(south),
        wanted(y) & 0b0_1010,
        wanted(y + 1) & beside(north),
        wanted(y + 2) & beyond(north),
    ]
}

/// Takes the cells that hang together with one out of a plane: how many they are.
fn take_cluster(plane: &mut Plane, place: Place) -> u32 {
    let mut cluster = Plane::EMPTY;
    cluster.insert(place);
    cluster.flood(plane);
    for y in 0..SIDE {
        *plane.row_mut(y) &= !cluster.row(y);
    }
    cluster.len()
}
