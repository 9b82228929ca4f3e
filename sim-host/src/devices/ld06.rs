//! A simulated LDROBOT LD06 lidar, which turns and sends packets without being asked.

use ubimap_agent::sense::NOTHING_IN_RANGE;
use ubimap_protocol::time::{Duration, Instant};

use super::line::Line;

/// The speed of its port in bits per second.
const BAUD: u32 = 230_400;
/// Duration of a turn: ten turns per second.
const TURN: Duration = Duration::from_millis(100);
/// Points per second, and per packet.
const POINTS_PER_SECOND: u64 = 4_500;
const POINTS: u64 = 12;
/// Duration of a packet's points.
const PACKET: Duration = Duration::from_micros(POINTS * 1_000_000 / POINTS_PER_SECOND);
/// A full turn in 1/100 degree.
const FULL: u64 = 36_000;
/// The speed that it reports, in degrees per second.
const SPEED: u16 = 3_600;
/// The confidence of a point with a return.
const CONFIDENCE: u8 = 200;

/// A lidar that has reached its speed. Its arrow is ahead.
#[derive(Debug)]
pub struct SimLd06 {
    line: Line,
    /// When the first point of the next packet is measured.
    next: Instant,
}

impl Default for SimLd06 {
    fn default() -> Self {
        Self::new()
    }
}

impl SimLd06 {
    /// A lidar that turns.
    pub fn new() -> Self {
        Self { line: Line::new(BAUD), next: Instant(0) }
    }

    /// Measures up to `taken` in what it sees then: distances in millimetres at equal angles, 0 for none,
    /// counter-clockwise from behind it. Call it many times per turn.
    pub fn expose(&mut self, around: &[u16], taken: Instant) {
        if around.is_empty() {
            return;
        }
        // After a pause it goes on from now: what it measured meanwhile was never seen.
        if taken.since(self.next) > TURN {
            self.next = taken;
        }
        while self.next + PACKET <= taken {
            let packet = packet(self.next, around);
            self.next = self.next + PACKET;
            self.line.send(&packet, self.next);
        }
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

/// Clockwise from the arrow, in 1/100 degree.
fn angle(at: Instant) -> u64 {
    at.micros() % TURN.micros() * FULL / TURN.micros()
}

/// The packet whose first point is measured at `from`.
fn packet(from: Instant, around: &[u16]) -> Vec<u8> {
    let point =
        |index: u64| angle(from + Duration::from_micros(index * 1_000_000 / POINTS_PER_SECOND));
    let mut bytes = vec![0x54, 0x2C];
    bytes.extend(SPEED.to_le_bytes());
    bytes.extend((point(0) as u16).to_le_bytes());
    for index in 0..POINTS {
        // Counter-clockwise from behind; the beams are in the middles of their sectors.
        let behind = (FULL / 2 + FULL - point(index)) % FULL;
        let beam = behind as usize * around.len() / FULL as usize;
        let (distance, confidence) = match around[beam] {
            NOTHING_IN_RANGE => (0, 0),
            // What is too near gives a wrong distance, which the sensor does not trust.
            0 => (1, 0),
            distance => (distance, CONFIDENCE),
        };
        bytes.extend(distance.to_le_bytes());
        bytes.push(confidence);
    }
    bytes.extend((point(POINTS - 1) as u16).to_le_bytes());
    bytes.extend(((from.micros() / 1_000 % 30_000) as u16).to_le_bytes());
    bytes.push(crc8(&bytes));
    bytes
}

/// The manufacturer's checksum: CRC-8 with the polynomial 4D, bit by bit.
fn crc8(bytes: &[u8]) -> u8 {
    let mut crc = 0_u8;
    for bit in bytes.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1)) {
        let top = crc >> 7;
        crc <<= 1;
        if top != bit {
            crc ^= 0x4D;
        }
    }
    crc
}

#[cfg(test)]
mod tests {
    use ubimap_agent::device::{DepthSensor, ld06::Ld06};

    use super::*;

    /// The checksum of the packet in the manufacturer's document.
    #[test]
    fn the_checksum_is_the_documents() {
        let document = [
            0x54, 0x2C, 0x68, 0x08, 0xAB, 0x7E, 0xE0, 0x00, 0xE4, 0xDC, 0x00, 0xE2, 0xD9, 0x00,
            0xE5, 0xD5, 0x00, 0xE3, 0xD3, 0x00, 0xE4, 0xD0, 0x00, 0xE9, 0xCD, 0x00, 0xE4, 0xCA,
            0x00, 0xE2, 0xC7, 0x00, 0xE9, 0xC5, 0x00, 0xE5, 0xC2, 0x00, 0xE5, 0xC0, 0x00, 0xE5,
            0xBE, 0x82, 0x3A, 0x1A,
        ];
        assert_eq!(crc8(&document), 0x50);
    }

    #[test]
    fn the_driver_gets_turns_whose_readings_are_at_their_angles() {
        // Farther and farther, counter-clockwise from behind.
        let around: Vec<u16> = (0..360).map(|degree| 1_000 + 10 * degree).collect();
        let (mut lidar, mut sectors) = (SimLd06::new(), [0; 360]);
        let mut driver = Ld06::new(&mut sectors);
        let mut turns = Vec::new();
        for step in 1..=40 {
            let now = Instant(step * 25_000);
            lidar.expose(&around, now);
            let later = now + Duration::from_millis(20);
            let bytes = lidar.poll_transmit(later);
            let mut bytes = &bytes[..];
            while let Some(scan) = driver.receive(&mut bytes, later) {
                turns.push(scan.readings.to_vec());
            }
        }
        assert!(turns.len() >= 8, "{} turns", turns.len());
        for turn in &turns[1..] {
            for (degree, &reading) in turn.iter().enumerate() {
                let off = (i32::from(reading) - 1_000 - 10 * degree as i32).abs();
                assert!(reading == 0 || off <= 10, "{degree} degrees: {reading} mm");
            }
            let missing = turn.iter().filter(|&&reading| reading == 0).count();
            assert!(missing <= 36, "{missing} missing");
        }
    }
}
