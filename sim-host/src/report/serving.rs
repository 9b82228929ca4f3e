//! The report that `ubimap serve` prints at its end.

use std::fmt;

use serde::Serialize;

use super::{
    CameraMove, HexDigest, SeenMap, ServedRobot, TrackedPerson, UnexploredGround, link::LinkSummary,
};
use crate::grid::Scores;

/// Results of serving robots on serial ports and sockets, with or without cameras.
///
/// In the JSON, `schema` and `version` identify the format: within a version names keep their
/// meaning, and new ones may be added.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ServeReport {
    /// Always "ubimap-serve".
    pub schema: &'static str,
    /// Version of the schema.
    pub version: u32,
    /// Each robot of the deployment, and those that came beside them, by number.
    pub robots: Vec<ServedRobot>,
    /// Each person that robots are told of at this time.
    pub people: Vec<TrackedPerson>,
    /// Each port, in the order given.
    pub ports: Vec<PortSummary>,
    /// Each camera, in the order of the deployment's file.
    pub cameras: Vec<ServedCamera>,
    /// How long frames took, if any was looked at.
    pub delays: Option<FrameDelays>,
    /// The movements of cameras that were noticed, in order of time.
    pub camera_moves: Vec<CameraMove>,
    /// The map, if a deployment's file is served.
    pub map: Option<SeenMap>,
    /// What is left to explore, if robots explore.
    pub unexplored: Vec<UnexploredGround>,
    /// The agreement of the map with the floor plan, if there is one.
    pub plan: Option<Scores>,
    /// Duration of the run in seconds.
    pub elapsed_s: f64,
    /// The server's time in seconds: that of all poses and events here. It goes on from a stored map's.
    pub time_s: f64,
    /// What the computer's clock showed at [`ServeReport::time_s`], in seconds since 1970.
    pub unix_s: f64,
}

/// The delays from the arrival of a frame until what was seen in it has been sent to the robots, in
/// milliseconds, rounded up; those above a second count as a second. Skipped frames have none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FrameDelays {
    /// Number of frames.
    pub frames: u64,
    /// Half of the frames did not take longer.
    pub median_ms: u64,
    /// 90 % did not take longer.
    pub p90_ms: u64,
    /// 99 % did not take longer.
    pub p99_ms: u64,
    /// The longest delay.
    pub most_ms: u64,
}

impl fmt::Display for FrameDelays {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { median_ms, p90_ms, p99_ms, most_ms, .. } = self;
        write!(
            f,
            "from a frame to its messages {median_ms} ms (median), {p90_ms} ms (90 %), {p99_ms} ms (99 %), \
             {most_ms} ms (most)"
        )
    }
}

/// Results of one port.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PortSummary {
    /// The path of the port.
    pub port: String,
    /// The robot that last had a session on this port.
    pub robot: Option<u16>,
    /// Whether the session was open at the end.
    pub session: bool,
    /// Whether the other end hung up.
    pub hung_up: bool,
    /// The robot's last state report.
    pub state: Option<StateSummary>,
    /// Number of events that the robot reported.
    pub events: u64,
    /// The newest events, each once, in the order in which they last came.
    pub newest_events: Vec<EventSummary>,
    /// Number of time requests of the robot in its session.
    pub time_requests: u32,
    /// Counters of the frames and messages at this port.
    pub link: LinkSummary,
    /// Bytes received, including noise.
    pub bytes_up: u64,
    /// Bytes sent.
    pub bytes_down: u64,
}

/// Results of one camera.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ServedCamera {
    /// Its name.
    pub name: String,
    /// Whether its pose is known; frames of a camera without a pose are not used.
    pub has_pose: bool,
    /// Frames that have arrived.
    pub frames: u64,
    /// Frames that were replaced by newer ones, because perception was busy.
    pub skipped: u64,
    /// Frames that were captured before one that had arrived already.
    pub out_of_order: u64,
    /// The time from the capture of the last frame to its arrival, in milliseconds.
    pub age_ms: f64,
    /// Frames in which robots were looked for.
    pub observations: u64,
    /// Frames of which cells were reported.
    pub looks: u64,
    /// Digest of what was seen in its frames. A recording has the digest that it has for `ubimap watch`.
    pub digest: HexDigest,
    /// Whether no frame has arrived lately.
    pub away: bool,
    /// Whether it was knocked, and is out of use until its new pose is known.
    pub knocked: bool,
    /// Whether it contradicts another camera, so that one of the two was knocked.
    pub disputed: bool,
    /// The system clock of the server minus the clock of the camera's sender, in seconds.
    pub clock_offset_s: Option<f64>,
    /// How often the sender's clock was set.
    pub clock_jumps: u32,
}

impl ServedCamera {
    /// What it is to the server.
    fn state(&self) -> &'static str {
        match self {
            Self { frames: 0, .. } => "no frame yet",
            Self { away: true, .. } => "away",
            Self { has_pose: false, .. } => "has no pose, not used",
            Self { knocked: true, .. } => "knocked, out of use until its new pose is known",
            Self { disputed: true, .. } => "in use, but contradicts another camera",
            _ => "in use",
        }
    }
}

/// "camera north: in use; 900 frames, 2 skipped, 870 looked at, 170 mapped; its clock is 3.250 s behind".
impl fmt::Display for ServedCamera {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, frames, skipped, observations, looks, .. } = self;
        write!(
            f,
            "camera {name}: {}; {frames} frames, {skipped} skipped, {observations} looked at, {looks} mapped",
            self.state()
        )?;
        if let Some(offset) = self.clock_offset_s {
            let way = if offset < 0.0 { "ahead" } else { "behind" };
            write!(
                f,
                "; its clock is {:.3} s {way}, set {} times",
                offset.abs(),
                self.clock_jumps
            )?;
        }
        Ok(())
    }
}

