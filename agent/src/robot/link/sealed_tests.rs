//! The robot's side of sealed links: stamps of attempts, and answers that are of no use.

use std::{boxed::Box, vec::Vec};

use ubimap_protocol::{
    frame::{Key, MAX_FRAME, SealSupport, cobs},
    link::{Answer, Fill, Terms, answer_sealed, write_answer},
    message::{Body, Stop},
    time::Duration,
    units::RobotId,
};

use super::*;
use crate::{Bounds, Config, Memory, Robot, memory, sense::SensorModel};

type Server = Endpoint<ToRobot, (), 1, MAX_FRAME>;

const KEY: Key = Key::new([7; 16]);
const ID: RobotId = RobotId(1);
const BOUNDS: Bounds = Bounds::SMALL;

fn robot(boot: u32, memory: &mut memory!(BOUNDS)) -> Robot<'_> {
    let sensor = SensorModel::Radial { first: 0.0, step: 0.1 };
    let seal = Some(Seal { key: KEY, boot });
    Robot::new(Config { seal, ..Config::new(ID, sensor, BOUNDS) }, memory).unwrap()
}

fn at(millis: u64) -> Instant {
    Instant(0) + Duration::from_millis(millis)
}

fn frames(robot: &mut Robot<'_>, now: Instant) -> Vec<Vec<u8>> {
    let mut out = [0; DEFAULT_FRAME];
    let next = || robot.poll_transmit(now, &mut out).map(|len| out[..len].to_vec());
    core::iter::from_fn(next).collect()
}

fn opened(frame: &[u8]) -> (Attempt, Hello) {
    let mut server = Server::sealed(SealSupport::PRESENT);
    match server.receive(&mut &*frame, at(0)) {
        Some(Received::Sealed(sealed)) => sealed.hello(&KEY).expect("it is sealed with the key"),
        other => panic!("{other:?}"),
    }
}

fn answered<M: Body<ToRobot>>(attempt: Option<Attempt>, salt: u64, message: &M) -> Vec<u8> {
    let mut out = [0; 64];
    let len = write_answer(&KEY, (ID, attempt, salt), message, &mut out).unwrap();
    out[..len].to_vec()
}

/// A Welcome to a Hello, and the server's end of the session.
fn welcome((attempt, hello): (Attempt, Hello), salt: u64) -> (Vec<u8>, Server) {
    let session = SessionId(100 + salt as u32);
    let resolution = hello.resolution;
    let terms = Terms { resolution, frame: 250, server_epoch: 1, stores: false };
    let Answer::Welcome(welcome) = answer_sealed(&hello, &terms, session, 1) else { panic!() };
    let mut server = Server::sealed(SealSupport::PRESENT);
    let key = SessionKey::derive(&KEY, ID, attempt, salt, session);
    server.begin_sealed(session, 250, (ID, key));
    (answered(Some(attempt), salt, &welcome), server)
}

fn echo(frame: &[u8]) -> u64 {
    let mut decoder = cobs::Decoder::<MAX_FRAME>::default();
    let raw = decoder.next(&mut &*frame).unwrap().unwrap();
    u64::from_le_bytes(*raw[raw.len() - 16..].first_chunk().unwrap())
}

#[test]
fn hellos_of_one_attempt_are_identical_and_every_attempt_is_later() {
    let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
    let mut robot = robot(5, &mut memory);
    let hellos: Vec<Vec<u8>> = (0..2_000).flat_map(|ms| frames(&mut robot, at(ms))).collect();
    assert_eq!(hellos.len(), 4);
    assert!(hellos.iter().all(|hello| *hello == hellos[0]));
    let (first, hello) = opened(&hellos[0]);
    assert_eq!((first, hello.robot), (Attempt { boot: 5, clock: 0 }, ID));

    let (welcome_frame, _) = welcome((first, hello), 1);
    robot.receive(&welcome_frame, at(2_000));
    assert!(robot.is_connected());
    let sent = frames(&mut robot, at(2_000));
    robot.receive(&answered(None, 2, &SealedReset { echo: echo(&sent[0]) }), at(2_400));
    assert!(!robot.is_connected());
    let (second, _) = opened(&frames(&mut robot, at(2_400))[0]);
    assert_eq!(second, Attempt { boot: 5, clock: at(2_400).0 });
}

