//! The search for a route to a goal or to the best frontier: it plans in windows of the map, from
//! the finest to the coarsest.
//!
//! A goal is searched for in the finest window that contains it, then in coarser ones. The robot
//! drives only routes planned in the finest window: the result of a coarse window is planned again
//! there, as far as the finest window reaches. A goal that can't be reached within any window is
//! approached through the rims of the finer ones. A way in a coarse window that ends where the robot stands is none.

use heapless::Vec;
use ubimap_protocol::{
    message::Waypoint,
    units::{Millimetres, Pose},
};

use super::{
    path::MAX_POINTS,
    plan::{PlanError, Planner, Progress, Target},
    plane::{Place, SIDE},
    planning_window::{
        GivenUp, GroundRow, MAX_LEVEL, PlanningWindow, WindowInputs, frontier_reach,
    },
};

/// The points of a route.
pub(super) type Route = Vec<Waypoint, MAX_POINTS>;

/// What a route is searched to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Sought {
    /// The best frontier.
    Frontier,
    /// A goal.
    Goal(Waypoint),
    /// A goal that drift may have moved into a wall: the route ends at the free cell nearest to it.
    Home(Waypoint),
}

impl Sought {
    /// The point searched for, if it is known.
    fn point(self) -> Option<Waypoint> {
        match self {
            Self::Frontier => None,
            Self::Goal(at) | Self::Home(at) => Some(at),
        }
    }
}

/// Maximum distance in cells between a goal and the free cell that stands in for it: less than the
/// distance from a wall to the first free cell.
const BESIDE: u8 = 3;

/// Maximum number of places where blind ground is given up.
const MAX_GIVEN_UP: usize = 48;

/// Where a route leads.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum End {
    /// To the goal.
    Goal,
    /// The route ends at a frontier: its point, and the level of the window in which it was found.
    Frontier(Waypoint, u32),
    /// The route ends at an intermediate point, from which another route is needed.
    OnTheWay,
}

/// State of a search.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Outcome {
    Searching,
    /// [`Search::route`] has the route.
    Found(End),
    Failed(PlanError),
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Attempt {
    level: u32,
    /// The finest level whose window contains the goal (see [`WindowInputs::level`]).
    finest: u32,
    /// Whether the path may leave through the rim of a window that does not contain the goal.
    beyond: bool,
    /// The result of a coarse window: an intermediate point in the finest window, and where the
    /// whole route leads.
    via: Option<(Waypoint, End)>,
    /// Whether it starts on ground that the coarse window cuts off, which the finest one must confirm.
    cut_off: bool,
}

/// The stages of an attempt. Each is a step of its own, which bounds the instructions of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// Fills the window.
    Fill,
    /// Finds the window's corners.
    Begin,
    /// Expands corners.
    Expand,
}

/// Working memory of a search: a window of the map and the planner, 7.6 KiB.
#[derive(Debug)]
pub struct Workspace {
    window: PlanningWindow,
    planner: Planner,
}

impl Workspace {
    /// Unused memory: all zero bits.
    pub const EMPTY: Self = Self { window: PlanningWindow::EMPTY, planner: Planner::EMPTY };
}

/// Searches for routes.
#[derive(Debug)]
pub(super) struct Search<'b> {
    workspace: &'b mut Workspace,
    given_up: Vec<GivenUp, MAX_GIVEN_UP>,
    sought: Sought,
    attempt: Attempt,
    /// What the next step does for it.
    stage: Stage,
    target: Target,
    route: Route,
}

impl<'b> Search<'b> {
    pub(super) fn new(workspace: &'b mut Workspace) -> Self {
        Self {
            workspace,
            given_up: Vec::new(),
            sought: Sought::Frontier,
            attempt: Attempt { level: 0, finest: 0, beyond: false, via: None, cut_off: false },
            stage: Stage::Fill,
            target: Target::Frontier,
            route: Route::new(),
        }
    }

    /// The planning window as last filled.
    pub(super) fn window(&self) -> &PlanningWindow {
        &self.workspace.window
    }

    /// The last route found.
    pub(super) fn route(&self) -> &Route {
        &self.route
    }

    /// Restarts the search at `pose`.
    pub(super) fn begin(&mut self, sought: Sought, pose: Pose, resolution: Millimetres) {
        let side = resolution.0.max(1).saturating_mul(SIDE as i32 / 2 - 3).unsigned_abs();
        let far = sought.point().map_or(0, |goal| distance(&goal, pose));
        let holds = |&level: &u32| far <= side.saturating_mul(1 << level);
        let finest = (0..MAX_LEVEL).find(holds).unwrap_or(MAX_LEVEL);
        self.sought = sought;
        self.attempt = Attempt { level: finest, finest, beyond: false, via: None, cut_off: false };
        self.stage = Stage::Fill;
    }

