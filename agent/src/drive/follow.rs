//! From a path to the wheels: pure pursuit (Coulter 1992), at a speed from which the robot can
//! always stop before what its own sensor sees.

use heapless::Vec;
use ubimap_protocol::{
    message::Waypoint,
    units::{Millimetres, Pose},
};

use super::{
    near::NearPoints,
    path::MAX_POINTS,
    planning_window::{Mover, PlanningWindow},
    root::root,
};
use crate::trigonometry::{radians, sin_cos};

/// What the wheels shall do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DriveCommand {
    /// Forward, in millimetres a second.
    pub speed: i16,
    /// Counter-clockwise, in milliradians a second.
    pub turn: i16,
}

impl DriveCommand {
    /// To stand.
    pub const STAND: Self = Self { speed: 0, turn: 0 };

    /// Whether the robot shall stand.
    pub fn is_stand(&self) -> bool {
        *self == Self::STAND
    }
}

/// What the robot can do, in millimetres, radians and seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// A circle about `base_link` that holds the robot.
    pub radius: u16,
    /// What it keeps from everything beside that.
    pub margin: u16,
    /// The fastest it drives.
    pub top_speed: f32,
    /// The fastest it turns.
    pub top_turn: f32,
    /// How it gains speed.
    pub acceleration: f32,
    /// How it can lose speed for sure.
    pub braking: f32,
    /// The most acceleration to the side.
    pub side_acceleration: f32,
    /// From a scan to when the wheels obey.
    pub reaction: f32,
    /// The speed of a person who walks.
    pub walking: f32,
    /// What it keeps from a person.
    pub person_margin: f32,
    /// The standard deviation of the position at which it stands.
    pub most_unsure: f32,
}

impl Default for Motion {
    /// A robot of 30 cm that drives half a metre a second.
    fn default() -> Self {
        Self {
            radius: 150,
            margin: 30,
            top_speed: 500.0,
            top_turn: 1.5,
            acceleration: 500.0,
            braking: 800.0,
            side_acceleration: 400.0,
            reaction: 0.15,
            walking: 1_200.0,
            person_margin: 250.0,
            most_unsure: 150.0,
        }
    }
}

impl Motion {
    /// The fastest speed from which the robot stands within a way.
    fn stops_within(&self, way: f32) -> f32 {
        let pause = self.braking * self.reaction;
        (root(pause * pause + 2.0 * self.braking * way.max(0.0)) - pause).max(0.0)
    }
}

/// What keeps the robot from driving on along its path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hindrance {
    /// It is at the end.
    Arrived,
    /// It has been pushed off its path.
    OffPath,
    /// Something stands in the way.
    Blocked,
    /// Somebody is about to cross it, or something that is not on the map is near.
    Person,
}

/// What a step looks at.
#[derive(Clone, Copy, Debug)]
pub struct Sight<'s> {
    /// `base_link` in `map`.
    pub pose: Pose,
    /// The standard deviation of its position, in millimetres.
    pub unsure: f32,
    /// The newest scan.
    pub near: &'s NearPoints,
    /// What the cameras see.
    pub movers: &'s [Mover],
    /// The map.
    pub window: &'s PlanningWindow,
    /// Since the last step, in seconds.
    pub elapsed: f32,
}

type Vector = (f32, f32);

/// Drives along a path.
#[derive(Clone, Debug)]
pub struct Follower {
    motion: Motion,
    /// The points that are left; the first is behind.
    route: Vec<Waypoint, MAX_POINTS>,
    /// The way from each of them to the end.
    rest: [f32; MAX_POINTS],
    /// The point behind the robot.
    at: usize,
    speed: f32,
    turn: f32,
    /// It turns on the spot until it looks along the path.
    turns: bool,
}

/// How far from the end it has arrived, and how far from its path it is off.
const ARRIVED: f32 = 40.0;
const OFF: f32 = 300.0;
/// Positions along what it is about to drive that are looked at.
const SAMPLES: usize = 8;
/// How far ahead people are predicted, in seconds.
const FORESIGHT: f32 = 2.0;
/// It turns at its fastest after half a second.
const TURN_GAIN: f32 = 2.0;
/// What is slower than this is no drive, in millimetres a second.
const STANDS: f32 = 20.0;
/// What it creeps by things it must pass, in millimetres a second, and in which time it would cover
/// the room that it has beside it.
const CREEP: f32 = 100.0;
const ROOM_TIME: f32 = 0.6;

