//! From a path to the wheels: pure pursuit (Coulter 1992), at a speed from which the robot can
//! always stop before an obstacle in its own sensor's view.

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

/// A velocity command for the wheels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DriveCommand {
    /// Forward, in mm/s.
    pub speed: i16,
    /// Counter-clockwise, in mrad/s.
    pub turn: i16,
}

impl DriveCommand {
    /// Zero speed, zero turn rate.
    pub const STAND: Self = Self { speed: 0, turn: 0 };
}

/// The robot's size and dynamics, in millimetres, radians and seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Radius of a circle around `base_link` that contains the robot.
    pub radius: u16,
    /// Distance to keep from all obstacles, in addition to the radius.
    pub margin: u16,
    /// Maximum speed.
    pub top_speed: f32,
    /// Maximum turn rate.
    pub top_turn: f32,
    /// Acceleration.
    pub acceleration: f32,
    /// Guaranteed deceleration.
    pub braking: f32,
    /// Maximum lateral acceleration.
    pub side_acceleration: f32,
    /// Delay from a scan until the wheels react.
    pub reaction: f32,
    /// Assumed walking speed of a person.
    pub walking: f32,
    /// Distance to keep from people.
    pub person_margin: f32,
    /// Standard deviation of the position, in millimetres. Above half of it the robot slows down, to 0.4 of its speed.
    pub unsure: f32,
}

impl Default for Motion {
    /// A robot 30 cm wide with a top speed of 0.5 m/s.
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
            unsure: 150.0,
        }
    }
}

impl Motion {
    /// The maximum speed from which the robot can stop within `way`.
    fn stops_within(&self, way: f32) -> f32 {
        let pause = self.braking * self.reaction;
        (root(pause * pause + 2.0 * self.braking * way.max(0.0)) - pause).max(0.0)
    }
}

/// Why the robot can't drive on along its path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hindrance {
    /// The path ends here.
    Arrived,
    /// The robot is too far off its path.
    OffPath,
    /// An obstacle is in the way.
    Blocked,
    /// A person is about to cross the path, or an object missing from the map is near.
    Person,
}

/// The inputs of a step.
#[derive(Clone, Copy, Debug)]
pub struct Sight<'s> {
    /// `base_link` in `map`.
    pub pose: Pose,
    /// Standard deviation of the position, in millimetres.
    pub unsure: f32,
    /// The newest scan.
    pub near: &'s NearPoints,
    /// Objects seen by the cameras.
    pub movers: &'s [Mover],
    /// The map.
    pub window: &'s PlanningWindow,
    /// Time since the last step, in seconds.
    pub elapsed: f32,
}

type Vector = (f32, f32);

/// Drives along a path.
#[derive(Clone, Debug)]
pub struct Follower {
    motion: Motion,
    /// The points of the path, from its start.
    route: Vec<Waypoint, MAX_POINTS>,
    /// Distance along the path from each point to the end.
    rest: [f32; MAX_POINTS],
    /// The index of the point that the robot passed last.
    at: usize,
    speed: f32,
    turn: f32,
    /// Whether the robot is turning on the spot towards the path.
    turns: bool,
}

/// Distance to the end of the path at which the robot has arrived, and distance from the path at
/// which it is off the path, in mm.
const ARRIVED: f32 = 40.0;
const OFF: f32 = 300.0;
/// Number of positions checked along the predicted motion.
const SAMPLES: usize = 8;
/// Prediction horizon for people, in seconds.
const FORESIGHT: f32 = 2.0;
/// Angular acceleration divided by the maximum turn rate, in 1/s: the maximum is reached after 0.5
/// s.
const TURN_GAIN: f32 = 2.0;
/// Turn rate in rad/s of a robot that does not know where it is, or a way: from one distance vector to the next, a second
/// later, it still sees some of the same walls.
const LOOK_RATE: f32 = 0.5;
/// Speed of a robot that is unsure of its position, as a share of the top speed.
const UNSURE_SPEED: f32 = 0.4;
/// Below this speed the robot counts as standing, in mm/s.
const STANDS: f32 = 20.0;
/// Minimum speed beside obstacles in mm/s. The speed limit there is the lateral clearance divided
/// by `ROOM_TIME`, in seconds.
const CREEP: f32 = 100.0;
const ROOM_TIME: f32 = 0.6;

