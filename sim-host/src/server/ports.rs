//! All ports, and the sessions on them.

use std::collections::BTreeMap;

use ubimap_protocol::{
    frame::{Attempt, Key, MAX_SEALED_HANDSHAKE, SessionId, SessionKey, Stray},
    link::{Answer, Terms, Verdict, answer, answer_sealed, write_answer},
    message::{Body, Hello, Refusal, RefusalReason, SealedReset, ToRobot},
    tile::Epoch,
    time::Instant,
    units::RobotId,
};

use super::{
    command::Command,
    keyring::{Age, Keyring},
    port::{Brought, Candidate, Policy, Port, SealedOffer},
    session::Session,
};
use crate::timing::SESSION_SILENT;

/// The open ports. A robot has at most one session.
#[derive(Debug)]
pub(super) struct Ports {
    open: BTreeMap<usize, Port>,
    next_port: usize,
    /// Last sessions of robots that have none now; their next sessions continue from these.
    parted: BTreeMap<RobotId, Session>,
    next_session: u32,
    keyring: Keyring,
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
    /// A sealed Hello of an earlier attempt. The operator must be told if `tell`.
    Old {
        tell: bool,
    },
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
            keyring: Keyring::new(u64::from(server_epoch).wrapping_mul(0x9E37_79B9_7F4A_7C15)),
        }
    }

    /// Sets the number of the next session.
    pub(super) fn number_sessions_from(&mut self, next: u32) {
        self.next_session = next;
    }

    /// Sets the salt of the next sealed answer.
    pub(super) fn salt_from(&mut self, next: u64) {
        self.keyring.salt_from(next);
    }

    /// Sets the key of a robot. A session under another key ends.
    pub(super) fn set_key(&mut self, robot: RobotId, key: Key) {
        if self.keyring.key(robot).is_some_and(|held| held != key) {
            self.retire_key(robot);
        }
        self.keyring.set(robot, key);
    }

    /// Removes the key of a robot; its session on a keyed port ends, and offers are withdrawn.
    /// Returns whether there was a key.
    pub(super) fn retire_key(&mut self, robot: RobotId) -> bool {
        let was_there = self.keyring.retire(robot);
        let keyed = self.open.values_mut().filter(|port| port.policy() == Policy::Keyed);
        for port in keyed {
            port.withdraw(robot);
            if port.robot() == Some(robot)
                && let Some(session) = port.end()
            {
                self.parted.insert(robot, session);
            }
        }
        was_there
    }

    /// Whether the operator must be told that a robot has no key.
    pub(super) fn tells_of(&mut self, robot: RobotId) -> bool {
        self.keyring.key(robot).is_none() && self.keyring.tell(robot)
    }

    /// Opens a port. Numbers count up from zero and are not reused.
    pub(super) fn open(&mut self, policy: Policy) -> usize {
        let port = self.next_port;
        self.next_port += 1;
        self.open.insert(port, Port::new(policy));
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

    /// Decodes a frame from the front of `bytes`, received at a port: see [`Port::receive`].
    pub(super) fn receive(
        &mut self,
        port: usize,
        bytes: &mut &[u8],
        now: Instant,
    ) -> Result<Option<Brought<'_>>, NoSuchPort> {
        let Self { open, keyring, parted, .. } = self;
        let there = open.get_mut(&port).ok_or(NoSuchPort(port))?;
        if there.is_spent()
            && let Some(session) = there.end()
        {
            parted.insert(session.robot(), session);
        }
        Ok(there.receive(bytes, keyring, now))
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

    /// Answers a sealed Hello received at a port: see [`Ports::greet`]. It never ends a session, and
    /// the first frame of the session that it offers does so only for the robot's own.
    pub(super) fn greet_sealed(
        &mut self,
        port: usize,
        (attempt, hello): (Attempt, &Hello),
        (terms, first_epoch): (&Terms, Epoch),
        now: Instant,
    ) -> Result<Greeted, NoSuchPort> {
        let robot = hello.robot;
        match self.judge(port, attempt, robot, now)? {
            Ok(()) => {}
            Err(greeted) => return Ok(greeted),
        }
        let session = Session::new(hello, self.last_session(robot), now);
        let id = SessionId(self.next_session.max(1));
        match answer_sealed(hello, terms, id, first_epoch.0) {
            Answer::Welcome(mut welcome) => {
                welcome.renumber = session.is_of_new_life();
                self.next_session = self.next_session.wrapping_add(1);
                let (salt, key) = (self.keyring.salt(), self.keyring.key(robot));
                let Some(key) = key else { return Ok(Greeted::Answered) };
                let frame = sealed(&key, (robot, Some(attempt), salt), &welcome);
                let key = SessionKey::derive(&key, robot, attempt, salt, id);
                let seal = SealedOffer { attempt, key, welcome: frame.clone() };
                let there = self.get_mut(port)?;
                there.offer(Candidate::new(&welcome, session, now).sealed(seal));
                there.answer_sealed(frame);
                Ok(Greeted::Answered)
            }
            Answer::Refusal(refusal) => {
                self.refuse_with(port, robot, attempt, &refusal)?;
                Ok(Greeted::Refused(refusal.reason))
            }
        }
    }

    /// Counts a sealed Hello by its attempt. Repeats the Welcome if it was offered here before, and
    /// returns how the Hello was answered, unless it must be answered still.
    fn judge(
        &mut self,
        port: usize,
        attempt: Attempt,
        robot: RobotId,
        now: Instant,
    ) -> Result<Result<(), Greeted>, NoSuchPort> {
        let age = self.keyring.judge(robot, attempt);
        let there = self.get_mut(port)?;
        there.judge(if age == Age::Old { Verdict::Replayed } else { Verdict::Good });
        match age {
            // A robot whose boot counter was reset knocks in vain.
            Age::Old => {
                let tell = !self.has_live_session(robot, now) && self.keyring.tell(robot);
                return Ok(Err(Greeted::Old { tell }));
            }
            Age::Repeated => {
                let welcome = there.welcome_of(robot, attempt).map(<[u8]>::to_vec);
                if let Some(welcome) = welcome {
                    there.answer_sealed(welcome);
                    return Ok(Err(Greeted::Answered));
                }
            }
            Age::New => self.open.values_mut().for_each(|port| port.withdraw(robot)),
        }
        Ok(Ok(()))
    }

    /// Answers a sealed Hello received at a port with a refusal, unless it is an old one.
    pub(super) fn refuse_sealed(
        &mut self,
        port: usize,
        (attempt, hello): (Attempt, &Hello),
        reason: RefusalReason,
        now: Instant,
    ) -> Result<(), NoSuchPort> {
        let refusal = Refusal { nonce: hello.nonce, reason };
        match self.judge(port, attempt, hello.robot, now)? {
            Ok(()) => self.refuse_with(port, hello.robot, attempt, &refusal),
            Err(_) => Ok(()),
        }
    }

    fn refuse_with(
        &mut self,
        port: usize,
        robot: RobotId,
        attempt: Attempt,
        refusal: &Refusal,
    ) -> Result<(), NoSuchPort> {
        let salt = self.keyring.salt();
        if let Some(key) = self.keyring.key(robot) {
            let frame = sealed(&key, (robot, Some(attempt), salt), refusal);
            self.get_mut(port)?.answer_sealed(frame);
        }
        Ok(())
    }

    /// Answers a sealed frame at a port that no session there opens with a Reset, unless the robot
    /// that it names is alive.
    pub(super) fn stray(
        &mut self,
        port: usize,
        stray: Stray,
        now: Instant,
    ) -> Result<(), NoSuchPort> {
        let Stray { robot, echo } = stray;
        if let Some(key) = self.keyring.key(robot)
            && !self.has_live_session(robot, now)
        {
            let salt = self.keyring.salt();
            let frame = sealed(&key, (robot, None, salt), &SealedReset { echo });
            self.get_mut(port)?.reset_sealed(frame);
        }
        Ok(())
    }

    fn has_live_session(&self, robot: RobotId, now: Instant) -> bool {
        self.session(robot).is_some_and(|session| session.silent_for(now) < SESSION_SILENT)
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
        if let Some(attempt) = offer.attempt() {
            self.keyring.spend(robot, attempt);
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

/// The sealed frame of an answer to a robot.
fn sealed<M: Body<ToRobot>>(
    key: &Key,
    names: (RobotId, Option<Attempt>, u64),
    message: &M,
) -> Vec<u8> {
    let mut frame = vec![0; MAX_SEALED_HANDSHAKE];
    let len = write_answer(key, names, message, &mut frame);
    frame.truncate(len.unwrap_or(0));
    frame
}

#[cfg(test)]
mod sealed_tests;
#[cfg(test)]
mod tests;
