//! The options of `ubimap keys`.

use std::path::PathBuf;

use clap::{Args, Subcommand};

/// Options of `ubimap keys`.
#[derive(Args, Clone, Debug)]
pub struct KeysOptions {
    /// What to do.
    #[command(subcommand)]
    pub action: KeysAction,

    /// The folder of the keys
    #[arg(long, value_name = "DIR", default_value = "keys", global = true)]
    pub dir: PathBuf,
}

/// What to do with keys.
#[derive(Clone, Copy, Debug, Subcommand)]
pub enum KeysAction {
    /// Make a key for a robot
    Make {
        /// The robot's number
        robot: u16,
    },
    /// List the robots that have a key, and its fingerprint
    List,
    /// Retire the key of a robot
    Retire {
        /// The robot's number
        robot: u16,
    },
}
