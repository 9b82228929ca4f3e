//! The sans-IO core: what is known of the room goes in, commands come out.

use std::collections::VecDeque;

use ubimap_protocol::{
    message::{EventCode, ObstacleClass, Path, Waypoint},
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::{
    evasion::make_way,
    exploration::Tried,
    frontiers::Frontier,
    ground::{Disc, Ground, Point},
    member::{ARRIVED_M, Member},
    reservation::{Claim, Held, Reservations},
    route::{HELD_UP, STANDING, Terrain},
    situation::{GoalError, Notice, Passer, Situation, Whereabouts},
};
use crate::server::Command;

/// Time from one [`Coordinator::tick`] to the next.
const INTERVAL: Duration = Duration::from_millis(200);
/// The ground is drawn anew this often.
const SURVEY: Duration = Duration::from_secs(1);
/// From wall to robot, at least, when a route is planned, in metres: what robots keep themselves.
const CLEARANCE_M: f64 = 0.08;
/// Around a robot unknown ground is passable up to this far from its own edge, in metres.
const TRODDEN_M: f64 = 0.3;
/// A robot is granted so much of its route, in metres: it need not brake.
const LOOK_AHEAD_M: f64 = 2.0;
/// Between robots and people, in metres.
const RESPECT_M: f64 = 0.1;
/// A robot that is so far off its route has lost it, in metres.
const ASTRAY_M: f64 = 0.6;
/// A robot that could drive and was seen to stand for so long can't.
const STALLED: Duration = Duration::from_secs(6);
/// And one of which nothing else was heard for so long.
const SILENT: Duration = Duration::from_secs(15);
/// What a robot says of the end of its path is about the newest one if that was sent so long ago.
const UNDER_WAY: Duration = Duration::from_secs(1);
/// A robot that was told to stand does after so long, and was then seen to.
const HALTING: Duration = Duration::from_millis(1_500);
const HALTED: Duration = Duration::from_secs(1);
/// By then it has said where it stands.
const REPORTED: Duration = Duration::from_millis(3_500);
/// One that can't be told comes to a stand by itself.
const LOST: Duration = Duration::from_secs(5);
/// Somebody in the way is waited for so long before another way is looked for.
const PATIENCE: Duration = Duration::from_secs(3);
/// A place where a robot was held up is avoided for so long, and so far around, in metres.
const AVOIDED: Duration = Duration::from_secs(20);
const AVOIDED_M: f64 = 0.4;
/// When a route is looked for again, after one that others had no room for and after none at all.
const RETRY: Duration = Duration::from_secs(1);
const RETRY_NO_WAY: Duration = Duration::from_secs(5);
/// Robots for which a route is looked for in one tick.
const ROUTES_A_TICK: usize = 3;

/// What the coordinator must know of a deployment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The side of the map's cells.
    pub resolution: Millimetres,
    /// A frontier is in view from this far, in metres; no more than the robots' sensors see.
    pub view_m: f64,
    /// How far these see, in metres: what is farther does not come back, and nothing before it is
    /// known then.
    pub range_m: f64,
    /// How long a robot takes to look around at the end of its way.
    pub look: Duration,
    /// The number of the first path. Of two paths the one with the higher number holds, so a
    /// server that starts again must go on from its earlier life's.
    pub first_path: u32,
}

/// Sends robots where somebody wants them, or where nobody has been, and never two to one place
/// at a time. The law: after every input drain [`Coordinator::poll_command`] and
/// [`Coordinator::poll_notice`], and call [`Coordinator::tick`] at [`Coordinator::poll_timeout`].
///
/// The same inputs give the same commands.
#[derive(Debug)]
pub struct Coordinator {
    pub(super) settings: Settings,
    next_path: u32,
    /// In order of their ids; the reservations have the same order.
    pub(super) members: Vec<Member>,
    pub(super) reservations: Reservations,
    pub(super) ground: Option<Ground>,
    pub(super) frontiers: Vec<Frontier>,
    /// What was tried in vain.
    pub(super) tried: Vec<Tried>,
    surveyed: Instant,
    passers: Vec<Passer>,
    /// Where robots were held up, and until when that is avoided.
    held_up: Vec<(Disc, Instant)>,
    /// Who is granted first, in turn.
    turn: usize,
    next_tick: Instant,
    commands: VecDeque<(RobotId, Command)>,
    notices: VecDeque<(RobotId, Notice)>,
}

