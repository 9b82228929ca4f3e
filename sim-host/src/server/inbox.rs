//! Passes a robot's messages to the parts of the server that handle them.

use ubimap_protocol::{
    message::{
        Certainty, Digests, Event, EventCode, FixSource, Messages, PoseFix, State, TileDigest,
        TileUpdateHead, ToServer, ToServerMessage,
    },
    tile::{Layer, tile_hash},
    time::{Duration, Instant},
};

use super::{
    session::Session,
    surroundings::{Place, Surroundings},
    unread::Unread,
};
use crate::mapping::{RobotLayer, Updated};

/// Deviations of the pose at which a robot was last heard of before it booted: it neither drives nor maps at
/// these. Its base may have gone on turning until it noticed, so that any heading is possible.
const HEARSAY: Certainty = Certainty { x: 1_000, y: 1_000, heading: 16_384 };

/// Time without a pose after which no camera sees a robot that does not know its pose.
const UNSEEN: Duration = Duration::from_secs(1);

/// The effects of the messages in a frame.
#[derive(Debug, Default)]
pub(super) struct Taken {
    /// The changes of the robot's tiles.
    pub(super) updated: Updated,
    /// Events that the robot reported.
    pub(super) events: Vec<Event>,
    /// The messages that could not be read.
    pub(super) unread: Vec<Unread>,
    /// Number of tiles in updates whose state was old.
    pub(super) late: u32,
    /// Where the robot was before it booted, if it has just been told so.
    pub(super) hearsay: Option<Place>,
}

impl Taken {
    /// The codes of the events, except those unknown to this version.
    pub(super) fn codes(&self) -> impl Iterator<Item = EventCode> {
        self.events.iter().filter_map(|event| EventCode::from_number(event.code))
    }
}

/// The parts of the server that handle one robot's messages.
pub(super) struct Inbox<'a> {
    session: &'a mut Session,
    layer: &'a mut RobotLayer,
    surroundings: &'a mut Surroundings,
    taken: Taken,
}

impl<'a> Inbox<'a> {
    pub(super) fn new(
        session: &'a mut Session,
        layer: &'a mut RobotLayer,
        surroundings: &'a mut Surroundings,
    ) -> Self {
        Self { session, layer, surroundings, taken: Taken::default() }
    }

    /// Processes the messages of a frame.
    pub(super) fn take(mut self, messages: Messages<'_, ToServer>, now: Instant) -> Taken {
        for message in messages.map_while(Result::ok) {
            let read = message.by_kind().and_then(|message| self.take_one(message, now));
            if read.is_none() {
                self.taken.unread.push(Unread::of(message));
            }
        }
        self.taken
    }

    /// Returns `None` if the message is malformed.
    fn take_one(&mut self, message: ToServerMessage<'_>, now: Instant) -> Option<()> {
        match message {
            // Handled by the link.
            ToServerMessage::Ack(_) => {}
            ToServerMessage::TimeRequest(request) => {
                self.session.time_requested(request.decode().ok()?.nonce, now);
            }
            ToServerMessage::State(state) => self.state(state.decode().ok()?, now),
            ToServerMessage::Interest(interest) => {
                self.session.interested(interest.decode().ok()?);
            }
            ToServerMessage::Request(request) => {
                self.session.requested(&request.decode().ok()?);
            }
            ToServerMessage::TileUpdate(update) => {
                let (head, coded) = update.split().ok()?;
                self.tile_update(&head, coded, now)?;
            }
            ToServerMessage::Digests(digests) => self.digests(&digests.decode().ok()?),
            ToServerMessage::ParameterReport(report) => {
                self.session.parameters(report.decode().ok()?);
            }
            ToServerMessage::Event(event) => {
                let event = event.decode().ok()?;
                self.session.event(event.clone(), now);
                self.taken.events.push(event);
            }
            ToServerMessage::DistanceVector(vector) => self.session.vector(vector.decode().ok()?),
            // Only valid in a handshake frame.
            ToServerMessage::Hello(_) => return None,
        }
        Some(())
    }

    fn state(&mut self, state: State, now: Instant) {
        self.session.state(state);
        if let State { time: Some(moment), pose: Some(pose), .. } = state {
            // A robot can't know its pose in the future.
            self.surroundings.told(self.session.robot(), moment.min(now), pose);
        } else if let State { time: None, pose: None, .. } = state
            && let Some(place) = self.surroundings.place(self.session.robot())
            && now.since(place.moment) >= UNSEEN
        {
            // It has booted where no camera sees it. Its distance vectors will show whether it is still
            // there; until then it neither maps nor drives, and nobody draws it.
            let pose = place.pose;
            self.surroundings.told(self.session.robot(), now, pose);
            let (certainty, source) = (HEARSAY, FixSource::MapMatch);
            let earlier = Default::default();
            self.taken.hearsay = Some(place);
            self.session.matched(PoseFix { time: now, pose, certainty, source, earlier });
        }
    }

    fn tile_update(&mut self, head: &TileUpdateHead, coded: &[u8], now: Instant) -> Option<()> {
        if head.layer != Layer::Robot {
            return None;
        }
        // A robot can't have seen anything in the future.
        let seconds = head.seconds.min((now.micros() / 1_000_000) as u32);
        let (mut updated, result) = self.layer.update(coded, seconds);
        let all = &mut self.taken.updated;
        all.refused = all.refused.or(updated.refused);
        all.tiles.append(&mut updated.tiles);
        all.complete.append(&mut updated.complete);
        all.folded.append(&mut updated.folded);
        self.taken.late += updated.late;
        if let Some(missing) = updated.missing {
            self.session.ask_for(missing);
        }
        result.ok()
    }

    fn digests(&mut self, digests: &Digests) {
        for digest in digests.tiles.iter().filter(|_| digests.layer == Layer::Robot) {
            if !self.holds(digest) {
                self.layer.discard(digest.id, digest.stamp);
                self.session.ask_for(digest.id);
            } else if let Some(stamp) = self.layer.on_disk(digest.id, digest.stamp.epoch) {
                // An earlier Stored message may have been lost with its session.
                self.session.stored(digest.id, stamp);
            }
        }
    }

    /// Whether the state that the robot reported, or a newer one, is held. True for a closed epoch:
    /// the digest is late.
    fn holds(&self, told: &TileDigest) -> bool {
        let TileDigest { id, stamp, hash } = *told;
        self.layer.is_closed(id, stamp.epoch)
            || self.layer.held(id, stamp.epoch).is_some_and(|(held, cells)| {
                held > stamp || held == stamp && tile_hash(cells) == hash
            })
    }
}

#[cfg(test)]
mod tests;
