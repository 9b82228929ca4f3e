//! A robot in a scenario.

use serde::Deserialize;

/// A robot: an upright cylinder on two wheels, with one range sensor and a scripted route.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotConfig {
    /// The robot's number, unique in the scenario.
    pub id: u16,
    /// Pose at the start; also the last stop of its route.
    pub start: StartConfig,
    /// Radius of its footprint.
    #[serde(default = "defaults::radius_m")]
    pub radius_m: f64,
    /// Height of its top above the floor.
    #[serde(default = "defaults::height_m")]
    pub height_m: f64,
    /// Length and width of a box-shaped robot; a cylinder if not given.
    pub box_m: Option<[f64; 2]>,
    /// The kind of marker on its top.
    #[serde(default)]
    pub marker: MarkerConfig,
    /// Side of a tag's black square, or of a colour marker.
    #[serde(default = "defaults::marker_size_m")]
    pub marker_size_m: f64,
    /// Number of its tag (default: the robot's). Only the first [`TAGS`](crate::world::TAGS) of the family
    /// are available: a robot with a higher number carries a blank plate.
    pub tag_id: Option<u16>,
    /// Mounting error of its marker: rotation relative to the robot, counter-clockwise.
    #[serde(default)]
    pub identifier_askew_deg: f64,
    /// The range sensor.
    #[serde(default)]
    pub sensor: SensorConfig,
    /// The route.
    #[serde(default)]
    pub route: RouteConfig,
    /// The odometry errors.
    #[serde(default)]
    pub odometry: OdometryConfig,
}

impl RobotConfig {
    /// Colours of the head and tail of its colour marker, as indices into red, yellow, green, cyan, blue,
    /// magenta. There are fifteen distinct unordered pairs, because head and tail look alike.
    pub fn colours(&self) -> [usize; 2] {
        let pairs = (0..6).flat_map(|head| (head + 1..6).map(move |tail| [head, tail]));
        pairs.cycle().nth(usize::from(self.id) % 15).unwrap_or([0, 1])
    }

    /// This robot as a Create 2 that carries an A010 with this number of columns: 340 mm wide, up to
    /// 0.5 m/s, and the sensor mounted as the robot's own.
    pub fn on_create2(&self, columns: usize) -> Self {
        let route = RouteConfig { speed_m_s: 0.5, turn_rate_deg_s: 75.0, ..self.route.clone() };
        let sensor = self.sensor.to_a010(columns);
        Self { radius_m: 0.17, box_m: None, sensor, route, ..self.clone() }
    }

    /// This robot with an LD06 lidar in the place of its sensor.
    pub fn with_ld06(self) -> Self {
        Self { sensor: self.sensor.to_ld06(), ..self }
    }

    /// The default robot, with a route through these points.
    pub(in super::super) fn at(id: u16, start: StartConfig, waypoints_m: Vec<[f64; 2]>) -> Self {
        Self {
            id,
            start,
            radius_m: defaults::radius_m(),
            height_m: defaults::height_m(),
            box_m: None,
            marker: MarkerConfig::default(),
            marker_size_m: defaults::marker_size_m(),
            tag_id: None,
            identifier_askew_deg: 0.0,
            sensor: SensorConfig::default(),
            route: RouteConfig { waypoints_m, ..RouteConfig::default() },
            odometry: OdometryConfig::default(),
        }
    }
}

/// The kind of marker on a robot's top, centred over `base_link`.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub enum MarkerConfig {
    /// A tag of the AprilTag family 36h11 with a white margin; its top edge is ahead.
    #[default]
    Tag,
    /// A light cover with a head disc ahead and a tail disc behind; their two colours identify the robot
    /// (Ahmed et al., 2.2).
    Colour,
}

/// The pose of a robot at the start.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StartConfig {
    /// x in `map`.
    pub x_m: f64,
    /// y in `map`.
    pub y_m: f64,
    /// Heading, counter-clockwise from x.
    #[serde(default)]
    pub heading_deg: f64,
}

/// A robot's range sensor, which measures a row of ranges at its own height. The `preset` gives the kind of
/// sensor and the defaults of all other keys.
#[derive(Clone, Debug, Deserialize)]
#[serde(from = "SensorKeys")]
pub struct SensorConfig {
    /// The kind of sensor.
    pub preset: SensorPreset,
    /// Position ahead of `base_link`.
    pub x_m: f64,
    /// Position to the left of `base_link`.
    pub y_m: f64,
    /// Height above the floor.
    pub height_m: f64,
    /// Direction of the centre of its view, counter-clockwise from the robot's x.
    pub heading_deg: f64,
    /// Mounting error: actual rotation from that direction, counter-clockwise, unknown to the robot.
    pub askew_deg: f64,
    /// Mounting error: how far it looks down, unknown to the robot.
    pub tilt_deg: f64,
    /// Field of view: from the first beam to the last; for a camera, from edge to edge.
    pub fov_deg: f64,
    /// Number of beams or columns.
    pub beams: usize,
    /// Minimum range; closer returns are lost.
    pub min_range_m: f64,
    /// Maximum range; farther returns are lost.
    pub max_range_m: f64,
    /// A beam without a return says that the ground is free up to here; 0 if it says nothing.
    pub clear_m: f64,
    /// Scan rate.
    pub rate_hz: f64,
    /// Standard deviation of a range: constant part.
    pub noise_m: f64,
    /// Standard deviation of a range: part proportional to the range (metres per metre).
    pub noise_ratio: f64,
}

