//! The shortest way across a window, from corner to corner of what stands in it, in 6.2 KiB.
//!
//! A shortest way bends only at the corners of obstacles, around them. So the search is A* over
//! these corners and the two ends, with straight lines for steps: their lengths are exact in any
//! direction, and the way needs no smoothing. Corners are found 64 cells at a time. That one corner
//! sees another is first taken for granted, and looked at when the other is the most promising of
//! all (as in Lazy Theta*: Nash, Koenig, Tovey 2010): most lines are never drawn.

use heapless::Vec;

use super::{
    path::{MAX_POINTS, Path},
    plane::{Place, Plane, SIDE},
    planning_window::{Line, PlanningWindow},
    root::root,
};

/// The most corners of a window.
const MOST_NODES: usize = 384;
/// The most clusters of frontier cells that are weighed.
const MOST_FRONTIERS: usize = 16;

/// What it costs more to cross a cell where something movable may stand, in cells.
const DEAR: f32 = 2.0;
/// What a frontier cell is worth in cells of way, and how many count at the most: 30 cells of way.
const WORTH: f32 = 30.0 / MOST_WORTH as f32;
const MOST_WORTH: u32 = 256;

/// Where to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// The frontier that is worth most: cells from where blind ground is near against the way.
    Frontier,
    /// A cell.
    Place(Place),
    /// Columns and rows from the corner, outside the window, at most 1,000: out through the rim.
    Beyond(i16, i16),
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
    /// The window has more corners than there is memory for.
    Crowded,
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

/// Lines through a corner that have its obstacle on one side: those that fall from west to east,
/// past what is in the north-east or south-west, and those that rise.
const FALLING: u8 = 1;
const RISING: u8 = 2;

#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    /// Nobody is known from whom it may be reached.
    New,
    /// Somebody is who may see it.
    Promised,
    /// Who of those that are done sees it is known.
    Seen,
    /// No shorter way leads there.
    Done,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    x: i16,
    y: i16,
    /// From which node it is reached.
    parent: u16,
    /// The lines that its obstacle does not meet at once.
    lines: u8,
    state: State,
    /// From the start, and with what is left at least to the goal, in cells.
    way: f32,
    promise: f32,
}

/// A search that goes on from call to call.
#[derive(Clone, Debug)]
pub struct Planner {
    /// The start, the goals, the corners.
    nodes: Vec<Node, MOST_NODES>,
    /// How many goals there are, and what each one costs more than the way.
    goals: usize,
    prices: [f32; MOST_FRONTIERS],
    target: Target,
    /// The goal that was reached, and where the way leaves the window if it is outside.
    found: u16,
    exit: Place,
}

const _: () = assert!(size_of::<Planner>() + size_of::<PlanningWindow>() <= 8 * 1024);

impl Planner {
    /// A planner that has not begun: all zero bits.
    pub const EMPTY: Self = Self {
        nodes: Vec::new(),
        goals: 0,
        prices: [0.0; MOST_FRONTIERS],
        target: Target::Frontier,
        found: 0,
        exit: Place { x: 0, y: 0 },
    };

    /// Begins a search in a window that must stay as it is until the search ends. It floods the
    /// free cells first, so a closed door is found here. A start among blocked cells is moved to
    /// the nearest free one. Some 50,000 instructions, 1.5 KiB of stack.
    ///
    /// # Errors
    /// [`PlanError`].
    pub fn begin(
        &mut self,
        window: &PlanningWindow,
        start: Place,
        target: Target,
    ) -> Result<(), PlanError> {
        let start = window.nearest_free(start).ok_or(PlanError::StartBlocked)?;
        let mut reached = Plane::EMPTY;
        reached.insert(start);
        reached.flood(&window.free);
        self.nodes.clear();
        self.target = target;
        self.add(start, FALLING | RISING)?;
        match target {
            Target::Place(goal) if !window.free.has(goal) => return Err(PlanError::GoalBlocked),
            Target::Place(goal) if !reached.has(goal) => return Err(PlanError::Unreachable),
            Target::Place(goal) => self.add(goal, FALLING | RISING)?,
            Target::Beyond(x, y) => self.add_at(x, y, FALLING | RISING)?,
            Target::Frontier => self.add_frontiers(&window.frontier, &reached, start)?,
        }
        self.goals = self.nodes.len() - 1;
        self.add_corners(&window.free, &reached)?;
        if window.has_dear {
            for y in 0..SIDE {
                *reached.row_mut(y) &= !window.dear.row(y);
            }
            self.add_corners(&reached, &reached)?;
        }
        if let Some(first) = self.nodes.first_mut() {
            (first.state, first.way, first.promise) = (State::Seen, 0.0, 0.0);
        }
        Ok(())
    }

