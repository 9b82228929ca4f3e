//! The Sipeed MaixSense A010: a time-of-flight camera on a UART.
//!
//! | part of a frame | bytes |
//! |---|---|
//! | start | `00 FF` |
//! | length | 2, little-endian: 16 plus the number of pixels |
//! | header | 16, see below |
//! | pixels | one each, row by row from the top left |
//! | checksum | the sum of all bytes before it, modulo 256 |
//! | end | `DD` |
//!
//! The header: `FF`, output mode, two temperatures, exposure time (4), error code, `00`, rows,
//! columns, frame number (2), version, `FF`.
//!
//! A pixel is a depth in steps of the unit, or, with unit 0, the square of a fifth: `(p / 5.1)^2`
//! mm. The sensor is configured by AT commands, which end in `\r`; it answers `OK\r\n`.

use ubimap_protocol::time::{Duration, Instant};

use super::{
    cadence::{Cadence, Regularity},
    depth_sensor::{DepthSensor, Scan, SensorCounters},
};
use crate::sense::{SliceError, Slicer};

/// Length of the start, the length field and the header, in bytes.
const HEADER: usize = 20;

/// Length of the checksum and the end mark, in bytes.
const TAIL: usize = 2;

/// Maximum number of pixels per row.
const MAX_SIDE: usize = 100;

/// Bits per byte on the line: start bit, eight data bits, stop bit.
const BITS_PER_BYTE: u64 = 10;

/// Time for the answer to a command, after which the command is repeated.
const ANSWER_TIME: Duration = Duration::from_millis(300);

/// Number of times that a command is sent before the configuration goes on without an answer: the
/// sensor's answers can be lost between the pixels of a running stream.
const ATTEMPTS: u8 = 3;

/// Time without a frame after which the sensor is configured again.
const SILENCE: Duration = Duration::from_secs(2);

/// The resolution of the sensor: it joins 1, 2 by 2 or 4 by 4 pixels to one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Binning {
    /// 100 by 100 pixels.
    One,
    /// 50 by 50 pixels.
    Two,
    /// 25 by 25 pixels.
    Four,
}

impl Binning {
    /// The finest binning with which a port can carry this number of frames per second. `None` if
    /// the port is too slow for all of them.
    pub const fn for_port(baud: u32, frames_per_second: u8) -> Option<Self> {
        let [one, two, four] = [Self::One, Self::Two, Self::Four];
        // A loop over the array is not possible in a constant function.
        if one.is_carried(baud, frames_per_second) {
            Some(one)
        } else if two.is_carried(baud, frames_per_second) {
            Some(two)
        } else if four.is_carried(baud, frames_per_second) {
            Some(four)
        } else {
            None
        }
    }

    const fn is_carried(self, baud: u32, frames_per_second: u8) -> bool {
        let bits = self.frame_len() as u64 * BITS_PER_BYTE;
        bits * frames_per_second as u64 <= baud as u64
    }

    /// Number of rows, and of pixels per row.
    pub const fn side(self) -> usize {
        match self {
            Self::One => 100,
            Self::Two => 50,
            Self::Four => 25,
        }
    }

    /// Length of a frame in bytes.
    pub const fn frame_len(self) -> usize {
        HEADER + self.side() * self.side() + TAIL
    }

    /// The argument of `AT+BINN`.
    const fn argument(self) -> u8 {
        match self {
            Self::One => 1,
            Self::Two => 2,
            Self::Four => 4,
        }
    }
}

/// The configuration of an A010.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct A010Config {
    /// The resolution.
    pub binning: Binning,
    /// The step of a pixel in millimetres, 1 to 10; 0 for steps that grow with the distance.
    pub unit: u8,
    /// Frames per second, 1 to 19.
    pub frames_per_second: u8,
    /// The speed of the port in baud, from which the time of a frame's transmission follows.
    pub baud: u32,
    /// Time from the exposure of a frame to its first byte on the line.
    pub latency: Duration,
}

impl A010Config {
    /// The finest resolution at which a port carries ten frames per second (25 by 25 pixels at
    /// 115,200 baud), steps of 10 mm, and a latency of one frame. `None` if the port is too slow.
    pub const fn for_port(baud: u32) -> Option<Self> {
        match Binning::for_port(baud, 10) {
            None => None,
            Some(binning) => Some(Self {
                binning,
                unit: 10,
                frames_per_second: 10,
                baud,
                latency: Duration::from_millis(100),
            }),
        }
    }

    /// When frames come: documents state no jitter, and no error of the rate, so both are guesses.
    const fn regularity(&self) -> Regularity {
        let interval = match 1_000_000_u32.checked_div(self.frames_per_second as u32) {
            Some(interval) => interval,
            None => 0,
        };
        Regularity { interval, jitter: 20_000, error: 6_000 }
    }

