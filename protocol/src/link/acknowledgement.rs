//! Which frames have arrived: the receiver records and reports it, and the sender retransmits the
//! others.

use heapless::Vec;

use super::{
    round_trip::RoundTrip,
    timing::{ACK_DELAY, ACK_REPEATS},
};
use crate::{frame::SEQUENCE_MODULUS, message::Ack, time::Instant};

/// Number of frames by which a sender may run ahead of the oldest missing one: the range of an
/// [`Ack`].
const SPAN: u16 = 33;
/// Number of frames after a sign of loss during which acknowledgements are repeated.
const FRAMES_AFTER_LOSS: u8 = 32;

fn ahead(of: u16, sequence: u16) -> u16 {
    sequence.wrapping_sub(of) % SEQUENCE_MODULUS
}

/// How a received reliable frame is treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arrival {
    /// New: its messages are delivered.
    New,
    /// Received before: acknowledged again, otherwise ignored.
    Duplicate,
    /// Beyond the sender's window: ignored.
    Refused,
}

/// The receiver's side of acknowledgements.
#[derive(Debug, Default)]
pub(super) struct ReceiveWindow {
    ack: Ack,
    due: Option<Instant>,
    repeats_left: usize,
    frames_after_loss: u8,
}

impl ReceiveWindow {
    /// Records a reliable frame.
    pub(super) fn arrive(&mut self, sequence: u16, now: Instant) -> Arrival {
        let ahead = ahead(self.ack.next, sequence);
        let arrival = match ahead {
            0 => {
                // Bit 0 of `later` is the frame after the missing one.
                let run = 1 + self.ack.later.trailing_ones();
                self.ack.next = (self.ack.next + run as u16) % SEQUENCE_MODULUS;
                self.ack.later = (u64::from(self.ack.later) >> run) as u32;
                Arrival::New
            }
            1..SPAN => {
                let bit = 1 << (ahead - 1);
                let seen = self.ack.later & bit != 0;
                self.ack.later |= bit;
                self.frames_after_loss = FRAMES_AFTER_LOSS;
                if seen { Arrival::Duplicate } else { Arrival::New }
            }
            _ if ahead >= SEQUENCE_MODULUS / 2 => {
                self.frames_after_loss = FRAMES_AFTER_LOSS;
                Arrival::Duplicate
            }
            _ => return Arrival::Refused,
        };
        self.frames_after_loss = self.frames_after_loss.saturating_sub(1);
        self.repeats_left = if self.frames_after_loss > 0 { ACK_REPEATS.len() } else { 0 };
        let soon = now + ACK_DELAY;
        self.due = Some(self.due.map_or(soon, |due| due.min(soon)));
        arrival
    }

    /// The latest time at which a pending acknowledgement must be sent.
    pub(super) fn due(&self) -> Option<Instant> {
        self.due
    }

    /// The acknowledgement to put into a frame that is sent now, if one is pending.
    pub(super) fn owed(&self) -> Option<Ack> {
        self.due.map(|_| self.ack)
    }

    /// Records that the acknowledgement was sent.
    pub(super) fn acknowledged(&mut self, now: Instant) {
        let repeat = ACK_REPEATS.len().checked_sub(self.repeats_left);
        self.due = repeat.and_then(|repeat| ACK_REPEATS.get(repeat)).map(|&wait| now + wait);
        self.repeats_left = self.repeats_left.saturating_sub(1);
    }
}

/// A frame that is in flight: sent and not yet acknowledged.
#[derive(Debug)]
struct Outstanding<T, const CONTENTS: usize> {
    sequence: u16,
    sent: u8,
    last_sent: Instant,
    token: T,
    contents: Vec<u8, CONTENTS>,
}

/// The sender's side of acknowledgements: holds up to `WINDOW` frames in flight, each of at most
/// `CONTENTS` bytes (header and payload).
#[derive(Debug)]
pub(super) struct SendWindow<T, const WINDOW: usize, const CONTENTS: usize> {
    next: u16,
    outstanding: [Option<Outstanding<T, CONTENTS>>; WINDOW],
    acknowledged: Vec<T, WINDOW>,
    newest_acknowledged: Option<Instant>,
    round_trip: RoundTrip,
}