impl Follower {
    /// For a robot that stands.
    pub fn new(motion: Motion) -> Self {
        let (route, rest) = (Vec::new(), [0.0; MAX_POINTS]);
        Self { motion, route, rest, at: 0, speed: 0.0, turn: 0.0, turns: false }
    }

    /// What the robot can do.
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    /// Takes another path.
    pub fn take(&mut self, route: &Vec<Waypoint, MAX_POINTS>) {
        self.rest = [0.0; MAX_POINTS];
        let mut rest = 0.0;
        let mut ahead: Option<Waypoint> = None;
        for (point, left) in route.iter().zip(&mut self.rest).rev() {
            rest += ahead.map_or(0.0, |ahead| length(between(*point, ahead)));
            *left = rest;
            ahead = Some(*point);
        }
        self.route = route.clone();
        self.at = 0;
    }

    /// Forgets the path and stands at once.
    pub fn stand(&mut self) -> DriveCommand {
        (self.speed, self.turn, self.turns) = (0.0, 0.0, false);
        DriveCommand::STAND
    }

    /// The path's end.
    pub fn end(&self) -> Option<Waypoint> {
        self.route.last().copied()
    }

    /// The way that is left from the last point it passed, in millimetres.
    pub fn way_left(&self) -> f32 {
        self.rest.get(self.at).copied().unwrap_or(0.0)
    }

    /// Whether what is left of the path is clear in a window.
    pub fn is_clear(&self, window: &PlanningWindow, pose: Pose) -> bool {
        let mut from = Waypoint { x: pose.x, y: pose.y };
        let ahead = self.route.get(self.at + 1..).unwrap_or_default();
        // From where it may stand too near to something it may leave.
        let stands_free = window.place(from).is_some_and(|place| window.free.has(place));
        let mut ahead = ahead.iter();
        if !stands_free && let Some(&next) = ahead.next() {
            from = next;
        }
        ahead.all(|&next| window.is_clear(core::mem::replace(&mut from, next), next))
    }

    /// The next command, and what hinders. At most 15,000 instructions.
    pub fn step(&mut self, sight: &Sight<'_>) -> (DriveCommand, Option<Hindrance>) {
        let Some((target, left)) = self.target(sight) else {
            return (self.stand(), Some(Hindrance::OffPath));
        };
        if left < ARRIVED {
            return (self.stand(), Some(Hindrance::Arrived));
        }
        let (sin, cos) = sin_cos(radians(sight.pose.heading));
        let (forward, side) = (target.0 * cos + target.1 * sin, target.1 * cos - target.0 * sin);
        // More than 37 degrees off it turns on the spot, until it is within 15.
        let enough = if self.turns { 0.27 } else { 0.75 };
        self.turns = side.abs() > enough * forward;
        if self.turns {
            self.speed = 0.0;
            return (self.turn_by(side, forward, sight.elapsed), None);
        }
        let square = (forward * forward + side * side).max(1.0);
        let curvature = 2.0 * side / square;
        let wanted = self.wanted(sight, curvature, left);
        let (speed, hindrance) = self.allowed(sight, curvature, wanted);
        let gained = self.speed + self.motion.acceleration * sight.elapsed;
        // Slower at once: what it can lose has been reckoned with.
        self.speed = speed.min(gained);
        self.turn = (self.speed * curvature).clamp(-self.motion.top_turn, self.motion.top_turn);
        (self.command(), hindrance)
    }

    /// Turns on the spot, to the left or to the right.
    pub fn spin(&mut self, left: bool, elapsed: f32) -> DriveCommand {
        self.speed = 0.0;
        self.turn_by(if left { 1.0 } else { -1.0 }, 0.0, elapsed)
    }

    /// Turns towards a point in `base_link`.
    fn turn_by(&mut self, side: f32, forward: f32, elapsed: f32) -> DriveCommand {
        // As fast as it can still lose by then; up to 45 degrees the tangent is the angle, about.
        let off = if forward > 0.0 { (side / forward).abs().min(1.0) } else { 1.0 };
        let gain = TURN_GAIN * self.motion.top_turn;
        let wanted = root(2.0 * gain * off).min(self.motion.top_turn).max(0.3).copysign(side);
        let most = gain * elapsed;
        self.turn += (wanted - self.turn).max(-most).min(most);
        self.command()
    }