/// Kinds of range sensors.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "snake_case")]
pub enum SensorPreset {
    /// A fan of thin beams.
    #[default]
    Beams,
    /// A row of 640 pixels of a stereo camera (D435): depths along the optical axis, with stereo noise;
    /// `noise_m` and `noise_ratio` are ignored.
    DepthRow,
    /// The level row of a time-of-flight camera with 100 x 100 pixels, a field of view of 70 degrees and a
    /// range of 2.5 m.
    Tof100,
    /// The row just above the horizon of a time-of-flight sensor with 8 x 8 zones and a field of view of 45
    /// degrees. A zone is a wide cone that reports its nearest return.
    Tof8,
    /// A grey camera that looks ahead over the floor, 320 x 240 pixels with a field of view of 90 degrees
    /// (Ahmed 2.1). It delivers pictures, and `noise_m` and `noise_ratio` are ignored.
    GreyCamera,
}

impl SensorPreset {
    /// The default sensor of this kind.
    fn sensor(self) -> SensorConfig {
        let beams = SensorConfig {
            preset: self,
            x_m: 0.1,
            y_m: 0.0,
            height_m: 0.2,
            heading_deg: 0.0,
            askew_deg: 0.0,
            tilt_deg: 0.0,
            fov_deg: 87.0,
            beams: 160,
            min_range_m: 0.1,
            max_range_m: 4.0,
            clear_m: 4.0,
            rate_hz: 10.0,
            noise_m: 0.004,
            noise_ratio: 0.002,
        };
        match self {
            Self::Beams => beams,
            Self::DepthRow => SensorConfig {
                beams: 640,
                min_range_m: 0.2,
                clear_m: 0.0,
                noise_m: 0.0,
                noise_ratio: 0.0,
                ..beams
            },
            Self::Tof100 => SensorConfig {
                fov_deg: 70.0,
                beams: 100,
                max_range_m: 2.5,
                clear_m: 0.0,
                noise_m: 0.003,
                noise_ratio: 0.01,
                ..beams
            },
            Self::GreyCamera => SensorConfig {
                fov_deg: 90.0,
                beams: GREY_COLUMNS,
                min_range_m: 0.0,
                max_range_m: 2.0,
                clear_m: 0.0,
                rate_hz: 5.0,
                noise_m: 0.0,
                noise_ratio: 0.0,
                ..beams
            },
            Self::Tof8 => SensorConfig {
                fov_deg: 45.0,
                beams: 8,
                min_range_m: 0.02,
                // A VL53L5CX can tell; its driver does not yet.
                clear_m: 0.0,
                noise_m: 0.008,
                noise_ratio: 0.02,
                ..beams
            },
        }
    }
}

/// Columns of a grey camera.
const GREY_COLUMNS: usize = 320;
/// Distance of a grey camera below the top of its robot, in metres.
const BELOW_TOP_M: f64 = 0.01;

impl SensorConfig {
    /// A grey camera in the place of this sensor, just below the top of a robot of this height.
    pub fn to_grey_camera(&self, robot_height_m: f64) -> Self {
        let &Self { x_m, y_m, heading_deg, askew_deg, .. } = self;
        let height_m = (robot_height_m - BELOW_TOP_M).max(BELOW_TOP_M);
        Self { x_m, y_m, height_m, heading_deg, askew_deg, ..SensorPreset::GreyCamera.sensor() }
    }

    /// An A010 depth camera with this number of columns, mounted as this sensor.
    fn to_a010(&self, columns: usize) -> Self {
        let &Self { x_m, y_m, height_m, heading_deg, askew_deg, tilt_deg, .. } = self;
        let camera = SensorPreset::Tof100.sensor();
        Self { x_m, y_m, height_m, heading_deg, askew_deg, tilt_deg, beams: columns, ..camera }
    }

