//! What a simulated room is made of, as a TOML file says it.
//!
//! Lengths are in metres and angles in degrees (the unit is in the key's name), axes are those of
//! REP-103, and positions are in the frame `map`. What the numbers alone can say about a mistake
//! is said here; what needs the geometry (a robot inside a wall) is said by
//! [`World::new`](super::World::new).

mod camera;
mod checks;
mod robot;

use std::path::{Path, PathBuf};

use serde::Deserialize;

pub use camera::{CameraConfig, DepthConfig, PictureConfig};
pub use robot::{
    MarkerConfig, OdometryConfig, RobotConfig, RouteConfig, SensorConfig, SensorPreset, StartConfig,
};

/// The usual scenario: one room with blind spots, two cameras, four robots, two people.
pub const BUILT_IN: &str = include_str!("../../../scenarios/room.toml");

/// All built-in scenarios by their names; the first is the usual one.
pub const NAMED: [(&str, &str); 5] = [
    ("room", BUILT_IN),
    ("warehouse", include_str!("../../../scenarios/warehouse.toml")),
    ("changing", include_str!("../../../scenarios/changing.toml")),
    ("office", include_str!("../../../scenarios/office.toml")),
    ("ahmed-2013", include_str!("../../../scenarios/ahmed-2013.toml")),
];

/// Why a scenario can't be simulated. Each is one line that names the file and the line or key.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// The file can't be read.
    #[error("{file}: {cause}")]
    Read {
        /// The file.
        file: String,
        /// What the operating system says.
        cause: std::io::Error,
    },
    /// There is neither a built-in scenario nor a file of this name.
    #[error("no scenario \"{name}\"{} {}, or give the path of a TOML file", meant(name), names())]
    Unknown {
        /// What was asked for.
        name: String,
    },
    /// The file is not TOML, or has a key that no scenario has, or lacks one.
    #[error("{file}, line {line}: {problem}")]
    Syntax {
        /// The file.
        file: String,
        /// The line, from one.
        line: usize,
        /// What is wrong there.
        problem: String,
    },
    /// A value that no room can have.
    #[error("{file}: {key} {problem}")]
    Invalid {
        /// The file.
        file: String,
        /// The key, as `robots[2].start`.
        key: String,
        /// What is wrong with it and what would be right.
        problem: String,
    },
}

/// Asks for the built-in scenario whose name is most like this one, if any is, and begins the list of all.
fn meant(name: &str) -> String {
    /// From 0 for nothing in common to 1 for the same.
    const LIKE: f64 = 0.5;
    let likeness = |known: &str| strsim::normalized_damerau_levenshtein(name, known);
    let known = NAMED.iter().map(|&(known, _)| (likeness(known), known));
    match known.max_by(|a, b| a.0.total_cmp(&b.0)) {
        Some((likeness, known)) if likeness >= LIKE => {
            format!("; did you mean \"{known}\"? There are")
        }
        _ => "; there are".to_owned(),
    }
}

fn names() -> String {
    NAMED.map(|(name, _)| name).join(", ")
}

/// A scenario: the room and everything in it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// What error messages call this scenario: its file.
    #[serde(skip)]
    pub file: String,
    /// How long a run lasts unless the caller says otherwise.
    pub duration_s: f64,
    /// The height at which the map is scored: surfaces there are the truth.
    pub slice_height_m: f64,
    /// The walls.
    pub room: RoomConfig,
    /// What stands, lies or hangs in the room, and moves at most when somebody moves it.
    #[serde(default)]
    pub furniture: Vec<FurnitureConfig>,
    /// Doors in the walls' gaps.
    #[serde(default)]
    pub doors: Vec<DoorConfig>,
    /// What is put into a map in addition, wherever there is room.
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
    /// From the floor to the ceiling.
    pub height_m: f64,
    /// Of the drawn walls, unless a wall has its own.
    #[serde(default = "defaults::wall_thickness_m")]
    pub wall_thickness_m: f64,
    /// The centre lines of the outer walls, corner by corner; closed by itself.
    #[serde(default)]
    pub outline_m: Vec<[f64; 2]>,
    /// Walls inside the room.
    #[serde(default)]
    pub walls: Vec<WallConfig>,
    /// A ROS map (`map.yaml`, relative to the scenario) whose occupied cells are walls.
    pub map: Option<PathBuf>,
}

/// How many of each are put into a map.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GrowConfig {
    /// Cameras that look straight down.
    pub cameras: u8,
    /// Robots.
    pub robots: u8,
    /// People.
    pub people: u8,
}

/// A wall inside the room.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WallConfig {
    /// The centre line, corner by corner.
    pub points_m: Vec<[f64; 2]>,
    /// The room's unless given.
    pub thickness_m: Option<f64>,
    /// Up to the ceiling unless given.
    pub height_m: Option<f64>,
}

/// A piece of furniture: an upright prism, from `bottom_m` to `top_m`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FurnitureConfig {
    /// What it is, for people who read the file.
    #[serde(default)]
    pub name: String,
    /// Its shape from above.
    pub footprint: FootprintConfig,
    /// Its lower side; above zero it overhangs the floor.
    #[serde(default)]
    pub bottom_m: f64,
    /// Its upper side.
    pub top_m: f64,
    /// Square legs of this side, from the floor to `bottom_m`, at the corners of a box.
    pub legs_m: Option<f64>,
    /// When and where it is moved, in the order of time; not for a polygon.
    #[serde(default)]
    pub moved: Vec<MoveConfig>,
}