impl<T: Copy, const WINDOW: usize, const CONTENTS: usize> Default
    for SendWindow<T, WINDOW, CONTENTS>
{
    fn default() -> Self {
        Self {
            next: 0,
            outstanding: [const { None }; WINDOW],
            acknowledged: Vec::new(),
            newest_acknowledged: None,
            round_trip: RoundTrip::default(),
        }
    }
}

impl<T: Copy, const WINDOW: usize, const CONTENTS: usize> SendWindow<T, WINDOW, CONTENTS> {
    /// Empties the window in place: assigning a new one would put a copy of it on the stack.
    pub(super) fn clear(&mut self) {
        self.next = 0;
        self.outstanding.iter_mut().for_each(|frame| *frame = None);
        self.acknowledged.clear();
        self.newest_acknowledged = None;
        self.round_trip = RoundTrip::default();
    }

    /// The sequence number of the next reliable frame, or `None` if none may be sent now.
    pub(super) fn next_sequence(&self) -> Option<u16> {
        let frames = || self.outstanding.iter().flatten();
        let oldest = frames().map(|frame| ahead(frame.sequence, self.next)).max();
        let room = frames().count() + self.acknowledged.len() < WINDOW;
        (room && oldest.is_none_or(|behind| behind < SPAN)).then_some(self.next)
    }

    /// Keeps a frame that was just sent with the number from [`Self::next_sequence`].
    pub(super) fn keep(&mut self, contents: &[u8], token: T, now: Instant) {
        let Ok(contents) = Vec::from_slice(contents) else { return };
        let sequence = self.next;
        if let Some(free) = self.outstanding.iter_mut().find(|frame| frame.is_none()) {
            *free = Some(Outstanding { sequence, sent: 1, last_sent: now, token, contents });
            self.next = (self.next + 1) % SEQUENCE_MODULUS;
        }
    }

    /// Processes an acknowledgement. [`Self::take_acknowledged`] then returns the tokens of the
    /// acknowledged frames.
    pub(super) fn acknowledge(&mut self, ack: Ack, now: Instant) {
        for place in &mut self.outstanding {
            let Some(frame) = place else { continue };
            let ahead = ahead(ack.next, frame.sequence);
            let arrived = match ahead {
                0 => false,
                1..SPAN => ack.later >> (ahead - 1) & 1 != 0,
                _ => ahead >= SEQUENCE_MODULUS / 2,
            };
            if !arrived {
                continue;
            }
            let Outstanding { sent, last_sent, token, .. } = *frame;
            *place = None;
            if sent == 1 {
                self.round_trip.sample(now.since(last_sent));
            }
            self.newest_acknowledged = self.newest_acknowledged.max(Some(last_sent));
            // The push can't fail: each frame is either outstanding or here.
            let _ = self.acknowledged.push(token);
        }
    }

    /// The token of an acknowledged frame; each is returned once.
    pub(super) fn take_acknowledged(&mut self) -> Option<T> {
        self.acknowledged.pop()
    }

    /// The contents and token of a frame that is due for retransmission. It counts as sent now.
    pub(super) fn resend(&mut self, now: Instant) -> Option<(&[u8], T)> {
        let mut first: Option<(Instant, usize)> = None;
        for (place, frame) in self.outstanding.iter().enumerate() {
            let Some(deadline) = frame.as_ref().map(|frame| self.deadline(frame)) else { continue };
            if deadline <= now && first.is_none_or(|(first, _)| deadline < first) {
                first = Some((deadline, place));
            }
        }
        let frame = self.outstanding.get_mut(first?.1)?.as_mut()?;
        frame.sent = frame.sent.saturating_add(1);
        frame.last_sent = now;
        Some((&frame.contents, frame.token))
    }

