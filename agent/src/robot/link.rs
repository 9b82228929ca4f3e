//! The robot's end of the link: the handshake that opens a session, and the session's frames.

use ubimap_protocol::{
    frame::{Attempt, DEFAULT_FRAME, MIN_VERSION, SealSlot, SessionId, SessionKey, VERSION},
    link::{
        ClockSync, Counters, Endpoint, Knocking, Opened, Received, SealedHandshake, Verdict,
        write_hello,
    },
    message::{
        Hello, Message, Refusal, RefusalReason, SealedReset, ToRobot, ToRobotMessage, ToServer,
        Welcome,
    },
    tile::Epoch,
    time::Instant,
};

use super::{config::Seal, mapper::Mapper, outbox::Token};
use crate::timing::{DEAF, RESET_SILENCE};

/// Maximum number of reliable frames in flight; the memory for them is the link's largest part.
const WINDOW: usize = 3;

/// Size of the link's part of a [`Robot`](crate::Robot): the frames in flight, the receive and
/// transmit buffers, the handshake and the clock. At most 4 KiB on a 32-bit machine.
pub const LINK_STATE: usize = size_of::<Endpoint<ToServer, Token, WINDOW, DEFAULT_FRAME>>()
    + size_of::<Knocking>()
    + size_of::<SealSlot<Sealing>>()
    + size_of::<ClockSync>();

#[cfg(target_pointer_width = "32")]
const _: () = assert!(LINK_STATE <= 4 * 1024);

/// The robot's end of the link.
#[derive(Debug)]
pub(super) struct Link {
    endpoint: Endpoint<ToServer, Token, WINDOW, DEFAULT_FRAME>,
    knocking: Knocking,
    /// `None` on an open link.
    sealing: SealSlot<Sealing>,
    server_epoch: Option<u32>,
    /// When the last frame of a session arrived.
    heard: Instant,
    refusal: Option<RefusalReason>,
}

/// The key of a sealed link, and the robot's stamps.
#[derive(Debug)]
struct Sealing {
    seal: Seal,
    /// The stamp of the newest attempt; `None` before the first one.
    attempt: Option<Attempt>,
    /// Whether an attempt is under way.
    has_begun: bool,
}

