//! The robot's end of the link: the handshake that opens a session, and the session's frames.

use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MIN_VERSION, SessionId, VERSION},
    link::{ClockSync, Counters, Endpoint, Knocking, Received},
    message::{Hello, Message, Refusal, RefusalReason, ToRobot, ToRobotMessage, ToServer, Welcome},
    tile::Epoch,
    time::Instant,
};

use super::{mapper::Mapper, outbox::Token};
use crate::timing::RESET_SILENCE;

/// Maximum number of reliable frames in flight; the memory for them is the link's largest part.
const WINDOW: usize = 3;

/// Size of the link's part of a [`Robot`](crate::Robot): the frames in flight, the receive and
/// transmit buffers, the handshake and the clock. At most 4 KiB on a 32-bit machine.
pub const LINK_STATE: usize = size_of::<Endpoint<ToServer, Token, WINDOW, DEFAULT_FRAME>>()
    + size_of::<Knocking>()
    + size_of::<ClockSync>();

#[cfg(target_pointer_width = "32")]
const _: () = assert!(LINK_STATE <= 4 * 1024);

/// The robot's end of the link.
#[derive(Debug)]
pub(super) struct Link {
    endpoint: Endpoint<ToServer, Token, WINDOW, DEFAULT_FRAME>,
    knocking: Knocking,
    server_epoch: Option<u32>,
    /// When the last frame of a session arrived.
    heard: Instant,
    refusal: Option<RefusalReason>,
}

impl Link {
    /// The link of a freshly booted robot, which starts the handshake.
    #[inline(never)]
    pub(super) fn new(boot_nonce: u32) -> Self {
        Self {
            endpoint: Endpoint::new(),
            knocking: Knocking::new(boot_nonce),
            server_epoch: None,
            heard: Instant(0),
            refusal: None,
        }
    }

    pub(super) fn session(&self) -> Option<SessionId> {
        Some(self.endpoint.session()).filter(|&session| session != SessionId::NONE)
    }

    pub(super) fn is_connected(&self) -> bool {
        self.session().is_some()
    }

    pub(super) fn server_epoch(&self) -> Option<Epoch> {
        self.server_epoch.map(Epoch)
    }

    pub(super) fn refusal(&self) -> Option<RefusalReason> {
        self.refusal
    }

    /// When the last frame of a session arrived; `None` if there has been no session.
    pub(super) fn heard(&self) -> Option<Instant> {
        self.server_epoch.map(|_| self.heard)
    }

    pub(super) fn counters(&self) -> Counters {
        self.endpoint.counters()
    }

    /// Space for messages in a frame of this session, in bytes.
    pub(super) fn room(&self) -> usize {
        self.endpoint.room()
    }

    /// When the next frame is due.
    pub(super) fn poll_timeout(&self, mapper: &Mapper<'_>) -> Instant {
        if !self.is_connected() {
            return self.knocking.poll_timeout();
        }
        let due = mapper.poll_transmit_timeout(self.endpoint.can_send_reliable());
        self.endpoint.poll_timeout().map_or(due, |resend| resend.min(due))
    }

    /// Consumes `bytes` up to the end of the next frame, and processes the frame. Returns `false`
    /// if `bytes` ends before the frame does.
    #[inline(never)]
    pub(super) fn receive_frame(
        &mut self,
        mapper: &mut Mapper<'_>,
        bytes: &mut &[u8],
        now: Instant,
    ) -> bool {
        let Some(received) = self.endpoint.receive(bytes, now) else { return false };
        match received {
            Received::Bad(_) => {}
            // The message is parsed into a copy, as it borrows from the endpoint, which the
            // following calls change.
            Received::Handshake(message) => match Knock::parse(message) {
                Some(Knock::Welcome(welcome)) => self.welcomed(mapper, &welcome, now),
                Some(Knock::Refusal(refusal)) => self.refused(&refusal, now),
                Some(Knock::Reset) => self.reset(now),
                None => mapper.statistics.malformed(),
            },
            Received::Session(messages) => {
                self.heard = now;
                mapper.take(messages, now);
            }
        }
        true
    }

    /// Reports the acknowledged frames to the mapper.
    pub(super) fn settle(&mut self, mapper: &mut Mapper<'_>, now: Instant) {
        while let Some(token) = self.endpoint.poll_acknowledged() {
            mapper.acknowledged(token, now);
        }
    }

    fn welcomed(&mut self, mapper: &mut Mapper<'_>, welcome: &Welcome, now: Instant) {
        let stale = welcome.nonce != self.knocking.nonce() || self.is_connected();
        if stale || !(MIN_VERSION..=VERSION).contains(&welcome.version) {
            return;
        }
        self.refusal = None;
        self.heard = now;
        let same_server =
            self.server_epoch.replace(welcome.server_epoch) == Some(welcome.server_epoch);
        self.endpoint.begin(welcome.session, usize::from(welcome.frame));
        mapper.begin_session(welcome, same_server, now);
    }

    fn refused(&mut self, refusal: &Refusal, now: Instant) {
        if refusal.nonce == self.knocking.nonce() && !self.is_connected() {
            self.refusal = Some(refusal.reason);
            self.knocking.refused(refusal.reason, now);
        }
    }

    /// Ends the session, because the server reports that it has none with this robot. Ignored if
    /// the session was active within the last [`RESET_SILENCE`].
    fn reset(&mut self, now: Instant) {
        if self.is_connected() && now.since(self.heard) > RESET_SILENCE {
            self.endpoint.end();
            self.knocking.restart(now);
        }
    }

