//! The LDROBOT LD06 (also sold as LDS-style "LD19"): a lidar that turns ten times per second and sends
//! what it measures on a UART, at 230,400 baud, 8N1. It takes no commands.
//!
//! | part of a packet | bytes |
//! |---|---|
//! | start, number of points | `54 2C`: 12 points |
//! | speed, degrees per second | 2, little-endian |
//! | angle of the first point, 1/100 degree | 2, little-endian |
//! | points: distance in mm, confidence | 12 times 2, little-endian, and 1 |
//! | angle of the last point, 1/100 degree | 2, little-endian |
//! | time in ms, modulo 30,000 | 2, little-endian |
//! | CRC-8 of all bytes before it | 1: polynomial 4D, from 0, not reflected |
//!
//! The sensor's angles grow clockwise, seen from above, from its arrow; those of a scan grow
//! counter-clockwise (REP-103). A turn is one scan of evenly spaced beams, which begins and ends behind
//! the sensor: it is passed to the robot as it is, since a lidar has no rows to slice.

use core::f32::consts::TAU;

use ubimap_protocol::time::{Duration, Instant};

use super::depth_sensor::{DepthSensor, Scan, SensorCounters};
use crate::sense::{NOTHING_IN_RANGE, SensorModel, Validity};

/// The speed of the sensor's port in baud.
pub const BAUD: u32 = 230_400;

/// Length of a packet in bytes.
const PACKET: usize = 47;

/// Number of points in a packet.
const POINTS: usize = 12;

/// The start of a packet.
const START: [u8; 2] = [0x54, 0x2C];

/// A full turn in 1/100 degree.
const TURN: u32 = 36_000;

/// Maximum angle between the first and the last point of a packet, in 1/100 degree. At 5 turns per
/// second, the slowest, it is 4.4 degrees, at 13, the fastest, 11.4.
const LARGEST_PACKET: u32 = 2_000;

/// Packets overlap by less than this, in 1/100 degree; a larger step backwards begins a turn.
const JITTER: u32 = 500;

/// Minimum part of a turn that arrived undamaged for a scan, in 1/100 degree: three quarters.
const LEAST: u32 = TURN / 4 * 3;

/// Time without a packet after which a turn is dropped.
const SILENCE: Duration = Duration::from_millis(50);

/// Time from the middle of a turn to its end at ten turns per second.
const HALF_TURN: Duration = Duration::from_millis(50);

/// Points with a confidence below this are noise (LDROBOT's own filter has the same bound).
const LEAST_CONFIDENCE: u8 = 15;

/// A driver of the LD06: it joins the packets of a turn to a scan.
///
/// Each beam takes the nearest valid point in its sector, which may be one with nothing in range: its distance
/// is 0. A point with a confidence below 15 is invalid. A beam without a valid point reads 0. A cut or
/// damaged packet loses only its own points, because a packet may begin at any byte. A turn is dropped if
/// less than three quarters of it arrived.
#[derive(Debug)]
pub struct Ld06<'b> {
    /// The nearest reading in each sector, counter-clockwise from behind the sensor, in mm.
    sectors: &'b mut [u16],
    /// The newest bytes, for packets that begin anywhere.
    newest: [u8; PACKET],
    /// Number of them that were received since the last packet, at most all.
    received: usize,
    turn: Turn,
    /// The points of the newest packet that belong to the turn after the one that was returned last.
    rest: Option<(Packet, usize)>,
    counters: SensorCounters,
}

/// The turn that is arriving.
#[derive(Clone, Copy, Debug, Default)]
struct Turn {
    /// Where the newest point was, clockwise from behind the sensor, in 1/100 degree.
    place: u32,
    /// The sum of the points' steps, in 1/100 degree.
    swept: u32,
    /// When the newest packet arrived; `None` before the first.
    heard: Option<Instant>,
}

/// The part of a packet that is used.
#[derive(Clone, Copy, Debug)]
struct Packet {
    /// Clockwise from behind the sensor, in 1/100 degree, less than a turn.
    first: u32,
    /// From the first point to the last, in 1/100 degree.
    span: u32,
    /// Distances in mm, 0 if invalid, [`NOTHING_IN_RANGE`] without a return.
    distances: [u16; POINTS],
}

impl<'b> Ld06<'b> {
    /// A driver whose scans have one reading for each place of `sectors`, which should be 360 or fewer:
    /// at ten turns per second the sensor measures 450 points.
    pub fn new(sectors: &'b mut [u16]) -> Self {
        sectors.fill(0);
        Self {
            sectors,
            newest: [0; PACKET],
            received: 0,
            turn: Turn::default(),
            rest: None,
            counters: SensorCounters::default(),
        }
    }

    /// The geometry of scans with this number of readings, with the sensor's arrow ahead.
    pub const fn sensor(readings: usize) -> SensorModel {
        let step = TAU / if readings == 0 { 1 } else { readings } as f32;
        SensorModel::Radial { first: step / 2.0 - TAU / 2.0, step }
    }

