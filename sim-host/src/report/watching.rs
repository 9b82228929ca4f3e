//! The results of watching a recording: printed by `ubimap watch`, and its `report.json`.

use std::fmt;

use serde::Serialize;

use super::{cameras::CameraMove, points::ExposureSummary, summary::HexDigest};
use crate::grid::OccupancyGrid;

/// Results of watching a recording. Times are in seconds of the recording's clock.
///
/// In the JSON, `schema` and `version` identify the format: within a version names keep their
/// meaning, and new ones may be added. The same recording gives the same report except for
/// `elapsed_s`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WatchReport {
    /// Always "ubimap-watch".
    pub schema: &'static str,
    /// Version of the schema.
    pub version: u32,
    /// Each camera.
    pub cameras: Vec<CameraSummary>,
    /// Each registered robot, ordered by id.
    pub robots: Vec<SeenRobot>,
    /// People and things present at the end.
    pub things: Vec<SeenThing>,
    /// Rejected poses, and events about people.
    pub events: Vec<PassedEvent>,
    /// The movements of cameras that were noticed, in order of time.
    pub camera_moves: Vec<CameraMove>,
    /// The exposure of the depths; left out without a rule.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure: Option<ExposureSummary>,
    /// The map at the end.
    pub map: SeenMap,
    /// Duration of the recording in seconds.
    pub recorded_s: f64,
    /// Duration of the run in seconds of the wall clock.
    pub elapsed_s: f64,
}

/// Results of one camera.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CameraSummary {
    /// The name of the camera's folder.
    pub name: String,
    /// Frames processed.
    pub frames: u64,
    /// Frames with a time stamp in the recording but no image.
    pub lost: u64,
    /// Frames whose depth image was evaluated and reported the state of cells.
    pub looks: u64,
    /// Digest of what was seen in its frames: when, which robots and which cells.
    pub digest: HexDigest,
    /// The floor that it sees, against z = 0 in its stated pose; `None` if there were too few depth images
    /// or it sees none.
    pub floor: Option<SeenFloor>,
}

/// A camera's floor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SeenFloor {
    /// Stated height of the camera less that above its floor, in metres.
    pub height_m: f64,
    /// Angle between the floor and the horizontal, in degrees.
    pub tilt_deg: f64,
    /// The part of the measured pixels that see the floor.
    pub share: f64,
    /// Whether height and tilt of the camera were corrected.
    pub is_corrected: bool,
}

impl fmt::Display for SeenFloor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:+.1} cm, {:.2} degrees", 100.0 * self.height_m, self.tilt_deg)?;
        if self.is_corrected { write!(f, ", corrected") } else { Ok(()) }
    }
}

/// The sightings of a robot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SeenRobot {
    /// The robot's id.
    pub id: u16,
    /// Number of frames in which it was localised.
    pub sightings: u64,
    /// Time of the last sighting.
    pub last_s: Option<f64>,
    /// The last pose in `map`: x and y in metres, heading in degrees.
    pub pose: Option<[f64; 3]>,
}

/// A person or a thing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SeenThing {
    /// "person", "movable" or "fixed", by height and motion.
    pub class: &'static str,
    /// "standing", "sitting" or "lying" for a person, by height; `None` if unknown.
    pub posture: Option<&'static str>,
    /// The centre in `map`, in metres.
    pub position_m: [f64; 2],
    /// The velocity in `map`, in metres per second.
    pub velocity_m_s: [f64; 2],
    /// Radius of the circle about the centre that contains the whole person or thing, in metres.
    pub radius_m: f64,
}

/// An event that needs attention.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PassedEvent {
    /// A description of the event.
    pub what: String,
    /// Number of times that the event began.
    pub count: u64,
    /// Time at which it last began.
    pub last_s: f64,
}

/// Results for the map.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SeenMap {
    /// Side length of a cell in metres.
    pub resolution_m: f64,
    /// Cells that are free or occupied.
    pub known: u64,
    /// Cells that are free.
    pub free: u64,
    /// Cells that are occupied, fixed or movable.
    pub occupied: u64,
    /// Cells in view of the cameras at the end.
    pub in_view: u64,
    /// Digest of the map's tiles.
    pub digest: HexDigest,
}

impl SeenMap {
    /// The figures of a map and of what cameras see of it.
    pub fn new(map: &OccupancyGrid, coverage: &OccupancyGrid, digest: HexDigest) -> Self {
        let counts = map.counts();
        Self {
            resolution_m: map.resolution_m(),
            known: counts.known as u64,
            free: counts.free as u64,
            occupied: counts.occupied as u64,
            in_view: coverage.counts().known as u64,
            digest,
        }
    }
}

impl WatchReport {
    /// The value of [`WatchReport::schema`].
    pub const SCHEMA: &'static str = "ubimap-watch";
    /// The version written by this program.
    pub const VERSION: u32 = 1;
}

impl Default for WatchReport {
    fn default() -> Self {
        Self {
            schema: Self::SCHEMA,
            version: Self::VERSION,
            cameras: Vec::new(),
            robots: Vec::new(),
            things: Vec::new(),
            events: Vec::new(),
            camera_moves: Vec::new(),
            exposure: None,
            map: SeenMap::default(),
            recorded_s: 0.0,
            elapsed_s: 0.0,
        }
    }
}

/// A table of the cameras and one of the robots, and a line for each of the other figures.
impl fmt::Display for WatchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:<20} {:>7} {:>5} {:>6}  floor off by", "camera", "frames", "lost", "looks")?;
        for CameraSummary { name, frames, lost, looks, floor, .. } in &self.cameras {
            let floor = floor.map_or("not found".to_owned(), |floor| floor.to_string());
            writeln!(f, "{name:<20} {frames:>7} {lost:>5} {looks:>6}  {floor}")?;
        }
        if !self.robots.is_empty() {
            writeln!(f, "robot    seen    last (s)     x (m)    y (m)  heading (degrees)")?;
        }
        for SeenRobot { id, sightings, last_s, pose } in &self.robots {
            write!(f, "{id:>5} {sightings:>7}")?;
            match last_s.zip(*pose) {
                Some((last, [x, y, heading])) => {
                    writeln!(f, " {last:>11.3} {x:>9.3} {y:>8.3} {heading:>18.1}")?;
                }
                None => writeln!(f, "       never")?,
            }
        }
        for SeenThing { class, posture, position_m: [x, y], velocity_m_s: [vx, vy], radius_m } in
            &self.things
        {
            let posture = posture.map_or(String::new(), |posture| format!(", {posture},"));
            writeln!(
                f,
                "at the end: {class}{posture} at ({x:.2}, {y:.2}) m, {:.2} m/s, within {radius_m:.2} m",
                vx.hypot(*vy)
            )?;
        }
        for PassedEvent { what, count, last_s } in &self.events {
            writeln!(f, "event: {what} ({count} times, last at {last_s:.3} s)")?;
        }
        for moved in &self.camera_moves {
            writeln!(f, "{moved}")?;
        }
        if let Some(exposure) = &self.exposure {
            write!(f, "{exposure}")?;
        }
        let map = &self.map;
        writeln!(
            f,
            "map: {} cells of {} m known ({} free, {} occupied), {} in view at the end, digest {}",
            map.known, map.resolution_m, map.free, map.occupied, map.in_view, map.digest
        )?;
        writeln!(f, "{:.1} s recorded, watched in {:.1} s", self.recorded_s, self.elapsed_s)
    }
}
