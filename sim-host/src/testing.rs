//! What tests need: the recorded data of others, and folders that clean up after themselves.

use std::path::{Path, PathBuf};

/// A file or folder of the recorded data, at `../shared/data` beside the repository or where
/// `UBIMAP_DATA` points; says so and gives `None` where there is none.
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
