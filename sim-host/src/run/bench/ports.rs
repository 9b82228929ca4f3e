//! `ubimap ports`: the serial ports of this computer, and the robots that say hello there.

use std::{
    fmt, thread,
    time::{Duration, Instant},
};

use clap::{Args, value_parser};
use serde::Serialize;
use ubimap_protocol::{
    frame::{Direction, FrameKind, SessionId},
    message::{Hello, Reset, ToRobot},
    units::RobotId,
};

use super::{
    opening::wire,
    options::PortOptions,
    overheard::{Ear, Overheard},
};
use crate::{
    channel::{
        address::NotAnAddress,
        serial::{self, ListedPort},
    },
    conformance::{Frame, Note},
    run::{RunError, interruption},
    server::about_number,
};

/// How long to listen: a robot without a session says hello every 3.2 s, and sooner after its start.
const LISTEN: Duration = Duration::from_millis(3_400);
/// How long a read waits.
const READ: Duration = Duration::from_millis(50);

/// Options of `ubimap ports`.
#[derive(Args, Clone, Debug)]
pub struct PortsOptions {
    /// Where to listen, instead of all serial ports that the system lists: pseudo-terminals must be named, and
    /// udp:0.0.0.0:4000 is for the first robot that comes there
    #[arg(value_name = "PORT")]
    pub ports: Vec<String>,

    /// Speed of the ports in bits per second
    #[arg(long, value_name = "N", default_value_t = 115_200, value_parser = value_parser!(u32).range(1_200..=12_000_000))]
    pub baud: u32,

    /// Print it as JSON
    #[arg(long)]
    pub json: bool,
}

/// The ports of this computer.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PortsReport {
    /// Always "ubimap-ports".
    pub schema: &'static str,
    /// Version of the schema.
    pub version: u32,
    /// Each port, in the order of the paths or as given.
    pub ports: Vec<PortFound>,
}

/// A port, and what is behind it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PortFound {
    /// Its path.
    pub port: String,
    /// What the operating system knows of it.
    pub device: Option<String>,
    /// What was heard.
    pub heard: Heard,
}

/// What was heard at a port.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Heard {
    /// A robot without a session.
    Robot {
        /// Its number; 0 is an image that was not provisioned.
        robot: u16,
        /// The versions of the protocol that it speaks, oldest and newest.
        versions: [u8; 2],
        /// A number that changes from boot to boot.
        boot_nonce: u32,
        /// The side of its cells in millimetres.
        resolution_mm: i32,
        /// Its largest frame in bytes.
        frame: u16,
    },
    /// A robot whose link is sealed.
    Sealed {
        /// Its number.
        robot: u16,
        /// The number of its boot.
        boot: u32,
    },
    /// A robot on a sealed link that has a session, or had one with a server that has gone.
    SealedSession {
        /// Its number.
        robot: u16,
    },
    /// A robot with a session that did not say hello.
    Session,
    /// Bytes that are no frames of a robot.
    Noise {
        /// Their number.
        bytes: u64,
    },
    /// Nothing.
    Silence,
    /// The port can't be used.
    Unusable {
        /// The reason.
        reason: String,
    },
}

/// Listens at all ports at once.
///
/// # Errors
/// [`RunError::Bench`] if the system can't list its ports.
pub fn run(options: &PortsOptions) -> Result<PortsReport, RunError> {
    let ports: Vec<ListedPort> = if options.ports.is_empty() {
        serial::list()
            .map_err(|reason| RunError::Bench { port: "the serial ports".into(), reason })?
    } else {
        let named = |path: &String| ListedPort { path: path.clone(), what: String::new() };
        options.ports.iter().map(named).collect()
    };
    let heard: Vec<Heard> = thread::scope(|scope| {
        let listening = |port| scope.spawn(move || listen(port, options.baud));
        let threads: Vec<_> = ports.iter().map(|port| listening(&port.path)).collect();
        // A thread that has panicked has printed why.
        threads.into_iter().map(|thread| thread.join().unwrap_or(Heard::Silence)).collect()
    });
    let found = ports.into_iter().zip(heard).map(|(ListedPort { path, what }, heard)| PortFound {
        port: path,
        device: Some(what).filter(|what| !what.is_empty()),
        heard,
    });
    Ok(PortsReport { schema: "ubimap-ports", version: 1, ports: found.collect() })
}