    fn command(&self) -> DriveCommand {
        let turn = libm::roundf(self.turn * 1_000.0) as i16;
        DriveCommand { speed: libm::floorf(self.speed) as i16, turn }
    }

    /// The point to drive at, from the robot in `map`'s axes, and the way left. `None` off the
    /// path.
    fn target(&mut self, sight: &Sight<'_>) -> Option<(Vector, f32)> {
        let robot = Waypoint { x: sight.pose.x, y: sight.pose.y };
        loop {
            let (&from, &to) = (self.route.get(self.at)?, self.route.get(self.at + 1)?);
            let (leg, way) = (between(from, to), between(from, robot));
            let square = leg.0 * leg.0 + leg.1 * leg.1;
            let along = ((way.0 * leg.0 + way.1 * leg.1) / square.max(1.0)).clamp(0.0, 1.0);
            let is_last = self.at + 2 >= self.route.len();
            if !is_last && (along >= 1.0 || length(between(robot, to)) < ARRIVED) {
                self.at += 1;
                continue;
            }
            let foot = (leg.0 * along - way.0, leg.1 * along - way.1);
            if length(foot) > OFF {
                return None;
            }
            let rest = self.rest.get(self.at + 1).copied().unwrap_or(0.0);
            let to_corner = root(square) * (1.0 - along);
            let mut ahead = 200.0 + 0.4 * self.speed;
            let corner = between(robot, to);
            for _ in 0..3 {
                let target = self.ahead(robot, foot, ahead);
                let point = Waypoint {
                    x: Millimetres(robot.x.0.saturating_add(target.0 as i32)),
                    y: Millimetres(robot.y.0.saturating_add(target.1 as i32)),
                };
                if sight.window.is_clear(robot, point) {
                    return Some((target, rest + to_corner));
                }
                ahead *= 0.5;
            }
            // Around the corner itself, then; or back to the path.
            let target =
                if length(corner) < ahead { corner } else { self.ahead(robot, foot, ahead) };
            return Some((target, rest + to_corner));
        }
    }

    /// The point so far ahead on the path of a point of it; both from the robot.
    fn ahead(&self, robot: Waypoint, foot: Vector, mut way: f32) -> Vector {
        let mut from = foot;
        for &point in self.route.get(self.at + 1..).unwrap_or_default() {
            let to = between(robot, point);
            let leg = (to.0 - from.0, to.1 - from.1);
            let long = length(leg);
            if long > way {
                let part = way / long;
                return (from.0 + leg.0 * part, from.1 + leg.1 * part);
            }
            way -= long;
            from = to;
        }
        from
    }

    /// The speed that the path, the room and the pose allow.
    fn wanted(&self, sight: &Sight<'_>, curvature: f32, left: f32) -> f32 {
        let motion = &self.motion;
        let bend = curvature.abs().max(1.0e-6);
        let in_curve = (motion.top_turn / bend).min(root(motion.side_acceleration / bend));
        let to_end = root(2.0 * motion.acceleration * left);
        // At full speed as long as half of that is left.
        let sure = (2.0 - 2.0 * sight.unsure / motion.most_unsure.max(1.0)).min(1.0);
        let room = sight.near.nearest().unwrap_or(f32::MAX) - f32::from(motion.radius);
        let beside = (room / ROOM_TIME).max(CREEP);
        let sure = (motion.top_speed * sure).max(0.0);
        motion.top_speed.min(in_curve).min(to_end).min(beside).min(sure)
    }

    /// The speed that what is ahead allows.
    fn allowed(&self, sight: &Sight<'_>, curvature: f32, wanted: f32) -> (f32, Option<Hindrance>) {
        let motion = &self.motion;
        let free = self.free_way(sight.near, curvature, wanted);
        let before_wall = motion.stops_within(free);
        let before_stranger = self.before_strangers(sight);
        let crossing = self.is_crossed(sight, curvature, wanted);
        let before_person = if crossing { 0.0 } else { before_stranger };
        let speed = wanted.min(before_wall).min(before_person);
        if before_person < CREEP {
            // Nobody is crept up to.
            (0.0, Some(Hindrance::Person))
        } else if before_wall < STANDS {
            (0.0, Some(Hindrance::Blocked))
        } else {
            (speed, None)
        }
    }

