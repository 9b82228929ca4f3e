//! Dispatches the server's messages.

use ubimap_protocol::{
    link::ClockSync,
    message::{
        Digests, Encoded, EventCode, FixSource, Messages, ParameterAction, ParameterCommand,
        PoseFix, Request, Stored, ToRobot, ToRobotMessage, Welcome,
    },
    tile::{Epoch, Layer},
    time::Instant,
};

use super::{
    mapper::{Mapper, point_beams},
    parameters::carry_out,
};
use crate::locate::{FixError, FixOutcome};

impl Mapper<'_> {
    /// Starts a session, either with the same server as before or with another one.
    pub(super) fn begin_session(&mut self, welcome: &Welcome, same_server: bool, now: Instant) {
        self.statistics.sessions = self.statistics.sessions.wrapping_add(1);
        if !same_server {
            // A restarted server has another clock, so times by the old clock mean nothing now.
            self.clock = ClockSync::default();
            self.commands.forget();
        }
        let pool = &mut self.map.pool;
        pool.begin_session(welcome.stores, same_server);
        pool.start_epochs_at(Epoch(welcome.first_epoch), welcome.renumber);
        let is_first = self.statistics.sessions == 1;
        self.outbox.begin_session(pool, same_server, is_first, now);
        self.fused.begin_session(Epoch(welcome.server_epoch));
    }

    /// Processes the messages of a frame.
    pub(super) fn take(&mut self, messages: Messages<'_, ToRobot>, now: Instant) {
        let mut command = None;
        for message in messages.map_while(Result::ok) {
            let Some(message) = message.by_kind() else {
                self.statistics.unknown_messages = self.statistics.unknown_messages.wrapping_add(1);
                continue;
            };
            if self.take_one(message, &mut command, now).is_none() {
                self.statistics.malformed();
            }
        }
        if let Some(command) = command {
            self.configure(&command);
        }
    }

    /// Processes a message. A command about parameters is only stored in `command`; the caller
    /// executes it after the rest of the frame. Returns `None` if the message is malformed.
    fn take_one(
        &mut self,
        message: ToRobotMessage<'_>,
        command: &mut Option<ParameterCommand>,
        now: Instant,
    ) -> Option<()> {
        match message {
            // Already processed by the link.
            ToRobotMessage::Ack(_) => {}
            ToRobotMessage::TimeReply(reply) => self.clock.reply(&reply.decode().ok()?, now),
            ToRobotMessage::PoseFix(fix) => self.fix(&fix.decode().ok()?, now),
            ToRobotMessage::TileUpdate(update) => {
                let (head, coded) = update.split().ok()?;
                if head.layer == Layer::Robot {
                    return None;
                }
                let (publisher, pool) = (&mut self.outbox.publisher, &mut self.map.pool);
                // The robot has not sent cells that agreed with a wrong tile, so they must be sent
                // now.
                let dropped = |id| publisher.requested(pool, id, now);
                self.fused.update(head.layer, coded, dropped).ok()?;
            }
            ToRobotMessage::Request(request) => self.requested(&request.decode().ok()?, now),
            ToRobotMessage::Peers(_)
            | ToRobotMessage::Obstacles(_)
            | ToRobotMessage::Path(_)
            | ToRobotMessage::Stop(_) => self.commands.take(message)?,
            ToRobotMessage::Parameter(told) => *command = Some(told.decode().ok()?),
            ToRobotMessage::Stored(stored) => self.stored(stored)?,
            ToRobotMessage::Digests(digests) => self.compare(digests, now)?,
            ToRobotMessage::Freshness(freshness) => {
                let freshness = freshness.decode().ok()?;
                // Without synchronised clocks the age of the message is unknown.
                if let Some(moment) = self.clock.to_local(freshness.time) {
                    self.fused.confirm(&freshness, moment);
                }
            }
            // These are allowed in handshake frames only.
            ToRobotMessage::Welcome(_) | ToRobotMessage::Refusal(_) | ToRobotMessage::Reset(_) => {
                return None;
            }
        }
        Some(())
    }

    fn requested(&mut self, request: &Request, now: Instant) {
        let pool = &mut self.map.pool;
        if request.tiles.is_empty() {
            self.outbox.publisher.requested(pool, None, now);
        }
        for &tile in &request.tiles {
            self.outbox.publisher.requested(pool, Some(tile), now);
        }
    }

    // Long messages are decoded outside `take_one`, so that they do not add to its stack frame.
    #[inline(never)]
    fn stored(&mut self, stored: Encoded<'_, Stored>) -> Option<()> {
        for &(id, stamp) in &stored.decode().ok()?.tiles {
            self.map.pool.stored(id, stamp);
        }
        Some(())
    }

    #[inline(never)]
    fn compare(&mut self, digests: Encoded<'_, Digests>, now: Instant) -> Option<()> {
        let digests = digests.decode().ok()?;
        if digests.layer == Layer::Robot {
            return None;
        }
        let (publisher, pool) = (&mut self.outbox.publisher, &mut self.map.pool);
        // The robot has not sent cells that agreed with a wrong tile, so they must be sent now.
        self.fused.compare(&digests, |id| publisher.requested(pool, Some(id), now));
        Some(())
    }

    fn fix(&mut self, message: &PoseFix, now: Instant) {
        let count = &mut self.statistics;
        for (moment, told) in message.fixes() {
            let local = self.clock.to_local(moment);
            match self.locator.fix(moment, local, told, message.certainty, now) {
                Ok((outcome, pose)) => {
                    count.fixes = count.fixes.wrapping_add(1);
                    match outcome {
                        FixOutcome::Rejected => {
                            count.fixes_rejected = count.fixes_rejected.wrapping_add(1);
                            self.outbox.events.raise(EventCode::FixRejected, now);
                        }
                        FixOutcome::Moved => count.moves = count.moves.wrapping_add(1),
                        FixOutcome::Taken if message.source == FixSource::Camera => {
                            if let Some(local) = local {
                                self.locator.learn(local, told, message.certainty);
                            }
                        }
                        FixOutcome::Began | FixOutcome::Taken => {}
                    }
                    if let Some(local) = local
                        && self.latest_pose.is_none_or(|(latest, _)| latest < local)
                    {
                        self.latest_pose = Some((local, pose));
                    }
                }
                Err(FixError::Repeated | FixError::Unused) => {}
                Err(FixError::TooOld | FixError::Future | FixError::Untimed) => {
                    count.fixes_untimely = count.fixes_untimely.wrapping_add(1);
                }
            }
        }
    }

    /// Executes a command that reads or changes parameters.
    fn configure(&mut self, command: &ParameterCommand) {
        let first_epoch = self.settings.first_epoch;
        if let Some(answer) = carry_out(command, &mut self.settings) {
            self.outbox.answer = Some(answer);
        }
        self.outbox.publisher.set_hold(self.settings.hold);
        if let ParameterAction::Set(_) = command.action {
            // The table of beams is recomputed whichever parameter was set: commands are rare, and
            // the table is cheap.
            point_beams(self.beams, &self.settings);
            self.map.configure((&self.settings).into(), self.beams);
        }
        if self.settings.first_epoch != first_epoch {
            self.map.pool.begin_anew(self.settings.first_epoch);
            self.selection.begin_anew();
        }
    }
}
