//! `ubimap init`: a deployment to begin with.

use std::{
    fs::{self, OpenOptions},
    io::Write,
    path::PathBuf,
};

use clap::Args;

use super::{RunError, deployment_file::EXAMPLE};

/// The name of the file.
const FILE: &str = "deployment.toml";

/// Options of `ubimap init`.
#[derive(Args, Clone, Debug)]
pub struct InitOptions {
    /// The folder; it is created if it does not exist
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
}

/// Writes a commented deployment into a folder. Returns the file.
///
/// # Errors
/// [`RunError::Deployment`] if there is one already, or the folder can't be written.
pub fn run(options: &InitOptions) -> Result<PathBuf, RunError> {
    let path = options.folder.join(FILE);
    let written = fs::create_dir_all(&options.folder)
        .and_then(|()| OpenOptions::new().write(true).create_new(true).open(&path))
        .and_then(|mut file| file.write_all(EXAMPLE.as_bytes()));
    match written {
        Ok(()) => Ok(path),
        Err(error) => Err(RunError::Deployment { path, reason: error.to_string() }),
    }
}
