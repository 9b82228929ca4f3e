//! The core of the coordination, without input or output: it takes the state of the room and
//! returns commands.

use std::collections::VecDeque;

use ubimap_protocol::{
    message::{EventCode, Path, Waypoint},
    time::Instant,
    units::{Millimetres, RobotId},
};

use super::{
    drivable::DrivableFloor,
    frontiers::Frontier,
    ground::{Disc, Ground, Point},
    member::Member,
    reservation::Reservations,
    route::Terrain,
    settings::Settings,
    situation::{GoalError, Notice, Passer, Situation},
    target::Tried,
};
use crate::server::command::Command;

/// Sends robots to their goals or to unexplored ground, never two to the same place at the same
/// time. It decides in ticks: call [`Coordinator::tick`] at [`Coordinator::poll_timeout`], then
/// drain [`Coordinator::poll_command`] and [`Coordinator::poll_notice`]. Its methods are in the
/// files of this folder, by subject.
///
/// Deterministic: the same inputs give the same commands.
#[derive(Debug)]
pub struct Coordinator {
    pub(super) settings: Settings,
    /// The floor that robots may use; `None` for all of it.
    floor: Option<DrivableFloor>,
    next_path: u32,
    /// The robots in order of id; `reservations` has the same order.
    pub(super) members: Vec<Member>,
    pub(super) reservations: Reservations,
    pub(super) ground: Option<Ground>,
    pub(super) frontiers: Vec<Frontier>,
    /// Frontiers that could not be reached, or not be seen from a viewpoint.
    pub(super) tried: Vec<Tried>,
    surveyed: Instant,
    pub(super) passers: Vec<Passer>,
    /// Places where robots were held up, and until when each is avoided.
    pub(super) held_up: Vec<(Disc, Instant)>,
    /// Index of the robot that is granted ground first; it changes with each tick.
    pub(super) turn: usize,
    next_tick: Instant,
    commands: VecDeque<(RobotId, Command)>,
    pub(super) notices: VecDeque<(RobotId, Notice)>,
}