    /// The time of a byte on the line, in 256ths of a microsecond.
    const fn byte_time(&self) -> u32 {
        match (BITS_PER_BYTE as u32 * 256_000_000).checked_div(self.baud) {
            Some(time) => time,
            None => 0,
        }
    }
}

/// A driver of the A010: it configures the sensor and reduces its frames to scans.
///
/// Rows are sliced as they arrive, so that no frame is ever held. A frame becomes a scan only when
/// its checksum is correct; a frame that is cut or damaged anywhere costs that scan and no other,
/// because a header is recognised at every byte.
#[derive(Debug)]
pub struct A010<'b> {
    config: A010Config,
    slicer: Slicer<'b>,
    setup: Setup,
    /// The newest bytes, for headers that begin anywhere.
    newest: [u8; HEADER],
    frame: Option<Frame>,
    /// The row of pixels that is arriving.
    row: [u16; MAX_SIDE],
    /// The number of the last complete frame.
    number: u16,
    cadence: Cadence,
    counters: SensorCounters,
}

/// The frame that is arriving.
#[derive(Clone, Copy, Debug)]
struct Frame {
    /// The frame's number, by which lost frames are counted.
    number: u16,
    /// Number of bytes after the header.
    received: usize,
    /// The sum of all bytes before the checksum.
    sum: u8,
    /// The earliest bound on the moment when the sensor began to send the frame.
    began: Instant,
}

/// The progress of the configuration.
#[derive(Clone, Copy, Debug)]
enum Setup {
    /// The command with this index waits for its answer; it was sent `attempts` times.
    Command { index: u8, attempts: u8, due: Instant },
    /// The sensor should be sending frames. `until`: it is configured again without one.
    Done { until: Instant },
}

/// Number of commands of the configuration.
const COMMANDS: u8 = 6;

impl<'b> A010<'b> {
    /// A driver that configures the sensor first.
    ///
    /// # Errors
    /// [`SliceError`]: the slicer is for frames of another width.
    pub fn new(config: A010Config, slicer: Slicer<'b>) -> Result<Self, SliceError> {
        let side = config.binning.side();
        if slicer.width() != side {
            return Err(SliceError::Width { expected: side, found: slicer.width() });
        }
        Ok(Self {
            config,
            slicer,
            setup: Setup::Command { index: 0, attempts: 0, due: Instant(0) },
            newest: [0; HEADER],
            frame: None,
            row: [0; MAX_SIDE],
            number: 0,
            cadence: Cadence::NEW,
            counters: SensorCounters::default(),
        })
    }

    /// The configuration.
    pub fn config(&self) -> &A010Config {
        &self.config
    }

    /// Processes a byte; `at` is the earliest bound on the moment when the sensor sent it. Returns
    /// the moment when the frame began to arrive if it is complete and undamaged.
    fn byte(&mut self, byte: u8, at: Instant) -> Option<Instant> {
        self.newest.copy_within(1.., 0);
        if let Some(last) = self.newest.last_mut() {
            *last = byte;
        }
        let done = self.frame.and_then(|frame| self.frame_byte(frame, byte, at));
        if done.is_none() && self.is_header() {
            if self.frame.is_some() {
                self.drop_frame();
            }
            let sum = self.newest.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte));
            let began = self.before(at, HEADER);
            let [.., n0, n1, _, _] = self.newest;
            let number = u16::from_le_bytes([n0, n1]);
            self.frame = Some(Frame { number, received: 0, sum, began });
        }
        done
    }

    /// Processes a byte of a frame after its header.
    fn frame_byte(&mut self, mut frame: Frame, byte: u8, at: Instant) -> Option<Instant> {
        let side = self.config.binning.side();
        let pixels = side * side;
        let place = frame.received;
        frame.received += 1;
        frame.began = frame.began.min(self.before(at, HEADER + frame.received));
        self.frame = Some(frame);
        if place < pixels {
            frame.sum = frame.sum.wrapping_add(byte);
            self.frame = Some(frame);
            let (row, column) = (place / side.max(1), place % side.max(1));
            if let Some(pixel) = self.row.get_mut(column) {
                *pixel = depth(byte, self.config.unit);
            }
            if column + 1 == side
                && let Some(readings) = self.row.get(..side)
                && self.slicer.line(row as u16, readings).is_err()
            {
                self.drop_frame();
            }
            return None;
        }
        if place == pixels {
            if byte != frame.sum {
                self.drop_frame();
            }
            return None;
        }
        if byte != END || !self.slicer.is_complete() {
            self.drop_frame();
            return None;
        }
        self.frame = None;
        let count = frame.number.wrapping_sub(self.number);
        self.number = frame.number;
        Some(self.cadence.moment(frame.began, count, &self.config.regularity()))
    }

    /// Drops the frame that is arriving.
    fn drop_frame(&mut self) {
        self.frame = None;
        self.slicer.discard();
        self.counters.torn = self.counters.torn.saturating_add(1);
    }

    /// When the first of `bytes` bytes, the last of which was sent at `at`, was begun.
    fn before(&self, at: Instant, bytes: usize) -> Instant {
        let time = u64::from(self.config.byte_time()) * bytes as u64;
        Instant(at.0.saturating_sub(time >> 8))
    }

    /// Whether the newest bytes are the header of a frame with the configured resolution.
    fn is_header(&self) -> bool {
        let side = self.config.binning.side();
        let [low, high] = ((side * side + HEADER - 4) as u16).to_le_bytes();
        let [s0, s1, l0, l1, m0, mode, _, _, _, _, _, _, error, m1, rows, columns, _, _, _, m2] =
            self.newest;
        [s0, s1, l0, l1] == [0x00, 0xFF, low, high]
            && [m0, mode, error, m1, m2] == [0xFF, 0, 0, 0, 0xFF]
            && [usize::from(rows), usize::from(columns)] == [side; 2]
    }

    /// Whether the newest bytes are the answer to a command.
    fn is_answer(&self) -> bool {
        self.newest.ends_with(b"OK\r\n")
    }

    /// Goes on to the next command of the configuration.
    fn answered(&mut self, now: Instant) {
        if let Setup::Command { index, attempts: 1.., .. } = self.setup {
            self.setup = next_command(index, now);
        }
    }
}

