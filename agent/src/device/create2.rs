//! The iRobot Create 2 (and Roombas of the 600 series), by its Open Interface at 115,200 baud.
//!
//! The board sends opcodes: 128 starts the interface, 131 selects the safe mode, in which the base
//! itself stops at cliffs and wheel drops, 148 asks for a stream of sensor packets, and 145 sets
//! the speeds of the wheels. Every 15 ms the base sends:
//!
//! | bytes | content |
//! |---|---|
//! | `19` | 19, the start |
//! | `10` | length of what follows, without the checksum |
//! | packet 7 | bit 0, 1: right and left bumper; bit 2, 3: right and left wheel dropped |
//! | packet 35 | the mode: 0 off, 1 passive, 2 safe, 3 full |
//! | packets 43, 44 | counts of the left and the right encoder, 2 bytes, high byte first |
//! | checksum | makes the sum of all bytes 0 modulo 256 |
//!
//! (All numbers are decimal; each packet is preceded by its number.)

use ubimap_protocol::time::{Duration, Instant};

use super::{
    cadence::{Cadence, Regularity},
    diff_drive::{DiffDrive, WheelBase, WheelSpeeds},
    wheels::{WheelCounters, WheelReport, Wheels},
};
use crate::drive::{DriveCommand, StopReason};

/// Length of a stream frame in bytes.
const FRAME: usize = 13;

/// The bytes of a stream frame that are always the same, with their places.
const FIXED: [(usize, u8); 6] = [(0, 19), (1, 10), (2, 7), (4, 35), (6, 43), (9, 44)];

/// Time without a frame after which the interface is started again: the base was powered up after
/// the board, or was reset.
const SILENCE: Duration = Duration::from_millis(500);

/// Time that the base needs to change its mode.
const MODE_CHANGE: Duration = Duration::from_millis(20);

/// Interval at which the wheels' speeds are sent again, in case a command was lost.
const REPEAT: Duration = Duration::from_millis(100);

/// Time of a byte on the line at 115,200 baud, in microseconds.
const BYTE_MICROS: u64 = 87;

/// Modes of the base.
const SAFE: u8 = 2;

/// The base sends a frame every 15 ms. With an error of 5 %, the moments are right again within a third of a
/// second after a lost frame.
const FRAMES: Regularity = Regularity { interval: 15_000, jitter: 0, error: 750 };

/// Opcodes.
const START: u8 = 128;
const SAFE_MODE: u8 = 131;
const DRIVE_DIRECT: u8 = 145;
const STREAM: u8 = 148;

/// A driver of the Create 2.
#[derive(Debug)]
pub struct Create2 {
    odometry: DiffDrive,
    speeds: WheelSpeeds,
    command: DriveCommand,
    /// The newest bytes, for frames that begin anywhere.
    newest: [u8; FRAME],
    /// Number of bytes received since the last frame, at most a frame's.
    received: usize,
    /// The encoders at the last frame; `None` after silence.
    encoders: Option<[u16; 2]>,
    setup: Setup,
    /// When the base last reported; before its first report, when it was first addressed.
    heard: Option<Instant>,
    cadence: Cadence,
    /// When the last step of the start was sent.
    started: Instant,
    /// The speeds last sent, and when.
    sent: Option<([i16; 2], Instant)>,
    counters: WheelCounters,
}

/// The progress of the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Setup {
    /// The step with this index is due then.
    Step(u8, Instant),
    /// The base streams.
    Done,
}

impl Default for Create2 {
    fn default() -> Self {
        Self::new()
    }
}

impl Create2 {
    /// A driver that starts the interface first.
    pub const fn new() -> Self {
        Self {
            odometry: DiffDrive::new(WheelBase::CREATE2),
            speeds: WheelSpeeds::new(WheelBase::CREATE2),
            command: DriveCommand::STAND,
            newest: [0; FRAME],
            received: 0,
            encoders: None,
            setup: Setup::Step(0, Instant(0)),
            heard: None,
            cadence: Cadence::NEW,
            started: Instant(0),
            sent: None,
            counters: WheelCounters { frames: 0, damaged: 0, restarts: 0 },
        }
    }

