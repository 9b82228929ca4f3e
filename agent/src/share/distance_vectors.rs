//! When distance vectors are sent. The server measures the error of the robot's pose with them.

use ubimap_protocol::{
    message::{DistanceVector, ToServer, Writer},
    time::{Duration, Instant},
    units::Angle,
};

use crate::timing::{BLIND_VECTOR_INTERVAL, STANDING_VECTOR_INTERVAL, TURNING_VECTOR_INTERVAL};

/// Number of vectors after the start of a session that a moving robot sends at the rate of a blind
/// one: the server estimates the robot's constant errors from them.
const FIRST: u8 = 24;
/// Angle since the last vector beyond which the robot has turned: 23 degrees in binary angle units.
const TURN: u16 = 4_172;

/// Timing of the next distance vector, and the one waiting to be sent.
#[derive(Debug)]
pub(crate) struct DistanceVectors {
    interval: Duration,
    /// When the scan of the last vector was taken (robot's clock), once there was one in this session.
    last: Instant,
    /// Whether the robot has moved since the last vector. Where it comes to rest is as uncertain as its way,
    /// and it may stay there for long.
    moved: bool,
    /// The heading of the last vector, and whether the robot has turned since.
    heading: Angle,
    turned: bool,
    /// Number of initial vectors still to be sent.
    first: u8,
    waiting: Option<DistanceVector>,
}

impl DistanceVectors {
    /// `interval` is the usual minimum time between two vectors of a moving robot.
    pub(crate) fn new(interval: Duration) -> Self {
        Self {
            interval,
            last: Instant(0),
            moved: false,
            heading: Angle(0),
            turned: false,
            first: FIRST,
            waiting: None,
        }
    }

    /// Starts a session: the server has no vectors of this robot yet.
    pub(crate) fn begin_session(&mut self) {
        (self.moved, self.first, self.waiting) = (false, FIRST, None);
    }

    /// Notes that the robot has moved, and its heading.
    pub(crate) fn move_on(&mut self, heading: Angle) {
        self.moved = true;
        self.turned = heading.distance(self.heading) > TURN;
    }

    /// Whether a vector of a scan taken at `taken` (robot's clock) is due. `blind` says that no camera sees
    /// the robot.
    pub(crate) fn is_due(&self, taken: Instant, blind: bool) -> bool {
        let wait = match (self.moved, blind) {
            (false, _) => self.interval.max(STANDING_VECTOR_INTERVAL),
            (true, true) if self.turned => self.interval.min(TURNING_VECTOR_INTERVAL),
            (true, _) if blind || self.first > 0 => self.interval.min(BLIND_VECTOR_INTERVAL),
            (true, _) => self.interval,
        };
        self.first == FIRST || taken >= self.last + wait
    }

    /// Stores the vector that was due, if the scan yielded one. It replaces a vector that has not
    /// been sent yet.
    pub(crate) fn take(&mut self, taken: Instant, vector: Option<DistanceVector>) {
        self.last = taken;
        (self.moved, self.turned) = (false, false);
        if let Some(vector) = &vector {
            self.heading = vector.pose.heading;
        }
        self.first = self.first.saturating_sub(1);
        self.waiting = vector;
    }

    /// Adds the waiting vector to a frame if it fits.
    pub(crate) fn push(&mut self, writer: &mut Writer<'_, ToServer>) {
        self.waiting.take_if(|vector| writer.push(vector));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{vec, vec::Vec};
    use ubimap_protocol::units::{Millimetres, Pose};

    #[test]
    fn the_longest_vector_fits_its_room_and_waits_for_it() {
        for (columns, is_driven) in [1, 20, 64].into_iter().flat_map(|it| [(it, false), (it, true)])
        {
            let far = Millimetres(i32::MIN);
            let far = Pose { x: far, y: far, heading: Angle(u16::MAX) };
            let vector = DistanceVector {
                time: Instant(u64::MAX),
                pose: far,
                first: Angle(u16::MAX),
                step: i16::MIN,
                distances: [255u8; 64].into_iter().take(columns).collect(),
                odometry: is_driven.then_some(far),
            };
            let mut vectors = DistanceVectors::new(Duration::from_secs(5));
            vectors.take(Instant(7), Some(vector));
            let mut written = |room| {
                let mut frame = vec![0; room];
                let mut writer = Writer::new(&mut frame);
                vectors.push(&mut writer);
                writer.len()
            };
            let odometry = if is_driven { DistanceVector::ODOMETRY } else { 0 };
            let room = columns + DistanceVector::OVERHEAD + odometry;
            assert_eq!(written(room - 2), 0);
            assert!(written(room) >= room - 1);
            assert_eq!(written(room), 0, "sent twice");
        }
    }

    #[test]
    fn vectors_are_sent_more_often_while_moving_and_most_often_without_fixes() {
        let mut vectors = DistanceVectors::new(Duration::from_secs(5));
        let after = |seconds| Instant(9) + Duration::from_secs(seconds);
        assert!(vectors.is_due(after(0), false));
        for _ in 0..FIRST {
            vectors.take(after(0), None);
            vectors.move_on(Angle(0));
            assert_eq!(vectors.is_due(after(1), false), vectors.first > 0);
        }
        for (seconds, moves, blind) in
            [(5, true, false), (60, false, false), (1, true, true), (60, false, true)]
        {
            vectors.take(after(0), None);
            if moves {
                vectors.move_on(Angle(0));
            }
            let due = |seconds| vectors.is_due(after(seconds), blind);
            assert!(!due(seconds - 1) && due(seconds), "{seconds} {moves} {blind}");
        }
        vectors.begin_session();
        assert!(vectors.is_due(after(1), false));
    }

    #[test]
    fn a_blind_robot_sends_more_vectors_while_it_turns() {
        let mut vectors = DistanceVectors::new(Duration::from_secs(5));
        let seen = |degrees| DistanceVector {
            time: Instant(0),
            pose: Pose { heading: Angle::from_degrees(degrees), ..Pose::default() },
            first: Angle(0),
            step: 1,
            distances: [7].into_iter().collect(),
            odometry: None,
        };
        (0..FIRST).for_each(|_| vectors.take(Instant(0), None));
        for (from, to, blind, millis) in [
            (170.0, -165.0, true, 400),
            (-165.0, 170.0, true, 400),
            (170.0, -169.0, true, 1_000),
            (170.0, -165.0, false, 5_000),
        ] {
            vectors.take(Instant(9), Some(seen(from)));
            vectors.move_on(Angle::from_degrees(to));
            let due = |millis| vectors.is_due(Instant(9) + Duration::from_millis(millis), blind);
            assert!(!due(millis - 1) && due(millis), "{from} {to} {blind}");
        }
    }

    #[test]
    fn where_a_robot_comes_to_rest_is_told_once() {
        let mut vectors = DistanceVectors::new(Duration::from_secs(5));
        let sent = |second: &u64| {
            let taken = Instant(second * 1_000_000);
            if (3..8).contains(second) {
                vectors.move_on(Angle(0));
            }
            let is_due = vectors.is_due(taken, true);
            if is_due {
                vectors.take(taken, None);
            }
            // It moves on a little after the last vector.
            if *second == 7 {
                vectors.move_on(Angle(0));
            }
            is_due
        };
        let sent: Vec<u64> = (0..60).filter(sent).collect();
        assert_eq!(sent, [0, 3, 4, 5, 6, 7, 8]);
    }
}
