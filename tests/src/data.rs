//! Where recorded data is, if it is there.

use std::{
    env,
    io::{self, Read, Write},
    path::PathBuf,
};

use flate2::read::GzDecoder;

/// A file of the shared data, or `None`, said in one line, where it is absent.
pub fn file(name: &str) -> Option<PathBuf> {
    let folder = env::var_os("UBIMAP_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"),
        PathBuf::from,
    );
    let path = folder.join(name);
    if path.exists() {
        return Some(path);
    }
    // Not `eprintln`, whose output the test harness keeps from the user.
    let _ = writeln!(
        io::stderr(),
        "left out: no recorded data at {} (UBIMAP_DATA names its folder)",
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