impl Coordinator {
    /// A coordinator that knows of no robot.
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
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

    /// Sends a robot to a place in `map`, in metres, whatever it was about.
    ///
    /// # Errors
    /// Every [`GoalError`]; the robot goes on with what it was about. It is a notice, too.
    pub fn goal(&mut self, robot: RobotId, x: f64, y: f64, now: Instant) -> Result<(), GoalError> {
        let goal = Point::new(x, y);
        let checked = self.check(robot, goal);
        match checked {
            Ok(index) => {
                let member = &mut self.members[index];
                (member.goal, member.target) = (Some(goal), None);
                member.set_out(now);
                self.reservations.drop_ahead(index);
            }
            Err(error) => self.notices.push_back((robot, Notice::Refused(error))),
        }
        checked.map(|_| ())
    }

    /// Lets a robot go where nobody has been as long as it has no goal, or no longer. Whether
    /// anything is known of the robot.
    pub fn set_exploring(&mut self, robot: RobotId, explores: bool) -> bool {
        let Ok(index) = self.index(robot) else { return false };
        let member = &mut self.members[index];
        member.explores = explores;
        if !explores && member.target.take().is_some() {
            self.reservations.drop_ahead(index);
        }
        true
    }

    /// A robot has told of something.
    pub fn event(&mut self, robot: RobotId, code: EventCode, now: Instant) {
        let Ok(index) = self.index(robot) else { return };
        let claim = self.reservations.claim_mut(index);
        match code {
            // It may be about an earlier end.
            EventCode::PathDone
                if claim.to_grant_m() <= ARRIVED_M
                    || now.since(self.members[index].sent) >= UNDER_WAY =>
            {
                claim.arrive();
                let (is_at_end, place) = (claim.is_at_end(), claim.end());
                let member = &mut self.members[index];
                let is_there = is_at_end && member.is_there(place);
                if let Some(target) = member.target.as_mut().filter(|_| is_there) {
                    target.looked = Some(now);
                }
            }
            EventCode::PathBlocked | EventCode::Collision | EventCode::DriveFault
                if self.members[index].can_drive() =>
            {
                self.blocked(index, now);
            }
            _ => {}
        }
    }

