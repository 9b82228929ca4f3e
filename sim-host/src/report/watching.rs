//! What came of watching a recording: what `ubimap watch` prints, and its `report.json`.

use std::fmt;

use serde::Serialize;

use super::summary::HexDigest;

/// The figures of a recording that was watched. Moments are in seconds of the recording's clock.
///
/// As JSON, `schema` and `version` tell a reader what to expect: within a version names keep their
/// meaning, and new ones may be added. The same recording gives the same report but for `elapsed_s`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WatchReport {
    /// Always "ubimap-watch".
    pub schema: &'static str,
    /// The version of the schema.
    pub version: u32,
    /// Each camera.
    pub cameras: Vec<CameraSummary>,
    /// Each robot that is registered, in the order of their ids.
    pub robots: Vec<SeenRobot>,
    /// What stood out of the empty room at the end.
    pub things: Vec<SeenThing>,
    /// What could not be a pose, and what happened to people.
    pub events: Vec<PassedEvent>,
    /// The map at the end.
    pub map: SeenMap,
    /// How long the recording is, in seconds.
    pub recorded_s: f64,
    /// How long it took to watch it, in seconds of the wall clock.
    pub elapsed_s: f64,
}

/// The figures of one camera.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CameraSummary {
    /// The name of its folder.
    pub name: String,
    /// Frames that were taken.
    pub frames: u64,
    /// Frames that have a time in the recording, and no image.
    pub lost: u64,
    /// Frames whose depths were looked at and said of cells what is there.
    pub looks: u64,
}

/// What the cameras saw of a robot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SeenRobot {
    /// Its number.
    pub id: u16,
    /// In how many frames it was localised.
    pub sightings: u64,
    /// When it was last.
    pub last_s: Option<f64>,
    /// Where it was then, in `map`: x and y in metres, heading in degrees.
    pub pose: Option<[f64; 3]>,
}

/// A person or a thing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SeenThing {
    /// "person", "movable" or "fixed", by height and motion.
    pub class: &'static str,
    /// Its middle in `map`, in metres.
    pub position_m: [f64; 2],
    /// In `map`, in metres a second.
    pub velocity_m_s: [f64; 2],
    /// A circle of this radius about the middle holds all of it, in metres.
    pub radius_m: f64,
}

/// Something that somebody should look at.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PassedEvent {
    /// What, in words.
    pub what: String,
    /// How often it began.
    pub count: u64,
    /// When it last began.
    pub last_s: f64,
}

/// The figures of the map.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SeenMap {
    /// The side of a cell in metres.
    pub resolution_m: f64,
    /// Cells that are free or occupied.
    pub known: u64,
    /// Cells that are free.
    pub free: u64,
    /// Cells that are occupied, fixed or movable.
    pub occupied: u64,
    /// Cells that the cameras saw at the end.
    pub in_view: u64,
    /// Of the map's tiles.
    pub digest: HexDigest,
}

impl WatchReport {
    /// What [`WatchReport::schema`] says.
    pub const SCHEMA: &'static str = "ubimap-watch";
    /// The version that is written.
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
            map: SeenMap::default(),
            recorded_s: 0.0,
            elapsed_s: 0.0,
        }
    }
}

/// A table of the cameras and one of the robots, and a line for each of the other figures.
impl fmt::Display for WatchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{:<20} {:>7} {:>5} {:>6}", "camera", "frames", "lost", "looks")?;
        for CameraSummary { name, frames, lost, looks } in &self.cameras {
            writeln!(f, "{name:<20} {frames:>7} {lost:>5} {looks:>6}")?;
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
        for SeenThing { class, position_m: [x, y], velocity_m_s: [vx, vy], radius_m } in
            &self.things
        {
            writeln!(
                f,
                "at the end: {class} at ({x:.2}, {y:.2}) m, {:.2} m/s, within {radius_m:.2} m",
                vx.hypot(*vy)
            )?;
        }
        for PassedEvent { what, count, last_s } in &self.events {
            writeln!(f, "event: {what} ({count} times, last at {last_s:.3} s)")?;
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