/// The last byte of a frame.
const END: u8 = 0xDD;

fn next_command(index: u8, now: Instant) -> Setup {
    if index + 1 < COMMANDS {
        Setup::Command { index: index + 1, attempts: 0, due: now }
    } else {
        Setup::Done { until: now + SILENCE }
    }
}

/// The depth of a pixel in millimetres; 0 if the sensor has none there, or one beyond its range.
fn depth(pixel: u8, unit: u8) -> u16 {
    match (pixel, unit) {
        (0 | u8::MAX, _) => 0,
        // (p / 5.1)^2 = p^2 * 100 / 2601.
        (_, 0) => ((u32::from(pixel) * u32::from(pixel) * 100 + 1_300) / 2_601) as u16,
        (_, unit) => u16::from(pixel) * u16::from(unit),
    }
}

impl DepthSensor for A010<'_> {
    fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Scan<'_>> {
        let began = loop {
            let (&byte, rest) = bytes.split_first()?;
            *bytes = rest;
            // The bytes behind this one were sent after it.
            let at = self.before(now, rest.len());
            if let Some(began) = self.byte(byte, at) {
                break began;
            }
            if self.frame.is_none() && self.is_answer() {
                self.answered(now);
            }
        };
        if let Setup::Done { until } = &mut self.setup {
            *until = now + SILENCE;
        }
        self.counters.frames = self.counters.frames.saturating_add(1);
        let taken = Instant(began.0.saturating_sub(self.config.latency.micros()));
        // The frame is complete: this was checked at its end.
        Some(Scan { taken, readings: self.slicer.finish().unwrap_or_default() })
    }

    fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        if let Setup::Done { until } = self.setup
            && until <= now
        {
            self.counters.restarts = self.counters.restarts.saturating_add(1);
            self.setup = Setup::Command { index: 0, attempts: 0, due: now };
        }
        if let Setup::Command { index, attempts: ATTEMPTS.., due } = self.setup
            && due <= now
        {
            self.setup = next_command(index, now);
        }
        let Setup::Command { index, attempts, due } = self.setup else { return None };
        if due > now {
            return None;
        }
        let (name, argument) = self.command(index);
        let length = write_command(out, name, argument)?;
        let due = now + ANSWER_TIME;
        self.setup = Setup::Command { index, attempts: attempts.saturating_add(1), due };
        Some(length)
    }

    fn poll_timeout(&self) -> Instant {
        match self.setup {
            Setup::Command { due, .. } => due,
            Setup::Done { until } => until,
        }
    }

    fn counters(&self) -> SensorCounters {
        self.counters
    }
}

impl A010<'_> {
    /// The name and the argument of a command of the configuration: stop the stream, set up, and
    /// start it on the UART.
    fn command(&self, index: u8) -> (&'static str, u8) {
        match index {
            0 => ("DISP", 0),
            1 => ("ISP", 1),
            2 => ("BINN", self.config.binning.argument()),
            3 => ("UNIT", self.config.unit),
            4 => ("FPS", self.config.frames_per_second),
            _ => ("DISP", 4),
        }
    }
}

/// Writes `AT+NAME=argument\r`. Returns its length; `None` if the buffer is too short.
fn write_command(out: &mut [u8], name: &str, argument: u8) -> Option<usize> {
    let tens = argument / 10;
    let digits = [b'0' + tens % 10, b'0' + argument % 10];
    let digits = if tens == 0 { digits.get(1..)? } else { &digits };
    let mut length = 0;
    for part in [b"AT+", name.as_bytes(), b"=", digits, b"\r"] {
        out.get_mut(length..length + part.len())?.copy_from_slice(part);
        length += part.len();
    }
    Some(length)
}

#[cfg(test)]
mod tests;
