//! The options of `ubimap conformance`.

use std::{net::SocketAddr, path::PathBuf};

use clap::{Args, ValueEnum};
use ubimap_protocol::time::Duration;

use crate::{conformance::Role, run::options::milliseconds};

/// Options of `ubimap conformance`.
#[derive(Args, Clone, Debug)]
pub struct ConformanceOptions {
    /// The implementation under test.
    #[command(flatten)]
    pub wire: WireOptions,

    /// What is tested: a robot, to which the runner is the server, or a server
    #[arg(long, value_enum, default_value_t = RoleName::Robot)]
    pub role: RoleName,

    /// Seal the link with the keys in this folder (ubimap keys); to a server the runner is the first robot
    #[arg(long, value_name = "DIR")]
    pub keys: Option<PathBuf>,

    /// Run these checks only, by their numbers in --list
    #[arg(long, value_name = "N,M", value_delimiter = ',')]
    pub only: Vec<usize>,

    /// List the checks and run none
    #[arg(long)]
    pub list: bool,

    /// Baud rate of --serial
    #[arg(long, value_name = "RATE", default_value_t = 115_200)]
    pub baud: u32,

    /// How late an answer may be because of the wire and the operating systems
    #[arg(long, value_name = "MS", default_value = "100", value_parser = milliseconds)]
    pub slack: Duration,

    /// Print the results as JSON
    #[arg(long)]
    pub json: bool,

    /// Also write the results as JUnit XML
    #[arg(long, value_name = "FILE")]
    pub junit: Option<PathBuf>,
}

/// The wire to the implementation: one of these.
#[derive(Args, Clone, Debug)]
#[group(multiple = false)]
pub struct WireOptions {
    /// A serial port or pseudo-terminal
    #[arg(long, value_name = "PATH")]
    pub serial: Option<PathBuf>,

    /// A UDP address: where the server is, or where the runner awaits the robot
    #[arg(long, value_name = "ADDRESS")]
    pub udp: Option<SocketAddr>,

    /// A command that speaks on its standard input and output
    #[arg(long, value_name = "COMMAND")]
    pub exec: Option<String>,
}

/// What is tested.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RoleName {
    /// A robot.
    Robot,
    /// A server.
    Server,
}

impl From<RoleName> for Role {
    fn from(name: RoleName) -> Self {
        match name {
            RoleName::Robot => Self::Robot,
            RoleName::Server => Self::Server,
        }
    }
}
