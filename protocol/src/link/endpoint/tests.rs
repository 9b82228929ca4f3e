use super::*;
use crate::{
    frame::{Direction, open, payload_capacity},
    message::{Hello, Request, ToRobot, ToServer},
    tile::{Layer, TileId},
    units::{Millimetres, RobotId},
};

type End<D> = Endpoint<D, u32, 8, 64>;

fn pair() -> (End<ToServer>, End<ToRobot>) {
    let (mut robot, mut server) = (End::new(), End::new());
    robot.begin(SessionId(77), 64);
    server.begin(SessionId(77), 64);
    (robot, server)
}

/// A message for either direction that carries a number.
pub(super) fn numbered(x: i16) -> Request {
    Request { layer: Layer::Robot, tiles: core::iter::once(TileId { x, y: 0 }).collect() }
}

fn send<D: Traffic>(end: &mut End<D>, now: i16, token: Option<u32>) -> std::vec::Vec<u8>
where
    Request: Body<D>,
{
    let mut out = [0u8; 64];
    let sent = end.poll_transmit(Instant(now as u64), &mut out, false, |writer, _| {
        assert!(writer.push(&numbered(now)));
        token.map_or(Fill::Datagram, Fill::Reliable)
    });
    out[..sent.unwrap().len].to_vec()
}

fn numbers<D: Traffic>(end: &mut End<D>, mut bytes: &[u8], now: u64) -> std::vec::Vec<i16>
where
    Request: Body<D::Opposite>,
{
    let mut numbers = std::vec::Vec::new();
    while let Some(received) = end.receive(&mut bytes, Instant(now)) {
        if let Received::Session(messages) = received {
            let requests = messages.filter_map(|message| message.ok()?.decode().ok());
            numbers.extend(requests.map(|request: Request| request.tiles[0].x));
        }
    }
    numbers
}

#[test]
fn a_lost_frame_is_sent_again_until_it_is_acknowledged() {
    let (mut robot, mut server) = pair();
    let _lost = send(&mut robot, 5, Some(42));
    let due = robot.poll_timeout().unwrap();
    let mut out = [0u8; 64];
    let again = robot.poll_transmit(due, &mut out, false, |_, _| Fill::Nothing).unwrap();
    assert_eq!(again.token, Some(42));
    assert_eq!(numbers(&mut server, &out[..again.len], due.0), [5]);
    // The same frame again is a duplicate, and is acknowledged.
    assert!(numbers(&mut server, &out[..again.len], due.0).is_empty());
    assert_eq!(server.counters().duplicates, 1);
    let now = server.poll_timeout().unwrap();
    let ack = server.poll_transmit(now, &mut out, false, |_, _| Fill::Nothing).unwrap();
    numbers(&mut robot, &out[..ack.len], now.0);
    assert_eq!(robot.poll_acknowledged(), Some(42));
    assert_eq!(robot.poll_timeout(), None);
}

#[test]
fn reliable_frames_need_a_session_and_a_free_place() {
    let (mut robot, mut server) = pair();
    assert_eq!(robot.session(), SessionId(77));
    for now in 0..8 {
        assert!(robot.can_send_reliable());
        let frame = send(&mut robot, now, Some(now as u32));
        numbers(&mut server, &frame, 0);
    }
    assert!(!robot.can_send_reliable());
    let mut out = [0u8; 64];
    let due = server.poll_timeout().unwrap();
    let ack = server.poll_transmit(due, &mut out, false, |_, _| Fill::Nothing).unwrap();
    assert_eq!(ack.token, None);
    numbers(&mut robot, &out[..ack.len], due.0);
    let tokens = core::iter::from_fn(|| robot.poll_acknowledged());
    assert_eq!(tokens.collect::<std::collections::BTreeSet<_>>(), (0..8).collect());
    assert!(robot.can_send_reliable());
    let sent = Counters { sent: 8, received: 1, ..Counters::default() };
    let received = Counters { sent: 1, received: 8, ..Counters::default() };
    assert_eq!((robot.counters(), server.counters()), (sent, received));
    send(&mut robot, 9, Some(9));
    robot.end();
    assert_eq!((robot.session(), robot.poll_timeout()), (SessionId::NONE, None));
    assert!(!robot.can_send_reliable());
    let fill = |_: &mut Writer<'_, ToServer>, _| panic!("there is no session");
    assert_eq!(robot.poll_transmit(Instant(9_000_000), &mut out, true, fill), None);
}