    /// Takes what is known now, and decides. Bounded: one survey of the ground a second, three
    /// routes, and the pairs of robots.
    pub fn tick(&mut self, situation: &Situation<'_>, now: Instant) {
        self.next_tick = now + INTERVAL;
        self.see(situation, now);
        // Nobody who has looked at its frontier is kept waiting.
        let is_heard_of = |member: &Member| member.target.is_some_and(|it| it.is_heard_of(now));
        let is_surveyed = self.ground.is_none()
            || now.since(self.surveyed) >= SURVEY
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

    /// When to call [`Coordinator::tick`].
    pub fn poll_timeout(&self) -> Instant {
        self.next_tick
    }

    /// The next command for a robot.
    #[must_use]
    pub fn poll_command(&mut self) -> Option<(RobotId, Command)> {
        self.commands.pop_front()
    }

    /// The next thing to tell whoever gave a robot its goal.
    #[must_use]
    pub fn poll_notice(&mut self) -> Option<(RobotId, Notice)> {
        self.notices.pop_front()
    }

    /// The frontier that a robot goes to look at, in metres in `map`.
    pub fn target(&self, robot: RobotId) -> Option<[f64; 2]> {
        let target = self.members[self.index(robot).ok()?].target?;
        Some(target.frontier.into())
    }

    fn index(&self, robot: RobotId) -> Result<usize, usize> {
        self.members.binary_search_by_key(&robot, |member| member.id)
    }

    /// Whether a goal can be reached, as far as the ground goes.
    fn check(&self, robot: RobotId, goal: Point) -> Result<usize, GoalError> {
        let index = self.index(robot).map_err(|_| GoalError::UnknownRobot(robot))?;
        let ground = self.ground.as_ref().ok_or(GoalError::OutsideMap)?;
        let at = ground.at(goal).ok_or(GoalError::OutsideMap)?;
        if ground.is_unknown(at) {
            return Err(GoalError::UnknownGround);
        }
        let terrain = Terrain::new(ground, self.members[index].radius_m + CLEARANCE_M);
        if !terrain.is_open(at) {
            return Err(GoalError::Occupied);
        }
        let from = self.reservations.claim(index).granted_end();
        terrain.route(from, goal).map(|_| index).ok_or(GoalError::Unreachable)
    }

    fn see(&mut self, situation: &Situation<'_>, now: Instant) {
        for robot in situation.robots {
            match self.index(robot.robot) {
                Ok(index) => self.see_again(index, robot, now),
                Err(index) => {
                    self.members.insert(index, Member::new(robot));
                    self.reservations
                        .insert(index, Claim::standing(robot.place(), robot.radius_m()));
                }
            }
        }
        let others = situation.obstacles.iter().filter(|it| it.class != ObstacleClass::Fixed);
        let passers = others.map(Passer::new).filter(|passer| {
            // Cameras may take a robot for something that moves.
            let is_it = |robot: &Whereabouts| {
                (robot.place() - passer.discs[0].centre).norm() < robot.radius_m()
            };
            !situation.robots.iter().any(is_it)
        });
        self.passers = passers.collect();
        self.held_up.retain(|(_, until)| now < *until);
    }

    fn see_again(&mut self, index: usize, robot: &Whereabouts, now: Instant) {
        let is_back = self.members[index].see(robot, now);
        let is_busy = self.members[index].explores || self.members[index].goal.is_some();
        let claim = self.reservations.claim_mut(index);
        claim.set_radius(robot.radius_m(), !is_busy && claim.is_at_end());
        claim.advance(robot.place());
        if is_back {
            claim.forget_sent();
        }
        let is_astray = !claim.is_at_end() && claim.off_m() > ASTRAY_M;
        if is_astray && self.members[index].can_drive() {
            self.halt(index, now);
        }
    }

    fn survey(&mut self, situation: &Situation<'_>, now: Instant) {
        self.surveyed = now;
        let trodden = self.members.iter().zip(self.reservations.claims()).map(|(member, claim)| {
            Disc { centre: claim.position(), radius: member.radius_m + CLEARANCE_M + TRODDEN_M }
        });
        let trodden: Vec<Disc> = trodden.collect();
        let Settings { resolution, .. } = self.settings;
        self.ground = Ground::survey(situation.fused, situation.coverage, resolution, &trodden);
        let Some(ground) = &self.ground else { return };
        // A route was planned with more room than a robot takes up: it holds until that is lost.
        for (index, member) in self.members.iter().enumerate() {
            let ahead = self.reservations.claim(index).ahead();
            if !ahead.iter().all(|place| ground.has_room(*place, member.radius_m)) {
                self.reservations.drop_ahead(index);
            }
        }
    }

    /// Sees how far everybody has come.
    fn follow(&mut self, now: Instant) {
        for index in 0..self.members.len() {
            let member = &mut self.members[index];
            let claim = self.reservations.claim_mut(index);
            let is_stuck = now.since(member.sent) >= STALLED
                && (member.still_for() >= STALLED || member.unmoved_for(now) >= SILENT);
            if let Some(lost) = member.lost {
                if now.since(lost) >= LOST && !claim.is_at_end() {
                    claim.stand();
                }
            } else if let Some(halted) = member.halted {
                if now.since(halted) >= HALTING
                    && (member.still_for() >= HALTED
                        || now.since(halted) >= REPORTED && member.unmoved_for(now) >= HALTED)
                {
                    claim.stand();
                    member.halted = None;
                    member.set_out(now);
                }
            } else if claim.is_at_end() {
                let is_there = member.is_there(claim.position());
                match &mut member.target {
                    _ if !is_there => {}
                    Some(target) => drop(target.reached.get_or_insert(now)),
                    None => {
                        member.goal = None;
                        self.notices.push_back((member.id, Notice::Reached));
                    }
                }
            } else if is_stuck && !claim.is_at_grant() {
                if claim.to_grant_m() > ARRIVED_M {
                    self.blocked(index, now);
                } else {
                    claim.arrive();
                }
            }
        }
    }

    /// A robot can't go on along its path: it gets another one from where it stands.
    fn blocked(&mut self, index: usize, now: Instant) {
        let member = &self.members[index];
        let centre = self.reservations.claim(index).point_before(member.radius_m + AVOIDED_M / 2.0);
        self.held_up.push((Disc { centre, radius: AVOIDED_M }, now + AVOIDED));
        self.notices.push_back((member.id, Notice::Blocked));
        self.halt(index, now);
    }

    fn halt(&mut self, index: usize, now: Instant) {
        self.members[index].halted = Some(now);
        self.command(index, &[], now);
    }

    /// Takes their routes from those who wait for each other in a circle: somebody has lost a
    /// route, or come to stand, where others have to pass. They are given new ones.
    fn untangle(&mut self) {
        let mut order: Vec<usize> = (0..self.members.len()).rev().collect();
        order.sort_by_key(|&index| self.members[index].goal.is_some());
        for index in order {
            if !self.reservations.claim(index).is_all_granted()
                && self.reservations.is_on_cycle(index)
            {
                self.reservations.drop_ahead(index);
            }
        }
    }

    /// Looks for the routes of those who have none to where they are to go. Goals of users come
    /// first, then whoever waits longest.
    fn find_routes(&mut self, now: Instant) {
        let is_waiting = |index: &usize| {
            let (member, claim) = (&self.members[*index], self.reservations.claim(*index));
            let has_none = member.destination().is_some_and(|it| it != claim.end());
            let is_there = claim.is_at_end() && member.is_there(claim.position());
            let is_due = claim.is_all_granted() && member.retry <= now;
            member.can_drive() && has_none && !is_there && is_due
        };
        let mut waiting: Vec<usize> = (0..self.members.len()).filter(is_waiting).collect();
        waiting.sort_by_key(|&index| {
            let member = &self.members[index];
            (member.goal.is_none(), member.waits_since.unwrap_or(now))
        });
        for index in waiting.into_iter().take(ROUTES_A_TICK) {
            self.find_route(index, now);
        }
    }

    fn find_route(&mut self, index: usize, now: Instant) {
        let Some(ground) = self.ground.take() else { return };
        let outcome = self.try_routes(&ground, index);
        self.ground = Some(ground);
        let member = &mut self.members[index];
        match outcome {
            Outcome::Admitted => member.set_out(now),
            Outcome::NoRoom => {
                member.retry = now + RETRY;
                member.waits_since = member.waits_since.or(Some(now));
                self.give_up_waiting(index, now);
            }
            Outcome::NoWay => {
                member.retry = now + RETRY_NO_WAY;
                if member.goal.is_some() && !member.is_told {
                    member.is_told = true;
                    self.notices.push_back((member.id, Notice::NoWay));
                }
                self.give_up_target(index, now);
            }
        }
    }

    fn try_routes(&mut self, ground: &Ground, index: usize) -> Outcome {
        let Some(destination) = self.members[index].destination() else { return Outcome::NoWay };
        let from = self.reservations.claim(index).granted_end();
        let mut terrain = self.terrain(ground, index);
        let Some(route) = terrain.route(from, destination) else { return Outcome::NoWay };
        if self.reservations.admit(&[(index, route.clone())]) {
            return Outcome::Admitted;
        }
        let Self { members, reservations, .. } = &*self;
        let mut changed = reservations.clone();
        let may_yield = |other: usize| members[other].can_drive();
        let terrain_of = |other| self.terrain(ground, other);
        if make_way(&mut changed, ground, index, &route, may_yield, terrain_of) {
            self.reservations = changed;
            return Outcome::Admitted;
        }
        // Around all who stand, at any cost.
        for (_, claim) in self.standing(index) {
            let radius = claim.disc_m() + self.reservations.claim(index).disc_m();
            terrain.shut(&Disc { centre: claim.end(), radius }, from);
        }
        let around = terrain.route(from, destination);
        match around.is_some_and(|around| self.reservations.admit(&[(index, around)])) {
            true => Outcome::Admitted,
            false => Outcome::NoRoom,
        }
    }

    /// The ground for one robot. Those who can't be told to go away are shut, and whoever stands
    /// is dear.
    pub(super) fn terrain<'a>(&self, ground: &'a Ground, index: usize) -> Terrain<'a> {
        let (member, mine) = (&self.members[index], self.reservations.claim(index));
        let mut terrain = Terrain::new(ground, member.radius_m + CLEARANCE_M);
        for (disc, _) in &self.held_up {
            terrain.make_dear(&grown(disc, member.radius_m), HELD_UP);
        }
        for disc in self.passers.iter().flat_map(|passer| &passer.discs) {
            terrain.make_dear(&grown(disc, member.radius_m + RESPECT_M), STANDING);
        }
        for (other, claim) in self.standing(index) {
            let disc = Disc { centre: claim.end(), radius: claim.disc_m() + mine.disc_m() };
            if self.members[other].lost.is_some() {
                terrain.shut(&disc, mine.granted_end());
            } else {
                terrain.make_dear(&disc, STANDING);
            }
        }
        terrain
    }

    /// The other robots that have no route to go away on.
    fn standing(&self, index: usize) -> impl Iterator<Item = (usize, &Claim)> {
        let claims = self.reservations.claims().iter().enumerate();
        claims.filter(move |(other, claim)| *other != index && claim.is_all_granted())
    }

    fn grant(&mut self, now: Instant) {
        let count = self.members.len();
        self.turn = (self.turn + 1) % count.max(1);
        for index in (0..count).map(|place| (place + self.turn) % count) {
            let member = &mut self.members[index];
            if !member.can_drive() {
                continue;
            }
            let respect_m = member.radius_m + RESPECT_M;
            let taken = |place| self.passers.iter().any(|passer| passer.is_near(place, respect_m));
            if self.reservations.extend(index, LOOK_AHEAD_M, taken) != Held::ByOthers {
                member.held_up = None;
            } else if now.since(*member.held_up.get_or_insert(now)) >= PATIENCE {
                member.held_up = None;
                member.set_out(now);
                self.reservations.drop_ahead(index);
            }
        }
    }

    fn send(&mut self, now: Instant) {
        for index in 0..self.members.len() {
            if self.members[index].can_drive()
                && let Some(path) = self.reservations.claim_mut(index).poll_path()
            {
                self.command(index, &path, now);
            }
        }
    }

    fn command(&mut self, index: usize, path: &[Point], now: Instant) {
        let mut waypoints = heapless::Vec::new();
        for place in path {
            let [x, y] = [place.x, place.y].map(Millimetres::from_metres);
            // A claim gives no more than there is room for.
            let _ = waypoints.push(Waypoint { x, y });
        }
        let member = &mut self.members[index];
        member.sent = now;
        let path = Path { number: self.next_path, waypoints };
        self.next_path = self.next_path.wrapping_add(1);
        self.commands.push_back((member.id, Command::Path(path)));
    }
}

/// How the search for a route went.
enum Outcome {
    Admitted,
    /// There is a way, but not with the others where they are.
    NoRoom,
    NoWay,
}

fn grown(disc: &Disc, metres: f64) -> Disc {
    Disc { radius: disc.radius + metres, ..*disc }
}
