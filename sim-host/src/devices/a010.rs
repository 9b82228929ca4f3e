//! A simulated Sipeed MaixSense A010, which answers AT commands and sends frames.

use ubimap_protocol::time::{Duration, Instant};

use super::line::Line;

/// Mean time from the exposure to the first byte.
const LATENCY: Duration = Duration::from_millis(100);

/// Maximum deviation of the latency from its mean.
const JITTER: Duration = Duration::from_millis(10);

/// Depth in millimetres of the rows that are not level, which a robot must not map: the floor before
/// the robot, and things above it.
const OTHER_ROWS: u16 = 350;

/// Maximum length of a command in bytes; a longer line is ignored.
const MAX_COMMAND: usize = 32;

/// A depth camera that measures a level row, as robots in the simulated room do, and sends it as the
/// middle rows of a square image.
#[derive(Debug)]
pub struct SimA010 {
    line: Line,
    command: Vec<u8>,
    /// Rows and columns of an image.
    side: usize,
    unit: u8,
    frames_per_second: u8,
    is_running: bool,
    is_streaming: bool,
    number: u16,
    /// When the last frame was taken.
    last: Option<Instant>,
}

impl SimA010 {
    /// A camera that has just been switched on, on a line of this speed.
    pub fn new(baud: u32) -> Self {
        Self {
            line: Line::new(baud),
            command: Vec::new(),
            side: 100,
            unit: 0,
            frames_per_second: 19,
            is_running: true,
            // It streams to its display and USB by default.
            is_streaming: false,
            number: 0,
            last: None,
        }
    }

    /// Processes bytes from the robot.
    pub fn receive(&mut self, bytes: &[u8], now: Instant) {
        for &byte in bytes {
            if byte != b'\r' {
                self.command.push(byte);
                continue;
            }
            let command = std::mem::take(&mut self.command);
            let is_short = command.len() <= MAX_COMMAND;
            let is_done = is_short && self.obey(String::from_utf8_lossy(&command).trim());
            self.line.send(if is_done { b"OK\r\n" } else { b"ERROR\r\n" }, now);
        }
        self.command.truncate(MAX_COMMAND + 1);
    }

    /// Obeys a command. Returns whether it is one.
    fn obey(&mut self, command: &str) -> bool {
        let Some((name, value)) = command.strip_prefix("AT+").and_then(|it| it.split_once('='))
        else {
            return command == "AT";
        };
        let Ok(value) = value.parse::<u8>() else { return false };
        match (name, value) {
            ("ISP", 0 | 1) => self.is_running = value == 1,
            ("BINN", 1 | 2 | 4) => self.side = 100 / usize::from(value),
            ("UNIT", 0..=10) => self.unit = value,
            ("FPS", 1..=19) => self.frames_per_second = value,
            // Bit 0: its display, bit 1: USB, bit 2: the UART.
            ("DISP", 0..=7) => self.is_streaming = value & 4 != 0,
            _ => return false,
        }
        true
    }

    /// Number of columns of an image.
    pub fn columns(&self) -> usize {
        self.side
    }

    /// Takes an image with this level row at `taken`: depths in millimetres, 0 for none, from the
    /// left. An image is left out if the last one was taken too recently or is still being sent, or
    /// if the row does not have as many columns.
    pub fn expose(&mut self, row: &[u16], taken: Instant) {
        // A tolerance of a tenth: scans are taken at steps of the simulation.
        let interval = Duration::from_micros(900_000 / u64::from(self.frames_per_second));
        let is_due = self.last.is_none_or(|last| taken >= last + interval);
        // The latency varies from image to image.
        let swing = (u64::from(self.number.wrapping_mul(0x9E37)) * 2 * JITTER.micros()) >> 16;
        let sent = taken + Duration::from_micros(LATENCY.micros() - JITTER.micros() + swing);
        let is_on = self.is_running && self.is_streaming && self.line.is_free(sent);
        if !is_due || !is_on || row.len() != self.side {
            return;
        }
        self.last = Some(taken);
        let frame = self.frame(row);
        self.line.send(&frame, sent);
        self.number = self.number.wrapping_add(1);
    }

    /// An image as bytes.
    fn frame(&self, row: &[u16]) -> Vec<u8> {
        let pixels = self.side * self.side;
        let mut bytes = vec![0x00, 0xFF];
        bytes.extend((pixels as u16 + 16).to_le_bytes());
        bytes.extend([0xFF, 0x00, 35, 36, 0, 0, 0, 0, 0, 0]);
        bytes.extend([self.side as u8; 2]);
        bytes.extend(self.number.to_le_bytes());
        bytes.extend([0, 0xFF]);
        let middle = self.side / 2;
        for index in 0..self.side {
            let is_level = index.abs_diff(middle) <= 1;
            let depth = |column: &u16| if is_level { *column } else { OTHER_ROWS };
            bytes.extend(row.iter().map(depth).map(|depth| self.pixel(depth)));
        }
        bytes.push(bytes.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte)));
        bytes.push(0xDD);
        bytes
    }

    fn pixel(&self, depth: u16) -> u8 {
        let steps = match (depth, self.unit) {
            (0, _) => return 0,
            (depth, 0) => 5.1 * f64::from(depth).sqrt(),
            (depth, unit) => f64::from(depth) / f64::from(unit),
        };
        // What is nearer than a step is not 0, which stands for no depth.
        steps.round().clamp(1.0, 255.0) as u8
    }

    /// When the next byte arrives at the robot.
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.line.poll_timeout()
    }

    /// Takes the bytes that have arrived at the robot by `now`.
    pub fn poll_transmit(&mut self, now: Instant) -> Vec<u8> {
        self.line.poll(now)
    }
}
