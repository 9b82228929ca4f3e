//! What tests need: the recorded data of others, and folders that clean up after themselves.

use std::path::{Path, PathBuf};

#[path = "../../tests/src/data.rs"]
#[expect(unreachable_pub, reason = "public in `tests`, whose file it is")]
mod data;

pub(crate) use data::file as shared_data;

/// A folder of one test's own, gone when the test is over.
pub(crate) struct Folder(PathBuf);

impl Folder {
    /// A new, empty folder; `name` tells the tests of one run apart.
    pub(crate) fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("ubimap-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    /// Where it is.
    pub(crate) fn path(&self) -> &Path {
        &self.0
    }

    /// Writes a file, with the folders on its way, and returns its path.
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