#[test]
fn whatever_is_as_long_as_the_room_fits_beside_an_acknowledgement() {
    for size in 20..=64 {
        let (mut robot, mut server) = pair();
        robot.begin(SessionId(77), size);
        server.begin(SessionId(77), size);
        let (room, capacity) = (server.room(), payload_capacity(size));
        let is_small = capacity < ROOM_FOR_TWO;
        assert_eq!(room, if is_small { capacity - 1 } else { capacity - ACK_LEN }, "{size}");
        // The longest acknowledgement: the first 2,047 frames, and all after the next one.
        for sequence in (0..SEQUENCE_MODULUS - 1).chain(0..32) {
            server.receiving.arrive(sequence, Instant(0));
        }
        let due = server.poll_timeout().unwrap();
        let mut kinds = std::vec::Vec::new();
        // In a small frame the acknowledgement travels alone.
        for _ in 0..if is_small { 2 } else { 1 } {
            let mut out = [0u8; 64];
            let longest = |writer: &mut Writer<'_, ToRobot>, _| {
                assert!(writer.push_encoded(Message::new(99, &[1; 64][..room - 2])), "{size}");
                Fill::Datagram
            };
            let len = server.poll_transmit(due, &mut out[..size], false, longest).unwrap().len;
            let received = robot.receive(&mut &out[..len], due);
            let Some(Received::Session(messages)) = received else { panic!("{received:?}") };
            kinds.extend(messages.map(|message| message.unwrap().number));
        }
        assert_eq!(kinds, [0, 99], "{size}");
    }
}

#[test]
fn a_handshake_passes_between_ends_without_a_session() {
    let hello = Hello {
        version: VERSION,
        min_version: MIN_VERSION,
        robot: RobotId(1),
        nonce: u32::MAX,
        frame: 250,
        resolution: Millimetres(50),
        fused_tiles: 16,
    };
    let (mut robot, mut server) = (End::<ToServer>::new(), End::<ToRobot>::new());
    let mut out = [0u8; 64];
    let len = robot.handshake(&hello, &mut out).unwrap();
    let mut payload = [0u8; 64];
    let mut writer = Writer::<ToServer>::new(&mut payload);
    assert!(writer.push(&hello));
    assert_eq!(len, cobs::encoded_len(HEADER_LEN + writer.len() + SEAL_LEN));
    for session in [SessionId::NONE, SessionId(77)] {
        server.begin(session, 64);
        let Some(Received::Handshake(message)) = server.receive(&mut &out[..len], Instant(0))
        else {
            panic!("no handshake")
        };
        assert_eq!(message.decode(), Ok(hello));
    }
    assert_eq!((robot.counters().sent, server.counters().received), (1, 2));
    assert_eq!(robot.handshake(&hello, &mut out[..len - 1]), None, "longer than the buffer");
    assert_eq!(Endpoint::<ToServer, u32, 8, 12>::new().handshake(&hello, &mut out), None);
}

#[test]
fn a_malformed_acknowledgement_is_counted_and_the_other_messages_are_read() {
    let (mut robot, mut server) = pair();
    let mut out = [0u8; 64];
    let sent = robot.poll_transmit(Instant(0), &mut out, false, |writer, _| {
        assert!(writer.push_encoded(Message::new(0, &[1])));
        assert!(writer.push(&numbered(3)));
        Fill::Datagram
    });
    let mut wire = &out[..sent.unwrap().len];
    let Some(Received::Session(messages)) = server.receive(&mut wire, Instant(0)) else {
        panic!("no messages")
    };
    assert_eq!(messages.count(), 2);
    assert_eq!((server.counters().received, server.counters().refused), (1, 1));
}

#[test]
fn urgent_frames_go_before_retransmissions_and_block_nothing() {
    let (mut robot, _) = pair();
    let _lost = send(&mut robot, 5, Some(42));
    let due = robot.poll_timeout().unwrap();
    let mut out = [0u8; 64];
    let mut poll = |fill: Fill<u32>| {
        let sent = robot.poll_transmit(due, &mut out, true, |writer, _| {
            assert!(writer.push(&numbered(1)));
            fill
        });
        sent.map(|sent| sent.token)
    };
    assert_eq!(poll(Fill::Reliable(7)), Some(Some(7)));
    assert_eq!(poll(Fill::Nothing), Some(Some(42)));
    assert_eq!(poll(Fill::Nothing), None);
}

#[test]
fn in_a_small_frame_an_acknowledgement_travels_alone() {
    let (mut robot, mut server) = pair();
    robot.begin(SessionId(77), 32);
    server.begin(SessionId(77), 32);
    let frame = send(&mut robot, 5, Some(1));
    numbers(&mut server, &frame, 5);
    let mut out = [0u8; 64];
    let mut fill = |server: &mut End<ToRobot>, now: Instant| {
        let longest = |writer: &mut Writer<'_, ToRobot>, _| {
            assert!(writer.push_encoded(Message::new(9, &[0; 21])));
            Fill::Datagram
        };
        let len = server.poll_transmit(now, &mut out, false, longest).unwrap().len;
        robot.receive(&mut &out[..len], now);
        (len, robot.poll_acknowledged())
    };
    let due = server.poll_timeout().unwrap();
    assert_eq!(fill(&mut server, Instant(5)), (31, None));
    assert_eq!(fill(&mut server, due).1, Some(1));
    assert_eq!(fill(&mut server, due), (31, None));
}

