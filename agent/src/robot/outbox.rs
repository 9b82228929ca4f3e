//! Messages to be sent.

use ubimap_protocol::{
    message::EventCode,
    time::{Duration, Instant},
};

use super::parameters::Answer;
use crate::{
    map::Pool,
    share::{DistanceVectors, Events, Publisher},
    timing::HURRY,
};

/// The content of a reliable frame in flight; the link returns it when the frame is acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Token {
    Tiles(u16),
    Event(EventCode),
    Other,
}

/// The messages to be sent, except requests for tiles and for the time.
#[derive(Debug)]
pub(super) struct Outbox {
    pub(super) publisher: Publisher,
    pub(super) vectors: DistanceVectors,
    pub(super) events: Events,
    /// The reply to the newest command about parameters.
    pub(super) answer: Option<Answer>,
    /// When the next state message is due.
    pub(super) next_state: Instant,
}

impl Outbox {
    /// An empty outbox.
    pub(super) fn new(hold: Duration, vector_interval: Duration) -> Self {
        Self {
            publisher: Publisher::new(hold),
            vectors: DistanceVectors::new(vector_interval),
            events: Events::default(),
            answer: None,
            next_state: Instant(0),
        }
    }

    /// Starts a session.
    pub(super) fn begin_session(
        &mut self,
        pool: &mut Pool<'_>,
        same_server: bool,
        is_first: bool,
        now: Instant,
    ) {
        self.publisher.begin_session(pool, same_server, now);
        self.events.begin_session();
        if is_first {
            self.events.raise(EventCode::Started, now);
        }
        self.vectors.begin_session();
        self.next_state = now;
    }

    /// Reports an event that may require a decision of the server. To inform it, the robot also
    /// sends its state at once, and changes of the map without delay.
    pub(super) fn raise(&mut self, code: EventCode, now: Instant) {
        self.next_state = now;
        self.publisher.hurry(now + HURRY);
        self.events.raise(code, now);
    }
}
