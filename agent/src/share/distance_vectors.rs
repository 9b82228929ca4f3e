//! Distance vectors to the server, now and then: from them it measures the error of the robot's
//! pose.

use ubimap_protocol::{
    message::{DistanceVector, ToServerKind, Writer},
    time::{Duration, Instant},
};

/// A robot that stands still tells nothing new: one in a minute at most.
const STANDING_INTERVAL: Duration = Duration::from_secs(60);

/// When to send the next one, and the one that is to be sent.
#[derive(Debug)]
pub(crate) struct DistanceVectors {
    interval: Duration,
    /// When the scan of the last one was taken (robot's clock).
    last: Option<Instant>,
    waiting: Option<DistanceVector>,
}

impl DistanceVectors {
    /// At most one in `interval`.
    pub(crate) fn new(interval: Duration) -> Self {
        Self { interval, last: None, waiting: None }
    }

    /// A session has begun: the server has none.
    pub(crate) fn begin_session(&mut self) {
        (self.last, self.waiting) = (None, None);
    }

    /// Whether one is due from a scan of this moment (robot's clock).
    pub(crate) fn is_due(&self, taken: Instant, moves: bool) -> bool {
        let wait = if moves { self.interval } else { self.interval.max(STANDING_INTERVAL) };
        self.last.is_none_or(|last| taken >= last + wait)
    }

    /// Takes the one that is due, if its scan had something to tell; one that has not been sent
    /// gives way to it.
    pub(crate) fn take(&mut self, taken: Instant, vector: Option<DistanceVector>) {
        self.last = Some(taken);
        self.waiting = vector;
    }

    /// Adds the one that waits to a frame that has room for it.
    pub(crate) fn push(&mut self, writer: &mut Writer<'_>) {
        let sent = |vector: &mut _| writer.push(ToServerKind::DistanceVector as u8, vector);
        self.waiting.take_if(sent);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;
    use ubimap_protocol::units::{Angle, Millimetres, Pose};

    #[test]
    fn the_longest_fits_the_room_that_it_was_made_for_and_waits_for_it() {
        for columns in [1, 20, 64] {
            let far = Millimetres(i32::MIN);
            let vector = DistanceVector {
                time: Instant(u64::MAX),
                pose: Pose { x: far, y: far, heading: Angle(u16::MAX) },
                first: Angle(u16::MAX),
                step: i16::MIN,
                distances: [255u8; 64].into_iter().take(columns).collect(),
            };
            let mut vectors = DistanceVectors::new(Duration::from_secs(5));
            vectors.take(Instant(7), Some(vector));
            let mut written = |room| {
                let mut frame = vec![0; room];
                let mut writer = Writer::new(&mut frame);
                vectors.push(&mut writer);
                writer.len()
            };
            let room = columns + DistanceVector::OVERHEAD;
            assert_eq!(written(room - 2), 0);
            assert!(written(room) >= room - 1);
            assert_eq!(written(room), 0, "sent twice");
        }
    }

    #[test]
    fn one_in_five_seconds_of_a_robot_that_moves_and_one_in_a_minute_of_one_that_stands() {
        let mut vectors = DistanceVectors::new(Duration::from_secs(5));
        let after = |seconds| Instant(9) + Duration::from_secs(seconds);
        assert!(vectors.is_due(after(0), false));
        vectors.take(after(0), None);
        for (seconds, moves, due) in
            [(4, true, false), (5, true, true), (59, false, false), (60, false, true)]
        {
            assert_eq!(vectors.is_due(after(seconds), moves), due, "{seconds} {moves}");
        }
        vectors.begin_session();
        assert!(vectors.is_due(after(1), false));
    }
}
