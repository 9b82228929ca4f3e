//! A robot's range sensor: a fan of beams at one height.

use libm::{cos, sin};
use parry2d_f64::{
    bounding_volume::{Aabb, BoundingVolume},
    glamx::DVec2,
};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use ubimap_protocol::units::Pose;

use super::{
    robots::PlanePose,
    room::Room,
    route::Body,
    scenario::SensorConfig,
    shapes::{Footprint, Prism},
};

/// A range sensor. Beam `i` points to `first_angle_rad() + i * step_rad()`, counter-clockwise from
/// the sensor's own x; [`RangeSensor::mount`] has the sensor in `base_link`.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeSensor {
    x: f64,
    y: f64,
    heading: f64,
    askew: f64,
    height: f64,
    fov: f64,
    beams: usize,
    min_range: f64,
    max_range: f64,
    rate: f64,
    noise: f64,
    noise_ratio: f64,
}

impl RangeSensor {
    /// The sensor in `base_link`, as the robot believes it to be mounted.
    pub fn mount(&self) -> Pose {
        Pose::from_metres(self.x, self.y, self.heading)
    }

    /// Above the floor, in metres.
    pub fn height_m(&self) -> f64 {
        self.height
    }

    /// The angle of the first beam, the rightmost, in radians.
    pub fn first_angle_rad(&self) -> f64 {
        -self.fov / 2.0
    }

    /// From each beam to the next, in radians.
    pub fn step_rad(&self) -> f64 {
        self.fov / (self.beams - 1) as f64
    }

    /// How many beams a scan has.
    pub fn beams(&self) -> usize {
        self.beams
    }

    /// The farthest return, in metres.
    pub fn max_range_m(&self) -> f64 {
        self.max_range
    }

    /// Scans each second.
    pub fn rate_hz(&self) -> f64 {
        self.rate
    }

    pub(super) fn new(config: &SensorConfig) -> Self {
        Self {
            x: config.x_m,
            y: config.y_m,
            heading: config.heading_deg.to_radians(),
            askew: config.askew_deg.to_radians(),
            height: config.height_m,
            fov: config.fov_deg.to_radians(),
            beams: config.beams.max(2),
            min_range: config.min_range_m,
            max_range: config.max_range_m,
            rate: config.rate_hz,
            noise: config.noise_m,
            noise_ratio: config.noise_ratio,
        }
    }

    /// A scan from a robot's pose, in millimetres for each beam; zero where nothing came back.
    pub(super) fn scan(
        &self,
        robot: PlanePose,
        room: &Room,
        others: &[Prism],
        dice: &mut ChaCha8Rng,
    ) -> Vec<u16> {
        let facing = DVec2::new(cos(robot.heading), sin(robot.heading));
        let origin = robot.position + facing.rotate(DVec2::new(self.x, self.y));
        let reach = self.max_range;
        let around = Aabb::from_half_extents(origin, DVec2::splat(reach));
        let near: Vec<&Prism> = others
            .iter()
            .filter(|prism| prism.spans(self.height))
            .filter(|prism| prism.footprint.bounds().intersects(&around))
            .collect();
        (0..self.beams)
            .map(|beam| {
                let bearing = self.first_angle_rad() + beam as f64 * self.step_rad();
                let angle = robot.heading + self.heading + self.askew + bearing;
                let (from, along) =
                    (origin.extend(self.height), DVec2::new(cos(angle), sin(angle)).extend(0.0));
                // One throw for each beam, hit or not: a person far away shifts no noise.
                let throw: f64 = StandardNormal.sample(dice);
                let fixed = room.first_hit(from, along, reach).map(|(_, range)| range);
                let moving = near.iter().filter_map(|body| body.first_hit(from, along, reach));
                match moving.chain(fixed).reduce(f64::min) {
                    Some(range) => {
                        self.reading(range + throw * (self.noise + self.noise_ratio * range))
                    }
                    None => 0,
                }
            })
            .collect()
    }

    fn reading(&self, range: f64) -> u16 {
        if range < self.min_range || range > self.max_range {
            return 0;
        }
        (range * 1000.0).round() as u16
    }
}

/// The body as a prism.
pub(super) fn cylinder(body: &Body) -> Prism {
    Prism { footprint: Footprint::disc(body.centre, body.radius), bottom: 0.0, top: body.height }
}