/// A robot's last state report. Times are in seconds of the server's clock, which starts at zero,
/// or continues from its store.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct StateSummary {
    /// When the report arrived.
    pub received_s: f64,
    /// The time of the pose.
    pub time_s: Option<f64>,
    /// The pose in `map`: x and y in metres, heading in degrees.
    pub pose: Option<[f64; 3]>,
    /// Cells that the robot could not map for lack of memory.
    pub cells_refused: u32,
}

/// An event reported by a robot, once or several times.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EventSummary {
    /// When the last report arrived, in seconds of the server's clock.
    pub received_s: f64,
    /// When the first of them arrived.
    pub first_s: f64,
    /// Number of reports.
    pub times: u32,
    /// Severity, kind and details as text.
    pub what: String,
}

impl ServeReport {
    /// The value of [`ServeReport::schema`].
    pub const SCHEMA: &'static str = "ubimap-serve";
    /// The version written by this program.
    pub const VERSION: u32 = 3;

    /// Whether any robot ever had a session.
    pub fn has_robot(&self) -> bool {
        self.ports.iter().any(|port| port.robot.is_some())
    }
}

/// A line for each robot, person, camera and movement, two for each port, and its newest events.
impl fmt::Display for ServeReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.robots.iter().try_for_each(|robot| writeln!(f, "{robot}"))?;
        self.people.iter().try_for_each(|person| writeln!(f, "{person}"))?;
        self.cameras.iter().try_for_each(|camera| writeln!(f, "{camera}"))?;
        for moved in &self.camera_moves {
            match self.cameras.get(moved.camera) {
                Some(camera) => moved.write(&camera.name, f)?,
                None => write!(f, "{moved}")?,
            }
            writeln!(f)?;
        }
        for port in &self.ports {
            match port.robot {
                Some(robot) => write!(f, "{}: robot {robot}", port.port)?,
                None => write!(f, "{}: no robot", port.port)?,
            }
            match port.state {
                Some(state) => writeln!(f, "; its own last report: {state}")?,
                None => writeln!(f)?,
            }
            writeln!(
                f,
                "    {}; {} bytes up, {} down{}",
                port.link,
                port.bytes_up,
                port.bytes_down,
                if port.hung_up { "; hung up" } else { "" }
            )?;
            if port.events > 0 {
                writeln!(f, "    {} events; the newest:", port.events)?;
            }
            for event in &port.newest_events {
                writeln!(f, "        {event}")?;
            }
        }
        if let Some(delays) = &self.delays {
            writeln!(f, "{delays}")?;
        }
        if let Some(map) = &self.map {
            let area = |cells: u64| cells as f64 * map.resolution_m * map.resolution_m;
            writeln!(f, "{:.1} m2 known, {:.1} m2 in view", area(map.known), area(map.in_view))?;
        }
        self.unexplored.iter().try_for_each(|ground| writeln!(f, "{ground}"))?;
        if let Some(Scores { precision, recall, tolerance_m, .. }) = self.plan {
            writeln!(
                f,
                "{:.0} % of the map's walls are on the plan within {:.0} cm, and {:.0} % of the plan's on the map",
                100.0 * precision,
                100.0 * tolerance_m,
                100.0 * recall
            )?;
        }
        writeln!(f, "{:.1} s served", self.elapsed_s)
    }
}

/// "98.5 s: Info: is at the end of its path (12 times since 15.7 s)".
impl fmt::Display for EventSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.1} s: {}", self.received_s, self.what)?;
        match self.times {
            0 | 1 => Ok(()),
            times => write!(f, " ({times} times since {:.1} s)", self.first_s),
        }
    }
}

/// Formats as "at 1.000 m, 2.000 m, 90.0 degrees at 12.3 s".
impl fmt::Display for StateSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.pose {
            Some([x, y, heading]) => write!(f, "at {x:.3} m, {y:.3} m, {heading:.1} degrees")?,
            None => write!(f, "without a pose")?,
        }
        if let Some(time) = self.time_s {
            write!(f, " at {time:.3} s")?;
        }
        if self.cells_refused > 0 {
            write!(f, ", {} cells refused", self.cells_refused)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_of_a_camera_is_told_in_words() {
        let camera = ServedCamera {
            name: "north".into(),
            has_pose: true,
            frames: 900,
            skipped: 2,
            observations: 870,
            looks: 170,
            clock_offset_s: Some(-3.25),
            ..ServedCamera::default()
        };
        assert_eq!(
            camera.to_string(),
            "camera north: in use; 900 frames, 2 skipped, 870 looked at, 170 mapped; its clock is 3.250 s ahead, \
             set 0 times"
        );
        let state = |camera: ServedCamera| camera.state();
        assert_eq!(state(ServedCamera { frames: 0, away: true, ..camera.clone() }), "no frame yet");
        let knocked = ServedCamera { knocked: true, ..camera.clone() };
        assert!(state(knocked.clone()).starts_with("knocked"));
        // Whoever has pulled its plug needs to know that first.
        assert_eq!(state(ServedCamera { away: true, ..knocked }), "away");
        assert!(state(ServedCamera { disputed: true, ..camera.clone() }).contains("contradicts"));
        assert!(state(ServedCamera { has_pose: false, ..camera }).contains("no pose"));
    }
}
