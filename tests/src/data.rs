//! Recorded data: where it is, and what happens if it is missing.
//!
//! The unit tests of `sim-host` include this file as well.

use std::{
    env, fs,
    io::{self, Write},
    path::{Path, PathBuf},
};

/// The path of a file or folder of the recorded data, in the folder that `UBIMAP_DATA` names
/// (default: `shared/data` beside the checkout).
///
/// If it is missing, writes one line to stderr and returns `None`; the test should then return.
///
/// # Panics
///
/// If it is missing under CI (`CI` is set), unless `UBIMAP_DATA` is `none`.
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

/// Folders of recorded frames that come without intrinsics, with the intrinsics that the data's
/// README states.
const INTRINSICS: [(&str, &str); 2] = [
    (
        "rgbd_frames/icl_nuim",
        "width = 640\nheight = 480\nfx = 481.2\nfy = -480.0\ncx = 319.5\ncy = 239.5\n\
         depth_per_metre = 5000.0\n",
    ),
    (
        "rgbd_frames/handheld",
        "width = 640\nheight = 480\nfx = 518.0\nfy = 519.0\ncx = 325.5\ncy = 253.5\n",
    ),
];

/// A folder of recorded frames with their intrinsics. If it is a temporary copy, it is removed when
/// dropped.
pub struct Frames {
    path: PathBuf,
    is_copy: bool,
}

/// Opens a folder of recorded frames, with their intrinsics. `None` if it is missing, as for
/// [`file()`].
///
/// # Panics
///
/// If the folder can't be copied, and as [`file()`].
pub fn frames(name: &str) -> Option<Frames> {
    let path = file(name)?;
    let Some((_, text)) = INTRINSICS.into_iter().find(|(folder, _)| *folder == name) else {
        return Some(Frames { path, is_copy: false });
    };
    let copy = env::temp_dir().join(format!(
        "ubimap-{}-{:?}-{}",
        std::process::id(),
        std::thread::current().id(),
        name.replace('/', "-")
    ));
    fs::create_dir_all(copy.join("depth")).unwrap();
    fs::copy(path.join("pose.txt"), copy.join("pose.txt")).unwrap();
    for image in fs::read_dir(path.join("depth")).unwrap() {
        let image = image.unwrap();
        fs::copy(image.path(), copy.join("depth").join(image.file_name())).unwrap();
    }
    fs::write(copy.join("intrinsics.toml"), text).unwrap();
    Some(Frames { path: copy, is_copy: true })
}

impl Frames {
    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Frames {
    fn drop(&mut self) {
        if self.is_copy {
            let _ = fs::remove_dir_all(&self.path);
        }
    }
}