impl Coordinator {
    /// A coordinator without robots.
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            floor: None,
            next_path: settings.first_path,
            members: Vec::new(),
            reservations: Reservations::default(),
            ground: None,
            frontiers: Vec::new(),
            tried: Vec::new(),
            surveyed: Instant(0),
            passers: Vec::new(),
            held_up: Vec::new(),
            turn: 0,
            next_tick: Instant(0),
            commands: VecDeque::new(),
            notices: VecDeque::new(),
        }
    }

    /// Keeps robots on a floor.
    pub fn keep_to(&mut self, floor: DrivableFloor) {
        self.floor = Some(floor);
    }

    /// Sends a robot to a position in `map`, in metres; replaces its current goal or target.
    ///
    /// # Errors
    /// Every [`GoalError`], which is also issued as a notice; the robot then continues as before.
    pub fn goal(&mut self, robot: RobotId, x: f64, y: f64, now: Instant) -> Result<(), GoalError> {
        let goal = Point::new(x, y);
        let checked = self.check(robot, goal);
        match checked {
            Ok(index) => {
                let member = &mut self.members[index];
                member.end_errand();
                member.goal = Some(goal);
                member.set_out(now);
                self.reservations.drop_ahead(index);
            }
            Err(error) => self.notices.push_back((robot, Notice::Refused(error))),
        }
        checked.map(|_| ())
    }

    /// Lets a robot explore while it has no goal, or stops it from exploring. Returns whether the
    /// robot is known.
    pub fn set_exploring(&mut self, robot: RobotId, explores: bool) -> bool {
        let Ok(index) = self.index(robot) else { return false };
        let member = &mut self.members[index];
        member.explores = explores;
        if !explores {
            member.cancel_recall();
            if member.target.take().is_some() || member.refuge.take().is_some() {
                self.reservations.drop_ahead(index);
            }
        }
        true
    }

    /// Takes a robot's goal or target away, and its memory of where it was blocked.
    pub fn end_errand(&mut self, robot: RobotId) {
        let Ok(index) = self.index(robot) else { return };
        self.members[index].end_errand();
        self.reservations.drop_ahead(index);
    }

    /// Notes that a robot has booted, and forgotten the calibration of its odometry.
    pub fn booted(&mut self, robot: RobotId) {
        if let Ok(index) = self.index(robot) {
            self.members[index].lose_calibration();
        }
    }

    /// Handles an event that a robot reported.
    pub fn event(&mut self, robot: RobotId, code: EventCode, now: Instant) {
        let Ok(index) = self.index(robot) else { return };
        let rules = self.settings.following;
        let claim = self.reservations.claim_mut(index);
        match code {
            // Without these conditions, the report may be about an earlier path.
            EventCode::PathDone
                if claim.to_grant_m() <= rules.arrived_m
                    || now.since(self.members[index].sent) >= rules.in_flight =>
            {
                claim.arrive();
                let (is_at_end, place) = (claim.is_at_end(), claim.end());
                let member = &mut self.members[index];
                let is_there = is_at_end && member.is_there(place, &rules);
                if let Some(target) = member.target.as_mut().filter(|_| is_there) {
                    target.looked = Some(now);
                }
            }
            EventCode::StoppedByPerson => self.members[index].stood_for_person = Some(now),
            EventCode::PathBlocked | EventCode::Collision | EventCode::DriveFault
                if self.members[index].can_drive() =>
            {
                self.blocked(index, now);
            }
            _ => {}
        }
    }

    /// Updates the coordinator with the current situation, and decides. The cost is bounded by
    /// [`Rates`](super::settings::Rates) (surveys and routes) and by the number of pairs of robots.
    pub fn tick(&mut self, situation: &Situation<'_>, now: Instant) {
        self.next_tick = now + self.settings.rates.tick;
        self.see(situation, now);
        // Surveys early if a robot has looked at its frontier, so that it gets its next one at
        // once.
        let arrives = self.settings.following.tiles_arrive;
        let is_heard_of =
            |member: &Member| member.target.is_some_and(|it| it.is_heard_of(arrives, now));
        let is_surveyed = self.ground.is_none()
            || now.since(self.surveyed) >= self.settings.rates.survey
            || self.members.iter().any(is_heard_of);
        if is_surveyed {
            self.survey(situation, now);
        }
        self.follow(now);
        self.reservations.order_anew();
        self.untangle();
        if is_surveyed {
            self.share_out(now);
        }
        self.find_routes(now);
        self.grant(now);
        self.send(now);
    }

    /// The deadline for the next call of [`Coordinator::tick`].
    pub fn poll_timeout(&self) -> Instant {
        self.next_tick
    }

    /// The next command for a robot.
    #[must_use]
    pub fn poll_command(&mut self) -> Option<(RobotId, Command)> {
        self.commands.pop_front()
    }

    /// The next notice about a robot's drive.
    #[must_use]
    pub fn poll_notice(&mut self) -> Option<(RobotId, Notice)> {
        self.notices.pop_front()
    }

    /// The frontier that a robot is sent to look at, in metres in `map`.
    pub fn target(&self, robot: RobotId) -> Option<[f64; 2]> {
        let target = self.members[self.index(robot).ok()?].frontier_target()?;
        Some(target.frontier.into())
    }

    pub(super) fn index(&self, robot: RobotId) -> Result<usize, usize> {
        self.members.binary_search_by_key(&robot, |member| member.id)
    }

    /// Checks whether a goal is reachable on the known ground. Returns the robot's index.
    fn check(&self, robot: RobotId, goal: Point) -> Result<usize, GoalError> {
        let index = self.index(robot).map_err(|_| GoalError::UnknownRobot(robot))?;
        let side_m = self.settings.side_m();
        // The casts saturate.
        let [column, row] = [goal.x, goal.y].map(|metres| (metres / side_m).floor() as i32);
        if self.floor.as_ref().is_some_and(|floor| !floor.allows(column, row)) {
            return Err(GoalError::OutsideFloor);
        }
        let ground = self.ground.as_ref().ok_or(GoalError::OutsideMap)?;
        let at = ground.at(goal).ok_or(GoalError::OutsideMap)?;
        if ground.is_unknown(at) {
            return Err(GoalError::UnknownGround);
        }
        let room_m = self.members[index].radius_m + self.settings.clearances.wall_m;
        let terrain = Terrain::new(ground, room_m, &self.settings);
        if !terrain.is_open(at) {
            return Err(GoalError::Occupied);
        }
        let from = self.reservations.claim(index).granted_end();
        terrain.route(from, goal).map(|_| index).ok_or(GoalError::Unreachable)
    }

    fn survey(&mut self, situation: &Situation<'_>, now: Instant) {
        self.surveyed = now;
        let places = self.members.iter().zip(self.reservations.claims());
        let trodden: Vec<Disc> = places
            .map(|(member, claim)| Disc { centre: claim.position(), radius: member.radius_m })
            .collect();
        let Situation { fused, coverage, .. } = situation;
        self.ground =
            Ground::survey(fused, coverage, &trodden, self.floor.as_ref(), &self.settings);
        let Some(ground) = &self.ground else { return };
        // Routes are planned with some clearance, but kept until an obstacle is within the
        // robot's own radius.
        for (index, member) in self.members.iter().enumerate() {
            let ahead = self.reservations.claim(index).ahead();
            if !ahead.iter().all(|place| ground.has_room(*place, member.radius_m)) {
                self.reservations.drop_ahead(index);
            }
        }
    }

    fn send(&mut self, now: Instant) {
        let rules = self.settings.granting;
        for index in 0..self.members.len() {
            if self.members[index].can_drive()
                && let Some(path) = self.reservations.claim_mut(index).poll_path(&rules)
            {
                self.command(index, &path, now);
            }
        }
    }

    pub(super) fn command(&mut self, index: usize, path: &[Point], now: Instant) {
        let mut waypoints = heapless::Vec::new();
        for place in path {
            let [x, y] = [place.x, place.y].map(Millimetres::from_metres);
            // A path has room for all corners of a claim.
            let _ = waypoints.push(Waypoint { x, y });
        }
        let member = &mut self.members[index];
        member.sent = now;
        let path = Path { number: self.next_path, waypoints };
        self.next_path = self.next_path.wrapping_add(1);
        self.commands.push_back((member.id, Command::Path(path)));
    }
}
