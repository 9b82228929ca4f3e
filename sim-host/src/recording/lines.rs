//! Reads the numbered lines of a text file, plain or gzipped.

use std::{
    io::{BufRead, BufReader, Read},
    path::{Path, PathBuf},
};

use flate2::bufread::MultiGzDecoder;

use super::error::{Field, LineFault, LogError};
use crate::files;

/// Maximum length of a line in bytes. A file with a longer line is not a log, and the line is not
/// read into memory.
const MAX_LINE: usize = 1 << 20;

/// Maximum size of a log in bytes, both compressed and uncompressed. In memory, its readings take
/// several times as much.
const MAX_LOG: u64 = 256 << 20;

const GZIP_MAGIC: [u8; 2] = [0x1F, 0x8B];

/// Reads a file line by line.
pub(super) struct Lines {
    path: PathBuf,
    reader: Box<dyn BufRead>,
    gzipped: bool,
    number: usize,
    line: Vec<u8>,
    /// Number of uncompressed bytes read so far.
    read: u64,
}

impl Lines {
    /// Opens a file, and detects by its first bytes whether it is gzipped.
    pub(super) fn open(path: &Path) -> Result<Self, LogError> {
        let io_error = |error| LogError::Io { path: path.to_owned(), error };
        let mut file = BufReader::new(files::open(path, MAX_LOG).map_err(io_error)?);
        let gzipped = file.fill_buf().map_err(io_error)?.starts_with(&GZIP_MAGIC);
        let reader: Box<dyn BufRead> = if gzipped {
            Box::new(BufReader::new(MultiGzDecoder::new(file)))
        } else {
            Box::new(file)
        };
        Ok(Self { path: path.to_owned(), reader, gzipped, number: 0, line: Vec::new(), read: 0 })
    }

    /// The next line with its number, from 1; `None` at the end.
    pub(super) fn next(&mut self) -> Option<Result<(usize, &str), LogError>> {
        self.line.clear();
        let mut limited = self.reader.by_ref().take(MAX_LINE as u64 + 1);
        let read = limited.read_until(b'\n', &mut self.line);
        match read {
            Ok(0) => return None,
            Ok(_) => self.number += 1,
            Err(error) => {
                let path = self.path.clone();
                return Some(Err(if self.gzipped {
                    LogError::Gzip { path, line: self.number, error }
                } else {
                    LogError::Io { path, error }
                }));
            }
        }
        self.read += self.line.len() as u64;
        if self.read > MAX_LOG {
            return Some(Err(LogError::Io {
                path: self.path.clone(),
                error: files::too_large(MAX_LOG),
            }));
        }
        if self.line.len() > MAX_LINE {
            return Some(Err(self.fault(LineFault::TooLong(MAX_LINE))));
        }
        match std::str::from_utf8(&self.line) {
            Ok(text) => Some(Ok((self.number, text))),
            Err(_) => Some(Err(self.fault(LineFault::NotText))),
        }
    }

    fn fault(&self, fault: LineFault) -> LogError {
        LogError::Line { path: self.path.clone(), line: self.number, fault }
    }
}

/// Parses a finite number.
pub(super) fn number(text: &str, field: Field) -> Result<f64, LineFault> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => {
            let text = text.chars().take(24).collect();
            Err(LineFault::NotANumber { field, text })
        }
    }
}

/// Parses a reading, a finite number that is not negative, in the unit of the file. `index` is its
/// number in the scan, for errors.
pub(super) fn reading(text: &str, index: usize) -> Result<f64, LineFault> {
    let value = number(text, Field::Reading(index))?;
    if value < 0.0 {
        let field = Field::Reading(index);
        return Err(LineFault::OutOfRange { field, value, reason: "negative" });
    }
    Ok(value)
}

/// Checks a coordinate of a pose, in metres: more than a thousand kilometres are an error.
pub(super) fn coordinate(value: f64, field: Field) -> Result<f64, LineFault> {
    const FARTHEST_M: f64 = 1e6;
    if value.abs() > FARTHEST_M {
        let reason = "more than a thousand kilometres away";
        return Err(LineFault::OutOfRange { field, value, reason });
    }
    Ok(value)
}
