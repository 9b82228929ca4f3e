//! All ports, and the sessions on them.

use std::collections::BTreeMap;

use ubimap_protocol::{
    frame::SessionId,
    link::{Answer, Terms, answer},
    message::{Hello, Refusal, RefusalReason},
    tile::Epoch,
    time::Instant,
    units::RobotId,
};

use super::{
    command::Command,
    port::{Candidate, Port},
    session::Session,
};

/// The open ports. A robot has at most one session.
#[derive(Debug)]
pub(super) struct Ports {
    open: BTreeMap<usize, Port>,
    next_port: usize,
    /// Last sessions of robots that have none now; their next sessions continue from these.
    parted: BTreeMap<RobotId, Session>,
    next_session: u32,
}

/// The port is not open.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("port {0} is not open")]
pub struct NoSuchPort(pub usize);

/// Why a command was not accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CommandError {
    /// The robot has no session.
    #[error("robot {} has no session", .0.0)]
    NoSession(RobotId),
    /// The command does not fit the frame size negotiated with the robot.
    #[error("the command is too long for the frames of robot {}: shorten it", .0.0)]
    TooLong(RobotId),
}

/// How a Hello was answered.
pub(super) enum Greeted {
    /// The robot got a new session.
    Joined,
    /// The Hello repeats an earlier one, or a session was offered while another one on the port is
    /// alive.
    Answered,
    Refused(RefusalReason),
}

impl Ports {
    /// Starts without ports.
    pub(super) fn new(server_epoch: u32) -> Self {
        Self {
            open: BTreeMap::new(),
            next_port: 0,
            parted: BTreeMap::new(),
            // Session ids must differ from those of earlier runs of the server.
            next_session: server_epoch.wrapping_mul(0x9E37_79B9) | 1,
        }
    }

    /// Sets the number of the next session.
    pub(super) fn number_sessions_from(&mut self, next: u32) {
        self.next_session = next;
    }

    /// Opens a port. Numbers count up from zero and are not reused.
    pub(super) fn open(&mut self) -> usize {
        let port = self.next_port;
        self.next_port += 1;
        self.open.insert(port, Port::default());
        port
    }

    /// Closes a port. Messages that were waiting to be sent there are lost.
    pub(super) fn close(&mut self, port: usize) -> Result<(), NoSuchPort> {
        let mut closed = self.open.remove(&port).ok_or(NoSuchPort(port))?;
        if let Some(session) = closed.end() {
            self.parted.insert(session.robot(), session);
        }
        Ok(())
    }

    pub(super) fn get(&self, port: usize) -> Result<&Port, NoSuchPort> {
        self.open.get(&port).ok_or(NoSuchPort(port))
    }

    pub(super) fn get_mut(&mut self, port: usize) -> Result<&mut Port, NoSuchPort> {
        self.open.get_mut(&port).ok_or(NoSuchPort(port))
    }

