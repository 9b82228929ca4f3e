//! Recorded data: where it is, and what its absence means.
//!
//! The unit tests of `sim-host` include this file as well.

use std::{
    env,
    io::{self, Write},
    path::PathBuf,
};

/// The path of a file or folder of the recorded data, in the folder that `UBIMAP_DATA` names
/// (default: `shared/data` beside the checkout).
///
/// If it is absent, writes one line to stderr and returns `None`; the test is then to return.
///
/// # Panics
///
/// If it is absent under CI (`CI` is set), unless `UBIMAP_DATA` is `none`.
pub fn file(name: &str) -> Option<PathBuf> {
    let folder = env::var_os("UBIMAP_DATA");
    let is_declined = folder.as_ref().is_some_and(|folder| folder == "none");
    let default = || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let path = folder.map_or_else(default, PathBuf::from).join(name);
    if !is_declined && path.exists() {
        return Some(path);
    }
    let message = if is_declined {
        format!("skipped: recorded data {name} (UBIMAP_DATA=none)")
    } else {
        format!("skipped: no recorded data at {} (UBIMAP_DATA names its folder)", path.display())
    };
    assert!(is_declined || env::var_os("CI").is_none(), "{message}; UBIMAP_DATA=none skips it");
    // Not `eprintln`, whose output the test harness captures.
    let _ = writeln!(io::stderr(), "{message}");
    None
}
