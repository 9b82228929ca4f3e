//! The images in a folder, ordered by the numbers in their names.

use std::path::{Path, PathBuf};

use super::error::LogError;

/// The extensions of files that are read as pictures.
pub(super) const PICTURE_KINDS: [&str; 7] = ["png", "jpg", "jpeg", "bmp", "ppm", "pgm", "pnm"];

/// The depth images in a folder or its subfolder `depth`, ordered by the numbers in their names.
pub(super) fn depth_images(folder: &Path) -> Result<Vec<PathBuf>, LogError> {
    let inner = folder.join("depth");
    let place = if inner.is_dir() { inner } else { folder.to_owned() };
    let images = files_in(&place, &["png", "pgm"])?;
    if images.is_empty() {
        return Err(LogError::Empty { path: place, record: "depth image (.png or .pgm)" });
    }
    Ok(images)
}

/// The files in a folder with one of these extensions, ordered by the numbers in their names.
pub(super) fn files_in(folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>, LogError> {
    let io_error = |error| LogError::Io { path: folder.to_owned(), error };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io_error)? {
        let path = entry.map_err(io_error)?.path();
        let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
        if extensions.iter().any(|known| extension == *known) && path.is_file() {
            files.push(path);
        }
    }
    files.sort_by_cached_key(|path| (number_in(path), path.clone()));
    Ok(files)
}

/// The number in a file's name: all digits before its extension.
pub(super) fn number_in(path: &Path) -> u128 {
    digits_of(&path.file_stem().unwrap_or_default().to_string_lossy())
}

/// All digits of a text as one number; 0 if there are none, or too many.
pub(super) fn digits_of(text: &str) -> u128 {
    let digits: String = text.chars().filter(char::is_ascii_digit).collect();
    digits.parse().unwrap_or(0)
}
