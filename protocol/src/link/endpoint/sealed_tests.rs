//! Sealed sessions: nonces, replays, and frames that were damaged or forged.

use std::{collections::BTreeSet, vec::Vec};

use proptest::prelude::*;

use super::{tests::numbered, *};
use crate::{
    frame::{Attempt, Key, TAG_LEN},
    message::{Request, ToRobot, ToServer},
};

type End<D> = Endpoint<D, u32, 8, 250>;

const KEY: Key = Key::new([7; 16]);
const ROBOT: RobotId = RobotId(0x0102);
const SESSION: SessionId = SessionId(77);

fn session_key(clock: u64) -> SessionKey {
    SessionKey::derive(&KEY, ROBOT, Attempt { boot: 3, clock }, 9, SESSION)
}

fn end<D: Traffic>() -> End<D> {
    let mut end = End::sealed(SealSupport::PRESENT);
    end.begin_sealed(SESSION, 250, (ROBOT, session_key(1)));
    end
}

fn send<D: Traffic>(end: &mut End<D>, number: i16, token: Option<u32>) -> Vec<u8>
where
    Request: Body<D>,
{
    let mut out = [0u8; 250];
    let sent = end.poll_transmit(Instant(0), &mut out, false, |writer, _| {
        assert!(writer.push(&numbered(number)));
        token.map_or(Fill::Datagram, Fill::Reliable)
    });
    out[..sent.unwrap().len].to_vec()
}

/// What arrives of `bytes`: the numbers in its messages, and the strays.
fn arrive(end: &mut End<ToRobot>, mut bytes: &[u8], now: u64) -> (Vec<i16>, Vec<Stray>) {
    let (mut numbers, mut strays) = (Vec::new(), Vec::new());
    while let Some(received) = end.receive(&mut bytes, Instant(now)) {
        match received {
            Received::Session(messages) => {
                let requests = messages.filter_map(|it| it.ok()?.decode::<Request>().ok());
                numbers.extend(requests.map(|request| request.tiles[0].x));
            }
            Received::Stray(stray, _) => strays.push(stray),
            Received::Sealed(_) | Received::Handshake(_) | Received::Bad(_) => {}
        }
    }
    (numbers, strays)
}

fn contents(wire: &[u8]) -> Vec<u8> {
    let mut decoder = cobs::Decoder::<1024>::default();
    decoder.next(&mut &*wire).unwrap().unwrap().to_vec()
}

fn wire(contents: &[u8]) -> Vec<u8> {
    let mut out = [0u8; 300];
    let len = cobs::encode([contents, &[]], &mut out).unwrap();
    out[..len].to_vec()
}

#[test]
fn framing_takes_24_bytes_and_the_text_is_hidden() {
    let (mut robot, mut server) = (end::<ToServer>(), end::<ToRobot>());
    let body = [0xAB; 200];
    let mut out = [0u8; 250];
    let sent = robot.poll_transmit(Instant(0), &mut out, false, |writer, _| {
        assert!(writer.push_encoded(Message::new(99, &body)));
        Fill::Datagram
    });
    let len = sent.unwrap().len;
    // The message's kind and length are three bytes.
    assert_eq!(len, 24 + 3 + body.len());
    assert!(!out[..len].windows(4).any(|four| four == [0xAB; 4]));
    let received = server.receive(&mut &out[..len], Instant(0));
    let Some(Received::Session(mut messages)) = received else { panic!("{received:?}") };
    assert_eq!(messages.next().unwrap().unwrap().body, body);
}

/// Everything that a sender ever writes in a session, in either direction, has another nonce.
#[test]
fn no_counter_is_used_twice_even_for_retransmissions_and_frames_that_do_not_fit() {
    let (mut robot, mut server) = (end::<ToServer>(), end::<ToRobot>());
    let mut sent = Vec::new();
    for round in 0..40u64 {
        let now = Instant(round * 4_000_000);
        let mut out = [0u8; 250];
        let fill = |writer: &mut Writer<'_, ToServer>, reliable: bool| {
            assert!(writer.push(&numbered(1)));
            if reliable { Fill::Reliable(1) } else { Fill::Datagram }
        };
        // Too short for the frame: its counter is used up all the same.
        let _ = robot.poll_transmit(now, &mut out[..30], true, |_, _| Fill::Nothing);
        while let Some(frame) = robot.poll_transmit(now, &mut out, round % 2 == 0, |writer, ok| {
            if ok { fill(writer, ok) } else { Fill::Nothing }
        }) {
            sent.push(out[..frame.len].to_vec());
        }
    }
    assert!(robot.counters().retransmissions > 20);
    let counters = sent.iter().map(|wire| contents(wire)[4..6].to_vec());
    assert_eq!(counters.collect::<BTreeSet<_>>().len(), sent.len());
    // Retransmissions keep their reliable number: the receiver takes them for duplicates.
    for frame in &sent {
        arrive(&mut server, frame, 0);
    }
    let Counters { received, duplicates, replayed, forged, .. } = server.counters();
    assert_eq!((received as usize, replayed, forged), (sent.len(), 0, 0));
    assert!(duplicates > 20);
}