#[test]
fn a_clock_that_stands_still_or_goes_back_repeats_no_stamp() {
    let seal = Seal { key: KEY, boot: 5 };
    let mut sealing = Sealing { seal, attempt: None, has_begun: false };
    let mut last = None;
    for now in [at(7), at(7), at(0), at(3)] {
        let attempt = sealing.attempt(now);
        assert!(Some(attempt) > last);
        assert_eq!(sealing.attempt(at(9)), attempt, "the same attempt");
        (last, sealing.has_begun) = (Some(attempt), false);
    }
}

#[test]
fn answers_to_other_attempts_forged_ones_and_unsealed_ones_begin_nothing() {
    let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
    let mut robot = robot(5, &mut memory);
    let (attempt, hello) = opened(&frames(&mut robot, at(10))[0]);
    let old = Attempt { boot: 4, ..attempt };
    robot.receive(&welcome((old, hello), 1).0, at(11));
    let (good, _) = welcome((attempt, hello), 2);
    let mut forged = good.clone();
    forged[20] ^= 1;
    robot.receive(&forged, at(11));
    assert_eq!((robot.is_connected(), robot.link_counters().forged), (false, 2));
    let mut out = [0; 64];
    let unsealed = Server::new().handshake(&Stop { number: 1, stop: true }, &mut out).unwrap();
    robot.receive(&out[..unsealed], at(11));
    assert_eq!((robot.is_connected(), robot.link_counters().refused), (false, 1));
    let reason = RefusalReason::TooManyRobots;
    let refusal = answered(Some(attempt), 3, &Refusal { nonce: hello.nonce, reason });
    robot.receive(&refusal, at(11));
    assert_eq!(robot.refusal(), Some(reason));
    robot.receive(&good, at(12));
    assert!(robot.is_connected());
    let session = robot.session();
    // Neither the same Welcome nor another one to this attempt begins a session again.
    for (again, replayed) in [(good, 1), (welcome((attempt, hello), 4).0, 2), (refusal, 3)] {
        robot.receive(&again, at(13));
        assert_eq!((robot.session(), robot.link_counters().replayed), (session, replayed));
    }
    assert_eq!(robot.statistics().sessions, 1);
}

#[test]
fn a_reset_must_name_a_new_frame_and_a_live_session_ignores_it() {
    let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
    let mut robot = robot(5, &mut memory);
    let first = opened(&frames(&mut robot, at(0))[0]);
    robot.receive(&welcome(first, 1).0, at(1));
    let sent: Vec<u64> = frames(&mut robot, at(1)).iter().map(|frame| echo(frame)).collect();
    let good = answered(None, 2, &SealedReset { echo: sent[0] });
    robot.receive(&good, at(200));
    assert!(robot.is_connected(), "the session was heard just now");
    robot.receive(&answered(None, 3, &SealedReset { echo: sent[0] ^ 1 }), at(1_000));
    assert_eq!((robot.is_connected(), robot.link_counters().replayed), (true, 1));
    robot.receive(&good, at(1_000));
    assert!(!robot.is_connected());
    let second = opened(&frames(&mut robot, at(1_000))[0]);
    robot.receive(&welcome(second, 4).0, at(1_001));
    frames(&mut robot, at(1_001));
    robot.receive(&good, at(9_000));
    assert_eq!((robot.is_connected(), robot.link_counters().replayed), (true, 2), "an old Reset");
}

/// After more than 32,768 lost frames the counter on the wire names the wrong one, for ever.
#[test]
fn a_robot_that_can_open_nothing_for_a_long_time_knocks_again() {
    let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
    let mut robot = robot(5, &mut memory);
    let first = opened(&frames(&mut robot, at(0))[0]);
    let (welcome, mut server) = welcome(first, 1);
    robot.receive(&welcome, at(1));
    let mut stop = |now| {
        let mut out = [0; MAX_FRAME];
        let sent = server.poll_transmit(now, &mut out, true, |writer, _| {
            assert!(writer.push(&Stop { number: 1, stop: true }));
            Fill::Datagram
        });
        out[..sent.unwrap().len].to_vec()
    };
    for _ in 0..2 {
        (0..30_000).for_each(|_| drop(stop(at(2))));
        robot.receive(&stop(at(2)), at(2));
    }
    assert_eq!(robot.link_counters().received, 3);
    (0..40_000).for_each(|_| drop(stop(at(2))));
    robot.receive(&stop(at(15_000)), at(15_000));
    assert!(robot.is_connected());
    robot.receive(&stop(at(15_004)), at(15_004));
    assert!(!robot.is_connected());
    let Counters { forged, replayed, .. } = robot.link_counters();
    assert_eq!(forged + replayed, 2);
    let second = opened(&frames(&mut robot, at(15_004))[0]);
    assert!(second.0 > first.0);
}
