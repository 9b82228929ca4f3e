//! The capture and arrival times of recorded frames: `times.txt`.

use std::{collections::BTreeMap, path::Path};

use super::error::FramesError;
use crate::recording::{
    error::Field,
    lines::{Lines, number},
    numbered_files::{PICTURE_KINDS, digits_of, number_in},
    time_stamps,
};

/// The name of the file of times.
pub(super) const TIMES_FILE: &str = "times.txt";

/// Maximum time stamp in seconds: a larger one is probably in milliseconds or a smaller unit.
const MAX_TIME_S: f64 = 1e11;
/// Maximum time in seconds between frames, between capture and arrival, and between the starts of
/// cameras. A longer time means that clocks differ, or that a clock was set.
pub(super) const MAX_SPAN_S: f64 = 86_400.0;

/// The times of a frame, in seconds of the recording's clock.
#[derive(Clone, Copy, Debug)]
pub(super) struct FrameTime {
    pub(super) captured_s: f64,
    pub(super) arrived_s: f64,
}

/// The times of a camera's frames, by number.
pub(super) type FrameTimes = BTreeMap<u128, FrameTime>;

/// Reads a file of times. `None` if there is no such file.
pub(super) fn read(path: &Path) -> Result<Option<FrameTimes>, FramesError> {
    if !path.is_file() {
        return Ok(None);
    }
    let fault = |line, reason| FramesError::Time { path: path.to_owned(), line, reason };
    let (mut times, mut written) = (FrameTimes::new(), BTreeMap::new());
    let mut lines = Lines::open(path)?;
    while let Some(line) = lines.next() {
        let (at, text) = line?;
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        if words.first().is_none_or(|word| word.starts_with('#')) {
            continue;
        }
        let (frame, time) = parse(&words).map_err(|reason| fault(at, reason))?;
        times.insert(frame, time);
        if let Some(other) = written.insert(frame, at) {
            return Err(fault(at, format!("frame {frame} again, after line {other}")));
        }
    }
    let in_order = times.iter().zip(times.iter().skip(1));
    for ((_, FrameTime { captured_s: last, .. }), (frame, FrameTime { captured_s, .. })) in in_order
    {
        if captured_s <= last {
            let reason = format!(
                "frame {frame} was captured at {captured_s} s, and the one before it at {last} s; \
                 later frames need higher numbers, and a clock that is not set back"
            );
            return Err(fault(written[frame], reason));
        }
        if captured_s - last > MAX_SPAN_S {
            let reason = format!(
                "frame {frame} was captured at {captured_s} s, and the one before it at {last} s: \
                 more than a day apart; a clock was set, or these are two recordings"
            );
            return Err(fault(written[frame], reason));
        }
    }
    Ok(Some(times))
}

/// Parses `NUMBER CAPTURED [ARRIVED]`, where the number may be the name of an image.
fn parse(words: &[&str]) -> Result<(u128, FrameTime), String> {
    let (name, captured, arrived) = match *words {
        [name, captured] => (name, captured, captured),
        [name, captured, arrived] => (name, captured, arrived),
        _ => {
            let reason = "a line has the frame's number, when it was captured, and perhaps when it \
                          arrived, both in seconds";
            return Err(reason.to_owned());
        }
    };
    let (captured_s, arrived_s) = (seconds(captured)?, seconds(arrived)?);
    if arrived_s < captured_s {
        return Err(format!("arrived at {arrived_s} s, before it was captured at {captured_s} s"));
    }
    if arrived_s - captured_s > MAX_SPAN_S {
        return Err(format!(
            "arrived at {arrived_s} s, a day after it was captured at {captured_s} s"
        ));
    }
    let file = Path::new(name);
    let is_image = file.extension().is_some_and(|it| PICTURE_KINDS.iter().any(|kind| it == *kind));
    let frame = if is_image { number_in(file) } else { digits_of(name) };
    Ok((frame, FrameTime { captured_s, arrived_s }))
}

fn seconds(word: &str) -> Result<f64, String> {
    let value = number(word, Field::Named("time")).map_err(|fault| fault.to_string())?;
    if (0.0..MAX_TIME_S).contains(&value) {
        Ok(value)
    } else {
        Err(format!("{value} is no time in seconds, from 0 to {MAX_TIME_S}"))
    }
}

/// The times of frames if there is no file of times, and a note for the user. The times are the
/// time stamps of the poses if there is one for each frame, otherwise they are one second apart.
pub(super) fn by_rule(
    frames: impl ExactSizeIterator<Item = u128>,
    stamps: Option<Vec<f64>>,
) -> (FrameTimes, Option<String>) {
    let stamps = stamps.filter(|stamps| stamps.len() == frames.len());
    let (times, note) = time_stamps::repair(stamps.as_deref(), frames.len());
    let seconds = times.into_iter().map(|time| time.micros() as f64 / 1e6);
    let times = seconds.map(|time| FrameTime { captured_s: time, arrived_s: time });
    (frames.zip(times).collect(), note)
}
