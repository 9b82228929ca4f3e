//! From the robot's task and inputs to the command for its wheels.

use ubimap_protocol::{
    message::Waypoint,
    time::Instant,
    units::{Millimetres, Pose},
};

use super::{
    driving::Driving,
    follow::{DriveCommand, Follower, Hindrance, Sight},
    look::{Gaze, LookAround},
    near::NearPoints,
    plan::PlanError,
    planning_window::{GroundRow, Mover, PlanningWindow, WindowInputs},
    reason::Reason,
    safety::{Health, Safety},
    search::{End, Outcome, Search, Sought, Workspace},
};
use crate::{
    timing::{
        AVOIDED_FOR, HINDERED_WAIT, LOST_REST, LOST_TURN, MAP_LOOK_INTERVAL, NO_WAY_RETRY,
        REPLAN_INTERVAL,
    },
    trigonometry::radians,
};

/// What the driver is asked to do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Task {
    /// Stand still.
    #[default]
    Stand,
    /// Go to a point of `map`.
    Go(Waypoint),
    /// Map all blind ground (ground that no camera sees) that can be reached, then return to this
    /// point of `map`, if given.
    Explore(Option<Waypoint>),
}

/// The inputs of a step.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'i> {
    /// Time, pose, and the inputs of the safety checks.
    pub health: Health,
    /// The newest scan.
    pub near: &'i NearPoints,
    /// Objects that the cameras see but the map does not contain: people, other robots, things.
    pub movers: &'i [Mover],
    /// Number of cells not mapped so far because the pool was full.
    pub cells_refused: u32,
}

/// Distance that the robot must drive before a hindrance counts as over, in millimetres.
const STRETCH: u32 = 200;
/// Upper limit of a step's duration in computations, in seconds.
const MAX_STEP: f32 = 0.2;

/// The reason why the robot can't drive on, since when, and the pose at that time.
#[derive(Clone, Copy, Debug)]
struct Hindered {
    since: Instant,
    at: Pose,
    reason: Reason,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    /// No task, or the task has ended for this reason.
    Resting(Reason),
    /// Looking for a path.
    Searching,
    /// Driving along the path.
    Driving,
    /// Turning to look at a frontier.
    Looking(Look),
    /// Turning to look around at a goal.
    LookingAround(Gaze, LookAround),
    /// No path; retried later.
    Stuck { why: PlanError, since: Instant },
}

/// A look at a frontier: the robot turns on the spot.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Look {
    /// The frontier's point, and the level of the window in which it was found (see
    /// [`WindowInputs::level`]).
    at: Waypoint,
    level: u32,
    /// Angle turned so far, in radians, and the pose at the last step.
    turned: f32,
    last: Pose,
}

/// Performs a [`Task`] by a map: plans paths, follows them, and waits for obstacles to go away.
#[derive(Debug)]
pub struct Driver<'b> {
    config: Driving,
    /// The side of a map cell.
    resolution: Millimetres,
    search: Search<'b>,
    follower: Follower,
    safety: Safety,
    task: Task,
    phase: Phase,
    /// Where the current path leads.
    end: End,
    /// Whether there is a path to drive: while a new one is searched for, the old one.
    has_path: bool,
    /// Whether the search has begun.
    is_begun: bool,
    /// Whether exploring is complete and the robot is driving home.
    goes_home: bool,
    /// Numbers of refused cells: when the task began, and now.
    refused: Option<[u32; 2]>,
    last: Option<Instant>,
    looked: Instant,
    planned: Instant,
    /// When the robot last began to turn on the spot to be found, or to find a way.
    turning: Option<Instant>,
    /// The current hindrance, and when it was last declared an obstacle.
    hindered: Option<Hindered>,
    avoided: Option<Instant>,
    command: DriveCommand,
    reason: Reason,
    told: Reason,
}

impl<'b> Driver<'b> {
    /// A standing robot on a map with cells of side `resolution`.
    pub fn new(config: Driving, resolution: Millimetres, workspace: &'b mut Workspace) -> Self {
        Self {
            config,
            resolution,
            search: Search::new(workspace),
            follower: Follower::new(config.motion),
            safety: Safety::new(config.safety),
            task: Task::Stand,
            phase: Phase::Resting(Reason::NoTask),
            end: End::OnTheWay,
            has_path: false,
            is_begun: false,
            goes_home: false,
            refused: None,
            last: None,
            looked: Instant(0),
            planned: Instant(0),
            turning: None,
            hindered: None,
            avoided: None,
            command: DriveCommand::STAND,
            reason: Reason::NoTask,
            told: Reason::NoTask,
        }
    }