impl Follower {
    /// A follower for a robot at standstill.
    pub fn new(motion: Motion) -> Self {
        let (route, rest) = (Vec::new(), [0.0; MAX_POINTS]);
        Self { motion, route, rest, at: 0, speed: 0.0, turn: 0.0, turns: false }
    }

    /// The robot's size and dynamics.
    pub fn motion(&self) -> &Motion {
        &self.motion
    }

    /// Sets another path.
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

    /// Drops the path and stops immediately.
    pub fn stand(&mut self) -> DriveCommand {
        (self.speed, self.turn, self.turns) = (0.0, 0.0, false);
        DriveCommand::STAND
    }

    /// The end of the path.
    pub fn end(&self) -> Option<Waypoint> {
        self.route.last().copied()
    }

    /// Whether the rest of the path, from `pose` on, is free in `window`.
    pub fn is_clear(&self, window: &PlanningWindow, pose: Pose) -> bool {
        let mut from = Waypoint { x: pose.x, y: pose.y };
        let ahead = self.route.get(self.at + 1..).unwrap_or_default();
        // A robot that stands too close to an obstacle may drive away from it, so the line to its
        // next point is not checked.
        let stands_free = window.place(from).is_some_and(|place| window.free.has(place));
        let mut ahead = ahead.iter();
        if !stands_free && let Some(&next) = ahead.next() {
            from = next;
        }
        ahead.all(|&next| window.is_clear(core::mem::replace(&mut from, next), next))
    }

    /// The next command, and the hindrance if any. At most 15,000 instructions.
    pub fn step(&mut self, sight: &Sight<'_>) -> (DriveCommand, Option<Hindrance>) {
        let Some((target, left)) = self.target(sight) else {
            return (self.stand(), Some(Hindrance::OffPath));
        };
        if left < ARRIVED {
            return (self.stand(), Some(Hindrance::Arrived));
        }
        let (sin, cos) = sin_cos(radians(sight.pose.heading));
        let (forward, side) = (target.0 * cos + target.1 * sin, target.1 * cos - target.0 * sin);
        // Starts to turn on the spot when the target is 37 degrees off straight ahead, and stops at
        // 15.
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
        // Braking is not limited here: the allowed speed already includes the braking distance.
        self.speed = speed.min(gained);
        // `clamp` would panic on a maximum that is not a number.
        let most = self.motion.top_turn;
        self.turn = (self.speed * curvature).max(-most).min(most);
        (self.command(), hindrance)
    }

    /// Turns on the spot, to the left or to the right.
    pub fn spin(&mut self, left: bool, elapsed: f32) -> DriveCommand {
        self.speed = 0.0;
        let most = self.motion.top_turn;
        self.turn_at(if left { most } else { -most }, elapsed)
    }

    /// Turns on the spot so slowly that the server can measure the turn.
    pub fn look_around(&mut self, elapsed: f32) -> DriveCommand {
        self.speed = 0.0;
        self.turn_at(self.motion.top_turn.min(LOOK_RATE), elapsed)
    }

    /// Turns on the spot towards a point in `base_link`.
    fn turn_by(&mut self, side: f32, forward: f32, elapsed: f32) -> DriveCommand {
        // The maximum turn rate from which the robot can still stop when it faces the point; up to
        // 45 degrees, tan(a) is about a.
        let off = if forward > 0.0 { (side / forward).abs().min(1.0) } else { 1.0 };
        let gain = TURN_GAIN * self.motion.top_turn;
        let wanted = root(2.0 * gain * off).min(self.motion.top_turn).max(0.3).copysign(side);
        self.turn_at(wanted, elapsed)
    }

    /// Goes towards a turn rate in rad/s.
    fn turn_at(&mut self, wanted: f32, elapsed: f32) -> DriveCommand {
        let most = TURN_GAIN * self.motion.top_turn * elapsed;
        self.turn += (wanted - self.turn).max(-most).min(most);
        self.command()
    }

