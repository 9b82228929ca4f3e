//! The scenario file (TOML): what a simulated room contains.
//!
//! Lengths are in metres and angles in degrees (each key names its unit); axes follow REP-103, and
//! positions are in the frame `map`. Mistakes in the numbers are reported here; mistakes that depend on
//! the geometry (a robot inside a wall) are reported by [`World::new`](super::World::new).

mod camera;
mod checks;
mod labelled;
mod robot;

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::{
    files,
    grid::{Class, LabelConfig},
};

pub use camera::{CameraConfig, DepthConfig, KnockConfig, PictureConfig};
pub use robot::{
    MarkerConfig, OdometryConfig, RobotConfig, RouteConfig, SensorConfig, SensorPreset, StartConfig,
};

/// The default scenario: one room with blind spots, two cameras, four robots, two people.
pub const BUILT_IN: &str = include_str!("../../../scenarios/room.toml");

/// All built-in scenarios by name; the first is the default.
pub const NAMED: [(&str, &str); 9] = [
    ("room", BUILT_IN),
    ("warehouse", include_str!("../../../scenarios/warehouse.toml")),
    ("changing", include_str!("../../../scenarios/changing.toml")),
    ("office", include_str!("../../../scenarios/office.toml")),
    ("ahmed-2013", include_str!("../../../scenarios/ahmed-2013.toml")),
    ("ahmed-2013-b", include_str!("../../../scenarios/ahmed-2013-b.toml")),
    ("aluckal-room", include_str!("../../../scenarios/aluckal-room.toml")),
    ("awareness", include_str!("../../../scenarios/awareness.toml")),
    ("ubislam-figure-1", include_str!("../../../scenarios/ubislam-figure-1.toml")),
];

/// Why a scenario can't be simulated. Each error is one line that names the file, and the line or
/// key.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The file cannot be read.
    #[error("{file}: {cause}")]
    Read {
        /// The file.
        file: String,
        /// The error of the operating system.
        cause: std::io::Error,
    },
    /// There is neither a built-in scenario nor a file of this name.
    #[error("no scenario \"{name}\"{} {}, or give the path of a TOML file", meant(name), names())]
    Unknown {
        /// The requested name.
        name: String,
    },
    /// The file is not TOML, has an unknown key, or lacks a key.
    #[error("{file}, line {line}: {problem}")]
    Syntax {
        /// The file.
        file: String,
        /// The line, from one.
        line: usize,
        /// The problem.
        problem: String,
    },
    /// A value is impossible.
    #[error("{file}: {key} {problem}")]
    Invalid {
        /// The file.
        file: String,
        /// The key, such as `robots[2].start`.
        key: String,
        /// The problem, and what would be right.
        problem: String,
    },
}

/// The text that suggests the built-in scenario with the most similar name, if there is a similar
/// one, and introduces the list of all.
fn meant(name: &str) -> String {
    /// Minimum similarity for a suggestion, from 0 (nothing in common) to 1 (equal).
    const LIKE: f64 = 0.5;
    let likeness = |known: &str| strsim::normalized_damerau_levenshtein(name, known);
    let known = NAMED.iter().map(|&(known, _)| (likeness(known), known));
    match known.max_by(|a, b| a.0.total_cmp(&b.0)) {
        Some((likeness, known)) if likeness >= LIKE => {
            format!("; did you mean \"{known}\"? The built-in ones are")
        }
        _ => "; the built-in ones are".to_owned(),
    }
}

fn names() -> String {
    NAMED.map(|(name, _)| name).join(", ")
}

/// A scenario: the room and everything in it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// The name used in error messages: the file.
    #[serde(skip)]
    pub file: String,
    /// Default duration of a run.
    pub duration_s: f64,
    /// The height at which the map is scored: the truth consists of the surfaces there.
    pub slice_height_m: f64,
    /// The walls.
    pub room: RoomConfig,
    /// Furniture: everything that stands, lies or hangs in the room and moves only when it is moved.
    #[serde(default)]
    pub furniture: Vec<FurnitureConfig>,
    /// Doors in gaps of the walls.
    #[serde(default)]
    pub doors: Vec<DoorConfig>,
    /// Where things of a class stand, for the server: how soon it forgets what it knows of these places.
    #[serde(default)]
    pub labels: Vec<LabelConfig>,
    /// Where the light is too bright or too dark for the depth cameras of robots.
    #[serde(default)]
    pub glare: Vec<GlareConfig>,
    /// Cameras, robots and people to be placed automatically in a map.
    pub grow: Option<GrowConfig>,
    /// The fixed cameras.
    #[serde(default)]
    pub cameras: Vec<CameraConfig>,
    /// The robots.
    #[serde(default)]
    pub robots: Vec<RobotConfig>,
    /// The people.
    #[serde(default)]
    pub people: Vec<PersonConfig>,
}

