//! Handshakes: who gets a session, and who keeps it.

use ubimap_protocol::{
    frame::{Direction, MAX_FRAME, MIN_VERSION, VERSION, cobs, seal},
    link::{Endpoint, Fill, Received, Terms},
    message::{Hello, RefusalReason, State, Stop, ToRobotMessage, ToServer},
    tile::{Epoch, TileId},
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use crate::{
    server::{Command, CommandError, Event, MAX_ROBOTS, Policy, Server},
    timing::SESSION_SILENT,
};

const TERMS: Terms =
    Terms { resolution: Millimetres(50), frame: 250, server_epoch: 1, stores: false };

fn hello(nonce: u32) -> Vec<u8> {
    hello_of(RobotId(1), nonce)
}

fn hello_of(robot: RobotId, nonce: u32) -> Vec<u8> {
    let hello = Hello {
        version: VERSION,
        min_version: MIN_VERSION,
        robot,
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

/// A late copy of a Hello ends the robot's session, but must not lock out the robot.
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

/// What is dropped is counted, and said with its reason, but not more often than the limit allows.
#[test]
fn what_is_dropped_is_counted_and_said() {
    let mut server = Server::new(TERMS, 1);
    server.receive(0, &hello(5), Instant(0)).unwrap();
    let session = server.session_at(0).unwrap();
    // A datagram with a message of a kind unknown, and a State that ends early.
    let contents = [&[0, 0x30][..], &[200, 1, 1], &[4, 1, 1]].concat();
    let mut out = [0u8; MAX_FRAME];
    let parts = [&contents[..], &seal(session, Direction::ToServer, &contents)];
    let len = cobs::encode(parts, &mut out).unwrap();
    server.receive(0, &out[..len], Instant(0)).unwrap();
    for _ in 0..30 {
        server.receive(0, &[7, 7, 0], Instant(1)).unwrap();
    }
    let counted = server.message_counters(0);
    assert_eq!((counted.unknown, counted.malformed, server.link_counters(0).bad), (1, 1, 30));
    let said = core::iter::from_fn(|| server.poll_event()).map(|(_, event)| event.to_string());
    let said: Vec<String> = said.skip(1).collect();
    assert_eq!(
        said[..3],
        [
            "port 0: ignored a message of kind 200, which this version does not know",
            "port 0: ignored a malformed State (kind 4, 1 bytes)",
            "port 0: dropped a frame: the frame is truncated: its last block is incomplete",
        ]
    );
    assert_eq!(said.len(), 22);
}

/// A robot that moved to another port gets its commands again, and its reports are not lost.
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

    let port = server.open_port(Policy::Open);
    assert_eq!((port, server.ports().collect::<Vec<_>>()), (1, vec![1]));
    server.receive(port, &hello(6), Instant(2)).unwrap();
    let mut out = [0u8; MAX_FRAME];
    let frames = std::iter::from_fn(|| server.poll_transmit(port, Instant(2), &mut out));
    assert_eq!(frames.count(), 2, "a Welcome and the Stop");
    assert_eq!(server.waiting(RobotId(1)), 0);
}

/// A robot with a link of its own.
struct Robot {
    port: usize,
    nonce: u32,
    link: Endpoint<ToServer, (), 1, MAX_FRAME>,
    refusal: Option<RefusalReason>,
}

impl Robot {
    fn new(port: usize, nonce: u32) -> Self {
        Self { port, nonce, link: Endpoint::new(), refusal: None }
    }

    /// Sends a Hello and reads the answer.
    fn knock(&mut self, server: &mut Server, now: Instant) {
        server.receive(self.port, &hello(self.nonce), now).unwrap();
        let mut out = [0; MAX_FRAME];
        while let Some(len) = server.poll_transmit(self.port, now, &mut out) {
            let Some(Received::Handshake(message)) = self.link.receive(&mut &out[..len], now)
            else {
                continue;
            };
            match message.by_kind() {
                Some(ToRobotMessage::Welcome(welcome)) => {
                    let welcome = welcome.decode().unwrap();
                    assert_eq!(welcome.nonce, self.nonce);
                    self.link.begin(welcome.session, welcome.frame.into());
                }
                Some(ToRobotMessage::Refusal(refusal)) => {
                    self.refusal = Some(refusal.decode().unwrap().reason);
                }
                _ => {}
            }
        }
    }

    /// Reports a state that contains the robot's nonce, to tell it from those of other robots.
    fn report(&mut self, server: &mut Server, now: Instant) {
        let state = State { time: None, pose: None, odometry: None, cells_refused: self.nonce };
        let mut out = [0; MAX_FRAME];
        let sent = self.link.poll_transmit(now, &mut out, true, |writer, _| {
            assert!(writer.push(&state));
            Fill::Datagram
        });
        server.receive(self.port, &out[..sent.unwrap().len], now).unwrap();
    }
}

fn seconds(count: u64) -> Instant {
    Instant(0) + Duration::from_secs(count)
}

/// The nonce of the robot that reported last.
fn reported(server: &Server) -> Option<u32> {
    server.state(RobotId(1)).map(|state| state.cells_refused)
}

fn joined(server: &mut Server) -> usize {
    let events = std::iter::from_fn(|| server.poll_event());
    events.filter(|(_, event)| matches!(event, Event::Joined(..))).count()
}

#[test]
fn late_and_repeated_hellos_cost_a_living_robot_nothing() {
    let mut server = Server::new(TERMS, 1);
    let mut robot = Robot::new(0, 5);
    robot.knock(&mut server, seconds(0));
    for second in 1..60 {
        robot.report(&mut server, seconds(second));
        assert_eq!(reported(&server), Some(5));
        for old in 0..6 {
            server.receive(0, &hello(100 * second as u32 + old), seconds(second)).unwrap();
            assert_eq!(drain(&mut server, seconds(second)), 1, "a Welcome to an offer");
        }
        server.receive(0, &hello(5), seconds(second)).unwrap();
        drain(&mut server, seconds(second));
    }
    assert_eq!((joined(&mut server), server.link_counters(0).bad), (1, 0));
}

#[test]
fn a_rebooted_robot_takes_over_at_once() {
    let mut server = Server::new(TERMS, 1);
    let mut before = Robot::new(0, 5);
    before.knock(&mut server, seconds(0));
    before.report(&mut server, seconds(1));
    let mut after = Robot::new(0, 6);
    after.knock(&mut server, seconds(2));
    // A repeated Hello gets the same Welcome again, although others are offered sessions.
    let offered = after.link.session();
    Robot::new(0, 7).knock(&mut server, seconds(2));
    after.knock(&mut server, seconds(2));
    assert_eq!(after.link.session(), offered);
    after.report(&mut server, seconds(2));
    assert_eq!((reported(&server), joined(&mut server)), (Some(6), 2));
}

#[test]
fn a_damaged_tile_is_requested_of_a_robot_that_takes_an_offer() {
    let mut server = Server::new(TERMS, 1);
    server.restore_damaged(RobotId(1), TileId { x: 3, y: 4 }, Epoch(1));
    let (mut before, mut after) = (Robot::new(0, 5), Robot::new(0, 6));
    before.knock(&mut server, seconds(0));
    assert_eq!(server.waiting(RobotId(1)), 0, "the life before was asked");
    after.knock(&mut server, seconds(1));
    after.report(&mut server, seconds(2));
    assert_eq!(server.waiting(RobotId(1)), 1);
}

#[test]
fn one_robot_too_many_is_refused_by_name() {
    let mut server = Server::new(TERMS, MAX_ROBOTS + 1);
    for port in 0..MAX_ROBOTS {
        let robot = RobotId(2 + port as u16);
        server.receive(port, &hello_of(robot, 5), seconds(0)).unwrap();
        assert_eq!(server.robot_at(port), Some(robot));
    }
    let mut last = Robot::new(MAX_ROBOTS, 6);
    last.knock(&mut server, seconds(1));
    assert_eq!(last.refusal, Some(RefusalReason::TooManyRobots));
    assert_eq!(server.robot_at(MAX_ROBOTS), None);
}

#[test]
fn of_two_robots_with_one_number_the_living_one_keeps_it() {
    // On another port, the second robot is refused because its number is in use, until the first
    // one has fallen silent.
    let mut server = Server::new(TERMS, 2);
    let (mut first, mut second) = (Robot::new(0, 5), Robot::new(1, 6));
    first.knock(&mut server, seconds(0));
    for moment in 1..30 {
        first.report(&mut server, seconds(moment));
        second.knock(&mut server, seconds(moment));
        assert_eq!(second.refusal.take(), Some(RefusalReason::NumberInUse));
    }
    let later = seconds(29) + SESSION_SILENT;
    second.knock(&mut server, later);
    second.report(&mut server, later);
    assert_eq!((second.refusal, reported(&server)), (None, Some(6)));

    // On the same port, the second robot gets no session.
    let mut server = Server::new(TERMS, 1);
    let (mut first, mut second) = (Robot::new(0, 5), Robot::new(0, 6));
    first.knock(&mut server, seconds(0));
    second.knock(&mut server, seconds(1));
    for moment in 1..30 {
        first.report(&mut server, seconds(2 * moment));
        second.report(&mut server, seconds(2 * moment + 1));
        assert_eq!(reported(&server), Some(5));
    }
    for moment in 61..66 {
        second.report(&mut server, seconds(moment));
    }
    assert_eq!(reported(&server), Some(6), "the first one is gone");
}
