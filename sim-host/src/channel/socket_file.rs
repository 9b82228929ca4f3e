//! The file of a socket, which goes when nobody listens there any more.

use std::{fs, path::PathBuf};

/// The file of a Unix socket. It is removed when this is dropped; a process that is killed leaves it, and the
/// next one replaces it.
#[derive(Debug)]
pub struct SocketFile(PathBuf);

impl SocketFile {
    /// The file at a path where this process listens.
    pub(super) fn new(path: PathBuf) -> Self {
        Self(path)
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        // Somebody may have removed it by hand.
        let _ = fs::remove_file(&self.0);
    }
}