    /// Sets another task. Setting the same task again restarts it.
    pub fn set_task(&mut self, task: Task) {
        self.task = task;
        self.goes_home = false;
        self.refused = None;
        self.hindered = None;
        self.search.forget();
        self.safety.forgive();
        self.set_out();
    }

    /// Sets the next point of a path. Until a way to it is found, the robot keeps driving along its
    /// old path, if it has one.
    pub fn go_to_next(&mut self, goal: Waypoint) {
        let has_path = self.has_path;
        self.task = Task::Go(goal);
        self.goes_home = false;
        self.search.forget();
        self.set_out();
        self.has_path = has_path;
    }

    /// The current task.
    pub fn task(&self) -> Task {
        self.task
    }

    /// What the robot does now, and why.
    pub fn reason(&self) -> Reason {
        self.reason
    }

    /// The current reason if it has changed since the last call.
    pub fn poll_event(&mut self) -> Option<Reason> {
        (self.told != self.reason).then(|| {
            self.told = self.reason;
            self.reason
        })
    }

    /// The planning window as last filled.
    pub fn window(&self) -> &PlanningWindow {
        self.search.window()
    }

    /// Makes a step, and returns the wheels' command until the next one. `ground(column, row)`
    /// returns the 32 map cells in a column of tiles and a row of cells. Call it at 10 Hz or more.
    // Not inlined, so that its stack does not add up with that of mapping.
    #[inline(never)]
    pub fn step(
        &mut self,
        inputs: &Inputs<'_>,
        ground: impl Fn(i32, i32) -> GroundRow,
    ) -> DriveCommand {
        let now = inputs.health.now;
        self.refused.get_or_insert([inputs.cells_refused; 2])[1] = inputs.cells_refused;
        let since = self.last.map_or(0, |last| now.since(last).micros());
        let elapsed = (since.min(1_000_000) as u32 as f32 * 1.0e-6).min(MAX_STEP);
        self.last = Some(now);
        let amiss = self.safety.check(&inputs.health, self.command);
        let (command, reason) = match (amiss, inputs.health.pose) {
            (None, Some((pose, unsure))) => {
                let sight = StepContext { inputs, pose, unsure, elapsed, now };
                self.go_on(&sight, &ground)
            }
            // What is to be seen around it may show the server where it is.
            (Some(Reason::PoseLost), Some(_)) if self.task != Task::Stand => {
                (self.turn(now, elapsed), Reason::PoseLost)
            }
            (amiss, _) => (self.follower.stand(), amiss.unwrap_or(Reason::PoseLost)),
        };
        if !matches!(reason, Reason::PoseLost | Reason::NoWay(_)) {
            self.turning = None;
        }
        // While faulty wheels are tried again, their fault is still reported: it is cleared only
        // after the robot has driven some distance, which shows that the wheels work.
        let doubt = self.safety.doubt().filter(|_| reason == Reason::Driving);
        (self.command, self.reason) = (command, doubt.unwrap_or(reason));
        command
    }

    /// Turns a robot that does not know its pose, or a way, on the spot: for a while, and after each rest again.
    fn turn(&mut self, now: Instant, elapsed: f32) -> DriveCommand {
        let since = self.turning.get_or_insert(now);
        if now.since(*since) >= LOST_REST {
            *since = now;
        }
        match now.since(*since) < LOST_TURN {
            true => self.follower.look_around(elapsed),
            false => self.follower.stand(),
        }
    }

    /// Starts the search for a path.
    fn set_out(&mut self) {
        self.has_path = false;
        self.is_begun = false;
        self.phase = match self.task {
            Task::Stand => Phase::Resting(Reason::NoTask),
            _ => Phase::Searching,
        };
    }

    fn go_on(
        &mut self,
        step: &StepContext<'_>,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) -> (DriveCommand, Reason) {
        match self.phase {
            Phase::Resting(reason) => (self.follower.stand(), reason),
            Phase::Stuck { why, since } => {
                if step.now.since(since) >= NO_WAY_RETRY {
                    self.set_out();
                }
                // What was in its way may be gone, or the robot may be somewhere else.
                let command = match why {
                    PlanError::GoalBlocked => self.follower.stand(),
                    _ => self.turn(step.now, step.elapsed),
                };
                (command, Reason::NoWay(why))
            }
            Phase::Searching => {
                self.search(step, ground);
                if self.has_path {
                    return self.drive(step);
                }
                (self.follower.stand(), self.waiting())
            }
            Phase::Driving => {
                self.look(step, ground);
                self.drive(step)
            }
            Phase::Looking(look) => self.look_at(look, step, ground),
            Phase::LookingAround(gaze, look) => self.look_around(gaze, look, step, ground),
        }
    }

