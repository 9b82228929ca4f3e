//! The runner as the server of a robot.

use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MAX_FRAME, SessionId, VERSION},
    message::{
        Certainty, FixSource, Hello, Message, ParameterAction, ParameterCommand, ParameterReport,
        PoseFix, Reset, TileUpdateHead, ToRobot, ToServer, Welcome,
    },
    time::Duration,
    units::Pose,
};

use super::{
    frames::Note,
    halt::{Halt, Role, fail, skip},
    talk::{Seen, Talk},
};

/// Interval of the resets that make a robot knock. It must be silent for 300 ms before it heeds one.
const RESETS: Duration = Duration::from_millis(700);
/// The longest time that a robot may wait before it knocks: it was refused.
const LONGEST_KNOCK: Duration = Duration::from_secs(12);
/// Interval of the fixes.
const FIXES: Duration = Duration::from_millis(100);
/// How old a fix is when it is sent.
const FIX_AGE: Duration = Duration::from_millis(60);
/// Where the robot stands, by the fixes: to the west of the origin, where coordinates and tiles are negative.
pub(super) const STANDS: (f64, f64) = (-1.0, 1.0);
/// Time for a robot to send a tile.
const TILE_TIME: Duration = Duration::from_secs(12);

impl Talk<'_> {
    /// Makes the robot knock. Returns its Hello.
    pub(super) fn hello(&mut self) -> Result<Hello, Halt> {
        let was_polite = std::mem::replace(&mut self.is_polite, false);
        let end = self.now() + LONGEST_KNOCK;
        loop {
            if let Some(hello) = self.body::<ToServer, Hello>(RESETS)? {
                self.is_polite = was_polite;
                self.server.hello = Some(hello);
                return Ok(hello);
            }
            if self.now() >= end {
                return fail("4.2: a Hello within 12 s, and after a Reset", "none");
            }
            self.handshake(Note::new::<ToRobot, _>(&Reset))?;
        }
    }

    /// A Welcome for a Hello, to a new session.
    pub(super) fn welcome_for(&mut self, hello: &Hello) -> Welcome {
        self.server.sessions += 1;
        Welcome {
            nonce: hello.nonce,
            version: hello.version.min(VERSION),
            session: SessionId(self.server.sessions),
            frame: hello.frame.min(DEFAULT_FRAME as u16),
            server_epoch: self.server.epoch,
            first_epoch: self.server.first_epoch,
            stores: false,
            renumber: false,
        }
    }

    /// Sends a Welcome, and begins its session.
    pub(super) fn send_welcome(&mut self, welcome: &Welcome) -> Result<(), Halt> {
        self.begin(welcome.session);
        self.handshake(Note::new::<ToRobot, _>(welcome))
    }

    /// Opens a session with the robot by a Welcome that `change` may alter, and waits until it has been
    /// heard there.
    pub(super) fn welcome_robot(&mut self, change: impl FnOnce(&mut Welcome)) -> Result<(), Halt> {
        let hello = self.hello()?;
        self.begin_session_with(&hello, change)
    }

    fn begin_session_with(
        &mut self,
        hello: &Hello,
        change: impl FnOnce(&mut Welcome),
    ) -> Result<(), Halt> {
        let mut welcome = self.welcome_for(hello);
        change(&mut welcome);
        self.send_welcome(&welcome)?;
        let patience = Duration::from_millis(2_500) + self.slack();
        let session = self.session;
        let heard = self.find(patience, |_, seen| {
            seen.frame.as_ref().is_ok_and(|frame| frame.session == session)
        })?;
        if heard.is_none() {
            return fail("4.2: a frame of the session within 2.5 s of its Welcome", "none");
        }
        Ok(())
    }

    /// A session with a server of another epoch, so that the robot sends everything anew.
    pub(super) fn welcome_by_another_server(
        &mut self,
        change: impl FnOnce(&mut Welcome),
    ) -> Result<(), Halt> {
        let hello = self.hello()?;
        self.server.epoch = self.server.epoch.wrapping_add(0x1111);
        // Frames of the session before have arrived until now.
        self.server.followed.clear();
        self.begin_session_with(&hello, change)
    }

    /// A question to a robot.
    pub(super) fn parameter_question(&self) -> Note {
        Note::new::<ToRobot, _>(&ParameterCommand {
            number: self.asked,
            action: ParameterAction::List,
        })
    }

    /// The numbers of the commands that a frame reports on.
    pub(super) fn reported(&self, seen: &Seen) -> Vec<u16> {
        seen.bodies::<ToServer, ParameterReport>().map(|report| report.number).collect()
    }

    /// Follows what the peer publishes.
    pub(super) fn follow(&mut self, seen: &Seen) {
        if self.role == Role::Server {
            return self.follow_server(seen);
        }
        let Some(carrier) = seen.carrier() else { return };
        for note in &seen.notes {
            let message = Message::<ToServer>::new(note.number, &note.body);
            if let Ok(update) = message.split::<TileUpdateHead>() {
                let followed = &mut self.server.followed;
                followed.take(update, &carrier);
                let newest = followed.tiles.keys().map(|(_, _, epoch)| epoch.0 + 1).max();
                self.server.first_epoch = self.server.first_epoch.max(newest.unwrap_or(1));
            }
        }
    }

    /// Sends the robot a fix of where it stands.
    pub(super) fn fix(&mut self) -> Result<(), Halt> {
        let time = self.server.time(self.now() - FIX_AGE);
        let fix = PoseFix {
            time,
            pose: Pose::from_metres(STANDS.0, STANDS.1, 0.0),
            certainty: Certainty { x: 5, y: 5, heading: 100 },
            source: FixSource::Camera,
            earlier: Default::default(),
        };
        self.datagram(&[Note::new::<ToRobot, _>(&fix)])
    }

    /// Everything that arrives within a time, while the robot gets fixes.
    pub(super) fn collect_with_fixes(&mut self, span: Duration) -> Result<Vec<Seen>, Halt> {
        let end = self.now() + span;
        let mut all = Vec::new();
        while self.now() < end {
            self.fix()?;
            let left = end.since(self.now());
            all.extend(self.collect(FIXES.min(left))?);
        }
        Ok(all)
    }

    /// Waits until the robot has published a tile completely.
    pub(super) fn must_publish(&mut self) -> Result<(), Halt> {
        let end = self.now() + TILE_TIME;
        while self.now() < end {
            self.collect_with_fixes(Duration::from_millis(500))?;
            if self.server.followed.updates.iter().any(super::followed::Update::is_last_part) {
                return Ok(());
            }
        }
        skip("the robot published no tile within 12 s of fixes and synchronised clocks")
    }

    /// The largest frame to agree on with the robot.
    pub(super) fn largest_frame(&self) -> u16 {
        self.server.hello.map_or(DEFAULT_FRAME as u16, |hello| hello.frame).min(MAX_FRAME as u16)
    }
}
