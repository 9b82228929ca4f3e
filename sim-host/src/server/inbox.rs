//! What a robot says: each message to the part of the server that it is for.

use ubimap_protocol::{
    message::{EventCode, Messages, Severity, State, TileDigest, ToServer, ToServerMessage},
    tile::{Layer, tile_hash},
    time::Instant,
};

use super::{events::described, session::Session, surroundings::Surroundings};
use crate::mapping::{RobotLayer, Updated};

/// The parts of the server that the messages of one robot go to.
pub(super) struct Inbox<'a> {
    pub(super) session: &'a mut Session,
    pub(super) layer: &'a mut RobotLayer,
    pub(super) surroundings: &'a mut Surroundings,
    pub(super) updated: &'a mut Updated,
    /// What has happened on the robot.
    pub(super) happened: &'a mut Vec<EventCode>,
}

impl Inbox<'_> {
    /// Returns how many messages were of an unknown kind, and how many could not be read.
    pub(super) fn take(&mut self, messages: Messages<'_, ToServer>, now: Instant) -> (u32, u32) {
        let (mut unknown, mut malformed) = (0, 0);
        for message in messages.map_while(Result::ok) {
            match message.by_kind() {
                None => unknown += 1,
                Some(message) => malformed += u32::from(self.one(message, now).is_none()),
            }
        }
        (unknown, malformed)
    }

    /// Whether the state that the robot tells of, or a newer one, is held.
    fn holds(&self, told: &TileDigest) -> bool {
        self.layer.held(told.id, told.stamp.epoch).is_some_and(|(held, cells)| {
            held > told.stamp || held == told.stamp && tile_hash(cells) == told.hash
        })
    }

    /// `None` if the message cannot be read.
    fn one(&mut self, message: ToServerMessage<'_>, now: Instant) -> Option<()> {
        match message {
            // The link has taken it.
            ToServerMessage::Ack(_) => {}
            ToServerMessage::TimeRequest(request) => {
                self.session.time_requested(request.decode().ok()?.nonce, now);
            }
            ToServerMessage::State(state) => {
                let state = state.decode().ok()?;
                self.session.state = Some(state);
                if let State { time: Some(moment), pose: Some(pose), .. } = state {
                    // Nobody can tell where it will be.
                    self.surroundings.robot(self.session.robot, moment.min(now), pose);
                }
            }
            ToServerMessage::Interest(interest) => {
                self.session.interested(interest.decode().ok()?);
            }
            ToServerMessage::Request(request) => {
                self.session.requested(&request.decode().ok()?);
            }
            ToServerMessage::TileUpdate(update) => {
                let (head, coded) = update.split().ok()?;
                if head.layer != Layer::Robot {
                    return None;
                }
                // Nobody has seen what is yet to come.
                let seconds = head.seconds.min((now.micros() / 1_000_000) as u32);
                let (mut updated, result) = self.layer.update(coded, seconds);
                self.updated.too_much |= updated.too_much;
                self.updated.tiles.append(&mut updated.tiles);
                self.updated.complete.append(&mut updated.complete);
                if let Some(missing) = updated.missing {
                    self.session.ask_for(missing);
                }
                result.ok()?;
            }
            ToServerMessage::Digests(digests) => {
                let digests = digests.decode().ok()?;
                for digest in digests.tiles.iter().filter(|_| digests.layer == Layer::Robot) {
                    if !self.holds(digest) {
                        self.session.ask_for(digest.id);
                    } else if let Some(stamp) = self.layer.on_disk(digest.id, digest.stamp.epoch) {
                        // The robot may have been told in an earlier session that it has lost.
                        self.session.stored(digest.id, stamp);
                    }
                }
            }
            ToServerMessage::ParameterReport(report) => {
                self.session.reported(report.decode().ok()?);
            }
            ToServerMessage::Event(event) => {
                let event = event.decode().ok()?;
                let robot = self.session.robot.0;
                let level = match event.severity {
                    Severity::Info => log::Level::Info,
                    Severity::Warning | Severity::Error => log::Level::Warn,
                };
                log::log!(level, "robot {robot}: {}", described(&event));
                self.happened.extend(EventCode::from_number(event.code));
                self.session.events.add(now, event);
            }
            ToServerMessage::DistanceVector(vector) => self.session.looked(vector.decode().ok()?),
            // It belongs in a handshake frame.
            ToServerMessage::Hello(_) => return None,
        }
        Some(())
    }
}
