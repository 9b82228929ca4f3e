//! A robot's range sensor: a fan of beams, or a row of a depth camera, at a fixed height.

use libm::{cos, sin, tan};
use parry2d_f64::{
    bounding_volume::{Aabb, BoundingVolume},
    glamx::{DVec2, DVec3},
};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use ubimap_agent::sense::NOTHING_IN_RANGE;
use ubimap_protocol::units::Pose;

use super::{
    plane_pose::PlanePose,
    room::Room,
    route::Body,
    scenario::{SensorConfig, SensorPreset},
    shapes::{Footprint, Prism},
    stereo::{PARTS, Stereo},
};

/// Standard deviation of a D435's disparity in pixels.
const STEREO_NOISE: f64 = 0.08;
/// Baseline of a D435 in metres.
const BASELINE: f64 = 0.05;

/// A beam whose noise exceeds this many standard deviations gets nothing back: one in 370.
const LOST: f64 = 3.0;

/// Rays per wide zone in each direction.
const RAYS: i32 = 3;

/// A range sensor at the pose [`RangeSensor::mount`] in `base_link`. Beam `i` of a fan has the direction
/// `first_angle_rad() + i * step_rad()`, counter-clockwise from the sensor's x. A camera
/// ([`RangeSensor::focal_px`]) gives for column `i`, counted from the left, a depth along that axis.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeSensor {
    x: f64,
    y: f64,
    heading: f64,
    askew: f64,
    /// How far it looks down, in radians.
    tilt: f64,
    height: f64,
    fov: f64,
    beams: usize,
    min_range: f64,
    max_range: f64,
    clear: f64,
    rate: f64,
    noise: f64,
    noise_ratio: f64,
    sees_grey: bool,
    optics: Optics,
}

/// The projection of a sensor.
#[derive(Clone, Debug, PartialEq)]
enum Optics {
    /// Thin beams at equal angles.
    Fan,
    /// Columns of a pinhole camera; the focal length is in columns.
    Pinhole { focal: f64 },
    /// Columns of a stereo camera.
    Stereo { focal: f64, stereo: Stereo },
    /// Columns of wide zones, each as high as it is wide.
    Zones { focal: f64 },
}

impl RangeSensor {
    /// The sensor's pose in `base_link` as configured, without its mounting error.
    pub fn mount(&self) -> Pose {
        Pose::from_metres(self.x, self.y, self.heading)
    }

    /// Height above the floor in metres.
    pub fn height_m(&self) -> f64 {
        self.height
    }

    /// Angle of the first beam, the rightmost, in radians.
    pub fn first_angle_rad(&self) -> f64 {
        -self.fov / 2.0
    }

    /// Angle between beams in radians.
    pub fn step_rad(&self) -> f64 {
        self.fov / (self.beams - 1) as f64
    }

    /// The direction of a beam in the sensor's frame, scaled so that a reading times the direction is the
    /// point.
    pub fn direction(&self, beam: usize) -> [f64; 2] {
        match self.focal_px() {
            Some(focal) => [1.0, ((self.beams - 1) as f64 / 2.0 - beam as f64) / focal],
            None => {
                let bearing = self.first_angle_rad() + beam as f64 * self.step_rad();
                [cos(bearing), sin(bearing)]
            }
        }
    }

    /// Number of beams or columns in a scan.
    pub fn beams(&self) -> usize {
        self.beams
    }

    /// Focal length of a camera in columns; `None` for a fan of beams.
    pub fn focal_px(&self) -> Option<f64> {
        match self.optics {
            Optics::Fan => None,
            Optics::Pinhole { focal } | Optics::Stereo { focal, .. } | Optics::Zones { focal } => {
                Some(focal)
            }
        }
    }

    /// Maximum range in metres.
    pub fn max_range_m(&self) -> f64 {
        self.max_range
    }

    /// Distance in metres up to which a beam without a return says that the ground is free; 0 if it says nothing.
    pub fn clear_m(&self) -> f64 {
        self.clear
    }

    /// Whether it is a grey camera, which delivers pictures instead of ranges.
    pub fn sees_grey(&self) -> bool {
        self.sees_grey
    }

    /// Scans per second.
    pub fn rate_hz(&self) -> f64 {
        self.rate
    }

    pub(super) fn new(config: &SensorConfig) -> Self {
        let focal = config.beams as f64 / 2.0 / tan(config.fov_deg.to_radians() / 2.0);
        let optics = match config.preset {
            SensorPreset::Beams => Optics::Fan,
            SensorPreset::Tof100 | SensorPreset::GreyCamera => Optics::Pinhole { focal },
            SensorPreset::Tof8 => Optics::Zones { focal },
            SensorPreset::DepthRow => {
                let range = [config.min_range_m, config.max_range_m];
                Optics::Stereo { focal, stereo: Stereo::new(focal, BASELINE, range) }
            }
        };
        Self {
            optics,
            x: config.x_m,
            y: config.y_m,
            heading: config.heading_deg.to_radians(),
            askew: config.askew_deg.to_radians(),
            tilt: config.tilt_deg.to_radians(),
            height: config.height_m,
            fov: config.fov_deg.to_radians(),
            beams: config.beams.max(2),
            min_range: config.min_range_m,
            max_range: config.max_range_m,
            clear: config.clear_m,
            rate: config.rate_hz,
            noise: config.noise_m,
            noise_ratio: config.noise_ratio,
            sees_grey: config.preset == SensorPreset::GreyCamera,
        }
    }

