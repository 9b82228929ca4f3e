//! `ubimap init`: a deployment to begin with.

use std::{
    fs::{self, OpenOptions},
    io::{ErrorKind, Write},
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
        Err(error) if error.kind() == ErrorKind::AlreadyExists && path.exists() => {
            let reason =
                "exists, and is left as it is; name another folder, or edit the file".into();
            Err(RunError::Deployment { path, reason })
        }
        Err(error) => Err(RunError::Deployment { path, reason: error.to_string() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    #[test]
    fn a_deployment_is_written_once() {
        let folder = Folder::new("init");
        let lab = folder.path().join("new/lab");
        let options = InitOptions { folder: lab.clone() };
        let path = run(&options).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), EXAMPLE);
        fs::write(&path, "mine").unwrap();
        let error = run(&options).unwrap_err().to_string();
        assert!(error.contains("exists, and is left as it is"), "{error}");
        assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
        let inside_a_file = InitOptions { folder: path.join("lab") };
        assert!(run(&inside_a_file).unwrap_err().to_string().contains("deployment.toml"));
    }
}
