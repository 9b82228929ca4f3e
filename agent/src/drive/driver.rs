//! What the robot shall do, and what it knows, to what its wheels do.

use heapless::Vec;
use ubimap_protocol::{
    message::Waypoint,
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use super::{
    follow::{DriveCommand, Follower, Hindrance, Motion, Sight},
    near::NearPoints,
    plan::{PlanError, Planner, Progress, Target},
    plane::{Place, SIDE},
    reason::Reason,
    safety::{Health, Safety, SafetyLimits},
    window::{GivenUp, GroundRow, MAX_LEVEL, Mover, View, Window},
};
use crate::trigonometry::radians;

/// What does not change while the robot drives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// What the robot can do.
    pub motion: Motion,
    /// When it must stand.
    pub safety: SafetyLimits,
    /// The side of the map's cells.
    pub resolution: Millimetres,
    /// Whether ground that the cameras see is worth exploring, too.
    pub explore_covered: bool,
    /// Cells that a search may expand in a step, about 350 instructions each.
    pub cells_per_step: usize,
}

impl Default for Config {
    /// 5 cm cells, 128 cells a step.
    fn default() -> Self {
        Self {
            motion: Motion::default(),
            safety: SafetyLimits::default(),
            resolution: Millimetres(50),
            explore_covered: false,
            cells_per_step: 128,
        }
    }
}

/// What to do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Task {
    /// To stand.
    #[default]
    Stand,
    /// To go to a point of `map`.
    Go(Waypoint),
    /// To map all blind ground that can be reached, then to come back to a point of `map`.
    Explore(Option<Waypoint>),
}

/// What is known at a step.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'i> {
    /// The moment, where the robot is, and what is amiss.
    pub health: Health,
    /// The newest scan.
    pub near: &'i NearPoints,
    /// What the cameras see that is not on the map: people, other robots, things.
    pub movers: &'i [Mover],
}

/// The most places from which blind ground was given up. With more the robot stops exploring.
const MOST_GIVEN_UP: usize = 48;
/// How often the map is looked at.
const REFRESH: Duration = Duration::from_millis(500);
/// How often a way is looked for again.
const REPLAN: Duration = Duration::from_secs(4);
/// How long is waited for a way to become clear before another one is looked for.
const PATIENCE: Duration = Duration::from_secs(3);
/// How long what was waited for counts as an obstacle.
const AVOIDED: Duration = Duration::from_secs(10);
/// How long is waited when there is no way.
const RETRY: Duration = Duration::from_secs(2);
/// Steps are no longer than this for what is reckoned with, in seconds.
const LONGEST_STEP: f32 = 0.2;

/// Which windows and targets are tried, one after the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Attempt {
    level: u32,
    /// Coarser windows have been tried: finer ones are left.
    finer: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    /// Nothing to do, or it is done.
    Resting(Reason),
    /// A way is being looked for, from where the robot was.
    Searching(Attempt),
    /// It drives.
    Driving,
    /// It turns to look around: how far it has, and where it looked last.
    Looking { turned: f32, last: Pose },
    /// There is no way; it is tried again.
    Stuck { why: PlanError, since: Instant },
}

/// Drives.
#[derive(Debug)]
pub struct Driver {
    config: Config,
    window: Window,
    planner: Planner,
    follower: Follower,
    safety: Safety,
    task: Task,
    phase: Phase,
    given_up: Vec<GivenUp, MOST_GIVEN_UP>,
    /// The window's level, and what the path leads to.
    level: u32,
    target: Target,
    /// Whether the path can still be driven while a new one is looked for.
    has_path: bool,
    /// Whether all has been explored, and it is on its way home.
    goes_home: bool,
    last: Option<Instant>,
    looked: Instant,
    planned: Instant,
    /// Since when something has hindered it, and when that was found to be an obstacle.
    hindered: Option<Instant>,
    avoided: Option<Instant>,
    command: DriveCommand,
    reason: Reason,
    told: Reason,
}

