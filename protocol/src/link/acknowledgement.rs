//! Which frames have arrived: kept by the receiver, told to the sender, used by the sender to
//! send again what is missing.

use heapless::Vec;

use super::{
    round_trip::RoundTrip,
    timing::{ACK_DELAY, ACK_REPEATS},
};
use crate::{frame::SEQUENCE_MODULUS, message::Ack, time::Instant};

/// How far ahead of the oldest frame missing a sender may go: what an [`Ack`] can tell.
const SPAN: u16 = 33;
/// For how many frames after a sign of loss acknowledgements are repeated.
const WARY: u8 = 32;

fn ahead(of: u16, sequence: u16) -> u16 {
    sequence.wrapping_sub(of) % SEQUENCE_MODULUS
}

/// What became of a reliable frame that came in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arrival {
    /// New: its messages count.
    New,
    /// Seen before: acknowledged once more, otherwise ignored.
    Duplicate,
    /// Further ahead than a sender may go: ignored.
    Refused,
}

/// The receiver's side.
#[derive(Debug, Default)]
pub(super) struct ReceiveWindow {
    ack: Ack,
    due: Option<Instant>,
    repeats_left: usize,
    wary: u8,
}

impl ReceiveWindow {
    /// Notes a reliable frame.
    pub(super) fn arrive(&mut self, sequence: u16, now: Instant) -> Arrival {
        let ahead = ahead(self.ack.next, sequence);
        let arrival = match ahead {
            0 => {
                // Bit 0 of `later` stands for the frame after the one that was missing.
                let run = 1 + self.ack.later.trailing_ones();
                self.ack.next = (self.ack.next + run as u16) % SEQUENCE_MODULUS;
                self.ack.later = (u64::from(self.ack.later) >> run) as u32;
                Arrival::New
            }
            1..SPAN => {
                let bit = 1 << (ahead - 1);
                let seen = self.ack.later & bit != 0;
                self.ack.later |= bit;
                self.wary = WARY;
                if seen { Arrival::Duplicate } else { Arrival::New }
            }
            _ if ahead >= SEQUENCE_MODULUS / 2 => {
                self.wary = WARY;
                Arrival::Duplicate
            }
            _ => return Arrival::Refused,
        };
        self.wary = self.wary.saturating_sub(1);
        self.repeats_left = if self.wary > 0 { ACK_REPEATS.len() } else { 0 };
        let soon = now + ACK_DELAY;
        self.due = Some(self.due.map_or(soon, |due| due.min(soon)));
        arrival
    }

    /// When an acknowledgement must leave at the latest.
    pub(super) fn due(&self) -> Option<Instant> {
        self.due
    }

    /// The acknowledgement to put into a frame that leaves now, if one is owed.
    pub(super) fn owed(&self) -> Option<Ack> {
        self.due.map(|_| self.ack)
    }

    /// The acknowledgement has left.
    pub(super) fn acknowledged(&mut self, now: Instant) {
        let repeat = ACK_REPEATS.len().checked_sub(self.repeats_left);
        self.due = repeat.and_then(|repeat| ACK_REPEATS.get(repeat)).map(|&wait| now + wait);
        self.repeats_left = self.repeats_left.saturating_sub(1);
    }
}

/// A frame that has been sent and not been acknowledged.
#[derive(Debug)]
struct Outstanding<T, const CONTENTS: usize> {
    sequence: u16,
    sent: u8,
    last_sent: Instant,
    token: T,
    contents: Vec<u8, CONTENTS>,
}

/// The sender's side: at most `WINDOW` frames of `CONTENTS` bytes (header and payload) wait.
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
    /// Forgets everything, where it is: a new one would take as much of the stack as it is large.
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

    /// Keeps a frame that has just been sent with [`Self::next_sequence`].
    pub(super) fn keep(&mut self, contents: &[u8], token: T, now: Instant) {
        let Ok(contents) = Vec::from_slice(contents) else { return };
        let sequence = self.next;
        if let Some(free) = self.outstanding.iter_mut().find(|frame| frame.is_none()) {
            *free = Some(Outstanding { sequence, sent: 1, last_sent: now, token, contents });
            self.next = (self.next + 1) % SEQUENCE_MODULUS;
        }
    }

    /// Takes an acknowledgement. The tokens of the frames can then be taken from
    /// [`Self::take_acknowledged`].
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
            // There is room: each frame is either outstanding or here.
            let _ = self.acknowledged.push(token);
        }
    }

    /// The token of a frame that has been acknowledged, each once.
    pub(super) fn take_acknowledged(&mut self) -> Option<T> {
        self.acknowledged.pop()
    }

    /// A frame that must be sent again now: its contents and token. It counts as sent.
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

    /// When the next frame must be sent again.
    pub(super) fn next_deadline(&self) -> Option<Instant> {
        let deadlines = self.outstanding.iter().flatten().map(|frame| self.deadline(frame));
        deadlines.fold(None, |first, deadline| Instant::earlier(first, Some(deadline)))
    }

    #[inline(never)]
    fn deadline(&self, frame: &Outstanding<T, CONTENTS>) -> Instant {
        let patience = frame.last_sent + self.round_trip.timeout(frame.sent);
        let overtaken = frame.last_sent + self.round_trip.reordering();
        match self.newest_acknowledged {
            Some(newest) if newest >= overtaken => overtaken,
            _ => patience,
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
        fn a_window_knows_what_has_arrived(
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

    #[test]
    fn what_is_acknowledged_is_not_sent_again() {
        let mut window = SendWindow::<u8, 4, 16>::default();
        for token in 0..4 {
            assert!(window.next_sequence().is_some());
            window.keep(&[token], token, Instant(0));
        }
        assert_eq!(window.next_sequence(), None);
        // 0 and 2 have arrived.
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
    fn a_sender_stays_within_what_an_acknowledgement_can_tell() {
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
