//! Sealed links (SPEC.md, 12): the cipher, frames of the handshake and of a session, and frames that
//! are dropped.

use serde_json::{Value, json};
use ubimap_protocol::{
    frame::{
        Attempt, FrameKind, Header, Key, MAX_FRAME, SealSupport, SessionId, SessionKey, VERSION,
        seal, seal_hello, seal_session,
    },
    link::{Endpoint, FrameFault, Received, write_answer, write_hello},
    message::{
        Direction, Hello, Refusal, RefusalReason, SealedReset, ToRobot, ToServer, Welcome, Writer,
    },
    time::Instant,
    units::{Millimetres, RobotId},
};
use ubimap_tests::vectors::{direction_name, hex};

use crate::{stuff, unstuff};

const BYTES: [u8; 16] = *b"a robot's secret";
const KEY: Key = Key::new(BYTES);
const ID: RobotId = RobotId(0x0107);
const ATTEMPT: Attempt = Attempt { boot: 42, clock: 0x0001_0203_0405 };
const SALT: u64 = 0xA1B2_C3D4_E5F6_0718;
const SESSION: SessionId = SessionId(0xA1B2_C3D4);

/// The cases.
pub(super) fn seals() -> Value {
    json!({ "hellos": hellos(), "answers": answers(), "sessions": sessions(), "refused": refused() })
}

fn hello() -> Hello {
    Hello {
        version: VERSION,
        min_version: VERSION,
        robot: ID,
        nonce: 99,
        frame: 250,
        resolution: Millimetres(50),
        fused_tiles: 16,
    }
}