/// A piece of furniture is moved: at once, or as soon as nobody stands there.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MoveConfig {
    /// When.
    pub at_s: f64,
    /// Where its centre is from then on.
    pub centre_m: [f64; 2],
    /// How it is turned from then on.
    #[serde(default)]
    pub heading_deg: f64,
}

/// A door: a leaf that hangs on a hinge. It opens and shuts at once, or as soon as nobody is in
/// its way; robots and people wait before a shut one.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DoorConfig {
    /// Where it hangs.
    pub hinge_m: [f64; 2],
    /// From the hinge along the shut leaf, counter-clockwise from x.
    #[serde(default)]
    pub heading_deg: f64,
    /// How far it turns to be open, counter-clockwise.
    #[serde(default = "defaults::door_swing_deg")]
    pub swing_deg: f64,
    /// From the hinge to the handle's edge.
    #[serde(default = "defaults::door_width_m")]
    pub width_m: f64,
    /// From the floor to its upper edge.
    #[serde(default = "defaults::door_height_m")]
    pub height_m: f64,
    /// Of the leaf.
    #[serde(default = "defaults::door_thickness_m")]
    pub thickness_m: f64,
    /// From when to when it is open, in the order of time; shut otherwise.
    #[serde(default)]
    pub open_s: Vec<[f64; 2]>,
}

/// A shape from above.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "lowercase")]
pub enum FootprintConfig {
    /// A rectangle.
    Box {
        /// Its centre.
        centre_m: [f64; 2],
        /// Its sides along x and y before it is turned.
        size_m: [f64; 2],
        /// Turned about its centre, counter-clockwise.
        #[serde(default)]
        heading_deg: f64,
    },
    /// A disc.
    Disc {
        /// Its centre.
        centre_m: [f64; 2],
        /// Its radius.
        radius_m: f64,
    },
    /// A convex polygon.
    Polygon {
        /// Its corners, in either sense.
        points_m: Vec<[f64; 2]>,
    },
}

/// A person, who walks from waypoint to waypoint.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PersonConfig {
    /// The stops; the person starts at the first and comes back to it after the last.
    pub waypoints_m: Vec<[f64; 2]>,
    /// The speed between stops.
    #[serde(default = "defaults::person_speed_m_s")]
    pub speed_m_s: f64,
    /// The mean pause at a stop; each lasts half to one and a half of it, by the seed.
    #[serde(default)]
    pub pause_s: f64,
    /// Of the body.
    #[serde(default = "defaults::person_radius_m")]
    pub radius_m: f64,
    /// Upright, from the sole to the crown.
    #[serde(default = "defaults::person_height_m")]
    pub height_m: f64,
    /// Standing, sitting or lying; who sits or lies stays at the first waypoint.
    #[serde(default)]
    pub posture: PostureConfig,
    /// Where who sits or lies faces: the head of who lies is there.
    #[serde(default)]
    pub heading_deg: f64,
}

/// How a person is.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "lowercase")]
pub enum PostureConfig {
    /// Upright.
    #[default]
    Standing,
    /// On something 0.45 m high.
    Sitting,
    /// On the floor.
    Lying,
}
/// What a scenario need not say.
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
    /// The usual person, who walks along these points.
    pub(super) fn along(waypoints_m: Vec<[f64; 2]>) -> Self {
        Self {
            waypoints_m,
            speed_m_s: defaults::person_speed_m_s(),
            pause_s: 2.0,
            radius_m: defaults::person_radius_m(),
            height_m: defaults::person_height_m(),
            posture: PostureConfig::default(),
            heading_deg: 0.0,
        }
    }
}

impl Scenario {
    /// The built-in scenario.
    pub fn built_in() -> Result<Self, ScenarioError> {
        Self::from_toml(BUILT_IN, "built-in scenario")
    }

    /// Reads a scenario: one of [`NAMED`] by its name, or a file; a map that a file names is
    /// looked for beside it.
    pub fn read(path: &Path) -> Result<Self, ScenarioError> {
        Self::read_with(path, None)
    }

    /// The same; `map`, if given, is the room's in place of any that it has.
    pub fn read_with(path: &Path, map: Option<&Path>) -> Result<Self, ScenarioError> {
        let mut scenario = match NAMED.iter().find(|(name, _)| path == Path::new(name)) {
            Some((name, text)) => Self::parse(text, &format!("built-in scenario {name}"))?,
            None => {
                let file = path.display().to_string();
                let text = std::fs::read_to_string(path).map_err(|cause| {
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
        scenario.room.map = map.map(Path::to_owned).or(scenario.room.map);
        scenario.check()?;
        Ok(scenario)
    }

    /// A scenario from text; `file` is what error messages call it.
    pub fn from_toml(text: &str, file: &str) -> Result<Self, ScenarioError> {
        let scenario = Self::parse(text, file)?;
        scenario.check()?;
        Ok(scenario)
    }

    /// A scenario from text, whose numbers may still be wrong.
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

    /// The height of the tallest robot: what stands above it is in no robot's way.
    pub fn robot_height_m(&self) -> f64 {
        self.robots
            .iter()
            .map(|robot| robot.height_m)
            .reduce(f64::max)
            .unwrap_or_else(robot::defaults::height_m)
    }

    /// What is wrong with a key of this scenario.
    pub(super) fn invalid(
        &self,
        key: impl Into<String>,
        problem: impl Into<String>,
    ) -> ScenarioError {
        ScenarioError::Invalid { file: self.file.clone(), key: key.into(), problem: problem.into() }
    }
}
