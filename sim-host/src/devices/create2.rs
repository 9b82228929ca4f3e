//! A simulated iRobot Create 2, which obeys its Open Interface.

use ubimap_protocol::time::{Duration, Instant};

use super::line::Line;

/// The speed of its port in bits per second.
const BAUD: u32 = 115_200;

/// Interval between two stream frames.
const INTERVAL: Duration = Duration::from_millis(15);

/// Distance between the wheels, in metres.
const TRACK_M: f64 = 0.235;

/// Distance per encoder count, in metres: the circumference of a wheel of 72 mm over 508.8 counts.
const COUNT_M: f64 = std::f64::consts::PI * 0.072 / 508.8;

/// Maximum speed of a wheel, in mm/s.
const MAX_SPEED: i16 = 500;

/// How the wheels are wired, and how their encoders count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wiring {
    /// The left and the right motor: -1 if it turns backwards.
    pub motors: [f64; 2],
    /// The counts of the left and the right encoder for each count of a good one, negative if it counts
    /// backwards.
    pub encoders: [f64; 2],
    /// Whether each motor gets the other one's commands.
    pub swapped_motors: bool,
    /// Whether each encoder is reported as the other one.
    pub swapped_encoders: bool,
}

impl Default for Wiring {
    /// All is as it should be.
    fn default() -> Self {
        Self {
            motors: [1.0; 2],
            encoders: [1.0; 2],
            swapped_motors: false,
            swapped_encoders: false,
        }
    }
}

/// The mode of the Open Interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    Off = 0,
    Passive = 1,
    Safe = 2,
    Full = 3,
}

/// A mobile base: it takes opcodes, and streams sensor packets.
#[derive(Debug)]
pub struct SimCreate2 {
    line: Line,
    mode: Mode,
    /// The bytes of an opcode that is not complete yet.
    opcode: Vec<u8>,
    /// The packets to stream.
    stream: Vec<u8>,
    next: Instant,
    /// The speeds of the left and the right wheel, in mm/s.
    speeds: [i16; 2],
    wiring: Wiring,
}

impl Default for SimCreate2 {
    fn default() -> Self {
        Self::new()
    }
}

impl SimCreate2 {
    /// A base that has just been switched on.
    pub fn new() -> Self {
        Self {
            line: Line::new(BAUD),
            mode: Mode::Off,
            opcode: Vec::new(),
            stream: Vec::new(),
            next: Instant(0),
            speeds: [0; 2],
            wiring: Wiring::default(),
        }
    }

    /// The same base, wired like this.
    pub fn wired(self, wiring: Wiring) -> Self {
        Self { wiring, ..self }
    }

    /// Processes bytes from the robot.
    pub fn receive(&mut self, bytes: &[u8], now: Instant) {
        for &byte in bytes {
            self.opcode.push(byte);
            let needed = match self.opcode[..] {
                [145, ..] => 5,
                [148] => 2,
                [148, count, ..] => 2 + usize::from(count),
                _ => 1,
            };
            if self.opcode.len() >= needed {
                let opcode = std::mem::take(&mut self.opcode);
                self.obey(&opcode, now);
            }
        }
    }

    fn obey(&mut self, opcode: &[u8], now: Instant) {
        match *opcode {
            [128] => {
                self.mode = Mode::Passive;
                self.speeds = [0; 2];
            }
            [131] if self.mode != Mode::Off => self.mode = Mode::Safe,
            [132] if self.mode != Mode::Off => self.mode = Mode::Full,
            [145, r1, r0, l1, l0] if self.drives() => {
                let speeds = [[l1, l0], [r1, r0]].map(i16::from_be_bytes);
                self.speeds = speeds.map(|speed| speed.clamp(-MAX_SPEED, MAX_SPEED));
            }
            [148, _, ref packets @ ..] if self.mode != Mode::Off => {
                self.stream = packets.to_vec();
                self.next = now + INTERVAL;
            }
            _ => {}
        }
    }

    fn drives(&self) -> bool {
        matches!(self.mode, Mode::Safe | Mode::Full)
    }

    /// The speed in m/s and the turn rate in rad/s that its wheels have by their commands.
    pub fn commanded(&self) -> [f64; 2] {
        let mut speeds = self.speeds.map(|speed| f64::from(speed) / 1_000.0);
        if self.wiring.swapped_motors {
            speeds.reverse();
        }
        let [left, right] = [0, 1].map(|wheel| speeds[wheel] * self.wiring.motors[wheel]);
        [(left + right) / 2.0, (right - left) / TRACK_M]
    }

    /// When the next stream frame is due.
    pub fn next_frame(&self) -> Option<Instant> {
        (!self.stream.is_empty()).then_some(self.next)
    }

