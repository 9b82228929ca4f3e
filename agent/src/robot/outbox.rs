//! What waits to be sent.

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

/// What a reliable frame carries, to be told apart when it is acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Token {
    Tiles(u16),
    Event(EventCode),
    Other,
}

/// What waits to be sent, apart from what the map and the clock have to ask.
#[derive(Debug)]
pub(super) struct Outbox {
    pub(super) publisher: Publisher,
    pub(super) vectors: DistanceVectors,
    pub(super) events: Events,
    /// The answer to the newest command about parameters.
    pub(super) answer: Option<Answer>,
    /// When the robot's state is due.
    pub(super) next_state: Instant,
}

impl Outbox {
    /// Nothing waits.
    pub(super) fn new(hold: Duration, vector_interval: Duration) -> Self {
        Self {
            publisher: Publisher::new(hold),
            vectors: DistanceVectors::new(vector_interval),
            events: Events::default(),
            answer: None,
            next_state: Instant(0),
        }
    }

    /// A session has begun.
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

    /// Tells the server that something has happened that it may have to decide upon; with it go where
    /// the robot is, at once, and soon what it has seen by then.
    pub(super) fn raise(&mut self, code: EventCode, now: Instant) {
        self.next_state = now;
        self.publisher.hurry(now + HURRY);
        self.events.raise(code, now);
    }
}