    /// The reason reported while standing to plan.
    fn waiting(&self) -> Reason {
        match self.reason {
            Reason::NoWay(_) | Reason::Blocked | Reason::Person => self.reason,
            _ => Reason::Driving,
        }
    }

    /// What to drive to.
    fn sought(&self) -> Sought {
        match self.task {
            Task::Go(goal) => Sought::Goal(goal),
            Task::Explore(Some(home)) if self.goes_home => Sought::Home(home),
            _ => Sought::Frontier,
        }
    }

    /// Begins or continues a search.
    fn search(&mut self, step: &StepContext<'_>, ground: &impl Fn(i32, i32) -> GroundRow) {
        if !self.is_begun {
            self.is_begun = true;
            self.search.begin(self.sought(), step.pose, self.resolution);
        }
        let none = NearPoints::default();
        let view = self.view(step, &none);
        match self.search.step(&view, ground, self.config.pairs_per_step) {
            Outcome::Searching => {}
            Outcome::Found(end) => {
                self.follower.take(self.search.route());
                self.end = end;
                self.has_path = true;
                (self.planned, self.looked) = (step.now, step.now);
                self.phase = Phase::Driving;
            }
            Outcome::Failed(error) => self.fail(error, step.now),
        }
    }

    /// Handles a failed search: no path, or nothing left to explore.
    fn fail(&mut self, why: PlanError, now: Instant) {
        self.has_path = false;
        match self.task {
            Task::Explore(home) if why == PlanError::NoFrontier && !self.goes_home => {
                self.come_home(home);
            }
            _ => self.phase = Phase::Stuck { why, since: now },
        }
    }

    /// Exploring is complete: drives home, if there is a home.
    fn come_home(&mut self, home: Option<Waypoint>) {
        self.phase = Phase::Resting(Reason::explored(self.refused));
        if home.is_some() {
            self.goes_home = true;
            self.set_out();
        }
    }

    /// The inputs of the planning window. An empty scan, `none`, replaces the newest one while its
    /// points do not count as obstacles.
    fn view<'v>(&self, step: &StepContext<'v>, none: &'v NearPoints) -> WindowInputs<'v> {
        // People who walk by are no reason to plan around them. The scan counts only for a while
        // after the robot has waited in vain for a hindrance to go away.
        let avoids = self.avoided.is_some_and(|since| step.now.since(since) < AVOIDED_FOR);
        let motion = &self.config.motion;
        WindowInputs {
            pose: step.pose,
            resolution: self.resolution,
            level: 0,
            radius: motion.radius.saturating_add(motion.margin),
            near: if avoids { step.inputs.near } else { none },
            movers: step.inputs.movers,
            given_up: &[],
            explore_covered: self.config.explore_covered,
        }
    }

    /// If due, refills the window, and starts a new search unless the path is clear and still leads
    /// to a frontier or was planned recently.
    fn look(&mut self, step: &StepContext<'_>, ground: &impl Fn(i32, i32) -> GroundRow) {
        if step.now.since(self.looked) < MAP_LOOK_INTERVAL {
            return;
        }
        self.looked = step.now;
        let none = NearPoints::default();
        self.search.fill(0, &self.view(step, &none), ground);
        let leads = match self.end {
            End::Frontier(at, 0) => self.search.is_frontier(at),
            _ => step.now.since(self.planned) < REPLAN_INTERVAL,
        };
        let clear = self.follower.is_clear(self.search.window(), step.pose);
        if !(leads && clear) {
            self.set_out();
            // If the path is clear, the robot keeps driving while it plans.
            self.has_path = clear;
        }
    }

    /// Drives along the path.
    fn drive(&mut self, step: &StepContext<'_>) -> (DriveCommand, Reason) {
        let sight = Sight {
            pose: step.pose,
            unsure: step.unsure,
            near: step.inputs.near,
            movers: step.inputs.movers,
            window: self.search.window(),
            elapsed: step.elapsed,
        };
        let (command, hindrance) = self.follower.step(&sight);
        let reason = match hindrance {
            None => Reason::Driving,
            Some(Hindrance::Arrived) => return (command, self.arrive(step)),
            Some(Hindrance::OffPath) => {
                self.set_out();
                Reason::Driving
            }
            Some(Hindrance::Person) => Reason::Person,
            Some(Hindrance::Blocked) => Reason::Blocked,
        };
        (command, self.wait(reason, step))
    }

