//! The calibration of a recorded camera whose folder states none: it is in the `cameras.toml`
//! beside the folder, under the name of the folder.

use std::path::Path;

use super::error::LogError;
use crate::{
    camera::{CAMERAS_FILE, CamerasFile, MountedCamera},
    files,
};

/// The camera with the name of `folder` in the `cameras.toml` of the parent folder. `None` if there
/// is no such file or no such camera.
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
