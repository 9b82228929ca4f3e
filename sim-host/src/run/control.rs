//! Commands to a running server, through a Unix socket: one line with the request, then the answer, whose
//! first word is `ok` or `error:`.

use std::{
    path::{Path, PathBuf},
    str::FromStr,
};

use clap::Args;
use ubimap_protocol::units::RobotId;

use super::RunError;
#[cfg(unix)]
use crate::channel::socket_file::SocketFile;

/// Maximum length of a request in bytes.
#[cfg(unix)]
const MAX_REQUEST: u64 = 200;

/// A request.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Request {
    /// Send a robot to a place in `map`, in metres.
    Go(RobotId, [f64; 2]),
    /// Stop a robot, or all.
    Stop(Option<RobotId>),
    /// Let a robot, or all, drive and explore.
    Explore(Option<RobotId>),
    /// Describe the state.
    Status,
    /// The same as JSON.
    Report,
}

/// Where the running server listens.
#[derive(Args, Clone, Debug)]
pub struct ControlOptions {
    /// The file of the running deployment
    #[arg(long, value_name = "TOML", default_value = "deployment.toml")]
    pub deployment: PathBuf,
}

/// Options of `ubimap go`.
#[derive(Args, Clone, Debug)]
pub struct GoOptions {
    /// The robot's number
    pub robot: u16,
    /// Where to: x in metres
    #[arg(allow_negative_numbers = true)]
    pub x: f64,
    /// Where to: y in metres
    #[arg(allow_negative_numbers = true)]
    pub y: f64,
    /// Where the running server listens.
    #[command(flatten)]
    pub control: ControlOptions,
}

/// Options of `ubimap stop` and `ubimap explore`.
#[derive(Args, Clone, Debug)]
pub struct RobotsOptions {
    /// The robot's number; all robots without it
    pub robot: Option<u16>,
    /// Where the running server listens.
    #[command(flatten)]
    pub control: ControlOptions,
}

/// Options of `ubimap status`.
#[derive(Args, Clone, Debug)]
pub struct StatusOptions {
    /// Print it as JSON, in the form of the server's report
    #[arg(long)]
    pub json: bool,
    /// Where the running server listens.
    #[command(flatten)]
    pub control: ControlOptions,
}

impl GoOptions {
    /// Sends the robot. Returns the server's answer.
    ///
    /// # Errors
    /// [`RunError::Control`].
    pub fn run(&self) -> Result<String, RunError> {
        ask(&self.control, &format!("go {} {} {}", self.robot, self.x, self.y))
    }
}

impl RobotsOptions {
    /// Sends a request with this verb. Returns the server's answer.
    ///
    /// # Errors
    /// [`RunError::Control`].
    pub fn run(&self, verb: &str) -> Result<String, RunError> {
        let robot = self.robot.map_or(String::new(), |robot| robot.to_string());
        ask(&self.control, &format!("{verb} {robot}"))
    }
}

impl StatusOptions {
    /// Asks for the state. Returns the server's answer.
    ///
    /// # Errors
    /// [`RunError::Control`].
    pub fn run(&self) -> Result<String, RunError> {
        ask(&self.control, if self.json { "report" } else { "status" })
    }
}

impl FromStr for Request {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let words: Vec<&str> = text.split_whitespace().collect();
        let robot = |word: &str| {
            word.parse().map(RobotId).map_err(|_| format!("{word:?} is not a robot's number"))
        };
        let metres = |word: &str| match word.parse::<f64>() {
            Ok(metres) if metres.abs() <= 10_000.0 => Ok(metres),
            _ => Err(format!("{word:?} is not a place in metres")),
        };
        match words[..] {
            ["go", id, x, y] => Ok(Self::Go(robot(id)?, [metres(x)?, metres(y)?])),
            ["stop"] => Ok(Self::Stop(None)),
            ["stop", id] => Ok(Self::Stop(Some(robot(id)?))),
            ["explore"] => Ok(Self::Explore(None)),
            ["explore", id] => Ok(Self::Explore(Some(robot(id)?))),
            ["status"] => Ok(Self::Status),
            ["report"] => Ok(Self::Report),
            _ => Err(
                "the requests are go ROBOT X Y, stop [ROBOT], explore [ROBOT], status and report"
                    .into(),
            ),
        }
    }
}

