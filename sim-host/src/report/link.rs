//! The counters of one end of a link (SPEC section 11).

use std::fmt;

use serde::Serialize;
use ubimap_protocol::link::Counters;

use crate::server::MessageCounters;

/// Counters of one end of a link: of the frames, and of the messages that had no effect.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LinkSummary {
    /// Frames sent, retransmissions included.
    pub sent: u32,
    /// Frames sent again.
    pub retransmissions: u32,
    /// Good frames received, duplicates included.
    pub received: u32,
    /// Reliable frames received more than once.
    pub duplicates: u32,
    /// Received data that is not a frame of the session: noise, damaged frames, frames of an earlier
    /// session.
    pub bad: u32,
    /// Good frames that break a rule.
    pub refused: u32,
    /// Sealed frames that were accepted before, or are too old to tell.
    pub replayed: u32,
    /// Sealed frames that no key here opens.
    pub forged: u32,
    /// Messages of a kind that this version does not know.
    pub unknown: u32,
    /// Messages that can't be read as their kind, or that break a rule.
    pub malformed: u32,
    /// Tile states that arrived after a newer one.
    pub late: u32,
}

impl LinkSummary {
    /// The counters of an end's frames and messages.
    pub fn new(frames: Counters, messages: MessageCounters) -> Self {
        let Counters { sent, retransmissions, received, duplicates, .. } = frames;
        let Counters { bad, refused, replayed, forged, .. } = frames;
        let MessageCounters { unknown, malformed, late } = messages;
        let counted = Self { sent, retransmissions, received, duplicates, ..Self::default() };
        Self { bad, refused, replayed, forged, unknown, malformed, late, ..counted }
    }

    /// The sums of both.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        let sum = u32::wrapping_add;
        Self {
            sent: sum(self.sent, other.sent),
            retransmissions: sum(self.retransmissions, other.retransmissions),
            received: sum(self.received, other.received),
            duplicates: sum(self.duplicates, other.duplicates),
            bad: sum(self.bad, other.bad),
            refused: sum(self.refused, other.refused),
            replayed: sum(self.replayed, other.replayed),
            forged: sum(self.forged, other.forged),
            unknown: sum(self.unknown, other.unknown),
            malformed: sum(self.malformed, other.malformed),
            late: sum(self.late, other.late),
        }
    }
}

/// All counters in one line.
impl fmt::Display for LinkSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} frames sent, {} again; {} received, {} duplicate, {} bad, {} refused, {} replayed, {} forged; messages: {} unknown, \
             {} malformed, {} late",
            self.sent,
            self.retransmissions,
            self.received,
            self.duplicates,
            self.bad,
            self.refused,
            self.replayed,
            self.forged,
            self.unknown,
            self.malformed,
            self.late
        )
    }
}
