//! Reads a log of any format.

use std::path::{Path, PathBuf};

use super::{carmen, join::concatenate, mines, rgbd, scan_log::Log, slicing::Slicing};
use crate::recording::{error::LogError, format::Format, lines::Lines};

/// Reads a log. If `format` is `None`, the format is detected: a folder contains depth images, a
/// file that begins with a word is CARMEN text, and one that begins with a number is a mines log.
/// `slicing` applies only to depth images.
///
/// # Errors
/// Every [`LogError`] except [`LogError::Mixed`].
pub fn read(path: &Path, format: Option<Format>, slicing: Slicing) -> Result<Log, LogError> {
    let is_folder = std::fs::metadata(path)
        .map_err(|error| LogError::Io { path: path.to_owned(), error })?
        .is_dir();
    let format = match format {
        Some(format) => format,
        None if is_folder => Format::Rgbd,
        None => detect(path)?,
    };
    if is_folder != (format == Format::Rgbd) {
        let expected = if is_folder { "file" } else { "folder" };
        return Err(LogError::Kind { path: path.to_owned(), format, expected });
    }
    match format {
        Format::Carmen => carmen::read(path),
        Format::Mines => mines::read(path),
        Format::Rgbd => rgbd::read(path, slicing),
    }
}

/// Reads several logs of one sensor and joins them; see [`concatenate`].
///
/// # Errors
/// Every [`LogError`].
pub fn read_all(
    paths: &[PathBuf],
    format: Option<Format>,
    slicing: Slicing,
) -> Result<Log, LogError> {
    let logs: Result<Vec<_>, _> =
        paths.iter().map(|path| Ok((path.clone(), read(path, format, slicing)?))).collect();
    concatenate(logs?)
}

/// Detects a text format by the first word that is not a comment.
fn detect(path: &Path) -> Result<Format, LogError> {
    let mut lines = Lines::open(path)?;
    let unknown = || LogError::UnknownFormat { path: path.to_owned() };
    while let Some(line) = lines.next() {
        let text = match line {
            Ok((_, text)) => text,
            // Binary data is not a log.
            Err(LogError::Line { .. }) => return Err(unknown()),
            Err(error) => return Err(error),
        };
        let Some(word) = text.split_ascii_whitespace().next() else { continue };
        if word.starts_with('#') {
            continue;
        }
        return if word.parse::<f64>().is_ok_and(f64::is_finite) {
            Ok(Format::Mines)
        } else if carmen::is_record_kind(word) {
            Ok(Format::Carmen)
        } else {
            Err(unknown())
        };
    }
    Err(unknown())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::testing::Folder;

    #[test]
    fn formats_are_detected_by_content() {
        let folder = Folder::new("log-detect");
        for (bytes, format) in [
            (&b"# c\n\nPARAM x 1 h 0\nFLASER"[..], Some(Format::Carmen)),
            (b"1234 5 6", Some(Format::Mines)),
            (b"\x89PNG\r\n", None),
            (b"{\"a\": 1}", None),
            (b"", None),
        ] {
            let path = folder.file("some.log", bytes);
            match format {
                Some(format) => assert_eq!(detect(&path).unwrap(), format),
                None => assert!(matches!(
                    read(&path, None, Slicing::default()),
                    Err(LogError::UnknownFormat { .. })
                )),
            }
        }
        let carmen_as_folder =
            read(folder.path(), Some(Format::Carmen), Slicing::default()).unwrap_err();
        assert!(carmen_as_folder.to_string().ends_with("a log of the format carmen is a file"));
        assert!(matches!(
            read(&folder.path().join("none"), None, Slicing::default()),
            Err(LogError::Io { .. })
        ));
    }

    #[test]
    fn a_truncated_gzip_names_the_last_line() {
        use std::io::Write;
        let line = "FLASER 2 1 1 0 0 0 0 0 0\n";
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::none());
        encoder.write_all(line.repeat(100).as_bytes()).unwrap();
        let bytes = encoder.finish().unwrap();
        let folder = Folder::new("log-gzip");
        assert_eq!(
            read(&folder.file("whole.gz", &bytes), None, Slicing::default()).unwrap().scans.len(),
            100
        );
        let cut = read(&folder.file("cut.gz", &bytes[..bytes.len() - 9]), None, Slicing::default())
            .unwrap_err();
        assert!(matches!(cut, LogError::Gzip { line: 99.., .. }), "{cut}");
        assert!(cut.to_string().contains("cut.gz:"));
        let mut damaged = bytes.clone();
        damaged[500] ^= 0x01;
        assert!(read(&folder.file("damaged.gz", &damaged), None, Slicing::default()).is_err());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// Any file content must give a log, or an error of one line.
        #[test]
        fn garbled_files_never_panic(
            at in any::<prop::sample::Index>(),
            byte in any::<u8>(),
            length in any::<prop::sample::Index>(),
            format in prop::sample::select(vec![Format::Carmen, Format::Mines]),
        ) {
            let folder = Folder::new(&format!("log-garbled-{format}"));
            let mut bytes = match format {
                Format::Mines => {
                    let mut line = vec!["1"; 707].join(" ");
                    line.push('\n');
                    line.repeat(3).into_bytes()
                }
                _ => b"PARAM robot_front_laser_max 80 h 0\n\
                       FLASER 3 1.5 81.83 0.2 1 2 3 1 2 3 0.5 h 0.5\n\
                       FLASER 3 1.5 81.83 0.2 1 2 3 1 2 3 0.7 h 0.7\n".to_vec(),
            };
            let at = at.index(bytes.len());
            bytes[at] = byte;
            bytes.truncate(length.index(bytes.len() + 1));
            for format in [Some(format), None] {
                match read(&folder.file("garbled.log", &bytes), format, Slicing::default()) {
                    Ok(log) => prop_assert!(!log.scans.is_empty()),
                    Err(error) => prop_assert_eq!(error.to_string().lines().count(), 1),
                }
            }
        }
    }
}