impl Driver {
    /// A robot that stands. It takes about 11 kB.
    pub fn new(config: Config) -> Self {
        Self {
            config,
            window: Window::default(),
            planner: Planner::default(),
            follower: Follower::new(config.motion),
            safety: Safety::new(config.safety),
            task: Task::Stand,
            phase: Phase::Resting(Reason::NoTask),
            given_up: Vec::new(),
            level: 0,
            target: Target::Frontier,
            has_path: false,
            goes_home: false,
            last: None,
            looked: Instant(0),
            planned: Instant(0),
            hindered: None,
            avoided: None,
            command: DriveCommand::STAND,
            reason: Reason::NoTask,
            told: Reason::NoTask,
        }
    }

    /// Gives it another task. The same once more is begun anew.
    pub fn set_task(&mut self, task: Task) {
        self.task = task;
        self.goes_home = false;
        self.given_up.clear();
        self.safety.forgive();
        self.set_out();
    }

    /// What it does now.
    pub fn reason(&self) -> Reason {
        self.reason
    }

    /// The reason, once each time it has changed.
    pub fn poll_event(&mut self) -> Option<Reason> {
        (self.told != self.reason).then(|| {
            self.told = self.reason;
            self.reason
        })
    }

    /// The ground as it was last looked at.
    pub fn window(&self) -> &Window {
        &self.window
    }

    /// What the wheels shall do until the next step. `ground` gives, for a column of tiles and a row
    /// of cells of the map, 32 cells. Steps should come at 10 Hz or more.
    pub fn step(
        &mut self,
        inputs: &Inputs<'_>,
        ground: impl Fn(i32, i32) -> GroundRow,
    ) -> DriveCommand {
        let now = inputs.health.now;
        let since = self.last.map_or(0, |last| now.since(last).micros());
        let elapsed = (since as f32 * 1.0e-6).min(LONGEST_STEP);
        self.last = Some(now);
        let amiss = self.safety.check(&inputs.health, self.command);
        let (command, reason) = match (amiss, inputs.health.pose) {
            (None, Some((pose, unsure))) => {
                let sight = Step { inputs, pose, unsure, elapsed, now };
                self.go_on(&sight, &ground)
            }
            (amiss, _) => (self.follower.stand(), amiss.unwrap_or(Reason::PoseLost)),
        };
        (self.command, self.reason) = (command, reason);
        command
    }

    /// Looks for a way to what the task wants.
    fn set_out(&mut self) {
        self.has_path = false;
        self.hindered = None;
        self.phase = match self.task {
            Task::Stand => Phase::Resting(Reason::NoTask),
            _ => Phase::Searching(Attempt { level: 0, finer: false }),
        };
        self.planned = Instant(0);
    }

    fn go_on(
        &mut self,
        step: &Step<'_>,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) -> (DriveCommand, Reason) {
        match self.phase {
            Phase::Resting(reason) => (self.follower.stand(), reason),
            Phase::Stuck { why, since } => {
                if step.now.since(since) >= RETRY {
                    self.set_out();
                }
                (self.follower.stand(), Reason::NoWay(why))
            }
            Phase::Searching(attempt) => {
                self.search(attempt, step, ground);
                if self.has_path {
                    self.drive(step)
                } else {
                    (self.follower.stand(), self.waiting())
                }
            }
            Phase::Driving => {
                self.look(step, ground);
                self.drive(step)
            }
            Phase::Looking { turned, last } => self.look_around(turned, last, step, ground),
        }
    }

    /// What is told while it stands to think.
    fn waiting(&self) -> Reason {
        match self.reason {
            Reason::NoWay(_) | Reason::Blocked | Reason::Person => self.reason,
            _ => Reason::Driving,
        }
    }

    /// The goal, if it has one: the task's, or home.
    fn goal(&self) -> Option<Waypoint> {
        match self.task {
            Task::Go(goal) => Some(goal),
            Task::Explore(home) if self.goes_home => home,
            _ => None,
        }
    }

    /// Fills the window.
    fn fill(&mut self, level: u32, step: &Step<'_>, ground: &impl Fn(i32, i32) -> GroundRow) {
        let none = NearPoints::default();
        // What walks by is no obstacle; what has been waited for is.
        let avoids = self.avoided.is_some_and(|since| step.now.since(since) < AVOIDED);
        let motion = &self.config.motion;
        let view = View {
            pose: step.pose,
            resolution: self.config.resolution,
            level,
            radius: motion.radius.saturating_add(motion.margin),
            near: if avoids { step.inputs.near } else { &none },
            movers: step.inputs.movers,
            given_up: &self.given_up,
            explore_covered: self.config.explore_covered,
        };
        self.window.fill(&view, ground);
        self.level = level;
        self.looked = step.now;
    }