/// The socket of a deployment: its file with the extension `sock`.
pub(super) fn socket(deployment: &Path) -> PathBuf {
    deployment.with_extension("sock")
}

/// Asks the running server.
#[cfg(unix)]
fn ask(options: &ControlOptions, request: &str) -> Result<String, RunError> {
    use std::{
        io::{Read, Write},
        os::unix::net::UnixStream,
        time::Duration,
    };

    let path = socket(&options.deployment);
    let failed = |reason: String| RunError::Control { path: path.clone(), reason };
    let exchange = || {
        let mut stream = UnixStream::connect(&path)?;
        stream.set_read_timeout(Some(Duration::from_secs(10)))?;
        stream.write_all(format!("{}\n", request.trim()).as_bytes())?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        Ok(answer)
    };
    let answer: std::io::Result<String> = exchange();
    let answer = answer.map_err(|error| {
        failed(format!(
            "no server answers ({error}); start ubimap serve, or name its deployment.toml with --deployment"
        ))
    })?;
    match answer.split_once(' ') {
        Some(("ok", answer)) => Ok(answer.to_owned()),
        Some(("error:", reason)) => Err(failed(reason.trim_end().to_owned())),
        _ => Err(failed("the server has ended before it answered".into())),
    }
}

#[cfg(not(unix))]
fn ask(options: &ControlOptions, _: &str) -> Result<String, RunError> {
    let reason = "this system has no Unix sockets".into();
    Err(RunError::Control { path: socket(&options.deployment), reason })
}

/// Listens for requests; `answer` is called with each in a thread. Returns the socket's file, which is removed
/// when that is dropped.
///
/// # Errors
/// [`WireError`](crate::channel::wire::WireError).
#[cfg(unix)]
pub(super) fn listen(
    path: &Path,
    answer: impl Fn(Request) -> Result<String, String> + Send + 'static,
) -> Result<SocketFile, crate::channel::wire::WireError> {
    use std::{
        io::{BufRead, BufReader, Read, Write},
        thread,
        time::Duration,
    };

    use crate::channel::{unix_socket, wire::WireError};

    let (listener, file) = unix_socket::listen(path)?;
    let work = move || {
        for stream in listener.incoming() {
            let Ok(mut stream) = stream else {
                thread::sleep(Duration::from_millis(100));
                continue;
            };
            let patience = Some(Duration::from_secs(2));
            if stream.set_read_timeout(patience).and(stream.set_write_timeout(patience)).is_err() {
                continue;
            }
            let mut line = String::new();
            if BufReader::new(&stream).take(MAX_REQUEST).read_line(&mut line).is_err() {
                continue;
            }
            let answered = match line.parse().and_then(&answer) {
                Ok(text) => format!("ok {text}"),
                Err(reason) => format!("error: {reason}\n"),
            };
            // Whoever has asked may be gone.
            let _ = stream.write_all(answered.as_bytes());
        }
    };
    let spawned = thread::Builder::new().name("control".into()).spawn(work);
    match spawned {
        Ok(_) => Ok(file),
        Err(reason) => Err(WireError::Io { name: path.display().to_string(), reason }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_read_and_nonsense_is_answered() {
        let robot = RobotId(7);
        for (text, expected) in [
            ("go 7 1.5 -2\n", Request::Go(robot, [1.5, -2.0])),
            ("stop", Request::Stop(None)),
            ("stop 7", Request::Stop(Some(robot))),
            ("explore 7", Request::Explore(Some(robot))),
            ("status", Request::Status),
            ("report", Request::Report),
        ] {
            assert_eq!(text.parse(), Ok(expected));
        }
        for text in ["", "go", "go x 1 2", "go 1 nan 2", "go 1 1e9 2", "stop 70000", "dance"] {
            assert!(text.parse::<Request>().is_err(), "{text}");
        }
    }
}
