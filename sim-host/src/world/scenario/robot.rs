//! A robot, as a scenario says it.

use serde::Deserialize;

/// A robot: an upright cylinder on two wheels, with one range sensor and a scripted route.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotConfig {
    /// Its number, unique in the scenario.
    pub id: u16,
    /// Where it stands in the beginning; also the last stop of its route.
    pub start: StartConfig,
    /// Of its footprint.
    #[serde(default = "defaults::radius_m")]
    pub radius_m: f64,
    /// From the floor to its top.
    #[serde(default = "defaults::height_m")]
    pub height_m: f64,
    /// Its length and width where it is a box; a cylinder without.
    pub box_m: Option<[f64; 2]>,
    /// What the cameras know it by.
    #[serde(default)]
    pub marker: MarkerConfig,
    /// The side of the black square of a tag, or of a colour marker.
    #[serde(default = "defaults::marker_size_m")]
    pub marker_size_m: f64,
    /// The number that its tag says; the robot's own unless given. Only the first
    /// [`TAGS`](crate::world::TAGS) of the family are known: a robot of a higher number wears a
    /// blank plate.
    pub tag_id: Option<u16>,
    /// How far its identifier is turned against the robot, counter-clockwise: glued on askew.
    #[serde(default)]
    pub identifier_askew_deg: f64,
    /// Its range sensor.
    #[serde(default)]
    pub sensor: SensorConfig,
    /// Where it drives.
    #[serde(default)]
    pub route: RouteConfig,
    /// How wrong its wheel encoders are.
    #[serde(default)]
    pub odometry: OdometryConfig,
}

impl RobotConfig {
    /// The colours of the head and the tail of its colour marker, of red, yellow, green, cyan, blue,
    /// magenta: fifteen robots can be told apart, for nobody knows the head of a pair by its colour.
    pub fn colours(&self) -> [usize; 2] {
        let pairs = (0..6).flat_map(|head| (head + 1..6).map(move |tail| [head, tail]));
        pairs.cycle().nth(usize::from(self.id) % 15).unwrap_or([0, 1])
    }

    /// The usual robot, with a route through these points.
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

/// What a robot wears on its top, over `base_link`.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub enum MarkerConfig {
    /// A tag of the AprilTag family 36h11 with a white margin; its upper edge is ahead.
    #[default]
    Tag,
    /// A light cover with a head ahead and a tail behind, in two colours that say which robot
    /// (Ahmed et al., 2.2).
    Colour,
}

/// A pose in the beginning.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StartConfig {
    /// In `map`.
    pub x_m: f64,
    /// In `map`.
    pub y_m: f64,
    /// Counter-clockwise from x.
    #[serde(default)]
    pub heading_deg: f64,
}

/// A robot's range sensor, which gives one row of ranges at its own height. `preset` says which
/// kind of sensor it is and what it need not say.
#[derive(Clone, Debug, Deserialize)]
#[serde(from = "SensorKeys")]
pub struct SensorConfig {
    /// Which kind it is.
    pub preset: SensorPreset,
    /// Ahead of `base_link`.
    pub x_m: f64,
    /// To the left of `base_link`.
    pub y_m: f64,
    /// Above the floor.
    pub height_m: f64,
    /// The middle of the view, counter-clockwise from the robot's x.
    pub heading_deg: f64,
    /// How far it is really turned from there, counter-clockwise: mounted askew, and the robot
    /// does not know.
    pub askew_deg: f64,
    /// From the first beam to the last; of a camera, from edge to edge.
    pub fov_deg: f64,
    /// How many beams, or columns.
    pub beams: usize,
    /// Nearer returns are lost.
    pub min_range_m: f64,
    /// Farther returns are lost.
    pub max_range_m: f64,
    /// Scans each second.
    pub rate_hz: f64,
    /// Standard deviation of a range, whatever the range.
    pub noise_m: f64,
    /// Standard deviation that grows with the range: metres for each metre.
    pub noise_ratio: f64,
}