#[test]
fn a_replay_costs_a_counter_and_is_not_acknowledged() {
    let (mut robot, mut server) = (end::<ToServer>(), end::<ToRobot>());
    let frames: Vec<_> = (0..80).map(|number| send(&mut robot, number, None)).collect();
    let first = send(&mut robot, 100, Some(1));
    assert_eq!(arrive(&mut server, &first, 0).0, [100]);
    let mut out = [0u8; 250];
    let due = server.poll_timeout().unwrap();
    assert!(server.poll_transmit(due, &mut out, false, |_, _| Fill::Nothing).is_some());
    assert_eq!(server.poll_timeout(), None);
    assert!(arrive(&mut server, &first, due.0).0.is_empty());
    assert_eq!((server.counters().replayed, server.counters().duplicates), (1, 0));
    assert_eq!(server.poll_timeout(), None, "a replay is not acknowledged");
    // Of the frames that were overtaken, the last 64 count, once.
    for round in 0..2 {
        let arrived = frames.iter().flat_map(|frame| arrive(&mut server, frame, 0).0);
        let expected: Vec<i16> = if round == 0 { (16..80).collect() } else { Vec::new() };
        assert_eq!(arrived.collect::<Vec<_>>(), expected);
    }
    assert_eq!(server.counters().replayed, 1 + 16 + 80);
}

proptest! {
    /// One flipped bit, at any place of the frame.
    #[test]
    fn a_changed_frame_costs_a_counter(number in any::<i16>(), reliable: bool) {
        let mut robot = end::<ToServer>();
        let good = contents(&send(&mut robot, number, reliable.then_some(1)));
        for bit in 0..8 * good.len() {
            let mut server = end::<ToRobot>();
            let mut changed = good.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            prop_assert!(arrive(&mut server, &wire(&changed), 0).0.is_empty(), "bit {}", bit);
            let Counters { received, bad, refused, forged, .. } = server.counters();
            // A handshake frame is for the owner; a frame that is not sealed is refused.
            let outside = u32::from(changed[1] >> 3 & 3 == 0 && changed[1] >> 7 == 1);
            prop_assert_eq!(bad + refused + forged + outside, 1, "bit {}", bit);
            prop_assert_eq!(received, refused);
            prop_assert_eq!(server.poll_timeout(), None);
            prop_assert_eq!(arrive(&mut server, &wire(&good), 0).0, [number], "the window moved");
        }
    }

    #[test]
    fn a_truncated_or_extended_frame_costs_a_counter(len in 0..60usize, filler: u8) {
        let (mut robot, mut server) = (end::<ToServer>(), end::<ToRobot>());
        let good = contents(&send(&mut robot, 5, None));
        prop_assume!(len != good.len() && len > 0);
        let mut changed = good.clone();
        changed.resize(len, filler);
        prop_assert!(arrive(&mut server, &wire(&changed), 0).0.is_empty());
        let Counters { bad, refused, forged, .. } = server.counters();
        prop_assert_eq!(bad + refused + forged, 1);
        prop_assert_eq!(arrive(&mut server, &wire(&good), 0).0, [5]);
    }

    #[test]
    fn no_bytes_make_an_endpoint_panic_or_accept(
        bytes in proptest::collection::vec(any::<u8>(), 0..120),
    ) {
        let mut server = end::<ToRobot>();
        let mut sealed = bytes.clone();
        if let Some(high) = sealed.get_mut(1) {
            *high |= 0x80;
        }
        for frame in [&bytes, &sealed] {
            prop_assert!(arrive(&mut server, &wire(frame), 0).0.is_empty());
        }
        prop_assert_eq!(server.counters().duplicates, 0);
    }
}