    /// Waits for a hindrance to go away, then plans around it. The reason is kept until the robot
    /// has driven [`STRETCH`]: nothing else shows that the way is clear.
    fn wait(&mut self, reason: Reason, step: &StepContext<'_>) -> Reason {
        let hindered = match (self.hindered, reason) {
            (None, Reason::Driving) => return reason,
            (None, _) => Hindered { since: step.now, at: step.pose, reason },
            (Some(hindered), _) => hindered,
        };
        let far = |a: Millimetres, b: Millimetres| a.0.abs_diff(b.0);
        let (from, to) = (hindered.at, step.pose);
        if far(from.x, to.x).max(far(from.y, to.y)) > STRETCH {
            self.hindered = None;
            return Reason::Driving;
        }
        self.hindered = Some(hindered);
        if reason != Reason::Driving && step.now.since(hindered.since) >= HINDERED_WAIT {
            self.hindered = Some(Hindered { since: step.now, ..hindered });
            self.avoided = Some(step.now);
            self.set_out();
        }
        hindered.reason
    }

    /// Handles the end of the path.
    fn arrive(&mut self, step: &StepContext<'_>) -> Reason {
        if self.phase != Phase::Driving {
            // The old path has ended while a new one is being searched for.
            self.has_path = false;
            return Reason::Driving;
        }
        match self.end {
            End::Frontier(at, level) => {
                self.phase = Phase::Looking(Look { at, level, turned: 0.0, last: step.pose });
                Reason::Driving
            }
            End::Goal
                if !self.goes_home
                    && let Some(gaze) = self.config.looks_at_goal =>
            {
                self.phase = Phase::LookingAround(gaze, LookAround::new(step.pose.heading));
                // The next step looks at the map immediately.
                self.looked = Instant(0);
                Reason::Driving
            }
            End::Goal => {
                let reason =
                    if self.goes_home { Reason::explored(self.refused) } else { Reason::Arrived };
                self.phase = Phase::Resting(reason);
                reason
            }
            End::OnTheWay => {
                self.set_out();
                Reason::Driving
            }
        }
    }

    /// Turns until all blind ground in sight has been looked at.
    fn look_around(
        &mut self,
        gaze: Gaze,
        mut look: LookAround,
        step: &StepContext<'_>,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) -> (DriveCommand, Reason) {
        let (resolution, explore_covered) = (self.resolution, self.config.explore_covered);
        if step.now.since(self.looked) >= MAP_LOOK_INTERVAL {
            self.looked = step.now;
            look.look(&gaze, step.pose, resolution, explore_covered, ground);
        }
        let Some(left) = look.turn(step.pose.heading, gaze.half_view) else {
            self.phase = Phase::Resting(Reason::Arrived);
            return (self.follower.stand(), Reason::Arrived);
        };
        self.phase = Phase::LookingAround(gaze, look);
        (self.follower.spin(left, step.elapsed), Reason::Driving)
    }

    /// Turns a full circle at a frontier, or less if no blind ground is left near it. Ground that
    /// can't be seen from there is given up.
    fn look_at(
        &mut self,
        look: Look,
        step: &StepContext<'_>,
        ground: &impl Fn(i32, i32) -> GroundRow,
    ) -> (DriveCommand, Reason) {
        let turned = look.turned + radians(step.pose.heading - look.last.heading);
        let look = Look { turned, last: step.pose, ..look };
        self.phase = Phase::Looking(look);
        let done = turned.abs() > core::f32::consts::TAU;
        if done || step.now.since(self.looked) >= MAP_LOOK_INTERVAL {
            self.looked = step.now;
            let none = NearPoints::default();
            let view = self.view(step, &none);
            self.search.fill(look.level, &view, ground);
            let is_blind = self.search.is_frontier(look.at);
            let is_full = Reason::explored(self.refused) == Reason::PoolFull;
            if is_blind && done && (is_full || !self.search.give_up(look.at, look.level, &view)) {
                // The pool or the list of given-up places is full: stop exploring.
                self.fail(PlanError::NoFrontier, step.now);
            } else if done || !is_blind {
                self.set_out();
            }
        }
        (self.follower.spin(true, step.elapsed), Reason::Driving)
    }
}

/// The inputs of a step and values derived from them.
struct StepContext<'s> {
    inputs: &'s Inputs<'s>,
    pose: Pose,
    unsure: f32,
    elapsed: f32,
    now: Instant,
}
