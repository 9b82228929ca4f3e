//! Robots that drive along their routes (turn in place, drive straight, wait for anyone ahead), or
//! by commanded speeds.

use libm::{atan2, cos, sin};
use parry2d_f64::glamx::DVec2;
use ubimap_protocol::units::{Pose, RobotId};

use super::{
    marker::{Colour, MarkerPlate},
    odometer::Odometer,
    plane_pose::{PlanePose, wrap},
    render::{Paint, Part},
    route::{Body, Route},
    scenario::RobotConfig,
    sensor::RangeSensor,
    shapes::{Footprint, Prism},
};

/// Colour of a robot's body: dark, except for the marker.
const BODY: Colour = [0.2, 0.21, 0.24];

/// Distance ahead in metres at which a robot stops for others.
const GAP: f64 = 0.35;

/// Ratio of braking to acceleration.
const BRAKE: f64 = 3.0;

/// Time in seconds after which a waiting robot turns back; each further robot waits a little longer, so
/// that two robots that wait for each other do not turn back together.
const PATIENCE: f64 = 5.0;

/// Distance in metres from the point of contact within which a robot counts as still in contact.
const LEANS: f64 = 0.05;

/// Distance ahead in metres at which something presses the bumper.
const BUMPER: f64 = 0.01;

/// What stopped a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Contact {
    /// A wall, furniture, or another robot.
    Thing,
    Person,
}

/// Commanded speeds in m/s and rad/s.
#[derive(Clone, Copy, Debug, Default)]
struct Wheels {
    speed: f64,
    turn: f64,
}

/// Time from standstill to the maximum turn rate, in seconds.
const TURN_RISE: f64 = 0.25;

/// A simulated robot.
#[derive(Clone, Debug)]
pub struct SimRobot {
    id: RobotId,
    radius: f64,
    height: f64,
    /// Length and width of a box; `None` for a cylinder.
    sides: Option<DVec2>,
    marker: MarkerPlate,
    /// Rotation of the marker on the robot, in radians.
    askew: f64,
    sensor: RangeSensor,
    truth: PlanePose,
    odometer: Odometer,
    route: Route,
    top_speed: f64,
    acceleration: f64,
    turn_rate: f64,
    patience: f64,
    speed: f64,
    waited: f64,
    /// Commanded speeds; `None` while the robot drives its route.
    wheels: Option<Wheels>,
    turning: f64,
    /// The present contact, and the robot's position when it began.
    contact: Option<(Contact, DVec2)>,
    /// Whether something touches the front.
    is_touching: bool,
}

impl SimRobot {
    /// The robot's number.
    pub fn id(&self) -> RobotId {
        self.id
    }

    /// True pose: `base_link` in `map`.
    pub fn truth(&self) -> Pose {
        self.truth.quantised()
    }

    /// Odometry: `base_link` in `odom`, whose origin is the start.
    pub fn odometry(&self) -> Pose {
        self.odometer.pose().quantised()
    }

    /// The way in metres and the angle in radians that the wheels have measured since the start, with
    /// their errors.
    pub fn rolled(&self) -> [f64; 2] {
        self.odometer.rolled()
    }

    /// Whether it touches something ahead.
    pub fn is_touching(&self) -> bool {
        self.is_touching
    }

    /// The robot's range sensor.
    pub fn sensor(&self) -> &RangeSensor {
        &self.sensor
    }

    /// Whether it has a route; without one it stands still.
    pub fn drives(&self) -> bool {
        self.route.target().is_some()
    }

    /// Maximum speed (m/s), maximum turn rate (rad/s) and acceleration (m/s^2).
    pub fn limits(&self) -> [f64; 3] {
        [self.top_speed, self.turn_rate, self.acceleration]
    }

    /// The radius of its footprint, in metres.
    pub fn radius_m(&self) -> f64 {
        self.radius
    }

    /// The robot's height, in metres.
    pub fn height_m(&self) -> f64 {
        self.height
    }

    pub(super) fn new(config: &RobotConfig, index: usize, odometer: Odometer) -> Self {
        let start = DVec2::new(config.start.x_m, config.start.y_m);
        Self {
            id: RobotId(config.id),
            radius: config.radius_m,
            height: config.height_m,
            sides: config.box_m.map(DVec2::from),
            marker: MarkerPlate::new(config),
            askew: config.identifier_askew_deg.to_radians(),
            sensor: RangeSensor::new(&config.sensor),
            truth: PlanePose { position: start, heading: config.start.heading_deg.to_radians() },
            odometer,
            route: Route::new(start, config.route.waypoints_m.iter().map(|&p| DVec2::from(p))),
            top_speed: config.route.speed_m_s,
            acceleration: config.route.acceleration_m_s2,
            turn_rate: config.route.turn_rate_deg_s.to_radians(),
            patience: PATIENCE + 1.5 * index as f64,
            speed: 0.0,
            waited: 0.0,
            wheels: None,
            turning: 0.0,
            contact: None,
            is_touching: false,
        }
    }

    pub(super) fn pose(&self) -> PlanePose {
        self.truth
    }

    pub(super) fn body(&self) -> Body {
        Body { centre: self.truth.position, radius: self.radius, height: self.height }
    }

    /// The pose that cameras measure: that of its marker.
    pub(super) fn identified(&self) -> PlanePose {
        let PlanePose { position, heading } = self.truth;
        PlanePose { position, heading: heading + self.askew }
    }

