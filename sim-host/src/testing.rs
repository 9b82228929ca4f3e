//! Test support: recorded data, and temporary folders.

use std::path::{Path, PathBuf};

#[path = "../../tests/src/data.rs"]
#[expect(unreachable_pub, reason = "public in `tests`, whose file it is")]
mod data;

pub(crate) use data::{file as shared_data, frames as shared_frames};

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
