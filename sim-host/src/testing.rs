//! Test support: recorded data, and temporary folders.

use std::path::{Path, PathBuf};

/// A file or folder of the recorded data, in `../shared/data` beside the repository or where
/// `UBIMAP_DATA` points. If it is missing, prints a line and returns `None`.
pub(crate) fn shared_data(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("UBIMAP_DATA").map(PathBuf::from);
    // Tests run in the folder of their package.
    let path = root.unwrap_or_else(|| PathBuf::from("../../shared/data")).join(name);
    if path.exists() {
        Some(path)
    } else {
        eprintln!("skipped: no recorded data {name} (set UBIMAP_DATA to its folder)");
        None
    }
}

/// A test's temporary folder, removed when dropped.
pub(crate) struct Folder(PathBuf);

impl Folder {
    /// Creates an empty folder; `name` distinguishes the tests of one run.
    pub(crate) fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("ubimap-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    /// The folder's path.
    pub(crate) fn path(&self) -> &Path {
        &self.0
    }

    /// Writes a file, creating parent folders, and returns its path.
    pub(crate) fn file(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, bytes).unwrap();
        path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}