/// Kinds of range sensors.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "snake_case")]
pub enum SensorPreset {
    /// A fan of thin beams, each with its range.
    #[default]
    Beams,
    /// A row of 640 pixels of a stereo camera, a D435: depths along the optical axis. Its noise is
    /// that of a stereo camera, whatever `noise_m` and `noise_ratio` say.
    DepthRow,
    /// The row that looks level of a time-of-flight camera of 100 x 100 pixels and 70 degrees,
    /// which sees 2.5 m far.
    Tof100,
    /// The row above the horizon of a time-of-flight sensor of 8 x 8 zones and 45 degrees. A zone
    /// is a wide cone: it gives the nearest that stands in it.
    Tof8,
}

impl SensorPreset {
    /// The sensor that says nothing more.
    fn sensor(self) -> SensorConfig {
        let beams = SensorConfig {
            preset: self,
            x_m: 0.1,
            y_m: 0.0,
            height_m: 0.2,
            heading_deg: 0.0,
            askew_deg: 0.0,
            fov_deg: 87.0,
            beams: 160,
            min_range_m: 0.1,
            max_range_m: 4.0,
            rate_hz: 10.0,
            noise_m: 0.004,
            noise_ratio: 0.002,
        };
        match self {
            Self::Beams => beams,
            Self::DepthRow => SensorConfig {
                beams: 640,
                min_range_m: 0.2,
                noise_m: 0.0,
                noise_ratio: 0.0,
                ..beams
            },
            Self::Tof100 => SensorConfig {
                fov_deg: 70.0,
                beams: 100,
                max_range_m: 2.5,
                noise_m: 0.003,
                noise_ratio: 0.01,
                ..beams
            },
            Self::Tof8 => SensorConfig {
                fov_deg: 45.0,
                beams: 8,
                min_range_m: 0.02,
                noise_m: 0.008,
                noise_ratio: 0.02,
                ..beams
            },
        }
    }
}

impl Default for SensorConfig {
    fn default() -> Self {
        SensorPreset::default().sensor()
    }
}

/// The keys of a sensor as they are written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SensorKeys {
    preset: Option<SensorPreset>,
    x_m: Option<f64>,
    y_m: Option<f64>,
    height_m: Option<f64>,
    heading_deg: Option<f64>,
    askew_deg: Option<f64>,
    fov_deg: Option<f64>,
    beams: Option<usize>,
    min_range_m: Option<f64>,
    max_range_m: Option<f64>,
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
            fov_deg: keys.fov_deg.unwrap_or(usual.fov_deg),
            beams: keys.beams.unwrap_or(usual.beams),
            min_range_m: keys.min_range_m.unwrap_or(usual.min_range_m),
            max_range_m: keys.max_range_m.unwrap_or(usual.max_range_m),
            rate_hz: keys.rate_hz.unwrap_or(usual.rate_hz),
            noise_m: keys.noise_m.unwrap_or(usual.noise_m),
            noise_ratio: keys.noise_ratio.unwrap_or(usual.noise_ratio),
        }
    }
}

/// A robot's route: from its start through the waypoints, back to the start, and again. It turns
/// in place, then drives straight.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RouteConfig {
    /// The stops after the start; none, and the robot stands.
    pub waypoints_m: Vec<[f64; 2]>,
    /// The speed between stops.
    pub speed_m_s: f64,
    /// Gained and lost each second.
    pub acceleration_m_s2: f64,
    /// How fast it turns in place.
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

/// How odometry departs from the truth.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OdometryConfig {
    /// The share by which the wheels measure too long a way (0.01 is one per cent).
    pub slip: f64,
    /// The share by which the wheels measure too wide a turn.
    pub turn_slip: f64,
    /// The heading that it wrongly gains on each metre.
    pub drift_deg_per_m: f64,
    /// Standard deviation of the way after one metre; grows with the root of the way.
    pub noise_m: f64,
    /// Standard deviation of the heading after one metre or one radian; grows with the root.
    pub heading_noise_deg: f64,
}

impl Default for OdometryConfig {
    fn default() -> Self {
        Self {
            slip: 0.01,
            turn_slip: 0.01,
            drift_deg_per_m: 0.0,
            noise_m: 0.01,
            heading_noise_deg: 0.5,
        }
    }
}

/// What a scenario need not say of a robot.
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
