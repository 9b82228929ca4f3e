//! What a simulated room is made of, as a TOML file says it.
//!
//! Lengths are in metres and angles in degrees (the unit is in the key's name), axes are those of
//! REP-103, and positions are in the frame `map`. What the numbers alone can say about a mistake
//! is said here; what needs the geometry (a robot inside a wall) is said by
//! [`World::new`](super::World::new).

use std::{
    ops::RangeInclusive,
    path::{Path, PathBuf},
};

use serde::Deserialize;

/// The built-in scenario: one room with blind spots, two cameras, four robots, two people.
pub const BUILT_IN: &str = include_str!("../../scenarios/room.toml");

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
    /// What stands, lies or hangs in the room and never moves.
    #[serde(default)]
    pub furniture: Vec<FurnitureConfig>,
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

/// A fixed camera. It looks at a point, or along a heading and a tilt.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Where its optical centre is.
    pub position_m: [f64; 3],
    /// The point in the middle of its picture.
    pub look_at_m: Option<[f64; 3]>,
    /// Where it faces, counter-clockwise from x; with `tilt_deg` instead of `look_at_m`.
    pub heading_deg: Option<f64>,
    /// How far it looks down: 0 level, 90 straight down.
    pub tilt_deg: Option<f64>,
    /// From the left to the right edge of the picture.
    #[serde(default = "defaults::camera_horizontal_fov_deg")]
    pub horizontal_fov_deg: f64,
    /// From the upper to the lower edge of the picture.
    #[serde(default = "defaults::camera_vertical_fov_deg")]
    pub vertical_fov_deg: f64,
    /// How far it sees.
    #[serde(default = "defaults::camera_range_m")]
    pub range_m: f64,
    /// Frames each second; each localises the robots in view.
    #[serde(default = "defaults::camera_rate_hz")]
    pub rate_hz: f64,
    /// How often, at most, a frame also says which cells are free or occupied.
    #[serde(default = "defaults::camera_cells_rate_hz")]
    pub cells_rate_hz: f64,
    /// From capture to arrival.
    #[serde(default = "defaults::camera_latency_ms")]
    pub latency_ms: f64,
    /// Standard deviation of a robot's position, in x and in y.
    #[serde(default)]
    pub position_noise_m: f64,
    /// Standard deviation of a robot's heading.
    #[serde(default)]
    pub heading_noise_deg: f64,
}

/// A robot: an upright cylinder on two wheels, with one range sensor and a scripted route.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotConfig {
    /// Its number, unique in the scenario.
    pub id: u16,
    /// Where it stands in the beginning; also the last stop of its route.
    pub start: StartConfig,
    /// Of its footprint.
    #[serde(default = "defaults::robot_radius_m")]
    pub radius_m: f64,
    /// From the floor to its top.
    #[serde(default = "defaults::robot_height_m")]
    pub height_m: f64,
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

/// A robot's range sensor: a fan of beams at one height.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorConfig {
    /// Ahead of `base_link`.
    pub x_m: f64,
    /// To the left of `base_link`.
    pub y_m: f64,
    /// Above the floor.
    pub height_m: f64,
    /// The middle of the fan, counter-clockwise from the robot's x.
    pub heading_deg: f64,
    /// From the first beam to the last.
    pub fov_deg: f64,
    /// How many beams.
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

