//! The shortest path across a window, from corner to corner of its obstacles, in 6.2 KiB.
//!
//! A shortest path bends only around corners of obstacles. So the search is A* over these corners
//! and the two ends, joined by straight lines: lengths are exact in any direction, and the path
//! needs no smoothing. Corners are found 64 cells at a time. Visibility between two corners is
//! assumed at first and checked only when the second becomes the most promising one (Lazy Theta*:
//! Nash, Koenig, Tovey 2010), so most lines are never traced.

use core::fmt;

use heapless::Vec;

use super::{
    path::{MAX_POINTS, Path},
    plane::{Place, Plane, SIDE},
    planning_window::{Line, PlanningWindow},
    root::root,
};

/// Maximum number of corners in a window.
const MAX_NODES: usize = 384;
/// Maximum number of frontier clusters considered.
const MAX_FRONTIERS: usize = 16;

/// Extra cost of a cell that a movable object may occupy, in cells.
const DEAR: f32 = 2.0;
/// Value of a frontier cell in cells of path length, and the maximum number of its cells that
/// count: a frontier is worth a detour of at most 30 cells.
const WORTH: f32 = 30.0 / MAX_WORTH as f32;
const MAX_WORTH: u32 = 256;

/// Where to plan to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// The best frontier: its number of cells, weighed against its distance.
    Frontier,
    /// A cell.
    Place(Place),
    /// A goal outside the window: its column and row relative to the window's south-western corner,
    /// at most 1,000 cells away. The path leaves the window through its rim.
    Beyond(i16, i16),
}

/// Why there is no path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlanError {
    /// There is no free ground near the robot.
    StartBlocked,
    /// The goal is inside an obstacle, too close to one, or on unknown ground.
    GoalBlocked,
    /// No path leads there, for example because a door is closed.
    Unreachable,
    /// No frontier can be reached: mapping is complete.
    NoFrontier,
    /// The window has more corners than there is memory for.
    Crowded,
}

impl fmt::Display for PlanError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::StartBlocked => f.write_str("there is no free ground near the robot"),
            Self::GoalBlocked => f.write_str("the goal is blocked or on unknown ground"),
            Self::Unreachable => f.write_str("no path leads to the goal"),
            Self::NoFrontier => f.write_str("no unmapped ground can be reached"),
            Self::Crowded => f.write_str("the surroundings have too many corners for the planner"),
        }
    }
}

impl core::error::Error for PlanError {}

/// State of a search.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// The search has not ended: call `step` again.
    Searching,
    /// A path is found; this cell is its end.
    Found(Place),
    /// There is no path.
    Failed(PlanError),
}

/// The directions in which a line can touch a corner and leave its obstacle on one side: falling
/// from west to east past an obstacle in the north-east or south-west, or rising past one in the
/// north-west or south-east.
const FALLING: u8 = 1;
const RISING: u8 = 2;

#[derive(Clone, Copy, Debug, PartialEq)]
enum State {
    /// No parent has been offered.
    New,
    /// The parent is assumed to see the node; not checked yet.
    Promised,
    /// The best of the expanded nodes that see the node is its parent.
    Seen,
    /// Expanded: the shortest path to the node is known.
    Done,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    x: i16,
    y: i16,
    /// The previous node on the best path to this one.
    parent: u16,
    /// The directions of lines that pass this corner's own obstacle.
    lines: u8,
    state: State,
    /// Path length from the start, and its sum with a lower bound of the distance to the goal, in
    /// cells.
    way: f32,
    promise: f32,
}

/// A search that can be continued from call to call.
#[derive(Clone, Debug)]
pub struct Planner {
    /// The start, then the goals, then the corners.
    nodes: Vec<Node, MAX_NODES>,
    /// Number of goals, and the extra cost of each.
    goals: usize,
    prices: [f32; MAX_FRONTIERS],
    target: Target,
    /// The goal reached, and the cell where the path leaves the window if the goal is outside.
    found: u16,
    exit: Place,
}

const _: () = assert!(size_of::<Planner>() + size_of::<PlanningWindow>() <= 8 * 1024);

impl Planner {
    /// An idle planner: all zero bits.
    pub const EMPTY: Self = Self {
        nodes: Vec::new(),
        goals: 0,
        prices: [0.0; MAX_FRONTIERS],
        target: Target::Frontier,
        found: 0,
        exit: Place { x: 0, y: 0 },
    };

    /// Begins a search. The window must not change until the search ends. First floods the free
    /// cells, which detects goals behind closed doors at once. A start on a blocked cell is moved
    /// to the nearest free one. About 50,000 instructions, 1.5 KiB of stack.
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

