//! What a robot says: each message to the part of the server that it is for.

use ubimap_protocol::{
    message::{
        Ack, Digests, Event, EventCode, Interest, Messages, Request, Severity, State, TileDigest,
        TileUpdateHead, TimeRequest, ToServerKind, decode,
    },
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
    pub(super) fn take(&mut self, messages: Messages<'_>, now: Instant) -> (u32, u32) {
        let (mut unknown, mut malformed) = (0, 0);
        for message in messages.map_while(Result::ok).filter(|it| it.kind != Ack::KIND) {
            match ToServerKind::from_number(message.kind) {
                None => unknown += 1,
                Some(kind) => malformed += u32::from(self.one(kind, message.body, now).is_none()),
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
    fn one(&mut self, kind: ToServerKind, body: &[u8], now: Instant) -> Option<()> {
        match kind {
            ToServerKind::TimeRequest => {
                self.session.time_requested(decode::<TimeRequest>(body).ok()?.0.nonce, now);
            }
            ToServerKind::State => {
                let (state, _) = decode::<State>(body).ok()?;
                self.session.state = Some(state);
                if let State { time: Some(moment), pose: Some(pose), .. } = state {
                    // Nobody can tell where it will be.
                    self.surroundings.robot(self.session.robot, moment.min(now), pose);
                }
            }
            ToServerKind::Interest => {
                self.session.interested(decode::<Interest>(body).ok()?.0);
            }
            ToServerKind::Request => {
                self.session.requested(&decode::<Request>(body).ok()?.0);
            }
            ToServerKind::TileUpdate => {
                let (head, coded) = decode::<TileUpdateHead>(body).ok()?;
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
            ToServerKind::Digests => {
                let (digests, _) = decode::<Digests>(body).ok()?;
                for digest in digests.tiles.iter().filter(|_| digests.layer == Layer::Robot) {
                    if !self.holds(digest) {
                        self.session.ask_for(digest.id);
                    } else if let Some(stamp) = self.layer.on_disk(digest.id, digest.stamp.epoch) {
                        // The robot may have been told in an earlier session that it has lost.
                        self.session.stored(digest.id, stamp);
                    }
                }
            }
            ToServerKind::ParameterReport => {
                self.session.reported(decode(body).ok()?.0);
            }
            ToServerKind::Event => {
                let (event, _) = decode::<Event>(body).ok()?;
                let robot = self.session.robot.0;
                let level = match event.severity {
                    Severity::Info => log::Level::Info,
                    Severity::Warning | Severity::Error => log::Level::Warn,
                };
                log::log!(level, "robot {robot}: {}", described(&event));
                self.happened.extend(EventCode::from_number(event.code));
                self.session.events.add(now, event);
            }
            ToServerKind::DistanceVector => self.session.looked(decode(body).ok()?.0),
            // It belongs into a handshake frame.
            ToServerKind::Hello => return None,
        }
        Some(())
    }
}