    /// Continues the search by one stage, examining about `pairs` pairs of corners.
    pub(super) fn step(
        &mut self,
        view: &WindowInputs<'_>,
        ground: &impl Fn(i32, i32) -> GroundRow,
        pairs: usize,
    ) -> Outcome {
        let progress = match self.stage {
            Stage::Fill if self.is_there_already(view) => Progress::Failed(PlanError::Unreachable),
            Stage::Fill => {
                let level = if self.attempt.via.is_some() { 0 } else { self.attempt.level };
                self.fill(level, view, ground);
                self.stage = Stage::Begin;
                Progress::Searching
            }
            Stage::Begin => {
                self.stage = Stage::Expand;
                self.target = self.target();
                let Workspace { window, planner } = &mut *self.workspace;
                let start = window.place(Waypoint { x: view.pose.x, y: view.pose.y });
                let start = start.unwrap_or_default();
                let mut begun = planner.begin(window, start, self.target);
                if begun == Err(PlanError::NoFrontier)
                    && self.attempt.level > 0
                    && let Some(other) = window.nearest_cut_off(start)
                {
                    self.attempt.cut_off = true;
                    begun = planner.begin(window, other, self.target);
                }
                match begun {
                    Ok(()) => Progress::Searching,
                    Err(error) => Progress::Failed(error),
                }
            }
            Stage::Expand => {
                let Workspace { window, planner } = &mut *self.workspace;
                planner.step(window, pairs)
            }
        };
        match progress {
            Progress::Searching => Outcome::Searching,
            Progress::Found(place) => self.found(place, view.pose),
            Progress::Failed(error) => self.try_otherwise(error, view),
        }
    }

    /// Whether a coarse window saw the goal, or a way to it, where the robot stands already.
    fn is_there_already(&self, view: &WindowInputs<'_>) -> bool {
        let reach = u32::from(view.radius);
        matches!(&self.attempt.via, Some((via, End::OnTheWay)) if distance(via, view.pose) <= reach)
    }

    /// Fills the window from the map, at this level.
    pub(super) fn fill(
        &mut self,
        level: u32,
        view: &WindowInputs<'_>,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) {
        let view = WindowInputs { level, given_up: &self.given_up, ..*view };
        self.workspace.window.fill(&view, ground);
    }

    /// Whether blind ground is near a point, in the window as last filled.
    pub(super) fn is_frontier(&self, point: Waypoint) -> bool {
        self.workspace
            .window
            .place(point)
            .is_some_and(|place| self.workspace.window.frontier.has(place))
    }

    /// Gives up the blind ground whose frontier, in a window of this level, includes the point
    /// `at`. Returns `false` if the list of given-up places is full.
    pub(super) fn give_up(&mut self, at: Waypoint, level: u32, view: &WindowInputs<'_>) -> bool {
        let cell = view.resolution.0.saturating_mul(1 << level.min(MAX_LEVEL));
        let reach = frontier_reach(view.radius, cell);
        self.given_up.push(GivenUp { at, reach }).is_ok()
    }

    /// Clears the given-up ground.
    pub(super) fn forget(&mut self) {
        self.given_up.clear();
    }

    fn target(&self) -> Target {
        let goal = match (self.attempt.via, self.sought.point()) {
            (Some((via, _)), _) => via,
            (None, Some(goal)) => goal,
            (None, None) => return Target::Frontier,
        };
        let (x, y) = self.workspace.window.column_and_row(goal);
        let inner = |it: i32| (1..SIDE as i32 - 1).contains(&it);
        let Some(place) = Place::new(x, y).filter(|_| inner(x) && inner(y)) else {
            // Clamped: only the direction matters.
            let far = |it: i32| it.clamp(-1_000, 1_000) as i16;
            return Target::Beyond(far(x), far(y));
        };
        // In a coarse window, or for an intermediate point, any free cell nearby will do, because
        // another window decides. For a goal itself the free cell must be within `BESIDE`: otherwise
        // the goal is inside or behind an obstacle.
        let is_home = matches!(self.sought, Sought::Home(_));
        let is_rough = self.attempt.via.is_some() || self.attempt.level > 0 || is_home;
        let is_beside = |near: &Place| {
            let (across, up) = (near.x.abs_diff(place.x), near.y.abs_diff(place.y));
            across.max(up) <= BESIDE
        };
        let near =
            self.workspace.window.nearest_free(place).filter(|near| is_rough || is_beside(near));
        Target::Place(near.unwrap_or(place))
    }

