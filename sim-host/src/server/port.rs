//! One port and its session.

use ubimap_protocol::{
    frame::SessionId,
    link::{Answer, Counters, Received},
    message::{Hello, Messages, Reset, ToServer, Writer},
    time::{Duration, Instant},
    units::RobotId,
};

use super::{
    command::Command,
    inflow::Inflow,
    session::{Link, Session},
    snapshot::Snapshot,
};
use crate::timing::SESSION_SILENT;

/// Minimum interval between Reset messages, which tell a robot that it has no session here.
const RESET_INTERVAL: Duration = Duration::from_millis(200);

/// A serial port or a simulated channel, with at most one robot behind it.
#[derive(Debug)]
pub(super) struct Port {
    link: Link,
    inflow: Inflow,
    session: Option<Session>,
    /// The handshake frame to send.
    answer: Option<Answer>,
    reset: PendingReset,
    /// Numbers of messages of unknown kinds, and of malformed messages.
    unknown: u32,
    malformed: u32,
    bytes_sent: u64,
}

#[derive(Debug, Default)]
struct PendingReset {
    due: bool,
    last: Option<Instant>,
}

/// The contents of a frame.
pub(super) enum Brought<'p> {
    /// Nothing to be handled outside of the port.
    Nothing,
    Hello(Hello),
    /// Messages of the session. Call [`Port::taken`] after handling them.
    Messages(&'p mut Session, Messages<'p, ToServer>),
}

impl Default for Port {
    fn default() -> Self {
        Self {
            link: Link::new(),
            inflow: Inflow::default(),
            session: None,
            answer: None,
            reset: PendingReset::default(),
            unknown: 0,
            malformed: 0,
            bytes_sent: 0,
        }
    }
}

impl Port {
    /// Returns the received bytes that may be read, and whether a flood begins with them.
    pub(super) fn admit<'b>(&mut self, bytes: &'b [u8], now: Instant) -> (&'b [u8], bool) {
        let was_flooded = self.inflow.floods();
        let admitted = self.inflow.admit(bytes.len(), now);
        (bytes.get(..admitted).unwrap_or_default(), !was_flooded && self.inflow.floods())
    }

    /// Decodes a frame from the front of `bytes`. `None` if they are used up.
    pub(super) fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Brought<'_>> {
        let Self { link, session, reset, malformed, .. } = self;
        Some(match (link.receive(bytes, now)?, session) {
            (Received::Bad, session) => {
                let is_silent = |session: &mut Session| session.silent_for(now) >= SESSION_SILENT;
                reset.due |= session.as_mut().is_none_or(is_silent);
                Brought::Nothing
            }
            (Received::Handshake(message), _) => match message.decode() {
                Ok(hello) => Brought::Hello(hello),
                Err(_) => {
                    *malformed += 1;
                    Brought::Nothing
                }
            },
            (Received::Session(messages), Some(session)) => {
                session.hear(now);
                Brought::Messages(session, messages)
            }
            (Received::Session(_), None) => Brought::Nothing,
        })
    }

    /// Call this after handling a frame, with the numbers of messages of unknown kinds and of
    /// malformed messages.
    pub(super) fn taken(&mut self, unknown: u32, malformed: u32) {
        self.unknown += unknown;
        self.malformed += malformed;
        while let Some(frame) = self.link.poll_acknowledged() {
            if let Some(session) = &mut self.session {
                session.acknowledged(frame);
            }
        }
    }

    /// The open session that was the answer to this Hello.
    pub(super) fn session_of(&self, hello: &Hello) -> Option<SessionId> {
        let session = self.session.as_ref()?;
        session.answers(hello).then(|| self.link.session())
    }

    /// Starts a session with frames of at most `frame` bytes.
    pub(super) fn begin(&mut self, id: SessionId, frame: u16, session: Session) {
        self.link.begin(id, usize::from(frame));
        // A pending Reset concerned the previous session.
        self.reset.due = false;
        self.session = Some(session);
    }

    /// Ends the session.
    pub(super) fn end(&mut self) -> Option<Session> {
        self.link.end();
        self.session.take()
    }

    /// Queues the answer to a Hello.
    pub(super) fn answer(&mut self, answer: Answer) {
        self.answer = Some(answer);
    }

    pub(super) fn session(&self) -> Option<&Session> {
        self.session.as_ref()
    }

    pub(super) fn session_mut(&mut self) -> Option<&mut Session> {
        self.session.as_mut()
    }

    /// The robot of the session.
    pub(super) fn robot(&self) -> Option<RobotId> {
        self.session().map(Session::robot)
    }

    /// Whether a command fits the frame size negotiated with the robot.
    pub(super) fn has_room_for(&self, command: &Command) -> bool {
        command.write(&mut Writer::new(&mut vec![0; self.link.room()]))
    }

    /// Writes the next due frame. Returns its length.
    pub(super) fn poll_transmit(
        &mut self,
        snapshot: &Snapshot<'_>,
        now: Instant,
        out: &mut [u8],
    ) -> Option<usize> {
        let len =
            self.poll_handshake(now, out).or_else(|| self.poll_session(snapshot, now, out))?;
        self.bytes_sent += len as u64;
        Some(len)
    }

    fn poll_handshake(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        match self.answer.take() {
            Some(Answer::Welcome(welcome)) => {
                return self.link.handshake(&welcome, out);
            }
            Some(Answer::Refusal(refusal)) => {
                return self.link.handshake(&refusal, out);
            }
            None => {}
        }
        if !self.reset.due || self.reset.ready_at() > now {
            return None;
        }
        self.reset = PendingReset { due: false, last: Some(now) };
        self.link.handshake(&Reset, out)
    }

    fn poll_session(
        &mut self,
        snapshot: &Snapshot<'_>,
        now: Instant,
        out: &mut [u8],
    ) -> Option<usize> {
        let session = self.session.as_mut()?;
        let urgent = session.is_urgent(now);
        let sent = self.link.poll_transmit(now, out, urgent, |writer, reliable| {
            session.fill(snapshot, now, writer, reliable)
        })?;
        session.sent(sent.len, now);
        Some(sent.len)
    }

    /// When the next frame is due.
    pub(super) fn poll_timeout(&self, snapshot: &Snapshot<'_>, now: Instant) -> Option<Instant> {
        if self.answer.is_some() {
            return Some(now);
        }
        let reset = self.reset.due.then(|| self.reset.ready_at());
        let reliable = self.link.can_send_reliable();
        let session = self.session();
        let messages = session.and_then(|session| session.poll_timeout(snapshot, reliable, now));
        [reset, self.link.poll_timeout(), messages].into_iter().flatten().min()
    }

    /// Bytes sent, including framing and retransmissions.
    pub(super) fn bytes_sent(&self) -> u64 {
        self.bytes_sent
    }

    /// Counters of the link.
    pub(super) fn counters(&self) -> Counters {
        self.link.counters()
    }

    /// Numbers of messages of unknown kinds, and of malformed messages.
    pub(super) fn unread(&self) -> (u32, u32) {
        (self.unknown, self.malformed)
    }
}