    /// The visible part of the robot.
    pub(super) fn part(&self) -> Part {
        let PlanePose { position, heading } = self.truth;
        let footprint = match self.sides {
            Some(sides) => Footprint::rectangle(position, sides, heading),
            None => Footprint::disc(position, self.radius),
        };
        let paint = Paint::Robot {
            colour: BODY,
            marker: self.marker.clone(),
            middle: position,
            facing: DVec2::new(cos(heading), sin(heading)).as_vec2(),
        };
        Part { prism: Prism { footprint, bottom: 0.0, top: self.height }, paint }
    }

    /// Commands speeds in m/s and rad/s; the robot leaves its route. Only a robot with a fault drives backwards.
    pub(super) fn tell_wheels(&mut self, speed: f64, turn: f64) {
        let turn = turn.clamp(-self.turn_rate, self.turn_rate);
        self.wheels = Some(Wheels { speed: speed.clamp(-self.top_speed, self.top_speed), turn });
    }

    /// Whether it drives by commanded speeds.
    pub(super) fn is_told(&self) -> bool {
        self.wheels.is_some()
    }

    /// Drives for one time step by the commanded speeds, within the limits of acceleration. `contact`
    /// says what the robot would touch at a position; that stops it. Returns a new contact, if any.
    pub(super) fn obey(
        &mut self,
        seconds: f64,
        contact: impl Fn(Body, DVec2) -> Option<Contact>,
    ) -> Option<Contact> {
        let Wheels { speed, turn } = self.wheels.unwrap_or_default();
        let gained = self.acceleration * seconds;
        self.speed += (speed - self.speed).clamp(-BRAKE * gained, gained);
        let most = self.turn_acceleration() * seconds;
        self.turning += (turn - self.turning).clamp(-most, most);
        let angle = self.turning * seconds;
        let middle = self.truth.heading + angle / 2.0;
        let mut way = self.speed * seconds;
        let next = self.truth.position + DVec2::new(cos(middle), sin(middle)) * way;
        let (mut touched, backs) = (None, way < 0.0);
        if way != 0.0 {
            let here = self.truth.position;
            // A robot that still leans on an obstacle does not touch it again.
            self.contact = self.contact.filter(|(_, at)| at.distance(here) < LEANS);
            let met = contact(self.body(), next);
            touched = met.filter(|_| self.contact.map(|(what, _)| what) != met);
            if let Some(what) = met {
                self.contact = Some((what, here));
                (self.speed, way) = (0.0, 0.0);
            } else {
                self.truth.position = next;
            }
        }
        let ahead = DVec2::new(cos(middle), sin(middle)) * BUMPER;
        // The bumper is at the front.
        self.is_touching = touched.is_some() && !backs
            || self.is_touching && contact(self.body(), self.truth.position + ahead).is_some();
        self.truth.heading = wrap(self.truth.heading + angle);
        self.odometer.measure(way, angle);
        touched
    }

    /// Drives along the route for one time step, among `others`.
    pub(super) fn step(&mut self, seconds: f64, others: &[Body]) {
        let Some(target) = self.route.target() else { return };
        let way = target - self.truth.position;
        let turn = wrap(atan2(way.y, way.x) - self.truth.heading);
        if turn.abs() > 1e-9 && self.speed == 0.0 {
            self.turn_towards(turn, seconds);
            return;
        }
        let heading = way.normalize_or_zero();
        let me = self.body();
        let left = way.length();
        let blocked = others.iter().any(|other| me.is_blocked(heading, other, GAP.min(left)));
        let gained = self.acceleration * seconds;
        self.speed = if blocked {
            (self.speed - BRAKE * gained).max(0.0)
        } else {
            // Slow enough to stop in time, but fast enough to arrive.
            let stopping = (2.0 * self.acceleration * left).sqrt().max(gained);
            (self.speed + gained).min(self.top_speed).min(stopping)
        };
        let step = (self.speed * seconds).min(left);
        let next = self.truth.position + heading * step;
        if others.iter().any(|other| me.would_touch(next, other)) {
            self.speed = 0.0;
        }
        if self.speed == 0.0 {
            self.wait(seconds);
            return;
        }
        self.waited = 0.0;
        self.truth.position = next;
        self.odometer.measure(step, 0.0);
        if left - step < 1e-9 {
            self.truth.position = target;
            self.speed = 0.0;
            self.route.arrive();
        }
    }

    fn wait(&mut self, seconds: f64) {
        self.waited += seconds;
        if self.waited > self.patience {
            self.waited = 0.0;
            self.route.turn_round();
        }
    }

    /// Angular acceleration in rad/s^2.
    fn turn_acceleration(&self) -> f64 {
        self.turn_rate / TURN_RISE
    }

    /// Turns in place for one time step, slowing down so as to stop at the target heading.
    fn turn_towards(&mut self, left: f64, seconds: f64) {
        let gained = self.turn_acceleration() * seconds;
        let stopping = (2.0 * self.turn_acceleration() * left.abs()).sqrt().max(gained);
        let rate = (self.turning.abs() + gained).min(self.turn_rate).min(stopping);
        let angle = (rate * seconds).min(left.abs()).copysign(left);
        self.turning = if angle == left { 0.0 } else { rate };
        self.truth.heading = wrap(self.truth.heading + angle);
        self.odometer.measure(0.0, angle);
    }
}
