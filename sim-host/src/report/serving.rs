//! The report that `ubimap serve` prints at its end.

use std::fmt;

use serde::Serialize;

use super::link::LinkSummary;

/// Results of serving robots on serial ports.
///
/// In the JSON, `schema` and `version` identify the format: within a version names keep their
/// meaning, and new ones may be added.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ServeReport {
    /// Always "ubimap-serve".
    pub schema: &'static str,
    /// Version of the schema.
    pub version: u32,
    /// Each port, in the order given.
    pub ports: Vec<PortSummary>,
    /// Duration of the run in seconds.
    pub elapsed_s: f64,
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
    /// The newest events, oldest first.
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

/// An event reported by a robot.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EventSummary {
    /// When the report arrived, in seconds of the server's clock.
    pub received_s: f64,
    /// Severity, kind and details as text.
    pub what: String,
}

impl ServeReport {
    /// The value of [`ServeReport::schema`].
    pub const SCHEMA: &'static str = "ubimap-serve";
    /// The version written by this program.
    pub const VERSION: u32 = 2;

    /// Whether any robot ever had a session.
    pub fn has_robot(&self) -> bool {
        self.ports.iter().any(|port| port.robot.is_some())
    }
}

/// Two lines for each port, and its newest events.
impl fmt::Display for ServeReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for port in &self.ports {
            match port.robot {
                Some(robot) => write!(f, "{}: robot {robot}", port.port)?,
                None => write!(f, "{}: no robot", port.port)?,
            }
            match port.state {
                Some(state) => writeln!(f, ", {state}")?,
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
                writeln!(f, "        {:.1} s: {}", event.received_s, event.what)?;
            }
        }
        writeln!(f, "{:.1} s served", self.elapsed_s)
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