    /// The open ports in the order of opening.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Port> {
        self.open.values()
    }

    /// The numbers of the open ports, starting at `port`.
    pub(super) fn numbers_from(&self, port: usize) -> impl Iterator<Item = usize> {
        self.open.range(port..).map(|(&number, _)| number)
    }

    pub(super) fn sessions(&self) -> impl Iterator<Item = &Session> {
        self.open.values().filter_map(Port::session)
    }

    /// The session of a robot whose port is open.
    pub(super) fn session(&self, robot: RobotId) -> Option<&Session> {
        self.sessions().find(|session| session.robot() == robot)
    }

    /// The session of a robot, or its last one if it has none now.
    pub(super) fn last_session(&self, robot: RobotId) -> Option<&Session> {
        self.session(robot).or_else(|| self.parted.get(&robot))
    }

    /// The session of a robot whose port is open.
    pub(super) fn session_mut(&mut self, robot: RobotId) -> Option<&mut Session> {
        self.port_of(robot)?.session_mut()
    }

    /// Forgets the last session of a robot that has none now.
    pub(super) fn forget(&mut self, robot: RobotId) {
        self.parted.remove(&robot);
    }

    fn port_of(&mut self, robot: RobotId) -> Option<&mut Port> {
        self.open.values_mut().find(|port| port.robot() == Some(robot))
    }

    /// Answers a Hello received at a port. The Welcome tells the robot to number the epochs of its
    /// tiles from `first_epoch` on.
    pub(super) fn greet(
        &mut self,
        port: usize,
        hello: &Hello,
        (terms, first_epoch): (&Terms, Epoch),
        now: Instant,
    ) -> Result<Greeted, NoSuchPort> {
        let new = Session::new(hello, self.last_session(hello.robot), now);
        let known = self.get(port)?.session_of(hello);
        let is_known = known.is_some();
        let (id, session) = known.unwrap_or((SessionId(self.next_session.max(1)), &new));
        let renumber = session.is_of_new_life();
        let mut answered = if self.is_in_use(hello.robot, port, now) {
            Answer::Refusal(Refusal { nonce: hello.nonce, reason: RefusalReason::NumberInUse })
        } else {
            answer(hello, terms, id, first_epoch.0)
        };
        if let Answer::Welcome(welcome) = &mut answered {
            welcome.renumber = renumber;
        }
        let greeted = match &answered {
            Answer::Welcome(welcome) if !is_known => {
                self.next_session = self.next_session.wrapping_add(1);
                let offer = Candidate::new(welcome, new, now);
                if self.get(port)?.is_alive(now) {
                    self.get_mut(port)?.offer(offer);
                    Greeted::Answered
                } else {
                    self.begin(port, offer)?;
                    Greeted::Joined
                }
            }
            Answer::Welcome(_) => Greeted::Answered,
            Answer::Refusal(refusal) => Greeted::Refused(refusal.reason),
        };
        self.get_mut(port)?.answer(answered);
        Ok(greeted)
    }

    /// Answers a Hello received at a port with a refusal.
    pub(super) fn refuse(
        &mut self,
        port: usize,
        hello: &Hello,
        reason: RefusalReason,
    ) -> Result<(), NoSuchPort> {
        let refusal = Answer::Refusal(Refusal { nonce: hello.nonce, reason });
        self.get_mut(port)?.answer(refusal);
        Ok(())
    }

    /// Whether a robot with this number has a live session on another port.
    fn is_in_use(&self, robot: RobotId, port: usize, now: Instant) -> bool {
        let mut others = self.open.iter().filter(|(number, _)| **number != port);
        others.any(|(_, other)| other.robot() == Some(robot) && other.is_alive(now))
    }

    /// Begins a session that was offered at a port, if the next frame in `bytes`, received there,
    /// is a valid frame of that session. Returns the robot of the session.
    pub(super) fn poll_candidate(
        &mut self,
        port: usize,
        bytes: &[u8],
        now: Instant,
    ) -> Result<Option<RobotId>, NoSuchPort> {
        let Some(offer) = self.get_mut(port)?.poll_candidate(bytes, now) else { return Ok(None) };
        self.begin(port, offer).map(Some)
    }

    /// Begins an offered session, which continues from the robot's last one. Returns the robot.
    fn begin(&mut self, port: usize, mut offer: Candidate) -> Result<RobotId, NoSuchPort> {
        let robot = offer.session_mut().robot();
        let last = self.port_of(robot).and_then(Port::end).or_else(|| self.parted.remove(&robot));
        if let Some(last) = last {
            offer.session_mut().continue_from(last);
        }
        let there = self.get_mut(port)?;
        let displaced = there.end();
        there.begin(offer);
        if let Some(displaced) = displaced {
            self.parted.insert(displaced.robot(), displaced);
        }
        Ok(robot)
    }

    /// Queues a command for a robot.
    ///
    /// # Errors
    /// Every [`CommandError`].
    pub(super) fn command(&mut self, robot: RobotId, command: Command) -> Result<(), CommandError> {
        let port = self.port_of(robot).ok_or(CommandError::NoSession(robot))?;
        if !port.has_room_for(&command) {
            return Err(CommandError::TooLong(robot));
        }
        if let Some(session) = port.session_mut() {
            session.command(command);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
