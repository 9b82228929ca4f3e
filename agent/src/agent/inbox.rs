//! What the server says: each message to the part of the agent that it is for.

use ubimap_protocol::{
    link::ClockSync,
    message::{
        Digests, Encoded, EventCode, FixSource, Message, Messages, ParameterCommand, PoseFix,
        Refusal, Request, Stored, ToRobot, ToRobotMessage, Welcome,
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
    pub(super) fn parse(message: Message<'_, ToRobot>) -> Option<Self> {
        match message.by_kind()? {
            ToRobotMessage::Welcome(welcome) => Some(Self::Welcome(welcome.decode().ok()?)),
            ToRobotMessage::Refusal(refusal) => Some(Self::Refusal(refusal.decode().ok()?)),
            ToRobotMessage::Reset(_) => Some(Self::Reset),
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
    pub(super) fn take(&mut self, messages: Messages<'_, ToRobot>, now: Instant) {
        for message in messages.map_while(Result::ok) {
            let Some(message) = message.by_kind() else {
                self.statistics.unknown_messages = self.statistics.unknown_messages.wrapping_add(1);
                continue;
            };
            if self.one(message, now).is_none() {
                self.statistics.malformed_messages =
                    self.statistics.malformed_messages.wrapping_add(1);
            }
        }
    }

    /// `None` if the message cannot be read.
    fn one(&mut self, message: ToRobotMessage<'_>, now: Instant) -> Option<()> {
        match message {
            // The link has taken it.
            ToRobotMessage::Ack(_) => {}
            ToRobotMessage::TimeReply(reply) => self.clock.reply(&reply.decode().ok()?, now),
            ToRobotMessage::PoseFix(fix) => self.fix(&fix.decode().ok()?, now),
            ToRobotMessage::TileUpdate(update) => {
                let (head, coded) = update.split().ok()?;
                if head.layer == Layer::Robot {
                    return None;
                }
                self.fused.update(head.layer, coded).ok()?;
            }
            ToRobotMessage::Request(request) => self.requested(&request.decode().ok()?, now),
            ToRobotMessage::Peers(_)
            | ToRobotMessage::Obstacles(_)
            | ToRobotMessage::Path(_)
            | ToRobotMessage::Stop(_) => self.commands.take(message)?,
            ToRobotMessage::Parameter(command) => *self.command = Some(command.decode().ok()?),
            ToRobotMessage::Stored(stored) => self.stored(stored)?,
            ToRobotMessage::Digests(digests) => self.compare(digests)?,
            ToRobotMessage::Freshness(freshness) => {
                let freshness = freshness.decode().ok()?;
                // Before the clocks agree its age is not known.
                if let Some(moment) = self.clock.to_local(freshness.time) {
                    self.fused.confirm(&freshness, moment);
                }
            }
            // These belong in handshake frames.
            ToRobotMessage::Welcome(_) | ToRobotMessage::Refusal(_) | ToRobotMessage::Reset(_) => {
                return None;
            }
        }
        Some(())
    }

    fn requested(&mut self, request: &Request, now: Instant) {
        let pool = &mut self.map.pool;
        if request.tiles.is_empty() {
            self.publisher.requested(pool, None, now);
        }
        for &tile in &request.tiles {
            self.publisher.requested(pool, Some(tile), now);
        }
    }

    // Long messages are not decoded in `one`, where they would add to the stack of every other.
    #[inline(never)]
    fn stored(&mut self, stored: Encoded<'_, Stored>) -> Option<()> {
        for &(id, stamp) in &stored.decode().ok()?.tiles {
            self.map.pool.stored(id, stamp);
        }
        Some(())
    }

    #[inline(never)]
    fn compare(&mut self, digests: Encoded<'_, Digests>) -> Option<()> {
        let digests = digests.decode().ok()?;
        if digests.layer == Layer::Robot {
            return None;
        }
        self.fused.compare(&digests);
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