    /// When the next retransmission is due.
    pub(super) fn next_deadline(&self) -> Option<Instant> {
        let deadlines = self.outstanding.iter().flatten().map(|frame| self.deadline(frame));
        deadlines.fold(None, |first, deadline| Instant::earlier(first, Some(deadline)))
    }

    #[inline(never)]
    fn deadline(&self, frame: &Outstanding<T, CONTENTS>) -> Instant {
        let timeout = frame.last_sent + self.round_trip.timeout(frame.sent);
        let overtaken = frame.last_sent + self.round_trip.reordering();
        match self.newest_acknowledged {
            Some(newest) if newest >= overtaken => overtaken,
            _ => timeout,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    proptest! {
        #[test]
        fn a_window_reports_which_frames_have_arrived(
            start in 0u16..SEQUENCE_MODULUS,
            offsets in proptest::collection::vec(0u16..200, 1..300),
        ) {
            let mut window = ReceiveWindow { ack: Ack { next: start, later: 0 }, ..Default::default() };
            let mut seen = BTreeSet::new();
            let mut next = 0u16;
            for offset in offsets {
                let arrival = window.arrive((start + offset) % SEQUENCE_MODULUS, Instant(0));
                let expected = if offset >= next + SPAN {
                    Arrival::Refused
                } else if seen.insert(offset) {
                    Arrival::New
                } else {
                    Arrival::Duplicate
                };
                prop_assert_eq!(arrival, expected);
                while seen.contains(&next) {
                    next += 1;
                }
                prop_assert_eq!(window.ack.next, (start + next) % SEQUENCE_MODULUS);
            }
        }
    }

    fn at(millis: u64) -> Instant {
        Instant(millis * 1_000)
    }

    /// Sends the pending acknowledgement whenever it is due; returns when, in milliseconds.
    fn acknowledge_all(window: &mut ReceiveWindow) -> std::vec::Vec<u64> {
        let mut times = std::vec::Vec::new();
        while let Some(due) = window.due() {
            assert_eq!(window.owed(), Some(window.ack));
            times.push(due.0 / 1_000);
            window.acknowledged(due);
        }
        assert_eq!(window.owed(), None);
        times
    }

    #[test]
    fn acknowledgements_are_repeated_for_some_frames_after_a_loss() {
        let mut window = ReceiveWindow::default();
        assert!(acknowledge_all(&mut window).is_empty());
        window.arrive(0, at(10));
        window.arrive(1, at(12));
        assert_eq!(acknowledge_all(&mut window), [15], "the first frame waits no longer");
        assert_eq!(window.arrive(3, at(20)), Arrival::New, "frame 2 is lost");
        assert_eq!(acknowledge_all(&mut window), [25, 65, 135]);
        let mut repeated = 1;
        window.arrive(2, at(200));
        for sequence in 4..60 {
            let times = acknowledge_all(&mut window);
            match times.len() {
                1 => break,
                3 => repeated += 1,
                _ => panic!("{times:?}"),
            }
            window.arrive(sequence, at(200));
        }
        assert_eq!(repeated, FRAMES_AFTER_LOSS - 1);
        assert_eq!(window.arrive(3, at(300)), Arrival::Duplicate, "its acknowledgement was lost");
        assert_eq!(acknowledge_all(&mut window), [305, 345, 415]);
        assert_eq!(window.arrive(window.ack.next + SPAN, at(400)), Arrival::Refused);
        assert!(acknowledge_all(&mut window).is_empty());
    }

    #[test]
    fn a_frame_overtaken_by_an_acknowledged_one_is_sent_again_at_once() {
        let mut window = SendWindow::<u8, 4, 16>::default();
        assert_eq!(window.next_deadline(), None);
        for (token, sent) in [(0, 0), (1, 10), (2, 100)] {
            window.keep(&[token], token, at(sent));
        }
        assert_eq!(window.next_deadline(), Some(at(500)), "without a round-trip time");
        window.acknowledge(Ack { next: 0, later: 2 }, at(200));
        // The round trip is 100 ms and its variation 50 ms: a timeout of 300 ms, 60 ms for
        // reordering.
        assert_eq!(window.next_deadline(), Some(at(60)));
        let mut resend =
            |now: u64| window.resend(at(now)).map(|(contents, token)| (contents[0], token));
        assert_eq!(resend(59), None);
        assert_eq!([resend(200), resend(200), resend(200)], [Some((0, 0)), Some((1, 1)), None]);
        assert_eq!((resend(799), resend(800)), (None, Some((0, 0))), "the timeout has doubled");
        assert_eq!(window.next_deadline(), Some(at(800)));
        // Frames that were sent twice are no sample of the round trip.
        window.acknowledge(Ack { next: 3, later: 0 }, at(5_000));
        while window.take_acknowledged().is_some() {}
        assert_eq!(window.next_deadline(), None);
        window.keep(&[3], 3, at(6_000));
        assert_eq!(window.next_deadline(), Some(at(6_300)));
    }

    #[test]
    fn a_late_acknowledgement_says_nothing_of_frames_beyond_its_range() {
        let mut window = SendWindow::<u8, 4, 16>::default();
        for token in 0..40 {
            window.keep(&[token], token, at(0));
            window.acknowledge(Ack { next: u16::from(token) + 1, later: 0 }, at(1));
            assert_eq!(window.take_acknowledged(), Some(token));
        }
        window.keep(&[40], 40, at(2));
        window.acknowledge(Ack { next: 3, later: u32::MAX }, at(3));
        assert_eq!(window.take_acknowledged(), None);
        window.acknowledge(Ack { next: 30, later: 1 << 9 }, at(3));
        assert_eq!(window.take_acknowledged(), Some(40));
    }

    #[test]
    fn tokens_that_were_not_taken_count_and_a_cleared_window_is_empty() {
        let mut window = SendWindow::<u8, 4, 16>::default();
        (0..4).for_each(|token| window.keep(&[token], token, at(0)));
        window.acknowledge(Ack { next: 4, later: 0 }, at(1));
        assert_eq!(window.next_sequence(), None);
        assert!(window.take_acknowledged().is_some());
        assert_eq!(window.next_sequence(), Some(4));
        window.keep(&[9], 9, at(2));
        window.clear();
        assert_eq!((window.next_sequence(), window.next_deadline()), (Some(0), None));
        assert_eq!((window.take_acknowledged(), window.resend(at(9_000))), (None, None));
        window.keep(&[9], 9, at(0));
        assert_eq!(window.next_deadline(), Some(at(500)), "the round trip is forgotten");
    }

    #[test]
    fn acknowledged_frames_are_not_sent_again() {
        let mut window = SendWindow::<u8, 4, 16>::default();
        for token in 0..4 {
            assert!(window.next_sequence().is_some());
            window.keep(&[token], token, Instant(0));
        }
        assert_eq!(window.next_sequence(), None);
        // Frames 0 and 2 have arrived.
        window.acknowledge(Ack { next: 1, later: 1 }, Instant(1000));
        let mut tokens = [window.take_acknowledged(), window.take_acknowledged()];
        tokens.sort();
        assert_eq!(tokens, [Some(0), Some(2)]);
        assert_eq!(window.take_acknowledged(), None);
        let late = Instant(10_000_000);
        let again = [window.resend(late).unwrap().1, window.resend(late).unwrap().1];
        assert!(again == [1, 3] || again == [3, 1]);
        assert_eq!(window.resend(late), None);
    }

    #[test]
    fn a_sender_stays_within_the_range_of_an_acknowledgement() {
        let mut window = SendWindow::<u8, 40, 4>::default();
        window.keep(&[0], 0, Instant(0));
        for _ in 1..SPAN {
            window.keep(&[0], 0, Instant(0));
            // All but the first arrive.
            window.acknowledge(Ack { next: 0, later: u32::MAX }, Instant(1));
            while window.take_acknowledged().is_some() {}
        }
        assert_eq!(window.next_sequence(), None);
        window.acknowledge(Ack { next: SPAN, later: 0 }, Instant(1));
        assert!(window.take_acknowledged().is_some());
        assert!(window.next_sequence().is_some());
    }
}