    /// The actual position and direction for a pose of the robot, and half the field of view (radians).
    pub(super) fn view(&self, robot: PlanePose) -> (DVec2, f64, f64) {
        let facing = DVec2::new(cos(robot.heading), sin(robot.heading));
        let origin = robot.position + facing.rotate(DVec2::new(self.x, self.y));
        (origin, robot.heading + self.heading + self.askew, self.fov / 2.0)
    }

    /// A scan at a pose of the robot: millimetres for each beam, or [`NOTHING_IN_RANGE`] for no return if that
    /// says anything, else 0.
    pub(super) fn scan(
        &self,
        robot: PlanePose,
        room: &Room,
        others: &[Prism],
        dice: &mut ChaCha8Rng,
    ) -> Vec<u16> {
        let (origin, axis, _) = self.view(robot);
        // A depth at the edge of the view is at a greater distance.
        let around = Aabb::from_half_extents(origin, DVec2::splat(2.0 * self.max_range));
        let near: Vec<&Prism> =
            others.iter().filter(|prism| prism.footprint.bounds().intersects(&around)).collect();
        let from = origin.extend(self.height);
        let ranges = (0..self.beams).map(|beam| {
            let meets = |way: DVec3| {
                let fixed = room.first_hit(from, way, self.max_range).map(|(_, range)| range);
                let moving =
                    near.iter().filter_map(|prism| prism.first_hit(from, way, self.max_range));
                // A level ray meets no floor.
                let floor = (way.z < 0.0).then(|| self.height / -way.z);
                moving.chain(fixed).chain(floor).reduce(f64::min)
            };
            self.ways(axis, beam)
                .map(|way| self.tilted(axis, way))
                .filter_map(meets)
                .reduce(f64::min)
        });
        let ranges: Vec<Option<f64>> = ranges.collect();
        // One random number for each beam, hit or not, so that distant people do not shift the noise.
        let mut throw = || -> f64 { StandardNormal.sample(dice) };
        if let Optics::Stereo { stereo, .. } = &self.optics {
            let depths: Vec<f32> =
                ranges.iter().map(|range| range.map_or(f32::INFINITY, |it| it as f32)).collect();
            let mut row = vec![0.0; depths.len()];
            stereo.disparities(&depths, &mut row);
            let noise = STEREO_NOISE as f32 * PARTS;
            let mut added: Vec<f32> = row.iter().map(|_| throw() as f32 * noise).collect();
            let mut readings = Vec::with_capacity(depths.len());
            stereo.measure(&row, &row, &mut added, &mut readings);
            return readings;
        }
        let noisy =
            |range: f64, throw: f64| range + throw * (self.noise + self.noise_ratio * range);
        ranges
            .into_iter()
            .map(|range| (range, throw()))
            .map(|(range, throw)| match range {
                Some(range) if throw.abs() < LOST => self.reading(noisy(range, throw)),
                _ => self.nothing(),
            })
            .collect()
    }

    /// The rays of a beam, scaled so that a reading times a ray is the point.
    fn ways(&self, axis: f64, beam: usize) -> impl Iterator<Item = DVec3> + use<> {
        let ahead = |angle: f64| DVec2::new(cos(angle), sin(angle));
        let column = beam as f64 - (self.beams - 1) as f64 / 2.0;
        let bearing = self.first_angle_rad() + beam as f64 * self.step_rad();
        let (middle, side, rays) = match self.optics {
            Optics::Fan => (ahead(axis + bearing), 0.0, 1),
            Optics::Pinhole { focal } | Optics::Stereo { focal, .. } => {
                let forward = ahead(axis);
                (forward - forward.perp() * (column / focal), 0.0, 1)
            }
            Optics::Zones { focal } => {
                let forward = ahead(axis);
                (forward - forward.perp() * (column / focal), 1.0 / focal, RAYS)
            }
        };
        let aside = ahead(axis).perp();
        (0..rays * rays).map(move |ray| {
            let part = |index: i32| (f64::from(index) + 0.5) / f64::from(rays);
            // The zone is above the horizon.
            let (across, up) = (part(ray % rays) - 0.5, part(ray / rays));
            (middle + aside * (across * side)).extend(up * side)
        })
    }

    /// A ray of a level sensor as that of the tilted one.
    fn tilted(&self, axis: f64, way: DVec3) -> DVec3 {
        if self.tilt == 0.0 {
            return way;
        }
        let forward = DVec2::new(cos(axis), sin(axis));
        let (level, (sine, cosine)) = (way.truncate(), (sin(self.tilt), cos(self.tilt)));
        let ahead = level.dot(forward);
        let turned = level + forward * (ahead * (cosine - 1.0) + way.z * sine);
        turned.extend(way.z * cosine - ahead * sine)
    }

    fn reading(&self, range: f64) -> u16 {
        match range {
            // Sensors notice what is too near.
            _ if range < self.min_range => 0,
            _ if range > self.max_range => self.nothing(),
            _ => (range * 1000.0).round() as u16,
        }
    }

    /// What a beam reads that gets nothing back.
    fn nothing(&self) -> u16 {
        if self.clear > 0.0 { NOTHING_IN_RANGE } else { 0 }
    }
}

/// A body as a prism.
pub(super) fn cylinder(body: &Body) -> Prism {
    Prism { footprint: Footprint::disc(body.centre, body.radius), bottom: 0.0, top: body.height }
}