    /// Sends the stream frame that is due by `now`, if any. `way_m` and `angle_rad` are what the
    /// wheels have measured since the start; `is_touching` says whether the bumper is pressed.
    pub fn measure(&mut self, [way_m, angle_rad]: [f64; 2], is_touching: bool, now: Instant) {
        if self.next_frame().is_none_or(|next| next > now) {
            return;
        }
        self.next = (self.next + INTERVAL).max(now);
        let aside = angle_rad * TRACK_M / 2.0;
        let ways = [way_m - aside, way_m + aside];
        let mut counts = [0, 1].map(|wheel| {
            let counts = ways[wheel] * self.wiring.encoders[wheel] / COUNT_M;
            (counts.floor() as i64 as u16).to_be_bytes()
        });
        if self.wiring.swapped_encoders {
            counts.reverse();
        }
        let mut packets = Vec::new();
        for &number in &self.stream {
            packets.push(number);
            match number {
                7 => packets.push(if is_touching { 0b11 } else { 0 }),
                35 => packets.push(self.mode as u8),
                43 => packets.extend(counts[0]),
                44 => packets.extend(counts[1]),
                // The others are of no interest here.
                _ => packets.push(0),
            }
        }
        let mut frame = vec![19, packets.len() as u8];
        frame.append(&mut packets);
        let sum = frame.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte));
        frame.push(sum.wrapping_neg());
        self.line.send(&frame, now);
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

#[cfg(test)]
mod tests {
    use super::*;

    /// The example of the Open Interface's document: a stream of the packets 29 and 13.
    #[test]
    fn a_stream_frame_adds_up_to_zero() {
        let document = [19, 5, 29, 2, 25, 13, 0, 163];
        assert_eq!(document.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte)), 0);
        let mut base = SimCreate2::new();
        base.receive(&[128, 131, 148, 4, 7, 35, 43, 44], Instant(0));
        base.measure([1.0, 0.0], false, Instant(15_000));
        let frame = base.poll_transmit(Instant(1_000_000));
        // 1 m are 2,249 counts.
        assert_eq!(frame[..12], [19, 10, 7, 0, 35, 2, 43, 8, 201, 44, 8, 201]);
        assert_eq!(frame.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte)), 0);
    }

    #[test]
    fn wrong_wires_turn_the_wheels_and_counts_that_they_name() {
        let good = Wiring::default();
        // The left wheel is commanded to 100 mm/s, the right one to 200; both roll 1 m, the right one 0.235 m more.
        for (wiring, speeds, counts) in [
            (good, [100, 200], [1_985, 2_513]),
            (Wiring { motors: [-1.0, 1.0], ..good }, [-100, 200], [1_985, 2_513]),
            (Wiring { swapped_motors: true, ..good }, [200, 100], [1_985, 2_513]),
            (Wiring { encoders: [1.0, -1.03], ..good }, [100, 200], [1_985, -2_590]),
            (Wiring { swapped_encoders: true, ..good }, [100, 200], [2_513, 1_985]),
        ] {
            let mut base = SimCreate2::new().wired(wiring);
            base.receive(&[128, 131, 145, 0, 200, 0, 100, 148, 2, 43, 44], Instant(0));
            let [left, right] = speeds.map(|speed| f64::from(speed) / 1_000.0);
            let [speed, turn] = base.commanded();
            assert!((speed - (left + right) / 2.0).abs() < 1e-9, "{wiring:?}");
            assert!((turn - (right - left) / TRACK_M).abs() < 1e-9, "{wiring:?}");
            base.measure([1.0, 1.0], false, Instant(15_000));
            let frame = base.poll_transmit(Instant(1_000_000));
            let counted = [3, 6].map(|at| i16::from_be_bytes([frame[at], frame[at + 1]]));
            assert_eq!(counted, counts, "{wiring:?}");
        }
    }

    #[test]
    fn it_drives_only_in_a_mode_that_allows_it() {
        let mut base = SimCreate2::new();
        let turn = [145, 0, 200, 0, 100];
        base.receive(&turn, Instant(0));
        assert_eq!(base.commanded(), [0.0, 0.0]);
        base.receive(&[128], Instant(0));
        base.receive(&turn, Instant(0));
        assert_eq!(base.commanded(), [0.0, 0.0]);
        base.receive(&[131, 145, 0, 200], Instant(0));
        base.receive(&[0, 100], Instant(0));
        // The right wheel is faster: it turns to the left.
        let [speed, turn] = base.commanded();
        assert!((speed - 0.15).abs() < 1e-9 && (turn - 0.1 / TRACK_M).abs() < 1e-9);
    }
}
