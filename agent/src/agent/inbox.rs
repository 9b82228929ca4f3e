//! What the server says: each message to the part of the agent that it is for.

use ubimap_protocol::{
    link::ClockSync,
    message::{
        Ack, Digests, EventCode, FixSource, Freshness, Message, Messages, ParameterCommand,
        PoseFix, Refusal, Request, Stored, TileUpdateHead, TimeReply, ToRobotKind, Welcome, decode,
    },
    tile::Layer,
    time::Instant,
    units::Pose,
};

use crate::{
    locate::{FixError, FixOutcome, Locator},
    map::LocalMap,
    share::{Commands, Events, FusedMap, Publisher},
    statistics::Statistics,
};

/// A message of the handshake.
pub(super) enum Knock {
    Welcome(Welcome),
    Refusal(Refusal),
    Reset,
}

impl Knock {
    pub(super) fn parse(message: Message<'_>) -> Option<Self> {
        match ToRobotKind::from_number(message.kind)? {
            ToRobotKind::Welcome => Some(Self::Welcome(decode(message.body).ok()?.0)),
            ToRobotKind::Refusal => Some(Self::Refusal(decode(message.body).ok()?.0)),
            ToRobotKind::Reset => Some(Self::Reset),
            _ => None,
        }
    }
}

/// The parts of an agent that messages of a session go to.
pub(super) struct Inbox<'a, 'b> {
    pub(super) clock: &'a mut ClockSync,
    pub(super) locator: &'a mut Locator,
    pub(super) latest_pose: &'a mut Option<(Instant, Pose)>,
    pub(super) fused: &'a mut FusedMap<'b>,
    pub(super) commands: &'a mut Commands,
    /// A command about parameters, to be carried out when the frame has been read.
    pub(super) command: &'a mut Option<ParameterCommand>,
    pub(super) map: &'a mut LocalMap<'b>,
    pub(super) publisher: &'a mut Publisher,
    pub(super) events: &'a mut Events,
    pub(super) statistics: &'a mut Statistics,
}

impl Inbox<'_, '_> {
    pub(super) fn take(&mut self, messages: Messages<'_>, now: Instant) {
        for message in messages.map_while(Result::ok) {
            if message.kind == Ack::KIND {
                continue;
            }
            let Some(kind) = ToRobotKind::from_number(message.kind) else {
                self.statistics.unknown_messages = self.statistics.unknown_messages.wrapping_add(1);
                continue;
            };
            if self.one(kind, message.body, now).is_none() {
                self.statistics.malformed_messages =
                    self.statistics.malformed_messages.wrapping_add(1);
            }
        }
    }

    /// `None` if the message cannot be read.
    fn one(&mut self, kind: ToRobotKind, body: &[u8], now: Instant) -> Option<()> {
        match kind {
            ToRobotKind::TimeReply => self.clock.reply(&decode::<TimeReply>(body).ok()?.0, now),
            ToRobotKind::PoseFix => self.fix(&decode::<PoseFix>(body).ok()?.0, now),
            ToRobotKind::TileUpdate => {
                let (head, coded) = decode::<TileUpdateHead>(body).ok()?;
                if head.layer == Layer::Robot {
                    return None;
                }
                self.fused.update(head.layer, coded).ok()?;
            }
            ToRobotKind::Request => {
                let (request, _) = decode::<Request>(body).ok()?;
                let pool = &mut self.map.pool;
                if request.tiles.is_empty() {
                    self.publisher.requested(pool, None, now);
                }
                for &tile in &request.tiles {
                    self.publisher.requested(pool, Some(tile), now);
                }
            }
            ToRobotKind::Peers | ToRobotKind::Obstacles | ToRobotKind::Path | ToRobotKind::Stop => {
                self.commands.take(kind, body)?
            }
            ToRobotKind::Parameter => *self.command = Some(decode(body).ok()?.0),
            ToRobotKind::Stored => {
                for &(id, stamp) in &decode::<Stored>(body).ok()?.0.tiles {
                    self.map.pool.stored(id, stamp);
                }
            }
            ToRobotKind::Digests => {
                let (digests, _) = decode::<Digests>(body).ok()?;
                if digests.layer == Layer::Robot {
                    return None;
                }
                self.fused.compare(&digests);
            }
            ToRobotKind::Freshness => {
                let (freshness, _) = decode::<Freshness>(body).ok()?;
                // Before the clocks agree its age is not known.
                if let Some(moment) = self.clock.to_local(freshness.time) {
                    self.fused.confirm(&freshness, moment);
                }
            }
            // They belong into handshake frames.
            ToRobotKind::Welcome | ToRobotKind::Refusal | ToRobotKind::Reset => return None,
        }
        Some(())
    }

    fn fix(&mut self, message: &PoseFix, now: Instant) {
        let count = &mut *self.statistics;
        for (moment, told) in message.fixes() {
            let local = self.clock.to_local(moment);
            match self.locator.fix(moment, local, told, message.certainty, now) {
                Ok((outcome, pose)) => {
                    count.fixes = count.fixes.wrapping_add(1);
                    match outcome {
                        FixOutcome::Rejected => {
                            count.fixes_rejected = count.fixes_rejected.wrapping_add(1);
                            self.events.raise(EventCode::FixRejected, now);
                        }
                        FixOutcome::Moved => count.moves = count.moves.wrapping_add(1),
                        FixOutcome::Taken if message.source == FixSource::Camera => {
                            if let Some(local) = local {
                                self.locator.learn(local, told, message.certainty);
                            }
                        }
                        FixOutcome::Began | FixOutcome::Taken => {}
                    }
                    if self.latest_pose.is_none_or(|(latest, _)| latest < moment) {
                        *self.latest_pose = Some((moment, pose));
                    }
                }
                Err(FixError::Repeated | FixError::Unused) => {}
                Err(FixError::TooOld | FixError::Future | FixError::Untimed) => {
                    count.fixes_untimely = count.fixes_untimely.wrapping_add(1);
                }
            }
        }
    }
}
