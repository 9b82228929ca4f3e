//! All ways in, and which robot has its session where.

use ubimap_protocol::{
    frame::SessionId,
    link::{Answer, Terms, answer},
    message::Hello,
    tile::Epoch,
    time::Instant,
    units::RobotId,
};

use super::{command::Command, port::Port, session::Session};

/// The ports. A robot has one session.
#[derive(Debug)]
pub(super) struct Ports {
    ports: Vec<Port>,
    next_session: u32,
}

/// A port that the server does not have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the server has no port {0}")]
pub struct NoSuchPort(pub usize);

/// Why a command is not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CommandError {
    /// The robot has no session.
    #[error("robot {} has no session", .0.0)]
    NoSession(RobotId),
    /// It does not fit the frames that were agreed on with the robot.
    #[error("the command is too long for the frames of robot {}: shorten it", .0.0)]
    TooLong(RobotId),
}

impl Ports {
    pub(super) fn new(ports: usize, server_epoch: u32) -> Self {
        Self {
            ports: (0..ports).map(|_| Port::default()).collect(),
            // Sessions of different lives of the server must differ.
            next_session: server_epoch.wrapping_mul(0x9E37_79B9) | 1,
        }
    }

    pub(super) fn get(&self, port: usize) -> Result<&Port, NoSuchPort> {
        self.ports.get(port).ok_or(NoSuchPort(port))
    }

    pub(super) fn get_mut(&mut self, port: usize) -> Result<&mut Port, NoSuchPort> {
        self.ports.get_mut(port).ok_or(NoSuchPort(port))
    }

    pub(super) fn sessions(&self) -> impl Iterator<Item = &Session> {
        self.ports.iter().filter_map(Port::session)
    }

    /// The session of a robot.
    pub(super) fn session(&self, robot: RobotId) -> Option<&Session> {
        self.sessions().find(|session| session.robot == robot)
    }

    /// The session of a robot.
    pub(super) fn session_mut(&mut self, robot: RobotId) -> Option<&mut Session> {
        self.port_of(robot)?.session_mut()
    }

    fn port_of(&mut self, robot: RobotId) -> Option<&mut Port> {
        self.ports.iter_mut().find(|port| port.robot() == Some(robot))
    }

    /// Answers a hello that came in at a port: a robot that is welcome has a session there, whose
    /// own tiles begin with this epoch.
    pub(super) fn greet(
        &mut self,
        index: usize,
        hello: &Hello,
        (terms, first_epoch): (&Terms, Epoch),
        now: Instant,
    ) -> Result<(), NoSuchPort> {
        let known = self.get(index)?.session_of(hello);
        let id = known.unwrap_or(SessionId(self.next_session.max(1)));
        let answered = answer(hello, terms, id, first_epoch.0);
        match answered {
            Answer::Welcome(welcome) if known.is_none() => {
                self.next_session = self.next_session.wrapping_add(1);
                let mut session = Session::new(hello.robot, hello.nonce, hello.fused_tiles, now);
                // It may have moved to another port.
                if let Some(last) = self.port_of(hello.robot).and_then(Port::end) {
                    session.continue_from(last);
                }
                self.get_mut(index)?.begin(id, welcome.frame, session);
                log::info!("robot {} has a session on port {index}", hello.robot.0);
            }
            Answer::Welcome(_) => {}
            Answer::Refusal(refusal) => {
                log::warn!("robot {} is refused: {:?}", hello.robot.0, refusal.reason);
            }
        }
        self.get_mut(index)?.answer(answered);
        Ok(())
    }

    /// A command for a robot.
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