fn listen(path: &str, baud: u32) -> Heard {
    attend(path, baud).unwrap_or_else(|error| {
        // The port is named beside it.
        let text = error.to_string();
        let reason = text.strip_prefix(&format!("{path}: ")).unwrap_or(&text).to_owned();
        Heard::Unusable { reason }
    })
}

fn attend(path: &str, baud: u32) -> Result<Heard, RunError> {
    let refuse = |reason: String| RunError::Bench { port: path.to_owned(), reason };
    let port = path.parse().map_err(|error: NotAnAddress| refuse(error.to_string()))?;
    let mut port = wire(&PortOptions { port, baud, keys: None })?;
    let (mut ear, mut session, mut sealed) = (Ear::default(), false, None);
    let mut buffer = [0; 1_024];
    let began = Instant::now();
    while began.elapsed() < LISTEN && !interruption::is_requested() {
        let count = port.reader.read_within(&mut buffer, READ)?;
        for overheard in ear.hear(&buffer[..count]) {
            match overheard {
                Overheard::Hello(hello) => return Ok(greeting(&hello)),
                Overheard::SealedHello { robot, boot } => {
                    return Ok(Heard::Sealed { robot: robot.0, boot });
                }
                // It asks for a session at once when it is told that there is none. Whatever has not shown
                // that it is a robot is sent nothing: it may be anything.
                Overheard::Session => {
                    session = true;
                    port.writer.write(&reset())?;
                }
                Overheard::SealedSession(robot) if sealed == Some(robot) => {
                    return Ok(Heard::SealedSession { robot: robot.0 });
                }
                Overheard::SealedSession(robot) => sealed = Some(robot),
            }
        }
    }
    Ok(match ear.bytes() {
        _ if session => Heard::Session,
        0 => Heard::Silence,
        bytes => Heard::Noise { bytes },
    })
}

fn greeting(hello: &Hello) -> Heard {
    Heard::Robot {
        robot: hello.robot.0,
        versions: [hello.min_version, hello.version],
        boot_nonce: hello.nonce,
        resolution_mm: hello.resolution.0,
        frame: hello.frame,
    }
}

/// The frame that tells a robot that it has no session here.
fn reset() -> Vec<u8> {
    let note = Note::new::<ToRobot, _>(&Reset);
    Frame::new(SessionId::NONE, Direction::ToRobot, (FrameKind::Handshake, 0), &[note]).wire()
}

impl fmt::Display for Heard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Robot { robot, versions: [least, most], boot_nonce, resolution_mm, frame } => {
                let about = about_number(RobotId(*robot));
                let versions =
                    if least == most { most.to_string() } else { format!("{least} to {most}") };
                write!(
                    f,
                    "robot {robot}{about}, protocol version {versions}, boot {boot_nonce:08x}, cells of \
                     {resolution_mm} mm, frames of {frame} bytes"
                )
            }
            Self::Sealed { robot, boot } => {
                write!(f, "robot {robot}, sealed link (needs its key), boot {boot}")
            }
            Self::SealedSession { robot } => {
                write!(f, "robot {robot}, sealed link (needs its key), in a session")
            }
            Self::Session => f.write_str("a robot in a session that did not begin a new one"),
            Self::Noise { bytes } => {
                write!(f, "{bytes} bytes that are not a robot's: another device, or a wrong --baud")
            }
            Self::Silence => f.write_str(
                "silent: no robot, its power is off, or its TX is not at this port's RX",
            ),
            Self::Unusable { reason } => f.write_str(reason),
        }
    }
}

impl fmt::Display for PortsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.ports.is_empty() {
            return writeln!(
                f,
                "no serial port is connected (pseudo-terminals are not listed: name them)"
            );
        }
        for PortFound { port, device, heard } in &self.ports {
            let device = device.as_ref().map_or(String::new(), |it| format!(" ({it})"));
            writeln!(f, "{port}{device}: {heard}")?;
        }
        Ok(())
    }
}