    /// Looks at the map again, and whether the path still leads to something.
    fn look(&mut self, step: &Step<'_>, ground: &impl Fn(i32, i32) -> GroundRow) {
        if step.now.since(self.looked) < REFRESH {
            return;
        }
        self.fill(self.level, step, ground);
        let leads = match self.target {
            Target::Frontier => self.is_frontier(),
            _ => step.now.since(self.planned) < REPLAN,
        };
        let clear = self.follower.is_clear(&self.window, step.pose);
        if !(leads && clear) {
            self.set_out();
            self.has_path = clear;
        }
    }

    /// Whether there is blind ground near the path's end.
    fn is_frontier(&self) -> bool {
        let end = self.follower.end().and_then(|end| self.window.place(end));
        end.is_some_and(|place| self.window.frontier.has(place))
    }

    /// Begins a search, or goes on with one.
    fn search(
        &mut self,
        attempt: Attempt,
        step: &Step<'_>,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) {
        let progress = if self.planned == Instant(0) {
            let attempt = self.first_level(attempt, step.pose);
            self.phase = Phase::Searching(attempt);
            self.fill(attempt.level, step, ground);
            self.target = self.target_at(attempt);
            self.planned = step.now;
            let start = self.window.place(Waypoint { x: step.pose.x, y: step.pose.y });
            let start = start.unwrap_or_default();
            match self.planner.begin(&self.window, start, self.target) {
                Ok(()) => Progress::Searching,
                Err(error) => Progress::Failed(error),
            }
        } else {
            self.planner.step(&mut self.window, self.config.cells_per_step)
        };
        match progress {
            Progress::Searching => {}
            Progress::Found(place) => {
                self.take_path(place);
                self.phase = Phase::Driving;
            }
            Progress::Failed(error) => self.try_otherwise(error, step.now),
        }
    }

    /// The finest level whose window holds the goal.
    fn first_level(&self, attempt: Attempt, pose: Pose) -> Attempt {
        let Some(goal) = self.goal() else { return attempt };
        let side = self.config.resolution.0.max(1).saturating_mul(SIDE as i32 / 2 - 3);
        let far = |a: Millimetres, b: Millimetres| a.0.abs_diff(b.0);
        let far = far(goal.x, pose.x).max(far(goal.y, pose.y));
        let holds = |&level: &u32| far <= side.unsigned_abs() << level;
        let level = (0..MAX_LEVEL).find(holds).unwrap_or(MAX_LEVEL);
        let level = if attempt.finer { attempt.level } else { attempt.level.max(level) };
        Attempt { level, ..attempt }
    }

    fn target_at(&self, attempt: Attempt) -> Target {
        let Some(goal) = self.goal() else { return Target::Frontier };
        let (x, y) = self.window.column_and_row(goal);
        let inner = |it: i32| (1..SIDE as i32 - 1).contains(&it);
        match Place::new(x, y).filter(|_| inner(x) && inner(y)) {
            Some(place) if attempt.level == 0 || self.window.free.has(place) => {
                Target::Place(place)
            }
            Some(place) => match self.window.nearest_free(place) {
                // A coarse cell is blocked more easily: near it the finer window knows better.
                Some(near) => Target::Place(near),
                None => Target::Place(place),
            },
            // Far enough to tell the direction.
            None => Target::Beyond(x.clamp(-1_000, 1_000), y.clamp(-1_000, 1_000)),
        }
    }

    /// Takes the way to a place.
    fn take_path(&mut self, place: Place) {
        let path = self.planner.path(&self.window, place);
        let mut route = Vec::new();
        for &place in &path.places {
            // As long as a path.
            let _ = route.push(self.window.middle(place));
        }
        // A goal is driven to, not the middle of its cell.
        let is_goal = self.target == Target::Place(place) && self.level == 0;
        if let (true, true, Some(goal), Some(end)) =
            (is_goal, path.is_whole, self.goal(), route.last_mut())
        {
            *end = goal;
        }
        self.follower.take(route);
        self.has_path = true;
        self.hindered = None;
    }

