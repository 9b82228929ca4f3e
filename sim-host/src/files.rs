//! Reading input files, with a limit on their size: the one place where they are opened.
//!
//! Devices and pipes are refused before they are opened: some never end, others block.

use std::{
    fs::{self, File},
    io::{self, Read},
    path::Path,
};

/// Maximum size of a file of settings in bytes: a scenario, intrinsics, the header of a map.
pub(crate) const MAX_SETTINGS: u64 = 4 << 20;

/// Opens a regular file of at most `limit` bytes. The limit does not apply to bytes that are added
/// to the file later.
pub(crate) fn open(path: &Path, limit: u64) -> io::Result<File> {
    let metadata = fs::metadata(path)?;
    if metadata.is_dir() {
        return Err(io::Error::other("is a folder; a file is needed"));
    }
    if !metadata.is_file() {
        return Err(io::Error::other("is a device or a pipe; a regular file is needed"));
    }
    if metadata.len() > limit {
        return Err(too_large(limit));
    }
    File::open(path)
}

/// The content of a regular file of at most `limit` bytes.
pub(crate) fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    // Some files, such as those in `/proc`, contain more than their size says.
    open(path, limit)?.take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit { Err(too_large(limit)) } else { Ok(bytes) }
}

/// The text of a file of settings.
pub(crate) fn read_settings(path: &Path) -> io::Result<String> {
    let bytes = read(path, MAX_SETTINGS)?;
    String::from_utf8(bytes)
        .map_err(|_| io::Error::other("not a text file, where settings are expected"))
}

/// What is wrong with a text in TOML, in one line that names its line.
pub(crate) fn toml_fault(error: &toml::de::Error, text: &str) -> String {
    let before = error.span().map_or(0, |span| span.start.min(text.len()));
    let line = 1 + text.as_bytes()[..before].iter().filter(|it| **it == b'\n').count();
    format!("line {line}: {}", error.message().lines().collect::<Vec<_>>().join(" "))
}

/// The error of content that exceeds a limit.
pub(crate) fn too_large(limit: u64) -> io::Error {
    io::Error::other(format!("larger than {} MB, the limit for such a file", limit >> 20))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Folder;

    #[test]
    fn only_regular_files_within_the_limit_are_read() {
        let folder = Folder::new("files");
        let path = folder.file("some", &[b'x'; 100]);
        assert_eq!(read(&path, 100).unwrap().len(), 100);
        let error = |path: &Path| read(path, 99).unwrap_err().to_string();
        assert!(error(&path).contains("larger than"));
        assert!(error(folder.path()).contains("is a folder"));
        if cfg!(target_os = "linux") {
            assert!(error(Path::new("/dev/zero")).contains("a device or a pipe"));
            // The size of such files is reported as zero.
            assert!(error(Path::new("/proc/self/smaps")).contains("larger than"));
        }
        assert_eq!(
            read(&folder.path().join("none"), 1).unwrap_err().kind(),
            io::ErrorKind::NotFound
        );
    }
}