    /// Adds a goal for each reachable frontier cluster: its cell nearest to the start. Larger
    /// clusters cost less.
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
            *price = (MAX_WORTH - cluster.len().min(MAX_WORTH)) as f32 * WORTH;
            let (x, y, lines) = (nearest.x.into(), nearest.y.into(), FALLING | RISING);
            let (way, promise) = (f32::MAX, f32::MAX);
            let node = Node { x, y, parent: 0, lines, state: State::New, way, promise };
            self.nodes.push(node).map_err(|_| PlanError::Crowded)?;
        }
        if self.nodes.len() > 1 { Ok(()) } else { Err(PlanError::NoFrontier) }
    }

    /// Adds the cells of `reached` that lie at a corner of an obstacle, which is made of cells not
    /// in `free`.
    fn add_corners(&mut self, free: &Plane, reached: &Plane) -> Result<(), PlanError> {
        for y in 1..SIDE - 1 {
            let cells = reached.row(y);
            if cells == 0 {
                continue;
            }
            let (south, here, north) = (free.row(y - 1), free.row(y), free.row(y + 1));
            let (east, west) = (here >> 1, here << 1);
            // Two adjacent sides are free and the diagonal cell between them is not.
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

    /// Number of corners found, and number of those expanded so far.
    pub fn corners(&self) -> (usize, usize) {
        let done = self.nodes.iter().filter(|node| node.state == State::Done);
        (self.nodes.len(), done.count())
    }

    /// Continues the search until it has examined about `most` pairs of corners, at least those of one
    /// corner. A pair takes up to 250 instructions, most take 50.
    pub fn step(&mut self, window: &PlanningWindow, most: usize) -> Progress {
        for _ in 0..(most / self.nodes.len().max(1)).max(1) {
            let Some((index, node)) = self.most_promising() else {
                return Progress::Failed(match self.target {
                    Target::Frontier => PlanError::NoFrontier,
                    _ => PlanError::Unreachable,
                });
            };
            if node.state != State::Seen {
                let settled = self.settled(index, node, window);
                if let Some(node) = self.nodes.get_mut(index) {
                    *node = settled;
                }
                if settled.promise > node.promise {
                    // Another may be more promising now.
                    continue;
                }
            }
            let Some(node) = self.nodes.get_mut(index) else { break };
            // Expanded nodes must never be the most promising.
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

    /// The node with the least promise, and its index.
    fn most_promising(&self) -> Option<(usize, Node)> {
        let (mut best, mut least) = (None, f32::MAX);
        for (index, node) in self.nodes.iter().enumerate() {
            if node.promise < least {
                (best, least) = (Some((index, *node)), node.promise);
            }
        }
        best
    }

    /// Checks a node, and gives it the best parent among the expanded nodes that see it.
    #[inline(never)]
    fn settled(&mut self, index: usize, mut node: Node, window: &PlanningWindow) -> Node {
        let rest = node.promise - node.way;
        let is_goal = index <= self.goals;
        let (mut best, mut from) = (f32::MAX, 0);
        // Tries the assumed parent first: if it sees the node at the assumed cost, no other parent
        // is better.
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

    /// Offers all other nodes the path through the node `from` that was just expanded.
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
            // The visibility of this node's parent has been checked, so a new parent must be
            // checked, too.
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

    /// The path found.
    pub fn path(&self) -> Path {
        let parents = |index: &u16| {
            let node = self.nodes.get(usize::from(*index)).filter(|_| *index != 0)?;
            Some(node.parent)
        };
        let back = || core::iter::successors(Some(self.found), parents).take(MAX_NODES);
        let beyond = back().count().saturating_sub(MAX_POINTS);
        let mut places = Vec::new();
        for index in back().skip(beyond) {
            let node = self.nodes.get(usize::from(index));
            let place = node.and_then(|node| Place::new(node.x.into(), node.y.into()));
            // The path has at most as many points as `places` holds.
            let _ = places.push(place.unwrap_or(self.exit));
        }
        places.reverse();
        Path { places, is_whole: beyond == 0 }
    }
}

/// Whether node `from` sees node `to`. Returns the extra cost of the cells in between, and the cell
/// where the line leaves the window if the goal is outside.
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

/// Whether a shortest path may lead straight from one corner to another: the line must pass the
/// obstacle of each corner on one side. A line that only touches an obstacle passes it.
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

/// Distance between two nodes, in cells.
#[inline(always)]
fn between(a: &Node, b: &Node) -> f32 {
    let (x, y) = (i32::from(a.x - b.x), i32::from(a.y - b.y));
    root((x * x + y * y) as f32)
}
