//! The figures of a time on serial ports: what `ubimap serve` prints at its end.

use std::fmt;

use serde::Serialize;

/// What became of the robots behind serial ports.
///
/// As JSON, `schema` and `version` tell a reader what to expect: within a version names keep their
/// meaning, and new ones may be added.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ServeReport {
    /// Always "ubimap-serve".
    pub schema: &'static str,
    /// The version of the schema.
    pub version: u32,
    /// Each port, in the order given.
    pub ports: Vec<PortSummary>,
    /// How long they were served, in seconds.
    pub elapsed_s: f64,
}

/// The figures of one port.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PortSummary {
    /// The port.
    pub port: String,
    /// The robot that last had a session here.
    pub robot: Option<u16>,
    /// Whether it still had it at the end.
    pub session: bool,
    /// Whether the other end hung up.
    pub hung_up: bool,
    /// What the robot last said of itself.
    pub state: Option<StateSummary>,
    /// How many events the robot has told of.
    pub events: u64,
    /// The newest of them, oldest first.
    pub newest_events: Vec<EventSummary>,
    /// How often the robot asked for the time in its session.
    pub time_requests: u32,
    /// Good frames received, those that arrived twice included.
    pub frames_received: u32,
    /// What was received and is no frame of the session: noise, damage, an earlier session.
    pub frames_bad: u32,
    /// Frames that the server sent again.
    pub retransmissions: u32,
    /// Bytes received, whatever they were.
    pub bytes_up: u64,
    /// Bytes sent.
    pub bytes_down: u64,
}

/// What a robot said of itself. Times are in seconds of the server's clock, which starts with it,
/// or goes on from its file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct StateSummary {
    /// When it arrived.
    pub received_s: f64,
    /// The moment of its pose.
    pub time_s: Option<f64>,
    /// Its pose in `map`: x and y in metres, heading in degrees.
    pub pose: Option<[f64; 3]>,
    /// Cells that it could not map for lack of memory.
    pub cells_refused: u32,
}

/// Something that happened on a robot.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EventSummary {
    /// When it was heard of, in seconds of the server's clock.
    pub received_s: f64,
    /// How much it matters, what happened, and more about it.
    pub what: String,
}

impl ServeReport {
    /// What [`ServeReport::schema`] says.
    pub const SCHEMA: &'static str = "ubimap-serve";
    /// The version that is written.
    pub const VERSION: u32 = 1;

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
                "    {} frames received, {} bad, {} sent again; {} bytes up, {} down{}",
                port.frames_received,
                port.frames_bad,
                port.retransmissions,
                port.bytes_up,
                port.bytes_down,
                if port.hung_up { "; hung up" } else { "" }
            )?;
            if port.events > 0 {
                writeln!(f, "    {} events, of which the newest:", port.events)?;
            }
            for event in &port.newest_events {
                writeln!(f, "        {:.1} s: {}", event.received_s, event.what)?;
            }
        }
        writeln!(f, "{:.1} s served", self.elapsed_s)
    }
}

/// In a few words, such as "at 1.000 m, 2.000 m, 90.0 degrees at 12.3 s".
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