    /// An LD06 lidar over the middle of the robot, as high as this sensor. It is asked many times per turn, as
    /// it turns; its readings are those of the moment.
    fn to_ld06(&self) -> Self {
        let &Self { height_m, heading_deg, askew_deg, tilt_deg, .. } = self;
        let lidar = SensorPreset::Beams.sensor();
        let lidar = Self { x_m: 0.0, fov_deg: 359.0, beams: 360, rate_hz: 40.0, ..lidar };
        let noise = Self { min_range_m: 0.02, max_range_m: 12.0, noise_m: 0.01, ..lidar };
        Self { height_m, heading_deg, askew_deg, tilt_deg, noise_ratio: 0.0, ..noise }
    }
}

impl Default for SensorConfig {
    fn default() -> Self {
        SensorPreset::default().sensor()
    }
}

/// The keys of a sensor in the file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SensorKeys {
    preset: Option<SensorPreset>,
    x_m: Option<f64>,
    y_m: Option<f64>,
    height_m: Option<f64>,
    heading_deg: Option<f64>,
    askew_deg: Option<f64>,
    tilt_deg: Option<f64>,
    fov_deg: Option<f64>,
    beams: Option<usize>,
    min_range_m: Option<f64>,
    max_range_m: Option<f64>,
    clear_m: Option<f64>,
    rate_hz: Option<f64>,
    noise_m: Option<f64>,
    noise_ratio: Option<f64>,
}

impl From<SensorKeys> for SensorConfig {
    fn from(keys: SensorKeys) -> Self {
        let usual = keys.preset.unwrap_or_default().sensor();
        Self {
            preset: usual.preset,
            x_m: keys.x_m.unwrap_or(usual.x_m),
            y_m: keys.y_m.unwrap_or(usual.y_m),
            height_m: keys.height_m.unwrap_or(usual.height_m),
            heading_deg: keys.heading_deg.unwrap_or(usual.heading_deg),
            askew_deg: keys.askew_deg.unwrap_or(usual.askew_deg),
            tilt_deg: keys.tilt_deg.unwrap_or(usual.tilt_deg),
            fov_deg: keys.fov_deg.unwrap_or(usual.fov_deg),
            beams: keys.beams.unwrap_or(usual.beams),
            min_range_m: keys.min_range_m.unwrap_or(usual.min_range_m),
            max_range_m: keys.max_range_m.unwrap_or(usual.max_range_m),
            // No farther than the range stated, unless that is stated, too.
            clear_m: keys.clear_m.unwrap_or_else(|| {
                usual.clear_m.min(keys.max_range_m.unwrap_or(usual.max_range_m))
            }),
            rate_hz: keys.rate_hz.unwrap_or(usual.rate_hz),
            noise_m: keys.noise_m.unwrap_or(usual.noise_m),
            noise_ratio: keys.noise_ratio.unwrap_or(usual.noise_ratio),
        }
    }
}

/// A robot's route: from its start through the waypoints and back to the start, repeatedly. The robot turns
/// in place, then drives straight.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RouteConfig {
    /// The stops after the start; without any, the robot stands still.
    pub waypoints_m: Vec<[f64; 2]>,
    /// Maximum speed.
    pub speed_m_s: f64,
    /// Acceleration, and deceleration before a stop.
    pub acceleration_m_s2: f64,
    /// Maximum turn rate in place.
    pub turn_rate_deg_s: f64,
}

impl Default for RouteConfig {
    fn default() -> Self {
        Self {
            waypoints_m: Vec::new(),
            speed_m_s: 0.4,
            acceleration_m_s2: 0.8,
            turn_rate_deg_s: 60.0,
        }
    }
}

/// The errors of the odometry. Each robot has its own systematic ones: those that are not given are drawn from normal
/// distributions by the seed and the robot's number.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OdometryConfig {
    /// Relative error of measured distances (0.01: one per cent too long). Default: drawn, standard deviation 0.01.
    pub slip: Option<f64>,
    /// Relative error of measured turns. Default: drawn, standard deviation 0.01.
    pub turn_slip: Option<f64>,
    /// Heading error gained per metre: wheels of unequal size. Default: drawn, standard
    /// deviation 0.5.
    pub drift_deg_per_m: Option<f64>,
    /// Standard deviation of the distance after one metre; grows with the square root of the distance.
    pub noise_m: f64,
    /// Standard deviation of the heading after one metre or one radian; grows with the square root.
    pub heading_noise_deg: f64,
}

impl Default for OdometryConfig {
    fn default() -> Self {
        Self {
            slip: None,
            turn_slip: None,
            drift_deg_per_m: None,
            noise_m: 0.01,
            heading_noise_deg: 0.5,
        }
    }
}

/// Defaults of a robot.
pub(super) mod defaults {
    pub(super) fn radius_m() -> f64 {
        0.15
    }
    pub(in super::super) fn height_m() -> f64 {
        0.3
    }
    pub(super) fn marker_size_m() -> f64 {
        0.1
    }
}