    fn add(&mut self, place: Place, lines: u8) -> Result<(), PlanError> {
        self.add_at(place.x.into(), place.y.into(), lines)
    }

    fn add_at(&mut self, x: i16, y: i16, lines: u8) -> Result<(), PlanError> {
        let (way, promise) = (f32::MAX, f32::MAX);
        let node = Node { x, y, parent: 0, lines, state: State::New, way, promise };
        self.nodes.push(node).map_err(|_| PlanError::Crowded)
    }

    /// Each cluster of the frontier that can be reached as a goal: the cell that is nearest to the
    /// start. Large ones cost less.
    fn add_frontiers(
        &mut self,
        frontier: &Plane,
        reached: &Plane,
        start: Place,
    ) -> Result<(), PlanError> {
        let mut left = *frontier;
        for y in 0..SIDE {
            *left.row_mut(y) &= reached.row(y);
        }
        for price in &mut self.prices {
            let Some(first) = left.cells().next() else { break };
            let mut cluster = Plane::EMPTY;
            cluster.insert(first);
            cluster.flood(&left);
            for y in 0..SIDE {
                *left.row_mut(y) &= !cluster.row(y);
            }
            let square = |it: &Place| {
                let (x, y) = (it.x.abs_diff(start.x), it.y.abs_diff(start.y));
                u32::from(x) * u32::from(x) + u32::from(y) * u32::from(y)
            };
            let nearest = cluster.cells().min_by_key(square).unwrap_or(first);
            *price = (MOST_WORTH - cluster.len().min(MOST_WORTH)) as f32 * WORTH;
            let (x, y, lines) = (nearest.x.into(), nearest.y.into(), FALLING | RISING);
            let (way, promise) = (f32::MAX, f32::MAX);
            let node = Node { x, y, parent: 0, lines, state: State::New, way, promise };
            self.nodes.push(node).map_err(|_| PlanError::Crowded)?;
        }
        if self.nodes.len() > 1 { Ok(()) } else { Err(PlanError::NoFrontier) }
    }

    /// The corners of what is not free, as far as they can be reached.
    fn add_corners(&mut self, free: &Plane, reached: &Plane) -> Result<(), PlanError> {
        for y in 1..SIDE - 1 {
            let cells = reached.row(y);
            if cells == 0 {
                continue;
            }
            let (south, here, north) = (free.row(y - 1), free.row(y), free.row(y + 1));
            let (east, west) = (here >> 1, here << 1);
            // A side and the next are free, and what is between them is not.
            let falling = north & east & !(north >> 1) | south & west & !(south << 1);
            let rising = north & west & !(north << 1) | south & east & !(south >> 1);
            let mut corners = cells & (falling | rising);
            while corners != 0 {
                let x = corners.trailing_zeros();
                corners &= corners - 1;
                let has = |row: u64| (row >> (x % 64)) as u8 & 1;
                let lines = (has(falling) * FALLING) | (has(rising) * RISING);
                self.add_at(x as i16, y as i16, lines)?;
            }
        }
        Ok(())
    }

    /// How many corners there are, and how many have been expanded.
    pub fn corners(&self) -> (usize, usize) {
        let done = self.nodes.iter().filter(|node| node.state == State::Done);
        (self.nodes.len(), done.count())
    }

    /// Expands so many corners at the most, each for some 200 instructions for each corner.
    pub fn step(&mut self, window: &PlanningWindow, most: usize) -> Progress {
        for _ in 0..most {
            let Some(index) = self.next(window) else {
                return Progress::Failed(match self.target {
                    Target::Frontier => PlanError::NoFrontier,
                    _ => PlanError::Unreachable,
                });
            };
            let Some(node) = self.nodes.get_mut(index) else { break };
            // None is more promising than who is not asked any more.
            (node.state, node.promise) = (State::Done, f32::MAX);
            if (1..=self.goals).contains(&index) {
                self.found = index as u16;
                let inside = Place::new(node.x.into(), node.y.into());
                return Progress::Found(inside.unwrap_or(self.exit));
            }
            let node = *node;
            self.expand(index, node, window);
        }
        Progress::Searching
    }

    /// The most promising node that is seen.
    fn next(&mut self, window: &PlanningWindow) -> Option<usize> {
        loop {
            let (mut best, mut least) = (None, f32::MAX);
            for (index, node) in self.nodes.iter().enumerate() {
                if node.promise < least {
                    (best, least) = (Some(index), node.promise);
                }
            }
            let index = best?;
            let mut node = *self.nodes.get(index)?;
            if node.state != State::Seen {
                node = self.settled(index, node, window);
                *self.nodes.get_mut(index)? = node;
            }
            if node.promise <= least {
                return best;
            }
        }
    }