/// The walls: either drawn (`outline_m` and `walls`) or taken from a ROS map.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoomConfig {
    /// Height of the ceiling.
    pub height_m: f64,
    /// Default thickness of drawn walls.
    #[serde(default = "defaults::wall_thickness_m")]
    pub wall_thickness_m: f64,
    /// Centre lines of the outer walls as a polygon, which is closed automatically.
    #[serde(default)]
    pub outline_m: Vec<[f64; 2]>,
    /// Walls inside the room.
    #[serde(default)]
    pub walls: Vec<WallConfig>,
    /// Reflectance of everything that stands in the room, from 0 to 1; by default walls are of plaster and
    /// furniture is of woods of many shades, some of which look like the floor to a grey camera.
    pub shade: Option<f64>,
    /// Whether the floor has no joints between tiles: to a grey camera they look like boundaries.
    #[serde(default)]
    pub seamless: bool,
    /// A ROS map (`map.yaml`, relative to the scenario) whose occupied cells are walls.
    pub map: Option<PathBuf>,
}

/// Surfaces with unusual light. Where they, or others beside them, are over- or underexposed in the
/// pictures of robots' stereo cameras, depths are arbitrary or missing.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GlareConfig {
    /// The ground under the surfaces.
    pub footprint: FootprintConfig,
    /// Light of the surfaces as a multiple of the room's.
    pub light: f64,
}

/// Cameras, robots and people to be placed in a map.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GrowConfig {
    /// Number of cameras; they look straight down.
    pub cameras: u8,
    /// Number of robots.
    pub robots: u8,
    /// Number of people.
    pub people: u8,
    /// The robots' sensor.
    #[serde(default)]
    pub sensor: SensorConfig,
}

/// A wall inside the room.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WallConfig {
    /// The corners of the centre line.
    pub points_m: Vec<[f64; 2]>,
    /// Thickness (default: the room's).
    pub thickness_m: Option<f64>,
    /// Height (default: the ceiling's).
    pub height_m: Option<f64>,
}

/// A piece of furniture: an upright prism, from `bottom_m` to `top_m`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FurnitureConfig {
    /// A description for readers of the file.
    #[serde(default)]
    pub name: String,
    /// The footprint of the piece.
    pub footprint: FootprintConfig,
    /// Height of its underside; above zero it overhangs the floor.
    #[serde(default)]
    pub bottom_m: f64,
    /// Height of its upper side.
    pub top_m: f64,
    /// Its class, which labels the place where it stands first.
    pub class: Option<Class>,
    /// Side of square legs from the floor to `bottom_m`, at the corners of a box.
    pub legs_m: Option<f64>,
    /// The times and places to which it is moved, in order of time; not for a polygon.
    #[serde(default)]
    pub moved: Vec<MoveConfig>,
}

/// A move of a piece of furniture, made at its time or as soon as the new place is free.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MoveConfig {
    /// The time of the move.
    pub at_s: f64,
    /// The new centre.
    pub centre_m: [f64; 2],
    /// The new heading.
    #[serde(default)]
    pub heading_deg: f64,
}

/// A door: a leaf on a hinge. It opens and closes as soon as nobody is in its way; robots and people wait
/// before a closed door.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DoorConfig {
    /// Position of the hinge.
    pub hinge_m: [f64; 2],
    /// Direction from the hinge along the closed leaf, counter-clockwise from x.
    #[serde(default)]
    pub heading_deg: f64,
    /// Opening angle, counter-clockwise.
    #[serde(default = "defaults::door_swing_deg")]
    pub swing_deg: f64,
    /// Width of the leaf.
    #[serde(default = "defaults::door_width_m")]
    pub width_m: f64,
    /// Height of the leaf.
    #[serde(default = "defaults::door_height_m")]
    pub height_m: f64,
    /// Thickness of the leaf.
    #[serde(default = "defaults::door_thickness_m")]
    pub thickness_m: f64,
    /// Its class, which labels the places of the leaf and the ground between.
    pub class: Option<Class>,
    /// Intervals (from, to) during which it is open, in order of time; otherwise it is closed.
    #[serde(default)]
    pub open_s: Vec<[f64; 2]>,
}

/// The footprint of a piece of furniture.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "lowercase")]
pub enum FootprintConfig {
    /// A rectangle.
    Box {
        /// The centre of the rectangle.
        centre_m: [f64; 2],
        /// The sides along x and y before rotation.
        size_m: [f64; 2],
        /// Rotation about its centre, counter-clockwise.
        #[serde(default)]
        heading_deg: f64,
    },
    /// A disc.
    Disc {
        /// The centre of the disc.
        centre_m: [f64; 2],
        /// The radius of the disc.
        radius_m: f64,
    },
    /// A convex polygon.
    Polygon {
        /// The corners, clockwise or counter-clockwise.
        points_m: Vec<[f64; 2]>,
    },
}