impl PendingReset {
    fn ready_at(&self) -> Instant {
        self.last.map_or(Instant(0), |last| last + RESET_INTERVAL)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::{CommandError, Server};
    use ubimap_protocol::{
        frame::{MAX_FRAME, MIN_VERSION, VERSION},
        link::{Endpoint, Terms},
        message::Stop,
        units::Millimetres,
    };

    const TERMS: Terms =
        Terms { resolution: Millimetres(50), frame: 250, server_epoch: 1, stores: false };

    fn hello(nonce: u32) -> Vec<u8> {
        let hello = Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: RobotId(1),
            nonce,
            frame: 250,
            resolution: Millimetres(50),
            fused_tiles: 16,
        };
        let mut out = [0u8; 250];
        let mut robot = Endpoint::<ToServer, (), 1, MAX_FRAME>::new();
        let len = robot.handshake(&hello, &mut out).unwrap();
        out[..len].to_vec()
    }

    /// Number of frames that the server sends on port 0.
    fn drain(server: &mut Server, now: Instant) -> usize {
        let mut out = [0u8; MAX_FRAME];
        std::iter::from_fn(|| server.poll_transmit(0, now, &mut out)).count()
    }

    /// An old Hello must not lock out the robot whose session it ended.
    #[test]
    fn a_session_opened_by_an_old_hello_is_reset() {
        let mut server = Server::new(TERMS, 1);
        server.receive(0, &hello(5), Instant(0)).unwrap();
        assert_eq!(drain(&mut server, Instant(0)), 1);
        let of_the_session_before = [7u8, 7, 0];
        let soon = Instant(0) + Duration::from_secs(1);
        server.receive(0, &of_the_session_before, soon).unwrap();
        assert_eq!(drain(&mut server, soon), 0, "a single bad frame may just be damaged");
        let later = Instant(0) + SESSION_SILENT;
        server.receive(0, &of_the_session_before, later).unwrap();
        assert_eq!(drain(&mut server, later), 1);
        assert_eq!(server.robot_at(0), Some(RobotId(1)));
    }

    #[test]
    fn a_new_session_cancels_a_pending_reset() {
        let mut server = Server::new(TERMS, 1);
        let garbage = [7u8, 7, 0];
        server.receive(0, &garbage, Instant(0)).unwrap();
        assert_eq!(drain(&mut server, Instant(0)), 1);
        // The next Reset has to wait, and a Hello comes first.
        server.receive(0, &garbage, Instant(1)).unwrap();
        assert_eq!(drain(&mut server, Instant(1)), 0);
        server.receive(0, &hello(5), Instant(2)).unwrap();
        assert_eq!(drain(&mut server, Instant(2)), 1);
        assert_eq!(server.poll_timeout(0, Instant(2)), None);
    }

    /// A robot moved to another port gets its commands again, and its reports are not lost.
    #[test]
    fn the_session_of_a_closed_port_continues_on_another() {
        let mut server = Server::new(TERMS, 1);
        server.receive(0, &hello(5), Instant(0)).unwrap();
        assert_eq!(drain(&mut server, Instant(0)), 1);
        let stop = Command::Stop(Stop { number: 1, stop: true });
        server.command(RobotId(1), stop.clone()).unwrap();
        assert_eq!(drain(&mut server, Instant(0)), 1);
        server.close_port(0).unwrap();
        assert!(server.receive(0, &[0], Instant(1)).is_err() && server.robot_at(0).is_none());
        assert_eq!(server.command(RobotId(1), stop), Err(CommandError::NoSession(RobotId(1))));

        let port = server.open_port();
        assert_eq!((port, server.ports().collect::<Vec<_>>()), (1, vec![1]));
        server.receive(port, &hello(6), Instant(2)).unwrap();
        let mut out = [0u8; MAX_FRAME];
        let frames = std::iter::from_fn(|| server.poll_transmit(port, Instant(2), &mut out));
        assert_eq!(frames.count(), 2, "a Welcome and the Stop");
        assert_eq!(server.waiting(RobotId(1)), 0);
    }
}