fn encoded<D: ubimap_protocol::message::Traffic>(
    push: impl FnOnce(&mut Writer<'_, D>) -> bool,
) -> Vec<u8> {
    let mut buffer = [0; 200];
    let mut writer = Writer::new(&mut buffer);
    assert!(push(&mut writer));
    let len = writer.len();
    buffer[..len].to_vec()
}

fn hellos() -> Value {
    const LAST: Attempt = Attempt { boot: u32::MAX, clock: u64::MAX };
    let cases = [("the first attempt of a boot", ATTEMPT), ("the last stamp", LAST)];
    let cases = cases.map(|(name, attempt)| {
        let mut out = [0; 64];
        let len = write_hello(&KEY, attempt, &hello(), &mut out).unwrap();
        json!({
            "name": name, "key": hex(&BYTES), "robot": ID.0, "boot": attempt.boot,
            "clock": attempt.clock,
            "payload": hex(&encoded::<ToServer>(|it| it.push(&hello()))), "wire": hex(&out[..len]),
        })
    });
    json!(cases)
}

fn welcome() -> Welcome {
    Welcome {
        nonce: 99,
        version: VERSION,
        session: SESSION,
        frame: 250,
        server_epoch: 3,
        first_epoch: 1,
        stores: true,
        renumber: true,
    }
}

fn answers() -> Value {
    let refusal = Refusal { nonce: 99, reason: RefusalReason::Frame(48) };
    let reset = SealedReset { echo: 0x0807_0605_0403_0201 };
    let case =
        |name: &str, attempt: Option<Attempt>, salt: u64, payload: Vec<u8>, wire: Vec<u8>| {
            let stamp = attempt.map(|attempt| json!([attempt.boot, attempt.clock]));
            json!({
                "name": name, "key": hex(&BYTES), "robot": ID.0, "answers": stamp, "salt": salt,
                "payload": hex(&payload), "wire": hex(&wire),
            })
        };
    let written = |write: &dyn Fn(&mut [u8]) -> Option<usize>| {
        let mut out = [0; 64];
        let len = write(&mut out).unwrap();
        out[..len].to_vec()
    };
    let attempt = Some(ATTEMPT);
    json!([
        case(
            "welcome",
            attempt,
            SALT,
            encoded::<ToRobot>(|it| it.push(&welcome())),
            written(&|out| write_answer(&KEY, (ID, attempt, SALT), &welcome(), out)),
        ),
        case(
            "refusal",
            attempt,
            SALT + 1,
            encoded::<ToRobot>(|it| it.push(&refusal)),
            written(&|out| write_answer(&KEY, (ID, attempt, SALT + 1), &refusal, out)),
        ),
        case(
            "reset",
            None,
            u64::MAX,
            encoded::<ToRobot>(|it| it.push(&reset)),
            written(&|out| write_answer(&KEY, (ID, None, u64::MAX), &reset, out)),
        ),
    ])
}

fn session_key() -> SessionKey {
    SessionKey::derive(&KEY, ID, ATTEMPT, SALT, SESSION)
}

fn frame(direction: Direction, header: Header, counter: u32, payload: &[u8]) -> Vec<u8> {
    let mut text = payload.to_vec();
    let names = (ID, SESSION);
    let (clear, tag) = seal_session(&session_key(), names, direction, header, counter, &mut text);
    stuff(&[&clear[..], &text, &tag].concat())
}

fn header(kind: FrameKind, sequence: u16) -> Header {
    Header { version: VERSION, kind, sequence }
}

fn sessions() -> Value {
    let (up, down) = (Direction::ToServer, Direction::ToRobot);
    let (reliable, datagram) = (FrameKind::Reliable, FrameKind::Datagram);
    let long: Vec<u8> = [&[99, 0xE0, 0x01][..], &[7; 223]].concat();
    let cases = [
        ("the first frame", up, reliable, 0, 0, vec![2, 1, 7]),
        ("the first frame of the server", down, reliable, 0, 0, vec![2, 1, 7]),
        ("a retransmission", up, reliable, 0, 1, vec![2, 1, 7]),
        ("without messages", up, datagram, 3, 2, vec![]),
        ("a block of the cipher", down, datagram, 2_047, 9, vec![3; 16]),
        ("a frame of 250 bytes", down, reliable, 5, 10, long),
        ("a counter of more than 16 bits", up, datagram, 1, 0x0001_0005, vec![2, 1, 8]),
    ];
    let cases = cases.map(|(name, direction, kind, sequence, counter, payload)| {
        let wire = frame(direction, header(kind, sequence), counter, &payload);
        json!({
            "name": name, "key": hex(&BYTES), "robot": ID.0, "boot": ATTEMPT.boot,
            "clock": ATTEMPT.clock, "salt": SALT, "session": SESSION.0,
            "direction": direction_name(direction),
            "kind": if kind == reliable { "reliable" } else { "datagram" },
            "sequence": sequence, "counter": counter, "payload": hex(&payload), "wire": hex(&wire),
        })
    });
    json!(cases)
}

/// Frames that arrive at a server in this session one after the other, and what becomes of each.
fn refused() -> Value {
    let up =
        |counter| frame(Direction::ToServer, header(FrameKind::Datagram, 0), counter, &[2, 1, 7]);
    let changed = |counter, at: usize, bit: u8| {
        let mut contents = unstuff(&up(counter));
        let at = at.min(contents.len() - 1);
        contents[at] ^= bit;
        stuff(&contents)
    };
    let mut text = encoded::<ToServer>(|it| it.push(&hello()));
    let (clear, tag) = seal_hello(&KEY, ID, ATTEMPT, &mut text);
    let hello = [&clear[..], &text, &tag].concat();
    let plain = [&header(FrameKind::Datagram, 0).encode()[..], &[2, 1, 7, 0, 0, 0, 0]].concat();
    let mut open = [&header(FrameKind::Handshake, 0).encode()[..], &[2, 1, 7]].concat();
    let tail = seal(SessionId::NONE, Direction::ToServer, &open);
    open.extend(tail);
    let frames = [
        ("the first", up(100)),
        ("again", up(100)),
        ("64 below the highest", up(36)),
        ("again", up(36)),
        ("65 below", up(35)),
        ("a changed tag", changed(101, 99, 1)),
        ("a changed text", changed(101, 6, 1)),
        ("a changed sequence number", changed(101, 0, 1)),
        ("a changed counter", changed(101, 4, 4)),
        ("another robot", changed(101, 2, 1)),
        ("the server's own", frame(Direction::ToRobot, header(FrameKind::Datagram, 0), 101, &[])),
        ("not sealed", stuff(&plain)),
        ("a handshake frame of an open robot", stuff(&open)),
        ("kind 3", changed(101, 1, 8)),
        ("too short", stuff(&unstuff(&up(101))[..21])),
        ("a handshake that is too short", stuff(&hello[..27])),
        ("a handshake that is too long", stuff(&[&hello[..], &[1; 30]].concat())),
        ("32,767 ahead", up(100 + 32_767)),
        ("beyond half a turn: taken for an old one", up(100 + 32_767 + 32_768)),
        ("32,766 further", up(100 + 32_767 + 32_766)),
        ("of another version", {
            let header = Header { version: 2, ..header(FrameKind::Datagram, 0) };
            frame(Direction::ToServer, header, 70_000, &[2, 1, 7])
        }),
    ];
    let mut server = Endpoint::<ToRobot, (), 1, MAX_FRAME>::sealed(SealSupport::PRESENT);
    server.begin_sealed(SESSION, 250, (ID, session_key()));
    let steps = frames.map(|(name, wire)| {
        let outcome = match server.receive(&mut &wire[..], Instant(0)).unwrap() {
            Received::Session(_) => "accepted",
            Received::Stray(_, FrameFault::Replayed(_)) => "replayed",
            Received::Stray(..) => "forged",
            Received::Bad(FrameFault::Unsealed) => "unsealed",
            Received::Bad(FrameFault::Seal) => "seal",
            Received::Bad(FrameFault::Shape) => "shape",
            Received::Bad(FrameFault::Version(_)) => "version",
            other => panic!("{name}: {other:?}"),
        };
        json!({ "name": name, "wire": hex(&wire), "outcome": outcome })
    });
    json!([{
        "name": "frames to a server", "key": hex(&BYTES), "robot": ID.0, "boot": ATTEMPT.boot,
        "clock": ATTEMPT.clock, "salt": SALT, "session": SESSION.0, "frames": steps,
    }])
}