    fn command(&self) -> DriveCommand {
        let turn = libm::roundf(self.turn * 1_000.0) as i16;
        DriveCommand { speed: libm::floorf(self.speed) as i16, turn }
    }

    /// The point to drive towards, relative to the robot along `map`'s axes, and the remaining
    /// distance. `None` if the robot is off the path.
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
            // Drives to the corner itself, or back to the path.
            let target =
                if length(corner) < ahead { corner } else { self.ahead(robot, foot, ahead) };
            return Some((target, rest + to_corner));
        }
    }

    /// The point at distance `way` along the path from `foot`, the path's nearest point to the
    /// robot; relative to the robot.
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

    /// The maximum speed allowed by the path, the lateral clearance and the uncertainty of the
    /// pose.
    fn wanted(&self, sight: &Sight<'_>, curvature: f32, left: f32) -> f32 {
        let motion = &self.motion;
        let bend = curvature.abs().max(1.0e-6);
        let in_curve = (motion.top_turn / bend).min(root(motion.side_acceleration / bend));
        let to_end = root(2.0 * motion.acceleration * left);
        // Full speed up to half the standard deviation, then linearly down.
        let sure = (2.0 - 2.0 * sight.unsure / motion.unsure.max(1.0)).clamp(UNSURE_SPEED, 1.0);
        let room = sight.near.nearest().unwrap_or(f32::MAX) - f32::from(motion.radius);
        let beside = (room / ROOM_TIME).max(CREEP);
        let sure = motion.top_speed * sure;
        motion.top_speed.min(in_curve).min(to_end).min(beside).min(sure)
    }

    /// The maximum speed allowed by the obstacles ahead, and the hindrance if there is one.
    fn allowed(&self, sight: &Sight<'_>, curvature: f32, wanted: f32) -> (f32, Option<Hindrance>) {
        let motion = &self.motion;
        let free = self.free_way(sight.near, curvature, wanted);
        let before_wall = motion.stops_within(free);
        let before_stranger = self.before_strangers(sight);
        let crossing = self.is_crossed(sight, curvature, wanted);
        let before_person = if crossing { 0.0 } else { before_stranger };
        let speed = wanted.min(before_wall).min(before_person);
        if before_person < CREEP {
            // For people the robot stops; it does not creep towards them.
            (0.0, Some(Hindrance::Person))
        } else if before_wall < STANDS {
            (0.0, Some(Hindrance::Blocked))
        } else {
            (speed, None)
        }
    }

    /// The distance that the robot can drive along an arc before it comes too close to a point of
    /// its scan; at most its stopping distance.
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
                // A robot that is too close to a point may move away from it.
                then < keep * keep && then < now
            });
            if let Some((index, _)) = hit {
                free = index;
            }
        }
        step * free as f32
    }

    /// The maximum speed that leaves time to stop for a person who walks towards the robot and is
    /// not on the map.
    fn before_strangers(&self, sight: &Sight<'_>) -> f32 {
        let motion = &self.motion;
        let keep = f32::from(motion.radius) + f32::from(motion.margin);
        // Closing speed: the person's, plus the robot's mean speed while it brakes.
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

    /// Whether a person seen by the cameras is about to cross the robot's motion.
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
                // If the person would come even closer to a robot that stands, stopping does not
                // help.
                then < keep * keep && then <= x * x + y * y
            })
        })
    }
}

/// The vector from one point to another.
fn between(from: Waypoint, to: Waypoint) -> Vector {
    (to.x.0.saturating_sub(from.x.0) as f32, to.y.0.saturating_sub(from.y.0) as f32)
}

fn length((x, y): Vector) -> f32 {
    root(x * x + y * y)
}

/// The point at distance `way` along a circle that begins straight ahead: forward and left. Error
/// below 0.1 % for arcs of less than one radian.
fn on_circle(curvature: f32, way: f32) -> Vector {
    let turned = (curvature * way).clamp(-2.0, 2.0);
    let square = turned * turned;
    let forward = way * (1.0 - square / 6.0 * (1.0 - square / 20.0));
    let left = way * turned * 0.5 * (1.0 - square / 12.0 * (1.0 - square / 30.0));
    (forward, left)
}