#[test]
fn counters_pass_their_low_half() {
    let (mut robot, mut server) = (end::<ToServer>(), end::<ToRobot>());
    for number in 0..70_000u32 {
        let frame = send(&mut robot, number as i16, None);
        // Long gaps, but fewer than 32,768 frames.
        if number % 30_000 < 10 {
            assert_eq!(arrive(&mut server, &frame, 0).0, [number as i16], "{number}");
        }
    }
    assert_eq!((server.counters().forged, server.counters().replayed), (0, 0));
}

#[test]
fn frames_of_other_keys_sessions_robots_and_directions_are_strays() {
    let wrong_key = (ROBOT, session_key(2));
    let wrong_robot = (RobotId(1), session_key(1));
    let ends =
        [(SESSION, wrong_key), (SessionId(78), (ROBOT, session_key(1))), (SESSION, wrong_robot)];
    let mut server = end::<ToRobot>();
    for (count, (session, keys)) in (1..).zip(ends) {
        let mut robot = End::<ToServer>::sealed(SealSupport::PRESENT);
        robot.begin_sealed(session, 250, keys);
        let frame = send(&mut robot, 5, None);
        let (numbers, strays) = arrive(&mut server, &frame, 0);
        let raw = contents(&frame);
        let echo = u64::from_le_bytes(*raw[raw.len() - TAG_LEN..].first_chunk().unwrap());
        assert_eq!((numbers, strays), (Vec::new(), std::vec![Stray { robot: keys.0, echo }]));
        assert!(robot.is_echo(echo) && !server.is_echo(echo));
        assert_eq!((server.counters().forged, server.counters().bad), (count, 0));
    }
    let echo = send(&mut server, 5, None);
    assert!(arrive(&mut server, &echo, 0).0.is_empty());
    assert_eq!(server.counters().forged, 4);
}

#[test]
fn a_reset_may_answer_one_of_the_last_four_frames() {
    let mut robot = end::<ToServer>();
    assert!(!robot.is_echo(0), "nothing was sent");
    let echoes: Vec<u64> = (0..6)
        .map(|number| {
            let raw = contents(&send(&mut robot, number, None));
            u64::from_le_bytes(*raw[raw.len() - TAG_LEN..].first_chunk().unwrap())
        })
        .collect();
    let known: Vec<bool> = echoes.iter().map(|&echo| robot.is_echo(echo)).collect();
    assert_eq!(known, [false, false, true, true, true, true]);
    robot.begin_sealed(SESSION, 250, (ROBOT, session_key(2)));
    assert!(!echoes.iter().any(|&echo| robot.is_echo(echo)));
}

#[test]
fn open_and_sealed_ends_refuse_each_other() {
    let (mut open, mut sealed) = (End::<ToServer>::new(), end::<ToServer>());
    open.begin(SESSION, 250);
    let mut server = end::<ToRobot>();
    assert!(arrive(&mut server, &send(&mut open, 1, None), 0).0.is_empty());
    assert_eq!((server.counters().bad, server.counters().refused), (1, 0));
    // An unsealed Hello counts as refused, noise as bad.
    let mut out = [0u8; 64];
    let len = open.handshake(&numbered(1), &mut out).unwrap();
    assert!(arrive(&mut server, &out[..len], 0).0.is_empty());
    assert_eq!((server.counters().bad, server.counters().refused), (1, 1));
    let mut server = End::<ToRobot>::new();
    server.begin(SESSION, 250);
    assert!(arrive(&mut server, &send(&mut sealed, 1, None), 0).0.is_empty());
    assert_eq!(server.counters().bad, 1);
}

#[test]
fn a_session_ends_before_its_counters_repeat() {
    let mut robot = end::<ToServer>();
    let Security::Sealed(_, session) = &mut robot.security else { panic!() };
    session.get_mut().unwrap().set_written(u32::MAX - 1);
    assert!(!robot.is_spent());
    send(&mut robot, 5, Some(1));
    assert!(robot.is_spent());
    let mut out = [0u8; 250];
    let fill = |_: &mut Writer<'_, ToServer>, _| panic!("its messages would be lost");
    assert_eq!(robot.poll_transmit(Instant(9_000_000), &mut out, true, fill), None);
    assert_eq!(robot.poll_timeout(), None);
}