    /// Writes the next frame due into `out`. Returns its length.
    #[inline(never)]
    pub(super) fn poll_transmit(
        &mut self,
        mapper: &mut Mapper<'_>,
        now: Instant,
        out: &mut [u8],
    ) -> Option<usize> {
        if !self.is_connected() {
            return self.knock(mapper, now, out);
        }
        let sent = self.endpoint.poll_transmit(now, out, false, |writer, reliable| {
            mapper.write(writer, reliable, now)
        })?;
        mapper.statistics.sent(sent.len, matches!(sent.token, Some(Token::Tiles(_))));
        Some(sent.len)
    }

    fn knock(&mut self, mapper: &mut Mapper<'_>, now: Instant, out: &mut [u8]) -> Option<usize> {
        if !self.knocking.poll(now) {
            return None;
        }
        let hello = Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: mapper.settings.robot,
            nonce: self.knocking.nonce(),
            frame: DEFAULT_FRAME as u16,
            resolution: mapper.settings.resolution,
            fused_tiles: mapper.fused.capacity().min(usize::from(u16::MAX)) as u16,
        };
        let len = self.endpoint.handshake(&hello, out)?;
        mapper.statistics.sent(len, false);
        Some(len)
    }
}

/// A message of the handshake, as the server sends it.
enum Knock {
    Welcome(Welcome),
    Refusal(Refusal),
    Reset,
}

impl Knock {
    fn parse(message: Message<'_, ToRobot>) -> Option<Self> {
        match message.by_kind()? {
            ToRobotMessage::Welcome(welcome) => Some(Self::Welcome(welcome.decode().ok()?)),
            ToRobotMessage::Refusal(refusal) => Some(Self::Refusal(refusal.decode().ok()?)),
            ToRobotMessage::Reset(_) => Some(Self::Reset),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{boxed::Box, vec::Vec};

    use ubimap_protocol::{
        frame::MAX_FRAME,
        link::{Answer, Terms, answer},
        message::{Body, Reset},
        time::Duration,
        units::RobotId,
    };

    use super::*;
    use crate::{Bounds, Config, Memory, Robot, memory, sense::SensorModel};

    type Server = Endpoint<ToRobot, (), 1, MAX_FRAME>;

    fn handshake(message: &impl Body<ToRobot>) -> Vec<u8> {
        let mut out = [0; MAX_FRAME];
        let len = Server::new().handshake(message, &mut out).unwrap();
        out[..len].to_vec()
    }

    /// The next frame of the robot, if it is a Hello.
    fn hello(robot: &mut Robot<'_>, now: Instant) -> Option<Hello> {
        let mut out = [0; MAX_FRAME];
        let len = robot.poll_transmit(now, &mut out)?;
        match Server::new().receive(&mut &out[..len], now) {
            Some(Received::Handshake(message)) => message.decode().ok(),
            _ => None,
        }
    }

    fn welcome(hello: &Hello, session: u32) -> Vec<u8> {
        let resolution = hello.resolution;
        let terms = Terms { resolution, frame: 250, server_epoch: 1, stores: false };
        match answer(hello, &terms, SessionId(session), 1) {
            Answer::Welcome(welcome) => handshake(&welcome),
            Answer::Refusal(refusal) => panic!("{refusal:?}"),
        }
    }

    #[test]
    fn answers_to_earlier_hellos_are_ignored() {
        const BOUNDS: Bounds = Bounds::SMALL;
        let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
        let sensor = SensorModel::Radial { first: 0.0, step: 0.1 };
        let config = Config::new(RobotId(1), sensor, BOUNDS);
        let mut robot = Robot::new(config, &mut memory).unwrap();
        let at = |millis| Instant(0) + Duration::from_millis(millis);
        let first = hello(&mut robot, at(0)).unwrap();
        let earlier = Hello { nonce: first.nonce ^ 1, ..first };
        robot.receive(&welcome(&earlier, 5), at(1));
        assert!(!robot.is_connected());
        let reason = RefusalReason::NumberInUse;
        let refusal = handshake(&Refusal { nonce: first.nonce, reason });
        robot.receive(&refusal, at(1));
        assert_eq!(robot.refusal(), Some(reason));
        assert_eq!(hello(&mut robot, at(2_900)), None, "the robot waits after a refusal");
        assert_eq!(hello(&mut robot, at(3_002)), Some(first));
        let reason = RefusalReason::Frame(64);
        robot.receive(&handshake(&Refusal { nonce: first.nonce, reason }), at(3_003));
        assert_eq!(hello(&mut robot, at(9_900)), None, "the server must be configured first");
        assert_eq!(hello(&mut robot, at(13_004)), Some(first));
        robot.receive(&welcome(&first, 7), at(14_002));
        assert!(robot.is_connected() && robot.refusal().is_none());

        // Repeated answers change nothing, neither in the session nor after it.
        robot.receive(&welcome(&first, 8), at(14_003));
        robot.receive(&refusal, at(14_003));
        assert_eq!((robot.statistics().sessions, robot.refusal()), (1, None));
        robot.receive(&handshake(&Reset), at(15_000));
        assert!(!robot.is_connected());
        robot.receive(&welcome(&first, 7), at(15_001));
        robot.receive(&refusal, at(15_001));
        assert!(!robot.is_connected() && robot.refusal().is_none());
        let second = hello(&mut robot, at(15_002)).unwrap();
        robot.receive(&welcome(&second, 9), at(15_003));
        assert!(robot.is_connected());
    }
}
