//! Finds recorded data.

use std::{
    env,
    io::{self, Read, Write},
    path::PathBuf,
};

use flate2::read::GzDecoder;

/// A file of the recorded data; if it is missing, prints a line and returns `None`.
pub fn file(name: &str) -> Option<PathBuf> {
    let folder = env::var_os("UBIMAP_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"),
        PathBuf::from,
    );
    let path = folder.join(name);
    if path.exists() {
        return Some(path);
    }
    // Not `eprintln`, whose output the test harness captures.
    let _ = writeln!(
        io::stderr(),
        "skipped: no recorded data at {} (set UBIMAP_DATA to its folder)",
        path.display()
    );
    None
}

/// The text of a gzipped file.
pub fn text(path: &std::path::Path) -> std::io::Result<String> {
    let mut text = String::new();
    GzDecoder::new(std::fs::File::open(path)?).read_to_string(&mut text)?;
    Ok(text)
}
