//! Keyed ports: who gets a session, and what replays and strangers cost.

use ubimap_protocol::{
    frame::{Attempt, Key, MAX_FRAME, MIN_VERSION, SealSupport, SessionKey, VERSION, cobs},
    link::{Counters, Endpoint, Fill, Received, Terms, write_hello},
    message::{Hello, RefusalReason, SealedReset, State, ToRobotMessage, ToServer},
    time::{Duration, Instant},
    units::{Millimetres, RobotId, SessionId},
};

use crate::{
    server::{Event, Policy, RobotEvent, Server},
    timing::SESSION_SILENT,
};

const TERMS: Terms =
    Terms { resolution: Millimetres(50), frame: 250, server_epoch: 1, stores: false };
const ID: RobotId = RobotId(1);
const KEY: Key = Key::new([7; 16]);

/// A server with keyed ports, and the keys of robots 1 and 2.
fn server(ports: usize) -> Server {
    let mut server = Server::new(TERMS, 0);
    server.set_key(ID, KEY);
    server.set_key(RobotId(2), Key::new([2; 16]));
    for _ in 0..ports {
        server.open_port(Policy::Keyed);
    }
    server
}

fn millis(count: u64) -> Instant {
    Instant(0) + Duration::from_millis(count)
}

/// A robot with a link of its own.
struct Robot {
    id: RobotId,
    key: Key,
    port: usize,
    attempt: Attempt,
    link: Endpoint<ToServer, (), 1, MAX_FRAME>,
    /// Welcomes, refusals and resets received.
    answers: [usize; 3],
    refusal: Option<RefusalReason>,
}

impl Robot {
    fn new(port: usize, boot: u32) -> Self {
        let attempt = Attempt { boot, clock: 5 };
        let link = Endpoint::sealed(SealSupport::PRESENT);
        Self { id: ID, key: KEY, port, attempt, link, answers: [0; 3], refusal: None }
    }

    fn hello_with(&self, frame: u16) -> Vec<u8> {
        let hello = Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: self.id,
            nonce: self.attempt.boot,
            frame,
            resolution: Millimetres(50),
            fused_tiles: 16,
        };
        let mut out = [0u8; 64];
        let len = write_hello(&self.key, self.attempt, &hello, &mut out).unwrap();
        out[..len].to_vec()
    }

    fn hello(&self) -> Vec<u8> {
        self.hello_with(250)
    }

    /// Reads what the server sends at its port. A Welcome begins a session.
    fn hear(&mut self, server: &mut Server, now: Instant) {
        let mut out = [0; MAX_FRAME];
        while let Some(len) = server.poll_transmit(self.port, now, &mut out) {
            let Some(Received::Sealed(sealed)) = self.link.receive(&mut &out[..len], now) else {
                continue;
            };
            if let Some((salt, opened)) = sealed.answer(&self.key, Some(self.attempt)) {
                match opened.message().unwrap().by_kind() {
                    Some(ToRobotMessage::Welcome(welcome)) => {
                        self.answers[0] += 1;
                        let welcome = welcome.decode().unwrap();
                        let session = welcome.session;
                        let key =
                            SessionKey::derive(&self.key, self.id, self.attempt, salt, session);
                        self.link.begin_sealed(session, welcome.frame.into(), (self.id, key));
                    }
                    Some(ToRobotMessage::Refusal(refusal)) => {
                        self.answers[1] += 1;
                        self.refusal = Some(refusal.decode().unwrap().reason);
                    }
                    other => panic!("{other:?}"),
                }
            } else if let Some((_, opened)) = sealed.answer(&self.key, None) {
                let reset: SealedReset = opened.message().unwrap().decode().unwrap();
                self.answers[2] += usize::from(self.link.is_echo(reset.echo));
            }
        }
    }

    fn knock(&mut self, server: &mut Server, now: Instant) {
        server.receive(self.port, &self.hello(), now).unwrap();
        self.hear(server, now);
    }

    /// A frame that reports a state with the robot's boot, to tell it from those of other lives.
    fn state(&mut self, now: Instant) -> Vec<u8> {
        let cells_refused = self.attempt.boot;
        let state = State { time: None, pose: None, odometry: None, cells_refused };
        let mut out = [0; MAX_FRAME];
        let sent = self.link.poll_transmit(now, &mut out, true, |writer, _| {
            assert!(writer.push(&state));
            Fill::Datagram
        });
        out[..sent.unwrap().len].to_vec()
    }

    fn report(&mut self, server: &mut Server, now: Instant) {
        let frame = self.state(now);
        server.receive(self.port, &frame, now).unwrap();
    }

    fn join(&mut self, server: &mut Server, now: Instant) {
        self.knock(server, now);
        self.report(server, now);
        assert_eq!(reported(server), Some(self.attempt.boot));
    }
}

/// The boot of the robot that reported last.
fn reported(server: &Server) -> Option<u32> {
    server.state(ID).map(|state| state.cells_refused)
}