    /// Processes a byte. Returns a frame's packets 7 and 35 and the encoders, if it ends one.
    fn byte(&mut self, byte: u8) -> Option<([u8; 2], [u16; 2])> {
        self.newest.copy_within(1.., 0);
        if let Some(last) = self.newest.last_mut() {
            *last = byte;
        }
        self.received = (self.received + 1).min(FRAME);
        let is_fixed = FIXED.iter().all(|&(place, fixed)| self.newest.get(place) == Some(&fixed));
        if self.received < FRAME || !is_fixed {
            return None;
        }
        self.received = 0;
        if self.newest.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte)) != 0 {
            self.counters.damaged = self.counters.damaged.saturating_add(1);
            return None;
        }
        self.counters.frames = self.counters.frames.saturating_add(1);
        let [_, _, _, contact, _, mode, _, l1, l0, _, r1, r0, _] = self.newest;
        Some(([contact, mode], [u16::from_be_bytes([l1, l0]), u16::from_be_bytes([r1, r0])]))
    }

    /// Takes the base's state from a frame.
    fn frame(
        &mut self,
        [contact, mode]: [u8; 2],
        encoders: [u16; 2],
        moment: Instant,
    ) -> WheelReport {
        self.heard = self.heard.max(Some(moment));
        if let Some(before) = self.encoders.replace(encoders) {
            let [left, right] = encoders;
            let [left_before, right_before] = before;
            // The counters wrap at 16 bits.
            let change = |now: u16, before: u16| i32::from(now.wrapping_sub(before) as i16);
            self.odometry.advance([change(left, left_before), change(right, right_before)]);
        }
        // After a wheel drop the base falls back to the passive mode.
        if mode != SAFE && self.setup == Setup::Done && contact & 0b1100 == 0 {
            self.setup = Setup::Step(1, moment);
        }
        let stop = match contact {
            _ if contact & 0b1100 != 0 => Some(StopReason::WheelDrop),
            _ if contact & 0b0011 != 0 => Some(StopReason::Bumper),
            _ => None,
        };
        WheelReport { moment, pose: self.odometry.pose(), stop }
    }

    /// The bytes of a step of the start, and the time until the next one.
    fn step(index: u8) -> Option<(&'static [u8], Duration)> {
        match index {
            0 => Some((&[START], MODE_CHANGE)),
            1 => Some((&[SAFE_MODE], MODE_CHANGE)),
            2 => Some((&[STREAM, 4, 7, 35, 43, 44], Duration(0))),
            _ => None,
        }
    }

    /// When the base is started again unless it reports.
    fn restart_due(&self) -> Instant {
        self.heard.map_or(self.started, |heard| heard.max(self.started)) + SILENCE
    }

    /// When the speeds must be sent.
    fn speeds_due(&self) -> Instant {
        match self.sent {
            None => Instant(0),
            // A change is sent at once, a ramp in steps of 20 ms.
            Some((speeds, at)) if speeds != self.speeds.speeds() => at,
            Some((_, at)) => at + REPEAT,
        }
    }
}

impl Wheels for Create2 {
    fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<WheelReport> {
        while let Some((&byte, rest)) = bytes.split_first() {
            *bytes = rest;
            if let Some((state, encoders)) = self.byte(byte) {
                let later = BYTE_MICROS.saturating_mul(rest.len() as u64);
                let arrived = Instant(now.0.saturating_sub(later));
                let moment = self.cadence.moment(arrived, 1, &FRAMES);
                return Some(self.frame(state, encoders, moment));
            }
        }
        None
    }

    fn drive(&mut self, command: DriveCommand, now: Instant) {
        let since = self.sent.map_or(0, |(_, at)| now.since(at).micros().min(200_000) as u32);
        let is_due = self.sent.is_none_or(|(_, at)| now >= at + MODE_CHANGE);
        if command == DriveCommand::STAND || is_due {
            self.speeds.follow(command, since / 1_000);
        }
        self.command = command;
    }

    fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        self.heard = self.heard.or(Some(now));
        if self.setup == Setup::Done && now >= self.restart_due() {
            self.counters.restarts = self.counters.restarts.saturating_add(1);
            self.encoders = None;
            self.setup = Setup::Step(0, now);
        }
        if let Setup::Step(index, due) = self.setup {
            if now < due {
                return None;
            }
            let (bytes, pause) = Self::step(index)?;
            out.get_mut(..bytes.len())?.copy_from_slice(bytes);
            self.setup = match Self::step(index + 1) {
                Some(_) => Setup::Step(index + 1, now + pause),
                None => Setup::Done,
            };
            (self.started, self.sent) = (now, None);
            return Some(bytes.len());
        }
        if now < self.speeds_due() {
            return None;
        }
        let speeds @ [left, right] = self.speeds.speeds();
        let ([l1, l0], [r1, r0]) = (left.to_be_bytes(), right.to_be_bytes());
        let bytes = [DRIVE_DIRECT, r1, r0, l1, l0];
        out.get_mut(..bytes.len())?.copy_from_slice(&bytes);
        self.sent = Some((speeds, now));
        Some(bytes.len())
    }

    fn poll_timeout(&self) -> Instant {
        match self.setup {
            Setup::Step(_, due) => due,
            Setup::Done => self.speeds_due().min(self.restart_due()),
        }
    }

    fn is_silent(&self, now: Instant) -> bool {
        self.heard.is_some_and(|heard| now >= heard + SILENCE)
    }

    fn counters(&self) -> WheelCounters {
        self.counters
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::{vec, vec::Vec};
    use ubimap_protocol::units::{Millimetres, Pose};

    /// A stream frame.
    fn frame(contact: u8, mode: u8, [left, right]: [u16; 2]) -> Vec<u8> {
        let ([l1, l0], [r1, r0]) = (left.to_be_bytes(), right.to_be_bytes());
        let mut bytes = vec![19, 10, 7, contact, 35, mode, 43, l1, l0, 44, r1, r0];
        let sum = bytes.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte));
        bytes.push(0u8.wrapping_sub(sum));
        bytes
    }

    fn receive(base: &mut Create2, bytes: &[u8], now: Instant) -> Vec<WheelReport> {
        let mut bytes = bytes;
        core::iter::from_fn(|| base.receive(&mut bytes, now)).collect()
    }

    /// What the driver sends from `from` to `until`, each with its time in milliseconds, while the
    /// base reports that it stands if `streams`.
    fn sent(base: &mut Create2, from: u64, until: u64, streams: bool) -> Vec<(u64, Vec<u8>)> {
        let mut out = [0; 16];
        let mut sent = Vec::new();
        for millis in from..until {
            let now = Instant(millis * 1_000);
            if streams && millis % 15 == 0 {
                receive(base, &frame(0, 2, [7, 7]), now);
            }
            while let Some(length) = base.poll_transmit(now, &mut out) {
                sent.push((millis, out[..length].to_vec()));
            }
        }
        sent
    }

    const STANDING: [u8; 5] = [145, 0, 0, 0, 0];

    #[test]
    fn the_start_takes_three_steps_and_is_repeated_after_silence() {
        let mut base = Create2::new();
        let stream = vec![148, 4, 7, 35, 43, 44];
        let start = [(0, vec![128]), (20, vec![131]), (40, stream)];
        let first = sent(&mut base, 0, 45, false);
        assert_eq!(first[..3], start);
        assert!(first[3..].iter().all(|(_, bytes)| *bytes == STANDING));
        assert!(!base.is_silent(Instant(499_000)) && base.is_silent(Instant(500_000)));
        // The base answers: the speeds are repeated ten times per second.
        let speeds = sent(&mut base, 45, 2_045, true);
        assert!(speeds.iter().all(|(_, bytes)| *bytes == STANDING) && speeds.len() == 20);
        assert!(!base.is_silent(Instant(2_045_000)));
        // It is switched off: the start is repeated every half second.
        let later = sent(&mut base, 2_045, 4_045, false);
        let starts: Vec<u64> =
            later.iter().filter(|(_, bytes)| *bytes == [128]).map(|(at, _)| *at).collect();
        assert_eq!(starts, [2_540, 3_080, 3_620]);
        assert_eq!(base.counters().restarts, 3);
        assert!(base.is_silent(Instant(4_045_000)));
    }

    #[test]
    fn counts_become_odometry_across_their_wrap_but_not_across_silence() {
        let mut base = Create2::new();
        let at = |base: &mut Create2, count: u16| {
            let reports = receive(base, &frame(0, 2, [count; 2]), Instant(0));
            reports[0].pose
        };
        assert_eq!(at(&mut base, 65_000), Pose::default());
        // 1,000 counts are 444.6 mm.
        assert_eq!(at(&mut base, 464), Pose { x: Millimetres(445), ..Pose::default() });
        assert_eq!(at(&mut base, 65_000), Pose::default());
        sent(&mut base, 0, 1_000, false);
        // The base was switched on again: its counts begin anew.
        assert_eq!(at(&mut base, 0), Pose::default());
        assert_eq!(at(&mut base, 225).x, Millimetres(100));
    }

    #[test]
    fn frames_that_waited_have_the_moments_at_which_they_were_sent() {
        let mut base = Create2::new();
        let standing = frame(0, 2, [7, 7]);
        let mut error = |from: u64, until: u64, arrives: &dyn Fn(u64) -> u64| {
            let mut most = 0;
            for sent in (from..until).step_by(15) {
                let now = Instant(arrives(sent) * 1_000);
                let moment = receive(&mut base, &standing, now)[0].moment;
                most = most.max(moment.0.abs_diff(sent * 1_000));
            }
            most
        };
        assert_eq!(error(0, 300, &|sent| sent), 0);
        // Nothing is read for 200 ms; then all frames are, at once.
        let stalled = |sent: u64| sent.max(500);
        assert!(error(300, 600, &stalled) <= 10_500);
        assert_eq!(error(1_200, 1_500, &|sent| sent), 0);
        // The reader falls back more and more.
        assert!(error(1_500, 2_100, &|sent| sent + (sent - 1_500) / 3) <= 31_000);
        // Three frames are lost: the moments come back to the time.
        assert!(error(2_145, 3_300, &|sent| sent) <= 45_000);
        assert_eq!(error(3_300, 3_600, &|sent| sent), 0);
        // The base was switched off for a while.
        assert_eq!(error(9_000, 9_300, &|sent| sent), 0);
    }

    #[test]
    fn contacts_and_modes_are_read() {
        let mut base = Create2::new();
        sent(&mut base, 0, 100, true);
        let stop = |base: &mut Create2, contact, mode| {
            receive(base, &frame(contact, mode, [7, 7]), Instant(100_000))[0].stop
        };
        assert_eq!(stop(&mut base, 0, 2), None);
        for contact in 1..4 {
            assert_eq!(stop(&mut base, contact, 2), Some(StopReason::Bumper));
        }
        for contact in 4..16 {
            assert_eq!(stop(&mut base, contact, 1), Some(StopReason::WheelDrop));
        }
        // The wheels are back on the ground: the base is in the passive mode and must leave it.
        assert_eq!(stop(&mut base, 0, 1), None);
        let sent = sent(&mut base, 100, 101, false);
        assert_eq!(sent[0], (100, vec![131]));
    }

    #[test]
    fn the_right_wheel_comes_first_and_a_stop_at_once() {
        let mut base = Create2::new();
        sent(&mut base, 0, 100, true);
        for millis in 100..400 {
            let now = Instant(millis * 1_000);
            base.drive(DriveCommand { speed: 200, turn: 1_000 }, now);
            sent(&mut base, millis, millis + 1, true);
        }
        // 200 mm/s and half of 1 rad/s times 235 mm.
        assert_eq!(base.speeds.speeds(), [83, 317]);
        let mut out = [0; 16];
        base.drive(DriveCommand { speed: 201, turn: 1_000 }, Instant(450_000));
        assert_eq!(base.poll_transmit(Instant(450_000), &mut out), Some(5));
        assert_eq!(out[..5], [145, 1, 62, 0, 84]);
        base.drive(DriveCommand::STAND, Instant(451_000));
        assert_eq!(base.poll_transmit(Instant(451_000), &mut out), Some(5));
        assert_eq!(out[..5], STANDING);
    }

    proptest! {
        /// After any noise, the second whole frame is read at the latest; noise alone never makes a
        /// panic, and a report in it must have a correct checksum.
        #[test]
        fn noise_costs_one_report_at_most(noise in prop::collection::vec(any::<u8>(), 0..500)) {
            let mut base = Create2::new();
            receive(&mut base, &noise, Instant(0));
            let frames = [frame(1, 2, [5, 6]), frame(1, 2, [5, 6])].concat();
            let reports = receive(&mut base, &frames, Instant(1_000));
            prop_assert!(!reports.is_empty());
            prop_assert_eq!(reports.last().unwrap().stop, Some(StopReason::Bumper));
        }
    }
}
