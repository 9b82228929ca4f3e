//! `ubimap decode`: captured bytes, frame by frame.

use std::path::PathBuf;

use clap::Args;
use ubimap_protocol::frame::{Direction, SessionId};

use super::RunError;
use crate::{conformance::Describer, files};

/// Maximum size of a capture in bytes.
const MAX_CAPTURE: u64 = 256 << 20;

/// Options of `ubimap decode`.
#[derive(Args, Clone, Debug)]
pub struct DecodeOptions {
    /// A file of captured bytes, raw or in hexadecimal digits, or the digits themselves
    #[arg(required = true, value_name = "FILE|HEX")]
    pub capture: Vec<String>,

    /// All frames go to the server; without this and --to-robot, the seals tell
    #[arg(long, conflicts_with = "to_robot")]
    pub to_server: bool,

    /// All frames go to the robot
    #[arg(long)]
    pub to_robot: bool,

    /// The session, in hexadecimal digits; sessions of Welcomes in the capture are known without
    #[arg(long, value_name = "HEX", value_parser = session)]
    pub session: Option<SessionId>,
}

fn session(text: &str) -> Result<SessionId, String> {
    let digits = text.trim_start_matches("0x");
    u32::from_str_radix(digits, 16)
        .map(SessionId)
        .map_err(|_| "not a session; give up to 8 hexadecimal digits".into())
}

/// Describes the capture.
///
/// # Errors
/// [`RunError::Capture`] if it can't be read.
pub fn run(options: &DecodeOptions) -> Result<String, RunError> {
    let bytes = read(&options.capture)?;
    let direction = match (options.to_server, options.to_robot) {
        (true, _) => Some(Direction::ToServer),
        (_, true) => Some(Direction::ToRobot),
        _ => None,
    };
    let mut describer = Describer::new(options.session, direction);
    describer.learn(&bytes);
    Ok(describer.describe(&bytes))
}

/// The bytes of one file, or of hexadecimal digits.
fn read(capture: &[String]) -> Result<Vec<u8>, RunError> {
    let text = capture.join(" ");
    let fault = |reason: String| RunError::Capture { name: text.clone(), reason };
    let path = PathBuf::from(&text);
    if !path.exists() {
        return digits(text.as_bytes())
            .ok_or_else(|| fault("neither a file nor hexadecimal digits".into()));
    }
    let bytes = files::read(&path, MAX_CAPTURE).map_err(|error| fault(error.to_string()))?;
    Ok(digits(&bytes).unwrap_or(bytes))
}

/// Bytes as pairs of hexadecimal digits, with any white space between them.
fn digits(text: &[u8]) -> Option<Vec<u8>> {
    let digits: Vec<u8> = text.iter().copied().filter(|it| !it.is_ascii_whitespace()).collect();
    let value = |digit: u8| char::from(digit).to_digit(16).map(|it| it as u8);
    if digits.is_empty() || digits.len() % 2 == 1 {
        return None;
    }
    digits.chunks(2).map(|pair| Some(value(pair[0])? << 4 | value(pair[1])?)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_are_read_in_pairs_and_nothing_else_is() {
        assert_eq!(digits(b"0a 0B\nff"), Some(vec![10, 11, 255]));
        assert_eq!(digits(b"0a0"), None);
        assert_eq!(digits(&[0x02, 0x10, 0x00]), None);
        assert_eq!(digits(b""), None);
    }
}