fn drain(server: &mut Server, port: usize, now: Instant) -> usize {
    let mut out = [0u8; MAX_FRAME];
    std::iter::from_fn(|| server.poll_transmit(port, now, &mut out)).count()
}

fn events(server: &mut Server) -> Vec<Event> {
    std::iter::from_fn(|| server.poll_event()).map(|(_, event)| event).collect()
}

#[test]
fn a_robot_with_the_key_joins_with_its_first_frame() {
    let mut server = server(1);
    let mut robot = Robot::new(0, 1);
    robot.knock(&mut server, millis(0));
    assert_eq!((server.robot_at(0), robot.answers), (None, [1, 0, 0]), "a Hello proves little");
    robot.report(&mut server, millis(1));
    assert_eq!((server.robot_at(0), reported(&server)), (Some(ID), Some(1)));
    assert_eq!(events(&mut server), [Event::Joined(ID, 0)]);
    let Counters { bad, refused, replayed, forged, .. } = server.link_counters(0);
    assert_eq!((bad, refused, replayed, forged), (0, 0, 0, 0));
}

#[test]
fn a_repeated_hello_gets_the_same_welcome_until_the_session_begins() {
    let mut server = server(1);
    let mut robot = Robot::new(0, 1);
    robot.knock(&mut server, millis(0));
    let session = robot.link.session();
    let mut frames = Vec::new();
    for _ in 0..3 {
        server.receive(0, &robot.hello(), millis(1)).unwrap();
        let mut out = [0; MAX_FRAME];
        let len = server.poll_transmit(0, millis(1), &mut out).unwrap();
        frames.push(out[..len].to_vec());
    }
    assert!(frames.iter().all(|frame| *frame == frames[0]));
    robot.report(&mut server, millis(2));
    assert_eq!(server.session_at(0), Some(session));
    // Then it is a replay.
    server.receive(0, &robot.hello(), millis(3)).unwrap();
    assert_eq!((drain(&mut server, 0, millis(3)), server.link_counters(0).replayed), (0, 1));
    assert_eq!(events(&mut server), [Event::Joined(ID, 0)], "a late copy is nothing to report");
}

#[test]
fn an_attempt_may_move_to_another_port() {
    let mut server = server(2);
    let mut robot = Robot::new(0, 1);
    robot.knock(&mut server, millis(0));
    robot.port = 1;
    robot.join(&mut server, millis(1));
    assert_eq!((server.robot_at(0), server.robot_at(1)), (None, Some(ID)));
}

#[test]
fn a_new_life_takes_over_at_once_and_an_old_one_never() {
    let mut server = server(2);
    let mut before = Robot::new(0, 1);
    before.join(&mut server, millis(0));
    let mut after = Robot::new(1, 2);
    after.join(&mut server, millis(100));
    assert_eq!((server.robot_at(0), server.robot_at(1)), (None, Some(ID)));
    // The earlier life, or a replay of its Hello: on any port, at any time.
    for (count, port) in [(1, 0), (2, 0), (3, 0)] {
        before.port = port;
        before.knock(&mut server, millis(200));
        assert_eq!(server.link_counters(0).replayed, count);
    }
    before.report(&mut server, millis(300));
    assert_eq!((reported(&server), before.answers), (Some(2), [1, 0, 0]));
    events(&mut server);
    // Only if the robot has no session the operator is told, once.
    let later = millis(300) + SESSION_SILENT;
    before.knock(&mut server, later);
    before.knock(&mut server, later);
    assert_eq!(events(&mut server), [Event::Robot(RobotEvent::OldAttempt(ID))]);
    let mut newest = Robot::new(0, 3);
    newest.join(&mut server, later);
}

#[test]
fn a_robot_without_a_key_here_gets_no_answer_and_is_named_once() {
    let mut server = server(1);
    let mut stranger = Robot { id: RobotId(7), ..Robot::new(0, 1) };
    for _ in 0..3 {
        stranger.knock(&mut server, millis(0));
    }
    let key = Key::new([1; 16]);
    let mut impostor = Robot { key, ..Robot::new(0, 9) };
    impostor.knock(&mut server, millis(0));
    assert_eq!((stranger.answers, impostor.answers), ([0; 3], [0; 3]));
    assert_eq!(server.link_counters(0).forged, 4);
    let told = events(&mut server);
    assert_eq!(told, [Event::Robot(RobotEvent::NoKey(RobotId(7)))]);
    assert!(told[0].to_string().ends_with("ubimap keys make 7"), "{}", told[0]);
    // The impostor's stamp has not spoilt the robot's.
    Robot::new(0, 1).join(&mut server, millis(1));
}