    /// How far the robot can drive along a circle before it is too near to what it sees; as far as
    /// it would need to stop, at the most.
    fn free_way(&self, near: &NearPoints, curvature: f32, speed: f32) -> f32 {
        let motion = &self.motion;
        let keep = f32::from(motion.radius) + f32::from(motion.margin);
        let far = speed * motion.reaction + speed * speed / (2.0 * motion.braking.max(1.0)) + 60.0;
        let step = far / SAMPLES as f32;
        let reach = far + keep;
        let samples: [Vector; SAMPLES] =
            core::array::from_fn(|index| on_circle(curvature, step * (index + 1) as f32));
        let mut free = SAMPLES;
        for &(x, y) in near.points() {
            let now = x * x + y * y;
            if now > reach * reach {
                continue;
            }
            let samples = samples.iter().take(free);
            let hit = samples.enumerate().find(|(_, at)| {
                let (x, y) = (x - at.0, y - at.1);
                let then = x * x + y * y;
                // It may leave what it is too near to.
                then < keep * keep && then < now
            });
            if let Some((index, _)) = hit {
                free = index;
            }
        }
        step * free as f32
    }

    /// The speed at which a person who is not on the map, and comes at the robot, still has room.
    fn before_strangers(&self, sight: &Sight<'_>) -> f32 {
        let motion = &self.motion;
        let keep = f32::from(motion.radius) + f32::from(motion.margin);
        // Those who walk, and the robot meanwhile.
        let closing = (motion.walking + 0.5 * motion.top_speed).max(1.0);
        let matters = (motion.reaction + motion.top_speed / motion.braking.max(1.0)) * closing;
        let mut nearest = (matters + keep) * (matters + keep);
        let window = sight.window;
        let to_window = window.of_robot(sight.pose);
        for &(x, y) in sight.near.points() {
            let square = x * x + y * y;
            if x >= -keep
                && square < nearest
                && to_window(x, y).is_some_and(|it| window.free.has(it) && !window.dear.has(it))
            {
                nearest = square;
            }
        }
        let time = (root(nearest) - keep) / closing - motion.reaction;
        (time * motion.braking).max(0.0)
    }

    /// Whether somebody whom the cameras see is about to be where the robot will be.
    fn is_crossed(&self, sight: &Sight<'_>, curvature: f32, speed: f32) -> bool {
        let (sin, cos) = sin_cos(radians(sight.pose.heading));
        let robot = Waypoint { x: sight.pose.x, y: sight.pose.y };
        sight.movers.iter().filter(|mover| !mover.stands()).any(|mover| {
            let (x, y) = between(robot, Waypoint { x: mover.x, y: mover.y });
            let (vx, vy) = (f32::from(mover.velocity_x), f32::from(mover.velocity_y));
            let keep = f32::from(self.motion.radius)
                + f32::from(mover.radius)
                + if mover.is_person {
                    self.motion.person_margin
                } else {
                    self.motion.margin.into()
                };
            (0..=SAMPLES).any(|sample| {
                let time = FORESIGHT * sample as f32 / SAMPLES as f32;
                let (forward, left) = on_circle(curvature, speed * time);
                let at = (forward * cos - left * sin, forward * sin + left * cos);
                let (x, y) = (x + vx * time, y + vy * time);
                let apart = (x - at.0, y - at.1);
                let then = apart.0 * apart.0 + apart.1 * apart.1;
                // If it stood they would be further apart: else driving on is no worse.
                then < keep * keep && then <= x * x + y * y
            })
        })
    }
}

/// From one point to another.
fn between(from: Waypoint, to: Waypoint) -> Vector {
    (to.x.0.saturating_sub(from.x.0) as f32, to.y.0.saturating_sub(from.y.0) as f32)
}

fn length((x, y): Vector) -> f32 {
    root(x * x + y * y)
}

/// So far along a circle that begins straight ahead: forward and left. Within a thousandth for
/// less than a radian of it.
fn on_circle(curvature: f32, way: f32) -> Vector {
    let turned = (curvature * way).clamp(-2.0, 2.0);
    let square = turned * turned;
    let forward = way * (1.0 - square / 6.0 * (1.0 - square / 20.0));
    let left = way * turned * 0.5 * (1.0 - square / 12.0 * (1.0 - square / 30.0));
    (forward, left)
}
