//! The pose of a recorded camera where its folder states none: from the `cameras.toml` beside it, by
//! the name of the folder.

use std::path::Path;

use super::error::LogError;
use crate::{
    camera::{CAMERAS_FILE, CamerasFile, MountedCamera},
    files,
};

/// The camera of this folder's name in the `cameras.toml` of the folder above, if both are there.
pub(super) fn mounted(folder: &Path) -> Result<Option<MountedCamera>, LogError> {
    let above = folder.parent().unwrap_or(Path::new("")).join(CAMERAS_FILE);
    if !above.is_file() {
        return Ok(None);
    }
    let text = files::read_settings(&above)
        .map_err(|error| LogError::Io { path: above.clone(), error })?;
    let file =
        CamerasFile::parse(&text).map_err(|reason| LogError::Cameras { path: above, reason })?;
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    Ok(file.named(&name).cloned())
}