    // Not inlined: smaller.
    #[inline(never)]
    fn found(&mut self, place: Place, pose: Pose) -> Outcome {
        let path = self.workspace.planner.path();
        let mut route = Route::new();
        for &place in &path.places {
            // A route has the capacity of a path.
            let _ = route.push(self.workspace.window.middle(place));
        }
        let whole = path.is_whole;
        let end = match (self.target, self.sought.point()) {
            (Target::Frontier, _) if whole => {
                End::Frontier(self.workspace.window.middle(place), self.attempt.level)
            }
            (Target::Place(_), Some(_)) if whole => End::Goal,
            _ => End::OnTheWay,
        };
        if let Some((_, end)) = self.attempt.via {
            let end = if whole { end } else { End::OnTheWay };
            return self.keep(route, end);
        }
        if self.attempt.level == 0 {
            return self.keep(route, end);
        }
        let reach = self.workspace.window.cell() >> self.attempt.level;
        let (via, is_end) = within(&route, pose, reach.saturating_mul(SIDE as i32 / 2 - 4));
        // If the goal were within reach, the finest window would have found it. So the end within
        // reach is a frontier or an intermediate point.
        let end = if is_end && end != End::Goal { end } else { End::OnTheWay };
        self.attempt.via = Some((via, end));
        self.stage = Stage::Fill;
        Outcome::Searching
    }

    /// Stores the route, with the goal itself in place of its cell's centre.
    fn keep(&mut self, mut route: Route, end: End) -> Outcome {
        if let (End::Goal, Sought::Goal(goal), Some(last)) = (end, self.sought, route.last_mut()) {
            *last = goal;
        }
        self.route = route;
        Outcome::Found(end)
    }

    /// Tries another window, or fails.
    fn try_otherwise(&mut self, error: PlanError, view: &WindowInputs<'_>) -> Outcome {
        let Attempt { level, finest, beyond, via, cut_off } = self.attempt;
        if cut_off && via.is_some() {
            // It lies behind a wall.
            return Outcome::Failed(PlanError::NoFrontier);
        }
        if let Some((_, End::Frontier(at, level))) = via
            && self.give_up(at, level, view)
        {
            // The frontier is not where the coarse window saw it, so the coarse window searches
            // again without it.
            return self.attempt_at(level, false);
        }
        // The finest window is the authority: a goal that is blocked there is blocked.
        let is_known = error == PlanError::GoalBlocked && level == 0 && via.is_none();
        if is_known || error == PlanError::StartBlocked && level == 0 {
            return Outcome::Failed(error);
        }
        if !beyond && level < MAX_LEVEL {
            return self.attempt_at(level + 1, false);
        }
        match (if beyond { level } else { finest }).checked_sub(1) {
            Some(level) if self.sought != Sought::Frontier => self.attempt_at(level, true),
            _ => Outcome::Failed(error),
        }
    }

    fn attempt_at(&mut self, level: u32, beyond: bool) -> Outcome {
        self.attempt = Attempt { level, beyond, via: None, cut_off: false, ..self.attempt };
        self.stage = Stage::Fill;
        Outcome::Searching
    }
}

/// The last point of a route that is within `reach` of a pose along both axes, and whether it is
/// the route's end.
fn within(route: &Route, pose: Pose, reach: i32) -> (Waypoint, bool) {
    let is_near = |point: &Waypoint| distance(point, pose) <= reach.unsigned_abs();
    let mut last = Waypoint { x: pose.x, y: pose.y };
    for point in route {
        if is_near(point) {
            last = *point;
            continue;
        }
        // Bisects the leg to find its last point within reach, to 1/256 of its length.
        let (mut inside, mut outside) = (last, *point);
        for _ in 0..8 {
            let half = |a: Millimetres, b: Millimetres| Millimetres((a.0 >> 1) + (b.0 >> 1));
            let middle = Waypoint { x: half(inside.x, outside.x), y: half(inside.y, outside.y) };
            if is_near(&middle) { inside = middle } else { outside = middle }
        }
        return (inside, false);
    }
    (last, true)
}

/// The distance of a point from a pose along the axis on which it is farther, in millimetres.
fn distance(point: &Waypoint, pose: Pose) -> u32 {
    point.x.0.abs_diff(pose.x.0).max(point.y.0.abs_diff(pose.y.0))
}