/// A person, who walks from waypoint to waypoint.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PersonConfig {
    /// The stops; the person starts at the first and returns to it after the last.
    pub waypoints_m: Vec<[f64; 2]>,
    /// Walking speed.
    #[serde(default = "defaults::person_speed_m_s")]
    pub speed_m_s: f64,
    /// Mean pause at a stop; each pause is random, from half to one and a half times the mean.
    #[serde(default)]
    pub pause_s: f64,
    /// Radius of the body.
    #[serde(default = "defaults::person_radius_m")]
    pub radius_m: f64,
    /// Standing height.
    #[serde(default = "defaults::person_height_m")]
    pub height_m: f64,
    /// Posture at the beginning; a person who sits or lies stays at the first waypoint.
    #[serde(default)]
    pub posture: PostureConfig,
    /// When a person who sits or lies gets up, in seconds from the start, to walk along the waypoints; never
    /// without it.
    #[serde(default)]
    pub rises_s: Option<f64>,
    /// Heading of a person who sits, and direction of the head of one who lies.
    #[serde(default)]
    pub heading_deg: f64,
}

/// The posture of a person.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub enum PostureConfig {
    /// Upright.
    #[default]
    Standing,
    /// On a seat 0.45 m high.
    Sitting,
    /// On the floor.
    Lying,
}
/// Defaults of a scenario.
mod defaults {
    pub(super) fn door_width_m() -> f64 {
        0.9
    }
    pub(super) fn door_height_m() -> f64 {
        2.0
    }
    pub(super) fn door_thickness_m() -> f64 {
        0.04
    }
    pub(super) fn door_swing_deg() -> f64 {
        90.0
    }
    pub(super) fn wall_thickness_m() -> f64 {
        0.12
    }
    pub(super) fn person_speed_m_s() -> f64 {
        1.2
    }
    pub(super) fn person_radius_m() -> f64 {
        0.2
    }
    pub(super) fn person_height_m() -> f64 {
        1.75
    }
}

impl PersonConfig {
    /// The default person, walking along these points.
    pub(super) fn along(waypoints_m: Vec<[f64; 2]>) -> Self {
        Self {
            waypoints_m,
            speed_m_s: defaults::person_speed_m_s(),
            pause_s: 2.0,
            radius_m: defaults::person_radius_m(),
            height_m: defaults::person_height_m(),
            posture: PostureConfig::default(),
            rises_s: None,
            heading_deg: 0.0,
        }
    }
}

impl Scenario {
    /// The built-in scenario.
    pub fn built_in() -> Result<Self, ScenarioError> {
        Self::from_toml(BUILT_IN, "built-in scenario")
    }

    /// Reads a scenario: one of [`NAMED`] by its name, or a file. The path of a map in a file is relative
    /// to that file.
    pub fn read(path: &Path) -> Result<Self, ScenarioError> {
        Self::read_with(path, None)
    }

    /// Reads a scenario like [`Scenario::read`]; `map`, if given, replaces the room's map.
    pub fn read_with(path: &Path, map: Option<&Path>) -> Result<Self, ScenarioError> {
        let mut scenario = match NAMED.iter().find(|(name, _)| path == Path::new(name)) {
            Some((name, text)) => Self::parse(text, &format!("built-in scenario {name}"))?,
            None => {
                let file = path.display().to_string();
                let text = files::read_settings(path).map_err(|cause| {
                    let is_name = path.components().count() == 1 && path.extension().is_none();
                    if is_name && cause.kind() == std::io::ErrorKind::NotFound {
                        ScenarioError::Unknown { name: file.clone() }
                    } else {
                        ScenarioError::Read { file: file.clone(), cause }
                    }
                })?;
                Self::parse(&text, &file)?
            }
        };
        if let (Some(map), Some(folder)) = (&mut scenario.room.map, path.parent()) {
            *map = folder.join(&map);
        }
        if let Some(map) = map {
            // A problem that concerns the map is not the fault of the scenario's file alone, so the
            // message names both.
            scenario.file = format!("{} with --map {}", scenario.file, map.display());
            scenario.room.map = Some(map.to_owned());
        }
        scenario.check()?;
        Ok(scenario)
    }

    /// Parses and checks a scenario; `file` is its name in error messages.
    pub fn from_toml(text: &str, file: &str) -> Result<Self, ScenarioError> {
        let scenario = Self::parse(text, file)?;
        scenario.check()?;
        Ok(scenario)
    }

    /// Parses a scenario without checking its numbers.
    fn parse(text: &str, file: &str) -> Result<Self, ScenarioError> {
        let mut scenario: Self = toml::from_str(text).map_err(|error| {
            let start = error.span().map_or(0, |span| span.start);
            let before = text.as_bytes().get(..start).unwrap_or(text.as_bytes());
            ScenarioError::Syntax {
                file: file.to_owned(),
                line: 1 + before.iter().filter(|&&byte| byte == b'\n').count(),
                problem: error.message().replace('\n', ", "),
            }
        })?;
        scenario.file = file.to_owned();
        Ok(scenario)
    }

    /// The height of the tallest robot: obstacles above it block no robot.
    pub fn robot_height_m(&self) -> f64 {
        self.robots
            .iter()
            .map(|robot| robot.height_m)
            .reduce(f64::max)
            .unwrap_or_else(robot::defaults::height_m)
    }

    /// The error for a key of this scenario.
    pub(super) fn invalid(
        &self,
        key: impl Into<String>,
        problem: impl Into<String>,
    ) -> ScenarioError {
        ScenarioError::Invalid { file: self.file.clone(), key: key.into(), problem: problem.into() }
    }
}