impl Link {
    /// The link of a freshly booted robot, which starts the handshake.
    #[inline(never)]
    pub(super) fn new(boot_nonce: u32, seal: Option<Seal>) -> Self {
        Self {
            endpoint: match seal {
                None => Endpoint::new(),
                Some(seal) => Endpoint::sealed(seal.key.support()),
            },
            knocking: Knocking::new(boot_nonce),
            sealing: SealSlot::new(seal.map(|seal| Sealing {
                seal,
                attempt: None,
                has_begun: false,
            })),
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
        let is_connected = self.is_connected();
        let Some(received) = self.endpoint.receive(bytes, now) else { return false };
        match received {
            Received::Bad(_) => {}
            Received::Stray(..) => self.deaf(now),
            Received::Sealed(sealed) => {
                let sealing = self.sealing.get();
                let knock = sealing.map(|sealing| sealing.open(&sealed, is_connected));
                let verdict = knock.map(|knock| self.sealed_knock(mapper, knock, now));
                self.endpoint.judge(verdict.unwrap_or(Verdict::Refused));
            }
            // The message is parsed into a copy, as it borrows from the endpoint, which the
            // following calls change.
            Received::Handshake(message) => match Knock::parse(message) {
                Some(Knock::Welcome(welcome)) => {
                    self.welcomed(mapper, &welcome, None, now);
                }
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

    /// Processes a message of a sealed handshake.
    fn sealed_knock(
        &mut self,
        mapper: &mut Mapper<'_>,
        knock: SealedKnock,
        now: Instant,
    ) -> Verdict {
        match knock {
            SealedKnock::Welcome(welcome, key) => {
                if !self.welcomed(mapper, &welcome, Some(key), now) {
                    return Verdict::Replayed;
                }
            }
            SealedKnock::Refusal(refusal) => self.refused(&refusal, now),
            SealedKnock::Reset(reset) if self.endpoint.is_echo(reset.echo) => self.reset(now),
            SealedKnock::Reset(_) | SealedKnock::Stale => return Verdict::Replayed,
            SealedKnock::Malformed => return Verdict::Refused,
            SealedKnock::Forged => return Verdict::Forged,
        }
        Verdict::Good
    }

    /// Begins the session of a Welcome, with its key on a sealed link. Returns whether it does.
    fn welcomed(
        &mut self,
        mapper: &mut Mapper<'_>,
        welcome: &Welcome,
        key: Option<SessionKey>,
        now: Instant,
    ) -> bool {
        let stale = welcome.nonce != self.knocking.nonce() || self.is_connected();
        if stale || !(MIN_VERSION..=VERSION).contains(&welcome.version) {
            return false;
        }
        self.refusal = None;
        self.heard = now;
        let same_server =
            self.server_epoch.replace(welcome.server_epoch) == Some(welcome.server_epoch);
        let frame = usize::from(welcome.frame);
        match key {
            None => self.endpoint.begin(welcome.session, frame),
            Some(key) => {
                let keys = (mapper.settings.robot, key);
                self.endpoint.begin_sealed(welcome.session, frame, keys);
            }
        }
        mapper.begin_session(welcome, same_server, now);
        true
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
            self.knock_again(now);
        }
    }

    /// Ends a sealed session in which nothing could be opened for a long time, although frames
    /// arrive.
    fn deaf(&mut self, now: Instant) {
        if self.is_connected() && now.since(self.heard) > DEAF {
            self.knock_again(now);
        }
    }

    fn knock_again(&mut self, now: Instant) {
        self.endpoint.end();
        self.knocking.restart(now);
        if let Some(sealing) = self.sealing.get_mut() {
            sealing.has_begun = false;
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
        if self.endpoint.is_spent() {
            self.knock_again(now);
        }
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
        let len = match self.sealing.get_mut() {
            None => self.endpoint.handshake(&hello, out)?,
            Some(sealing) => {
                let attempt = sealing.attempt(now);
                self.endpoint.count_sent();
                write_hello(&sealing.seal.key, attempt, &hello, out)?
            }
        };
        mapper.statistics.sent(len, false);
        Some(len)
    }
}

impl Sealing {
    /// The stamp of the present attempt: later than those of all others.
    fn attempt(&mut self, now: Instant) -> Attempt {
        let boot = self.seal.boot;
        let next = self.attempt.map_or(0, |last| last.clock.saturating_add(1));
        let fresh = Attempt { boot, clock: now.0.max(next) };
        let attempt = self.attempt.filter(|_| self.has_begun).unwrap_or(fresh);
        (self.attempt, self.has_begun) = (Some(attempt), true);
        attempt
    }

    /// Opens an answer.
    fn open(&self, sealed: &SealedHandshake<'_>, is_connected: bool) -> SealedKnock {
        let key = &self.seal.key;
        let attempt = self.attempt;
        if let Some(attempt) = attempt
            && let Some((salt, opened)) = sealed.answer(key, Some(attempt))
        {
            return match Knock::of(&opened) {
                _ if is_connected || !self.has_begun => SealedKnock::Stale,
                Some(Knock::Welcome(welcome)) => {
                    let (robot, session) = (sealed.robot(), welcome.session);
                    let derived = SessionKey::derive(key, robot, attempt, salt, session);
                    SealedKnock::Welcome(welcome, derived)
                }
                Some(Knock::Refusal(refusal)) => SealedKnock::Refusal(refusal),
                Some(Knock::Reset) | None => SealedKnock::Malformed,
            };
        }
        let Some((_, opened)) = sealed.answer(key, None) else { return SealedKnock::Forged };
        match opened.message().and_then(|message| message.decode::<SealedReset>().ok()) {
            Some(reset) => SealedKnock::Reset(reset),
            None => SealedKnock::Malformed,
        }
    }
}

/// A message of a sealed handshake.
enum SealedKnock {
    /// A Welcome to the present attempt, and the key of the session.
    Welcome(Welcome, SessionKey),
    Refusal(Refusal),
    Reset(SealedReset),
    /// An answer to an attempt that is over.
    Stale,
    Malformed,
    Forged,
}

/// A message of the handshake, as the server sends it.
enum Knock {
    Welcome(Welcome),
    Refusal(Refusal),
    Reset,
}

impl Knock {
    fn of(opened: &Opened<ToRobot>) -> Option<Self> {
        Self::parse(opened.message()?)
    }

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
#[cfg(feature = "seals")]
mod sealed_tests;
#[cfg(test)]
mod tests {
    use std::{boxed::Box, vec::Vec};

    use ubimap_protocol::{
        frame::MAX_FRAME,
        link::{Answer, Fill, Terms, answer},
        message::{Body, Certainty, FixSource, PoseFix, Reset, State, TimeReply, TimeRequest},
        time::Duration,
        units::{Pose, RobotId},
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
        welcome_of(hello, session, 1)
    }

    /// The Welcome of a server with this epoch.
    fn welcome_of(hello: &Hello, session: u32, server_epoch: u32) -> Vec<u8> {
        let resolution = hello.resolution;
        let terms = Terms { resolution, frame: 250, server_epoch, stores: false };
        match answer(hello, &terms, SessionId(session), 1) {
            Answer::Welcome(welcome) => handshake(&welcome),
            Answer::Refusal(refusal) => panic!("{refusal:?}"),
        }
    }

    /// A message in a datagram of the server.
    fn told(server: &mut Server, message: &impl Body<ToRobot>) -> Vec<u8> {
        let mut out = [0; MAX_FRAME];
        let sent = server.poll_transmit(Instant(0), &mut out, true, |writer, _| {
            assert!(writer.push(message));
            Fill::Datagram
        });
        out[..sent.unwrap().len].to_vec()
    }

    /// The robot's frames until it has sent a State, and the nonce of its last time request.
    fn state(robot: &mut Robot<'_>, server: &mut Server, now: Instant) -> (State, Option<u16>) {
        let (mut state, mut asked) = (None, None);
        let mut out = [0; MAX_FRAME];
        while let Some(len) = robot.poll_transmit(now, &mut out) {
            let Some(Received::Session(messages)) = server.receive(&mut &out[..len], now) else {
                continue;
            };
            for message in messages.flatten() {
                state = message.decode::<State>().ok().or(state);
                asked = message.decode::<TimeRequest>().ok().map(|it| it.nonce).or(asked);
            }
        }
        (state.expect("a state"), asked)
    }

    /// A pose may be known before the clock of a new server is: it must not be told with a time of
    /// the robot's own clock. A robot that stands unseen goes on telling it.
    #[test]
    fn a_state_has_the_pose_of_now_but_no_time_before_the_clocks_agree() {
        const BOUNDS: Bounds = Bounds::SMALL;
        let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
        let sensor = SensorModel::Radial { first: 0.0, step: 0.1 };
        let mut robot = Robot::new(Config::new(RobotId(1), sensor, BOUNDS), &mut memory).unwrap();
        let mut server = Server::new();
        let at = |millis| Instant(0) + Duration::from_millis(millis);
        let pose = Pose::from_metres(1.0, 2.0, 0.0);
        let stands = |robot: &mut Robot<'_>, millis: core::ops::Range<u64>| {
            for millis in millis.step_by(100) {
                robot.odometry(at(millis), Pose::default(), at(millis));
                robot.scan(at(millis), &[1_000; 64], at(millis)).unwrap();
                robot.timeout(at(millis));
            }
        };
        let knock = hello(&mut robot, at(0)).unwrap();
        robot.receive(&welcome(&knock, 5), at(1));
        server.begin(SessionId(5), MAX_FRAME);
        let (first, asked) = state(&mut robot, &mut server, at(2));
        assert_eq!((first.time, first.pose), (None, None));
        // The server's clock is 90 s behind the robot's.
        let received = Instant(0);
        let reply = TimeReply { nonce: asked.unwrap(), received, held_micros: 0 };
        robot.receive(&told(&mut server, &reply), at(2));
        for millis in (100..=1_000).step_by(100) {
            stands(&mut robot, millis..millis + 100);
            let certainty = Certainty { x: 5, y: 5, heading: 50 };
            let (time, source) = (Instant(1_000 * (millis - 2)), FixSource::Camera);
            let fix = PoseFix { time, pose, certainty, source, earlier: Default::default() };
            robot.receive(&told(&mut server, &fix), at(millis));
            robot.timeout(at(millis));
        }
        stands(&mut robot, 1_100..2_100);
        let (known, _) = state(&mut robot, &mut server, at(2_100));
        assert_eq!(known.pose, Some(pose));
        assert!(known.time >= Some(Instant(1_900_000)), "{known:?}");

        robot.receive(&handshake(&Reset), at(2_400));
        let knock = hello(&mut robot, at(2_401)).unwrap();
        robot.receive(&welcome_of(&knock, 6, 2), at(2_402));
        server.begin(SessionId(6), MAX_FRAME);
        let (anew, _) = state(&mut robot, &mut server, at(2_403));
        assert_eq!(anew.time, None);
        stands(&mut robot, 2_420..2_421);
        robot.timeout(at(4_000));
        let (anew, _) = state(&mut robot, &mut server, at(4_500));
        assert_eq!(anew.time, None, "{anew:?}");
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