#[test]
fn unsealed_frames_are_refused_and_sealed_ones_mean_nothing_on_an_open_port() {
    let mut server = server(1);
    let mut out = [0; MAX_FRAME];
    let mut open = Endpoint::<ToServer, (), 1, MAX_FRAME>::new();
    open.begin(SessionId(1), 250);
    let hello = Hello {
        version: VERSION,
        min_version: MIN_VERSION,
        robot: ID,
        nonce: 1,
        frame: 250,
        resolution: Millimetres(50),
        fused_tiles: 16,
    };
    let len = open.handshake(&hello, &mut out).unwrap();
    server.receive(0, &out[..len], millis(0)).unwrap();
    assert_eq!((drain(&mut server, 0, millis(0)), server.link_counters(0).refused), (0, 1));
    let port = server.open_port(Policy::Open);
    let robot = Robot::new(port, 1);
    server.receive(port, &robot.hello(), millis(0)).unwrap();
    assert_eq!((server.robot_at(port), server.link_counters(port).bad), (None, 1));
}

#[test]
fn refusals_are_sealed_and_small_frames_are_refused() {
    let mut server = server(1);
    let mut robot = Robot::new(0, 1);
    server.receive(0, &robot.hello_with(47), millis(0)).unwrap();
    robot.hear(&mut server, millis(0));
    assert_eq!((robot.answers, robot.refusal), ([0, 1, 0], Some(RefusalReason::Frame(48))));
    let mut robot = Robot::new(0, 2);
    server.receive(0, &robot.hello_with(48), millis(0)).unwrap();
    robot.hear(&mut server, millis(0));
    assert_eq!(robot.answers, [1, 0, 0]);
}

#[test]
fn a_reset_answers_a_robot_without_a_session_and_echoes_its_frame() {
    let mut server = server(2);
    let mut robot = Robot::new(0, 1);
    robot.join(&mut server, millis(0));
    // Frames of a live robot at another port: no Reset, so that a copy can't end its session.
    robot.port = 1;
    robot.report(&mut server, millis(100));
    robot.hear(&mut server, millis(100));
    assert_eq!((robot.answers[2], server.link_counters(1).forged), (0, 1));
    server.close_port(0).unwrap();
    for (at, resets) in [(200, 1), (300, 1), (400, 2)] {
        robot.report(&mut server, millis(at));
        robot.hear(&mut server, millis(at));
        assert_eq!(robot.answers[2], resets, "{at}");
    }
    // A Reset that waits is dropped when a session begins.
    robot.report(&mut server, millis(500));
    robot.attempt.clock += 1;
    robot.knock(&mut server, millis(500));
    robot.report(&mut server, millis(501));
    robot.hear(&mut server, millis(900));
    assert_eq!((robot.answers, server.robot_at(1)), ([2, 0, 2], Some(ID)));
}

#[test]
fn a_retired_key_ends_the_session_and_a_new_one_forgets_old_stamps() {
    let mut server = server(1);
    let mut robot = Robot::new(0, 9);
    robot.join(&mut server, millis(0));
    assert!(server.retire_key(ID) && !server.retire_key(ID));
    assert_eq!(server.robot_at(0), None);
    robot.report(&mut server, millis(1));
    robot.attempt.boot += 1;
    robot.knock(&mut server, millis(2));
    assert_eq!((robot.answers, drain(&mut server, 0, millis(500))), ([1, 0, 0], 0));
    let key = Key::new([5; 16]);
    server.set_key(ID, key);
    let mut robot = Robot { key, ..Robot::new(0, 1) };
    robot.join(&mut server, millis(3));
    server.set_key(ID, key);
    assert_eq!(server.robot_at(0), Some(ID), "the same key again changes nothing");
    server.set_key(ID, KEY);
    assert_eq!(server.robot_at(0), None);
}

/// Another robot on the wire of a live one.
#[test]
fn the_robot_of_a_port_keeps_it_while_it_lives() {
    let mut server = server(1);
    let mut first = Robot::new(0, 1);
    first.join(&mut server, millis(0));
    let mut second = Robot { id: RobotId(2), key: Key::new([2; 16]), ..Robot::new(0, 1) };
    second.knock(&mut server, millis(100));
    first.report(&mut server, millis(200));
    second.report(&mut server, millis(300));
    assert_eq!(server.robot_at(0), Some(ID));
    second.report(&mut server, millis(3_300));
    assert_eq!(server.robot_at(0), Some(RobotId(2)), "the first one is gone");
}

#[test]
fn two_answers_never_have_the_same_salt() {
    let mut server = server(1);
    server.salt_from(u64::MAX - 5);
    let mut salts = std::collections::BTreeSet::new();
    for boot in 1..20 {
        let mut robot = Robot::new(0, boot);
        let frame = if boot % 2 == 0 { 40 } else { 250 };
        server.receive(0, &robot.hello_with(frame), millis(0)).unwrap();
        let mut out = [0; MAX_FRAME];
        let len = server.poll_transmit(0, millis(0), &mut out).unwrap();
        let mut decoder = cobs::Decoder::<MAX_FRAME>::default();
        let raw = decoder.next(&mut &out[..len]).unwrap().unwrap();
        assert!(salts.insert(raw[4..12].to_vec()));
        robot.hear(&mut server, millis(0));
    }
}