    /// A node with the best parent, of those that are done, that sees it.
    #[inline(never)]
    fn settled(&mut self, index: usize, mut node: Node, window: &PlanningWindow) -> Node {
        let rest = node.promise - node.way;
        let is_goal = index <= self.goals;
        let (mut best, mut from) = (f32::MAX, 0);
        // Who promised most is looked at first. If it sees the node at that price nobody is better.
        let promised = node.parent;
        if let Some(parent) = self.nodes.get(usize::from(promised))
            && let Some((dear, exit)) = sight(parent, &node, is_goal, window)
        {
            (best, from) = (node.way + dear, promised);
            self.exit = exit.unwrap_or(self.exit);
        }
        if best > node.way {
            for (index, other) in self.nodes.iter().enumerate() {
                if other.state != State::Done || index == usize::from(promised) {
                    continue;
                }
                let way = other.way + between(other, &node);
                if way < best
                    && may_see(other, &node)
                    && let Some((dear, exit)) = sight(other, &node, is_goal, window)
                    && way + dear < best
                {
                    (best, from) = (way + dear, index as u16);
                    self.exit = exit.unwrap_or(self.exit);
                }
            }
        }
        let promise = if best < f32::MAX { best + rest } else { f32::MAX };
        (node.way, node.promise) = (best, promise);
        (node.parent, node.state) = (from, State::Seen);
        node
    }

    /// Promises the others a way by a node that is done.
    #[inline(never)]
    fn expand(&mut self, index: usize, from: Node, window: &PlanningWindow) {
        let Self { nodes, goals, prices, target, exit, .. } = self;
        let goal = nodes.get(1).copied();
        for (other, node) in nodes.iter_mut().enumerate() {
            if node.state == State::Done || !may_see(&from, node) {
                continue;
            }
            let mut way = from.way + between(&from, node);
            if way >= node.way {
                continue;
            }
            // Whom the others do not see, or by a longer way, is looked at now.
            if node.state == State::Seen {
                let Some((dear, left)) = sight(&from, node, other <= *goals, window) else {
                    continue;
                };
                way += dear;
                if way >= node.way {
                    continue;
                }
                *exit = left.unwrap_or(*exit);
            } else {
                node.state = State::Promised;
            }
            let rest = match (*target, &goal) {
                (Target::Frontier, _) if other <= *goals => {
                    other.checked_sub(1).and_then(|it| prices.get(it)).copied().unwrap_or(0.0)
                }
                (Target::Frontier, _) | (_, None) => 0.0,
                (_, Some(goal)) => between(node, goal),
            };
            (node.way, node.promise, node.parent) = (way, way + rest, index as u16);
        }
    }

    /// The way that has been found.
    pub fn path(&self) -> Path {
        let parents = |index: &u16| {
            let node = self.nodes.get(usize::from(*index)).filter(|_| *index != 0)?;
            Some(node.parent)
        };
        let back = || core::iter::successors(Some(self.found), parents).take(MOST_NODES);
        let beyond = back().count().saturating_sub(MAX_POINTS);
        let mut places = Vec::new();
        for index in back().skip(beyond) {
            let node = self.nodes.get(usize::from(index));
            let place = node.and_then(|node| Place::new(node.x.into(), node.y.into()));
            // No more than there is room for.
            let _ = places.push(place.unwrap_or(self.exit));
        }
        places.reverse();
        Path { places, is_whole: beyond == 0 }
    }
}

/// Whether a node sees another: what it costs more for what is dear in between, and where the line
/// leaves the window towards a goal outside.
fn sight(
    from: &Node,
    to: &Node,
    is_goal: bool,
    window: &PlanningWindow,
) -> Option<(f32, Option<Place>)> {
    let place = Place::new(from.x.into(), from.y.into())?;
    match window.line(place, (to.x.into(), to.y.into())) {
        Line::Clear { dear } => Some((DEAR * dear as f32, None)),
        Line::Leaves(place) if is_goal => Some((0.0, Some(place))),
        _ => None,
    }
}

/// Whether a shortest way may go straight from one corner to another: the line passes by the
/// obstacle of each. Past that of one it may go by as little as it could miss it.
#[inline(always)]
fn may_see(a: &Node, b: &Node) -> bool {
    let (x, y) = (i32::from(b.x - a.x), i32::from(b.y - a.y));
    let lines = if x ^ y < 0 { FALLING } else { RISING };
    if a.lines & b.lines & lines != 0 || x == 0 || y == 0 {
        return true;
    }
    let (x, y) = (x.abs(), y.abs());
    (a.lines | b.lines) & lines != 0 && (3 * x < y || 3 * y < x)
}

/// From one node to another, in cells.
#[inline(always)]
fn between(a: &Node, b: &Node) -> f32 {
    let (x, y) = (i32::from(a.x - b.x), i32::from(a.y - b.y));
    root((x * x + y * y) as f32)
}