#[test]
fn frames_that_violate_the_protocol_are_no_sign_of_life() {
    let (_, mut server) = pair();
    let sealed = |header: Header, session| {
        let contents = [&header.encode()[..], &[9, 1, 0]].concat();
        let mut out = [0u8; 64];
        let tail = seal(session, Direction::ToServer, &contents);
        let len = cobs::encode([&contents, &tail], &mut out).unwrap();
        out[..len].to_vec()
    };
    let good = Header { version: VERSION, kind: FrameKind::Datagram, sequence: 0 };
    let cases = [
        (Header { version: VERSION + 1, ..good }, SessionId(77), FrameFault::Version(VERSION + 1)),
        (Header { kind: FrameKind::Handshake, ..good }, SessionId(77), FrameFault::Kind),
        (
            Header { kind: FrameKind::Reliable, sequence: 400, ..good },
            SessionId(77),
            FrameFault::Sequence(400),
        ),
        (good, SessionId::NONE, FrameFault::Kind),
    ];
    for (count, (header, session, fault)) in (1..).zip(cases) {
        let received = server.receive(&mut &sealed(header, session)[..], Instant(0));
        let Some(Received::Bad(found)) = received else { panic!("{header:?} {session:?}") };
        assert_eq!(found, fault);
        assert_eq!((server.counters().refused, server.counters().bad), (count, 0));
    }
    let received = server.receive(&mut &sealed(good, SessionId(77))[..], Instant(0));
    assert!(matches!(received, Some(Received::Session(_))));
}

#[test]
fn frames_of_another_session_and_echoes_do_not_pass() {
    let (mut robot, mut server) = pair();
    let frame = send(&mut robot, 1, None);
    assert!(numbers(&mut robot, &frame, 1).is_empty());
    server.begin(SessionId(78), 64);
    assert!(numbers(&mut server, &frame, 1).is_empty());
    assert_eq!((robot.counters().bad, server.counters().bad), (1, 1));
}

#[test]
fn the_frame_after_a_damaged_one_is_read() {
    let (mut robot, mut server) = pair();
    let mut wire = send(&mut robot, 1, None);
    wire[4] ^= 0x40;
    let truncated = send(&mut robot, 2, None);
    wire.extend(&truncated[..6]);
    wire.push(0);
    wire.extend([1u8; 90]);
    wire.push(0);
    wire.extend(send(&mut robot, 3, None));
    assert_eq!(numbers(&mut server, &wire, 9), [3]);
    assert_eq!(server.counters().bad, 3);
}

#[test]
fn an_empty_frame_is_sent_for_a_due_acknowledgement_only() {
    let (mut robot, mut server) = pair();
    let mut out = [0u8; 64];
    for fill in [Fill::Nothing, Fill::Datagram] {
        let frame = send(&mut robot, 5, Some(1));
        assert_eq!(server.poll_transmit(Instant(5), &mut out, false, |_, _| fill), None);
        numbers(&mut server, &frame, 5);
        let due = server.poll_timeout().unwrap();
        let early = Instant(due.0 - 1);
        assert_eq!(server.poll_transmit(early, &mut out, false, |_, _| fill), None);
        assert!(server.poll_transmit(due, &mut out, false, |_, _| fill).is_some());
        assert_eq!(server.poll_transmit(due, &mut out, false, |_, _| fill), None);
    }
}

#[test]
fn datagrams_are_numbered_and_the_numbers_wrap() {
    let (mut robot, _) = pair();
    for count in 0..2 * SEQUENCE_MODULUS + 3 {
        let wire = send(&mut robot, 5, None);
        let mut decoder = cobs::Decoder::<64>::default();
        let frame = decoder.next(&mut &wire[..]).unwrap().unwrap();
        let contents = open(SessionId(77), Direction::ToServer, frame).unwrap();
        let (header, _) = Header::decode(contents).unwrap();
        assert_eq!((header.kind, header.sequence), (FrameKind::Datagram, count % SEQUENCE_MODULUS));
    }
}

#[test]
fn an_acknowledgement_of_a_number_that_there_is_not_acknowledges_nothing() {
    let (mut robot, _) = pair();
    send(&mut robot, 5, Some(42));
    // Modulo 2,048 it would acknowledge the frame.
    let header = Header { version: VERSION, kind: FrameKind::Datagram, sequence: 0 };
    for (next, acknowledged) in [([0x81, 0x10], None), ([0x01, 0x00], Some(42))] {
        let mut contents = header.encode().to_vec();
        match next {
            [next, 0] => contents.extend([0, 2, next, 0]),
            [low, high] => contents.extend([0, 3, low, high, 0]),
        }
        let tail = seal(SessionId(77), Direction::ToRobot, &contents);
        let mut wire = [0; 64];
        let len = cobs::encode([&contents, &tail], &mut wire).unwrap();
        assert!(robot.receive(&mut &wire[..len], Instant(6)).is_some());
        assert_eq!(robot.poll_acknowledged(), acknowledged);
    }
    assert_eq!(robot.counters().refused, 1);
}