    /// Which readings are valid. What gives no return is farther than 4 m, or black: a guess, since documents
    /// give the range on white surfaces only (12 m).
    pub fn validity() -> Validity {
        Validity { clear: 4_000, ..Validity::default() }
    }

    /// Processes a byte. Returns the packet that it completes.
    fn byte(&mut self, byte: u8) -> Option<Packet> {
        self.newest.copy_within(1.., 0);
        if let Some(last) = self.newest.last_mut() {
            *last = byte;
        }
        self.received = (self.received + 1).min(PACKET);
        if self.received < PACKET || !self.newest.starts_with(&START) {
            return None;
        }
        let (body, crc) = self.newest.split_at(PACKET - 1);
        let packet = if crc == [crc8(body)] { Packet::parse(body) } else { None };
        match packet {
            Some(_) => self.received = 0,
            None => self.counters.torn = self.counters.torn.saturating_add(1),
        }
        packet
    }

    /// Takes the points of a packet from `from` on. Returns whether they have completed a turn; the
    /// others are left for the next turn.
    fn take(&mut self, packet: Packet, from: usize) -> bool {
        for (index, &distance) in packet.distances.iter().enumerate().skip(from) {
            let place = packet.place(index);
            if place + JITTER < self.turn.place {
                let swept = core::mem::take(&mut self.turn.swept);
                self.turn.place = place;
                if swept >= LEAST {
                    self.rest = Some((packet, index));
                    return true;
                }
                self.sectors.fill(0);
            }
            self.turn.place = self.turn.place.max(place);
            let step = packet.span / (POINTS as u32 - 1);
            self.turn.swept = self.turn.swept.saturating_add(step);
            self.put(place, distance);
        }
        false
    }

    /// Puts a point into its sector.
    fn put(&mut self, place: u32, distance: u16) {
        // Counter-clockwise from behind the sensor. A point exactly behind it is the last of a turn.
        let around = TURN - 1 - place.min(TURN - 1);
        let sector = around as usize * self.sectors.len() / TURN as usize;
        let Some(nearest) = self.sectors.get_mut(sector) else { return };
        if distance != 0 && (*nearest == 0 || distance < *nearest) {
            *nearest = distance;
        }
    }
}

impl Packet {
    /// Parses the bytes before the checksum. `None` if the points are not those of one packet.
    fn parse(body: &[u8]) -> Option<Self> {
        let word = |at: usize| Some(u16::from_le_bytes([*body.get(at)?, *body.get(at + 1)?]));
        let [first, last] = [u32::from(word(4)?), u32::from(word(42)?)];
        let span = (last + TURN).checked_sub(first)? % TURN;
        if first >= TURN || last >= TURN || span > LARGEST_PACKET {
            return None;
        }
        let mut distances = [0; POINTS];
        let points = body.get(6..)?.chunks_exact(3);
        for (distance, point) in distances.iter_mut().zip(points) {
            *distance = match *point {
                [0, 0, _] => NOTHING_IN_RANGE,
                [low, high, confidence] if confidence >= LEAST_CONFIDENCE => {
                    u16::from_le_bytes([low, high])
                }
                _ => 0,
            };
        }
        Some(Self { first: (first + TURN / 2) % TURN, span, distances })
    }

    /// Where a point was, clockwise from behind the sensor, in 1/100 degree.
    fn place(&self, index: usize) -> u32 {
        (self.first + self.span * index as u32 / (POINTS as u32 - 1)) % TURN
    }
}

/// CRC-8 with the polynomial 4D, from 0.
fn crc8(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |crc, byte| {
        (0..8).fold(
            crc ^ byte,
            |crc: u8, _| {
                if crc & 0x80 == 0 { crc << 1 } else { crc << 1 ^ 0x4D }
            },
        )
    })
}

impl DepthSensor for Ld06<'_> {
    fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Scan<'_>> {
        if let Some((packet, from)) = self.rest.take() {
            self.sectors.fill(0);
            self.take(packet, from);
        }
        let at = loop {
            let (&byte, rest) = bytes.split_first()?;
            *bytes = rest;
            let Some(packet) = self.byte(byte) else { continue };
            // The bytes behind this one were sent after it.
            let later = rest.len() as u64 * 10 * 1_000_000 / u64::from(BAUD);
            let at = Instant(now.0.saturating_sub(later));
            let is_silent = |heard: Instant| at.since(heard) > SILENCE;
            if self.turn.heard.replace(at).is_none_or(is_silent) {
                // What arrived before belongs to an earlier turn.
                self.turn = Turn { place: packet.first, swept: 0, heard: Some(at) };
                self.sectors.fill(0);
            }
            if self.take(packet, 0) {
                break at;
            }
        };
        self.counters.frames = self.counters.frames.saturating_add(1);
        // The middle of the turn, when it looked ahead.
        let taken = Instant(at.0.saturating_sub(HALF_TURN.micros()));
        Some(Scan { taken, readings: self.sectors })
    }

    fn counters(&self) -> SensorCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests;