impl Default for SensorConfig {
    fn default() -> Self {
        Self {
            x_m: 0.1,
            y_m: 0.0,
            height_m: 0.2,
            heading_deg: 0.0,
            fov_deg: 87.0,
            beams: 160,
            min_range_m: 0.1,
            max_range_m: 4.0,
            rate_hz: 10.0,
            noise_m: 0.004,
            noise_ratio: 0.002,
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

/// A person: an upright cylinder that walks from waypoint to waypoint.
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
    /// Of the cylinder.
    #[serde(default = "defaults::person_radius_m")]
    pub radius_m: f64,
    /// Of the cylinder.
    #[serde(default = "defaults::person_height_m")]
    pub height_m: f64,
}

/// What a scenario need not say.
mod defaults {
    pub(super) fn wall_thickness_m() -> f64 {
        0.12
    }
    /// The depth camera of an Intel RealSense D435.
    pub(super) fn camera_horizontal_fov_deg() -> f64 {
        87.0
    }
    pub(super) fn camera_vertical_fov_deg() -> f64 {
        58.0
    }
    pub(super) fn camera_range_m() -> f64 {
        8.0
    }
    pub(super) fn camera_rate_hz() -> f64 {
        15.0
    }
    pub(super) fn camera_cells_rate_hz() -> f64 {
        2.0
    }
    pub(super) fn camera_latency_ms() -> f64 {
        60.0
    }
    pub(super) fn robot_radius_m() -> f64 {
        0.15
    }
    pub(super) fn robot_height_m() -> f64 {
        0.3
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

impl Scenario {
    /// The built-in scenario.
    pub fn built_in() -> Result<Self, ScenarioError> {
        Self::from_toml(BUILT_IN, "built-in scenario")
    }

    /// Reads a scenario from a file; a map that it names is looked for beside it.
    pub fn read(path: &Path) -> Result<Self, ScenarioError> {
        let file = path.display().to_string();
        let text = std::fs::read_to_string(path)
            .map_err(|cause| ScenarioError::Read { file: file.clone(), cause })?;
        let mut scenario = Self::from_toml(&text, &file)?;
        if let (Some(map), Some(folder)) = (&mut scenario.room.map, path.parent()) {
            *map = folder.join(&map);
        }
        Ok(scenario)
    }

    /// A scenario from text; `file` is what error messages call it.
    pub fn from_toml(text: &str, file: &str) -> Result<Self, ScenarioError> {
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
        scenario.check()?;
        Ok(scenario)
    }

    /// The height of the tallest robot: what stands above it is in no robot's way.
    pub fn robot_height_m(&self) -> f64 {
        self.robots
            .iter()
            .map(|robot| robot.height_m)
            .reduce(f64::max)
            .unwrap_or_else(defaults::robot_height_m)
    }

    /// What is wrong with a key of this scenario.
    pub(super) fn invalid(
        &self,
        key: impl Into<String>,
        problem: impl Into<String>,
    ) -> ScenarioError {
        ScenarioError::Invalid { file: self.file.clone(), key: key.into(), problem: problem.into() }
    }

    /// Refuses numbers that no room can have.
    pub(super) fn check(&self) -> Result<(), ScenarioError> {
        self.number("duration_s", self.duration_s, 0.1..=86_400.0)?;
        self.number("slice_height_m", self.slice_height_m, 0.0..=10.0)?;
        self.check_room()?;
        for (index, furniture) in self.furniture.iter().enumerate() {
            self.check_furniture(&format!("furniture[{index}]"), furniture)?;
        }
        for (index, camera) in self.cameras.iter().enumerate() {
            self.check_camera(&format!("cameras[{index}]"), camera)?;
        }
        for (index, robot) in self.robots.iter().enumerate() {
            let key = format!("robots[{index}]");
            self.check_robot(&key, robot)?;
            if let Some(first) = self.robots[..index].iter().position(|r| r.id == robot.id) {
                let problem =
                    format!("is {}, which robots[{first}] has already; give another", robot.id);
                return Err(self.invalid(format!("{key}.id"), problem));
            }
        }
        for (index, person) in self.people.iter().enumerate() {
            self.check_person(&format!("people[{index}]"), person)?;
        }
        Ok(())
    }

    fn check_room(&self) -> Result<(), ScenarioError> {
        let room = &self.room;
        self.number("room.height_m", room.height_m, 0.1..=100.0)?;
        self.number("room.wall_thickness_m", room.wall_thickness_m, 0.001..=10.0)?;
        match (&room.map, room.outline_m.len()) {
            (None, 0..=2) => {
                let problem = "needs at least three corners (or give room.map)";
                return Err(self.invalid("room.outline_m", problem));
            }
            (Some(_), 1..) => {
                let problem = "and room.map are both given; leave one out";
                return Err(self.invalid("room.outline_m", problem));
            }
            _ => {}
        }
        self.points("room.outline_m", &room.outline_m)?;
        for (index, wall) in room.walls.iter().enumerate() {
            let key = format!("room.walls[{index}]");
            if wall.points_m.len() < 2 {
                return Err(self.invalid(format!("{key}.points_m"), "needs at least two points"));
            }
            self.points(&format!("{key}.points_m"), &wall.points_m)?;
            if let Some(thickness) = wall.thickness_m {
                self.number(&format!("{key}.thickness_m"), thickness, 0.001..=10.0)?;
            }
            if let Some(height) = wall.height_m {
                self.number(&format!("{key}.height_m"), height, 0.001..=room.height_m)?;
            }
        }
        Ok(())
    }

    fn check_furniture(&self, key: &str, furniture: &FurnitureConfig) -> Result<(), ScenarioError> {
        match &furniture.footprint {
            FootprintConfig::Box { centre_m, size_m, heading_deg } => {
                self.point(&format!("{key}.footprint.box.centre_m"), centre_m)?;
                for size in size_m {
                    self.number(&format!("{key}.footprint.box.size_m"), *size, 0.001..=1000.0)?;
                }
                self.angle(&format!("{key}.footprint.box.heading_deg"), *heading_deg)?;
            }
            FootprintConfig::Disc { centre_m, radius_m } => {
                self.point(&format!("{key}.footprint.disc.centre_m"), centre_m)?;
                self.number(&format!("{key}.footprint.disc.radius_m"), *radius_m, 0.001..=1000.0)?;
            }
            FootprintConfig::Polygon { points_m } => {
                let key = format!("{key}.footprint.polygon.points_m");
                self.points(&key, points_m)?;
                if !is_convex(points_m) {
                    let problem = "is not a convex polygon; cut it into convex pieces";
                    return Err(self.invalid(key, problem));
                }
            }
        }
        self.number(&format!("{key}.bottom_m"), furniture.bottom_m, 0.0..=100.0)?;
        self.number(&format!("{key}.top_m"), furniture.top_m, 0.0..=self.room.height_m)?;
        if furniture.top_m <= furniture.bottom_m {
            let problem = format!("is not above bottom_m ({} m)", furniture.bottom_m);
            return Err(self.invalid(format!("{key}.top_m"), problem));
        }
        if let Some(legs) = furniture.legs_m {
            let key = format!("{key}.legs_m");
            let FootprintConfig::Box { size_m, .. } = &furniture.footprint else {
                return Err(self.invalid(key, "is only for a box; leave it out"));
            };
            if furniture.bottom_m <= 0.0 {
                return Err(self.invalid(key, "needs bottom_m above zero"));
            }
            self.number(&key, legs, 0.001..=size_m[0].min(size_m[1]))?;
        }
        Ok(())
    }

    fn check_camera(&self, key: &str, camera: &CameraConfig) -> Result<(), ScenarioError> {
        let position = format!("{key}.position_m");
        self.point(&position, &[camera.position_m[0], camera.position_m[1]])?;
        self.number(&position, camera.position_m[2], 0.01..=self.room.height_m)?;
        match (camera.look_at_m, camera.heading_deg, camera.tilt_deg) {
            (Some(look_at), None, None) => {
                let key = format!("{key}.look_at_m");
                for coordinate in look_at {
                    self.number(&key, coordinate, -1e4..=1e4)?;
                }
                if look_at == camera.position_m {
                    return Err(self.invalid(key, "is the camera's own position"));
                }
            }
            (None, Some(heading), Some(tilt)) => {
                self.angle(&format!("{key}.heading_deg"), heading)?;
                self.number(&format!("{key}.tilt_deg"), tilt, -90.0..=90.0)?;
            }
            _ => {
                let problem = "needs either look_at_m, or heading_deg and tilt_deg";
                return Err(self.invalid(key, problem));
            }
        }
        let fov = 1.0..=170.0;
        self.number(&format!("{key}.horizontal_fov_deg"), camera.horizontal_fov_deg, fov.clone())?;
        self.number(&format!("{key}.vertical_fov_deg"), camera.vertical_fov_deg, fov)?;
        self.number(&format!("{key}.range_m"), camera.range_m, 0.01..=1000.0)?;
        self.number(&format!("{key}.rate_hz"), camera.rate_hz, 0.01..=100.0)?;
        self.number(&format!("{key}.cells_rate_hz"), camera.cells_rate_hz, 0.01..=100.0)?;
        self.number(&format!("{key}.latency_ms"), camera.latency_ms, 0.0..=60_000.0)?;
        self.number(&format!("{key}.position_noise_m"), camera.position_noise_m, 0.0..=10.0)?;
        self.number(&format!("{key}.heading_noise_deg"), camera.heading_noise_deg, 0.0..=180.0)
    }

    fn check_robot(&self, key: &str, robot: &RobotConfig) -> Result<(), ScenarioError> {
        self.point(&format!("{key}.start"), &[robot.start.x_m, robot.start.y_m])?;
        self.angle(&format!("{key}.start.heading_deg"), robot.start.heading_deg)?;
        self.number(&format!("{key}.radius_m"), robot.radius_m, 0.01..=10.0)?;
        self.number(&format!("{key}.height_m"), robot.height_m, 0.01..=self.room.height_m)?;

        let sensor = &robot.sensor;
        let key_of = |name: &str| format!("{key}.sensor.{name}");
        self.number(&key_of("x_m"), sensor.x_m, -robot.radius_m..=robot.radius_m)?;
        self.number(&key_of("y_m"), sensor.y_m, -robot.radius_m..=robot.radius_m)?;
        self.number(&key_of("height_m"), sensor.height_m, 0.0..=self.room.height_m)?;
        self.angle(&key_of("heading_deg"), sensor.heading_deg)?;
        self.number(&key_of("fov_deg"), sensor.fov_deg, 0.1..=360.0)?;
        if !(2..=4096).contains(&sensor.beams) {
            let problem = format!("is {}; give a number from 2 to 4096", sensor.beams);
            return Err(self.invalid(key_of("beams"), problem));
        }
        // A reading is a whole number of millimetres in 16 bits.
        self.number(&key_of("max_range_m"), sensor.max_range_m, 0.01..=65.5)?;
        self.number(&key_of("min_range_m"), sensor.min_range_m, 0.0..=sensor.max_range_m)?;
        self.number(&key_of("rate_hz"), sensor.rate_hz, 0.01..=100.0)?;
        self.number(&key_of("noise_m"), sensor.noise_m, 0.0..=10.0)?;
        self.number(&key_of("noise_ratio"), sensor.noise_ratio, 0.0..=1.0)?;

        let route = &robot.route;
        let key_of = |name: &str| format!("{key}.route.{name}");
        self.points(&key_of("waypoints_m"), &route.waypoints_m)?;
        self.number(&key_of("speed_m_s"), route.speed_m_s, 0.001..=10.0)?;
        self.number(&key_of("acceleration_m_s2"), route.acceleration_m_s2, 0.01..=100.0)?;
        self.number(&key_of("turn_rate_deg_s"), route.turn_rate_deg_s, 0.1..=3600.0)?;

        let odometry = &robot.odometry;
        let key_of = |name: &str| format!("{key}.odometry.{name}");
        self.number(&key_of("slip"), odometry.slip, -0.9..=10.0)?;
        self.number(&key_of("turn_slip"), odometry.turn_slip, -0.9..=10.0)?;
        self.number(&key_of("drift_deg_per_m"), odometry.drift_deg_per_m, -360.0..=360.0)?;
        self.number(&key_of("noise_m"), odometry.noise_m, 0.0..=10.0)?;
        self.number(&key_of("heading_noise_deg"), odometry.heading_noise_deg, 0.0..=180.0)
    }

    fn check_person(&self, key: &str, person: &PersonConfig) -> Result<(), ScenarioError> {
        let waypoints = format!("{key}.waypoints_m");
        if person.waypoints_m.is_empty() {
            return Err(self.invalid(waypoints, "needs at least one point"));
        }
        self.points(&waypoints, &person.waypoints_m)?;
        self.number(&format!("{key}.speed_m_s"), person.speed_m_s, 0.001..=10.0)?;
        self.number(&format!("{key}.pause_s"), person.pause_s, 0.0..=3600.0)?;
        self.number(&format!("{key}.radius_m"), person.radius_m, 0.01..=10.0)?;
        self.number(&format!("{key}.height_m"), person.height_m, 0.01..=self.room.height_m)
    }

    fn points(&self, key: &str, points: &[[f64; 2]]) -> Result<(), ScenarioError> {
        points
            .iter()
            .enumerate()
            .try_for_each(|(index, point)| self.point(&format!("{key}[{index}]"), point))
    }

    fn point(&self, key: &str, point: &[f64; 2]) -> Result<(), ScenarioError> {
        point.iter().try_for_each(|&coordinate| self.number(key, coordinate, -1e4..=1e4))
    }

    fn angle(&self, key: &str, degrees: f64) -> Result<(), ScenarioError> {
        self.number(key, degrees, -3600.0..=3600.0)
    }

    /// Not a number is outside of every range.
    fn number(
        &self,
        key: &str,
        value: f64,
        range: RangeInclusive<f64>,
    ) -> Result<(), ScenarioError> {
        if range.contains(&value) {
            return Ok(());
        }
        let problem =
            format!("is {value}; give a number from {} to {}", range.start(), range.end());
        Err(self.invalid(key, problem))
    }
}

/// Whether corners go round a convex polygon once, in either sense, without three on a line.
fn is_convex(points: &[[f64; 2]]) -> bool {
    let count = points.len();
    let corner = |index: usize| points[index % count];
    let turn = |index: usize| {
        let ([ax, ay], [bx, by], [cx, cy]) = (corner(index), corner(index + 1), corner(index + 2));
        (bx - ax) * (cy - by) - (by - ay) * (cx - bx)
    };
    // All corners turn the same way, and no corner lies beyond any edge: a star turns the same
    // way everywhere too, but twice round.
    let beyond = |index: usize, other: usize| {
        let ([ax, ay], [bx, by], [cx, cy]) = (corner(index), corner(index + 1), corner(other));
        (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    };
    count >= 3
        && [1.0, -1.0].iter().any(|sense| {
            (0..count).all(|index| {
                turn(index) * sense > 1e-9
                    && (0..count).all(|other| beyond(index, other) * sense >= -1e-9)
            })
        })
}
