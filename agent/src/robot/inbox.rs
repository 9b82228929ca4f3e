//! What the server says: each message to the part of the robot that it is for.

use ubimap_protocol::{
    link::ClockSync,
    message::{
        Ack, Digests, EventCode, FixSource, Freshness, Messages, ParameterAction, ParameterCommand,
        PoseFix, Request, Stored, TileUpdateHead, TimeReply, ToRobotKind, Welcome, decode,
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
    /// A session has begun, with the server of the last one or with another.
    pub(super) fn begin_session(&mut self, welcome: &Welcome, same_server: bool, now: Instant) {
        self.statistics.sessions = self.statistics.sessions.wrapping_add(1);
        if !same_server {
            // Another life of the server has another clock: moments of the last one mean nothing.
            self.clock = ClockSync::default();
            self.commands.forget();
            self.latest_pose = None;
        }
        let pool = &mut self.map.pool;
        pool.begin_session(welcome.stores, same_server);
        pool.start_epochs_at(Epoch(welcome.first_epoch));
        let is_first = self.statistics.sessions == 1;
        self.outbox.begin_session(pool, same_server, is_first, now);
        self.fused.begin_session(Epoch(welcome.server_epoch));
    }

    /// Takes the messages of a frame.
    pub(super) fn take(&mut self, messages: Messages<'_>, now: Instant) {
        let mut command = None;
        for message in messages.map_while(Result::ok) {
            if message.kind == Ack::KIND {
                continue;
            }
            let Some(kind) = ToRobotKind::from_number(message.kind) else {
                self.statistics.unknown_messages = self.statistics.unknown_messages.wrapping_add(1);
                continue;
            };
            // Apart, or the longest messages would be on the stack below the deepest calls.
            let taken = match kind {
                ToRobotKind::PoseFix => self.take_fix(message.body, now),
                ToRobotKind::Peers
                | ToRobotKind::Obstacles
                | ToRobotKind::Path
                | ToRobotKind::Stop => self.commands.take(kind, message.body),
                _ => self.take_other(kind, message.body, &mut command, now),
            };
            if taken.is_none() {
                self.statistics.malformed();
            }
        }
        if let Some(command) = command {
            self.configure(&command);
        }
    }

    /// Takes fixes. `None` if the message cannot be read.
    #[inline(never)]
    fn take_fix(&mut self, body: &[u8], now: Instant) -> Option<()> {
        self.fix(&decode::<PoseFix>(body).ok()?.0, now);
        Some(())
    }

    /// Takes a message; a command about parameters is carried out when the frame has been read.
    /// `None` if the message cannot be read.
    #[inline(never)]
    fn take_other(
        &mut self,
        kind: ToRobotKind,
        body: &[u8],
        command: &mut Option<ParameterCommand>,
        now: Instant,
    ) -> Option<()> {
        match kind {
            ToRobotKind::TimeReply => self.clock.reply(&decode::<TimeReply>(body).ok()?.0, now),
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
                    self.outbox.publisher.requested(pool, None, now);
                }
                for &tile in &request.tiles {
                    self.outbox.publisher.requested(pool, Some(tile), now);
                }
            }
            ToRobotKind::Parameter => *command = Some(decode(body).ok()?.0),
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
            // Those of handshake frames; the rest is taken apart.
            _ => return None,
        }
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
                    if self.latest_pose.is_none_or(|(latest, _)| latest < moment) {
                        self.latest_pose = Some((moment, pose));
                    }
                }
                Err(FixError::Repeated | FixError::Unused) => {}
                Err(FixError::TooOld | FixError::Future | FixError::Untimed) => {
                    count.fixes_untimely = count.fixes_untimely.wrapping_add(1);
                }
            }
        }
    }

    /// Carries out a command about parameters.
    fn configure(&mut self, command: &ParameterCommand) {
        let first_epoch = self.settings.first_epoch;
        self.outbox.answer = Some(carry_out(command, &mut self.settings));
        self.outbox.publisher.set_hold(self.settings.hold);
        if let ParameterAction::Set(_) = command.action {
            // Whatever it was: commands are rare, and the table is soon filled.
            point_beams(self.beams, &self.settings);
            self.map.configure((&self.settings).into(), self.beams);
        }
        if self.settings.first_epoch != first_epoch {
            self.map.pool.begin_anew(self.settings.first_epoch);
            self.selection.begin_anew();
        }
    }
}