    /// Another window, or the end.
    fn try_otherwise(&mut self, error: PlanError, now: Instant) {
        let Phase::Searching(attempt) = self.phase else { return };
        let is_inside = matches!(self.target, Target::Place(_));
        let next = if !attempt.finer && self.level < MAX_LEVEL {
            // What is blocked in the finest window is blocked.
            let blocked = error == PlanError::GoalBlocked && self.level == 0;
            (!blocked).then_some(Attempt { level: self.level + 1, finer: false })
        } else if self.goal().is_some() && self.level > 0 && !(is_inside && attempt.finer) {
            Some(Attempt { level: self.level - 1, finer: true })
        } else {
            None
        };
        if let Some(next) = next {
            self.phase = Phase::Searching(next);
            self.planned = Instant(0);
            return;
        }
        self.has_path = false;
        self.phase = match (self.task, error) {
            (Task::Explore(home), PlanError::NoFrontier) if !self.goes_home => {
                if home.is_some() {
                    self.goes_home = true;
                    return self.set_out();
                }
                Phase::Resting(Reason::Explored)
            }
            _ => Phase::Stuck { why: error, since: now },
        };
    }

    /// Drives along the path.
    fn drive(&mut self, step: &Step<'_>) -> (DriveCommand, Reason) {
        let sight = Sight {
            pose: step.pose,
            unsure: step.unsure,
            near: step.inputs.near,
            movers: step.inputs.movers,
            window: &self.window,
            elapsed: step.elapsed,
        };
        let (command, hindrance) = self.follower.step(&sight);
        let reason = match hindrance {
            None => {
                // Only a stretch driven shows that the way is clear again.
                if command.speed > 0 {
                    self.hindered = None;
                }
                Reason::Driving
            }
            Some(Hindrance::Arrived) => return (command, self.arrive(step)),
            Some(Hindrance::OffPath) => {
                self.set_out();
                Reason::Driving
            }
            Some(hindrance) => {
                let since = *self.hindered.get_or_insert(step.now);
                if step.now.since(since) >= PATIENCE {
                    self.avoided = Some(step.now);
                    self.set_out();
                }
                match hindrance {
                    Hindrance::Person => Reason::Person,
                    _ => Reason::Blocked,
                }
            }
        };
        (command, reason)
    }

    /// At the end of the path.
    fn arrive(&mut self, step: &Step<'_>) -> Reason {
        if !matches!(self.phase, Phase::Driving) {
            // Another path is being looked for.
            self.has_path = false;
            return Reason::Driving;
        }
        if self.target == Target::Frontier {
            self.phase = Phase::Looking { turned: 0.0, last: step.pose };
            return Reason::Driving;
        }
        let at_goal = self.goal().zip(self.follower.end()).is_some_and(|(goal, end)| goal == end);
        if !at_goal {
            self.set_out();
            return Reason::Driving;
        }
        let reason = if self.goes_home { Reason::Explored } else { Reason::Arrived };
        self.phase = Phase::Resting(reason);
        reason
    }

    /// Turns once round at a frontier, as long as there is blind ground near.
    fn look_around(
        &mut self,
        turned: f32,
        last: Pose,
        step: &Step<'_>,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) -> (DriveCommand, Reason) {
        let turned = turned + radians(step.pose.heading - last.heading);
        self.phase = Phase::Looking { turned, last: step.pose };
        let done = turned > core::f32::consts::TAU;
        if done || step.now.since(self.looked) >= REFRESH {
            self.fill(self.level, step, ground);
            if !self.is_frontier() {
                self.set_out();
            } else if done {
                self.give_up();
            }
        }
        (self.follower.spin(true, step.elapsed), Reason::Driving)
    }

    /// What can't be seen from here is passed over from now on.
    fn give_up(&mut self) {
        let reach = self.window.frontier_reach(self.config.motion.radius);
        let given_up = self.follower.end().map(|at| GivenUp { at, reach });
        if given_up.is_some_and(|it| self.given_up.push(it).is_ok()) {
            self.set_out();
        } else {
            self.phase = Phase::Resting(Reason::Explored);
        }
    }
}

/// What a step has to do with.
struct Step<'s> {
    inputs: &'s Inputs<'s>,
    pose: Pose,
    unsure: f32,
    elapsed: f32,
    now: Instant,
}
