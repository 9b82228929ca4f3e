//! The file `robots.toml`: the robots and their markers ([`Registry`]).

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::RunError;
use crate::{deployment::registry::Registry, files, recording::LogError};

/// The name of the file.
pub(super) const FILE: &str = "robots.toml";

/// Reads a file.
///
/// # Errors
/// [`RunError::Robots`], and [`RunError::Log`] for a file that can't be read.
pub(super) fn read(path: &Path) -> Result<Registry, RunError> {
    let text = files::read_settings(path)
        .map_err(|error| LogError::Io { path: path.to_owned(), error })?;
    Registry::from_toml(&text)
        .map_err(|fault| RunError::Robots { path: path.to_owned(), reason: fault.to_string() })
}

/// Reads the registry of a recording: from the file `named`, or from the only such file in its
/// folders. If there is no file, the registry is empty.
///
/// # Errors
/// Every error of [`read`].
pub(super) fn find(named: Option<&Path>, folders: &[PathBuf]) -> Result<Registry, RunError> {
    let there = folders.iter().map(|folder| folder.join(FILE)).filter(|path| path.is_file());
    let there: Vec<PathBuf> = there.collect();
    match (named, &there[..]) {
        (Some(path), _) => read(path),
        (None, [path]) => read(path),
        (None, []) => {
            log::info!("no {FILE} found, so no marker belongs to a robot; see --robots");
            Ok(Registry::default())
        }
        (None, [first, path, ..]) => {
            let reason =
                format!("{} exists as well; name one of them with --robots", first.display());
            Err(RunError::Robots { path: path.clone(), reason })
        }
    }
}

/// Writes the file into a folder.
///
/// # Errors
/// [`RunError::Log`].
pub(super) fn write(registry: &Registry, folder: &Path) -> Result<(), RunError> {
    let path = folder.join(FILE);
    let written = fs::write(&path, registry.to_toml());
    Ok(written.map_err(|error| LogError::Io { path, error })?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    const ONE: &str = "[[robots]]\nid = 1\nmarker_size_m = 0.1\nheight_m = 0.3\n";

    #[test]
    fn a_written_registry_is_read_back() {
        let folder = Folder::new("registry");
        let path = folder.file(FILE, ONE.as_bytes());
        let folders = [folder.path().to_owned()];
        let registry = find(None, &folders).unwrap();
        assert_eq!(registry.robots.len(), 1);
        fs::remove_file(path).unwrap();
        assert_eq!(find(None, &folders).unwrap(), Registry::default());
        write(&registry, folder.path()).unwrap();
        assert_eq!(find(None, &folders).unwrap(), registry);
    }

    #[test]
    fn errors_name_the_file_and_two_files_are_ambiguous() {
        let folder = Folder::new("registry-faults");
        let path = folder.file(FILE, ONE.replace("0.3", "nan").as_bytes());
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("robots.toml: robot 1: height_m: NaN must be"), "{error}");
        let other = folder.file("other/robots.toml", ONE.as_bytes());
        let folders = [folder.path().to_owned(), folder.path().join("other")];
        let error = find(None, &folders).unwrap_err().to_string();
        assert!(error.contains("name one of them with --robots"), "{error}");
        assert!(find(Some(&other), &folders).is_ok());
    }
}
