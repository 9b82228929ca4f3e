//! Where a robot is.

use std::path::PathBuf;

use clap::{Args, value_parser};

use crate::channel::address::Address;

/// The port of a robot.
#[derive(Args, Clone, Debug)]
pub struct PortOptions {
    /// Where the robot is: a serial port (see ubimap ports), or udp:4000 or tcp:4000 for a robot that comes to
    /// this computer. No server may use it at the same time
    #[arg(value_name = "PORT")]
    pub port: Address,

    /// Speed of a serial port in bits per second
    #[arg(long, value_name = "N", default_value_t = 115_200, value_parser = value_parser!(u32).range(1_200..=12_000_000))]
    pub baud: u32,

    /// The folder with the robot's key, if its link is sealed: see ubimap keys
    #[arg(long, value_name = "DIR")]
    pub keys: Option<PathBuf>,
}
