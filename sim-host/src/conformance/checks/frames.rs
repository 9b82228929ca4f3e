//! Checks of frames and payloads (SPEC 1.2, 2 and 10), for robots and servers alike.

use ubimap_protocol::{
    frame::{FrameKind, Header, MAX_FRAME, SessionId, VERSION, seal},
    message::{
        Hello, ParameterAction, ParameterCommand, Reset, TimeReply, ToRobot, ToServer,
        ToServerKind, Welcome,
    },
    time::Duration,
};

use super::super::{
    check::Check,
    frames::{Frame, Note, payload, stuffed, unstuffed},
    halt::{Halt, Role, fail, skip},
    talk::Talk,
};

pub(super) const CHECKS: &[Check] = &[
    Check {
        name: "frame-after-noise",
        section: "2.2",
        rule: "a good frame is read after corrupt, truncated and oversized ones",
        run: after_noise,
    },
    Check {
        name: "empty-frames",
        section: "2.2",
        rule: "consecutive delimiters are no frame and no error",
        run: delimiters,
    },
    Check {
        name: "damaged-frame",
        section: "2.4",
        rule: "a frame with a flipped bit has no effect",
        run: damaged,
    },
    Check {
        name: "seal-of-another-session",
        section: "2.4",
        rule: "a frame sealed in another session or direction has no effect",
        run: foreign_seal,
    },
    Check {
        name: "sealed-outside-session",
        section: "2.6",
        rule: "a frame of a session that is sealed outside of it has no effect",
        run: sealed_outside,
    },
    Check {
        name: "handshake-sealed-in-session",
        section: "2.6",
        rule: "a handshake frame that is sealed in the session has no effect",
        run: handshake_inside,
    },
    Check {
        name: "reserved-kind",
        section: "2.6",
        rule: "a frame of the reserved kind has no effect",
        run: reserved_kind,
    },
    Check {
        name: "frame-version",
        section: "2.6",
        rule: "a frame of an unsupported version has no effect and is not acknowledged",
        run: frame_version,
    },
    Check {
        name: "cut-payload",
        section: "2.5",
        rule: "messages before one that is cut short count, and the frame is acknowledged",
        run: cut_payload,
    },
    Check {
        name: "unknown-kind",
        section: "10",
        rule: "a frame with a message of an unknown kind is acknowledged, and read on after it",
        run: unknown_kind,
    },
    Check {
        name: "malformed-message",
        section: "1.2",
        rule: "a malformed message is ignored, and the frame is read on after it",
        run: malformed_message,
    },
    Check {
        name: "added-fields",
        section: "10",
        rule: "bytes after the fields of a message are ignored, and added fields may be absent",
        run: added_fields,
    },
    Check {
        name: "long-varint",
        section: "1.2",
        rule: "a varint that is longer than necessary is accepted",
        run: long_varint,
    },
    Check {
        name: "empty-reliable-frame",
        section: "2.5",
        rule: "a reliable frame without messages is acknowledged",
        run: empty_frame,
    },
];

fn after_noise(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.send_wire(vec![9, 1, 2, 0])?;
    talk.must_answer("after a truncated frame")?;
    let mut long = vec![0xFF; 3 * MAX_FRAME];
    long.push(0);
    talk.send_wire(long)?;
    talk.must_answer("after an oversized frame")?;
    talk.send_wire((1..=255).chain([0]).collect())?;
    talk.must_answer("after noise")
}

fn delimiters(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.send_wire(vec![0; 5])?;
    talk.must_answer("after five delimiters")
}

fn damaged(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let question = talk.question();
    let frame = talk.next_reliable(&[question]);
    let contents = unstuffed(&talk.wire(&frame)).unwrap_or_default();
    for at in [0, 2, contents.len() - 5, contents.len() - 1] {
        let mut damaged = contents.clone();
        damaged[at] ^= 0x10;
        let wire = stuffed(&damaged);
        talk.must_ignore(&frame, wire, &format!("a frame whose byte {at} is damaged"))?;
    }
    talk.send(&frame)?;
    if talk.is_answered()? { Ok(()) } else { fail("the undamaged frame is answered", "no answer") }
}

fn foreign_seal(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let question = talk.question();
    let good = talk.next_reliable(&[question]);
    let other = Frame { session: SessionId(good.session.0 ^ 0x8000_0001), ..good.clone() };
    talk.must_ignore_frame(&good, &other, "a frame sealed in another session")?;
    let echo = Frame { direction: talk.inwards(), ..good.clone() };
    talk.must_ignore_frame(&good, &echo, "a frame sealed in the other direction")?;
    talk.send(&good)?;
    if talk.is_answered()? {
        Ok(())
    } else {
        fail("the same frame, sealed well, is answered", "no answer")
    }
}

fn sealed_outside(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    for kind in [FrameKind::Reliable, FrameKind::Datagram] {
        let question = talk.question();
        let good = talk.frame(kind, talk.next_sequence(), &[question]);
        let outside = Frame { session: SessionId::NONE, ..good.clone() };
        talk.must_ignore_frame(&good, &outside, "a frame of a session sealed in session 0")?;
    }
    talk.must_answer("after a frame sealed in session 0")
}

fn handshake_inside(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    match talk.role {
        Role::Robot => {
            // Silence first, as a robot that hears its server ignores any Reset.
            talk.is_polite = false;
            talk.wait(Duration::from_millis(700))?;
            let frame = talk.frame(FrameKind::Handshake, 0, &[Note::new::<ToRobot, _>(&Reset)]);
            talk.send(&frame)?;
            if talk.body::<ToServer, Hello>(talk.patience())?.is_some() {
                return fail("a Reset sealed in the session: no effect", "a Hello");
            }
        }
        Role::Server => {
            let hello = talk.next_hello();
            let frame = talk.frame(FrameKind::Handshake, 0, &[Note::new::<ToServer, _>(&hello)]);
            talk.send(&frame)?;
            if talk.body::<ToRobot, Welcome>(talk.patience())?.is_some() {
                return fail("a Hello sealed in the session: no effect", "a Welcome");
            }
        }
    }
    Ok(())
}

fn reserved_kind(talk: &mut Talk<'_>) -> Result<(), Halt> {
    if talk.is_keyed() {
        return skip("a header is sealed with the frame");
    }
    talk.open()?;
    let question = talk.question();
    let good = talk.frame(FrameKind::Reliable, talk.next_sequence(), &[question]);
    let mut contents = good.header.encode().to_vec();
    contents[1] |= 0x18;
    contents.extend_from_slice(&good.payload);
    let tail = seal(talk.session, talk.outwards(), &contents);
    contents.extend_from_slice(&tail);
    let wire = stuffed(&contents);
    talk.must_ignore(&good, wire, "a frame of kind 3")?;
    talk.must_answer("after a frame of kind 3")
}

fn frame_version(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    for version in [0, VERSION + 1] {
        let question = talk.question();
        let good = talk.frame(FrameKind::Reliable, talk.next_sequence(), &[question]);
        let other = Frame { header: Header { version, ..good.header }, ..good.clone() };
        talk.must_ignore_frame(&good, &other, &format!("a frame of version {version}"))?;
    }
    talk.must_answer("after frames of other versions")
}

/// Sends a reliable frame with a question and something else, and expects an acknowledgement and an
/// answer.
fn must_read(talk: &mut Talk<'_>, what: &str, payload: Vec<u8>) -> Result<(), Halt> {
    let frame = Frame { payload, ..talk.next_reliable(&[]) };
    talk.send(&frame)?;
    if !talk.is_answered()? {
        return fail(format!("the question in a frame with {what} is answered"), "no answer");
    }
    let sequence = frame.header.sequence;
    if !talk.is_acknowledged(sequence)? {
        return fail(format!("a frame with {what} is acknowledged"), "no acknowledgement");
    }
    Ok(())
}

fn cut_payload(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    for rest in [&[4][..], &[4, 0x80], &[4, 9, 1, 2]] {
        let mut payload = payload(&[talk.question()]);
        payload.extend_from_slice(rest);
        must_read(talk, "a message that is cut short after it", payload)?;
    }
    talk.must_answer("after frames with a message that is cut short")
}

fn unknown_kind(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let strange = Note { number: 200, body: vec![1, 2, 3] };
    let payload = payload(&[strange.clone(), talk.question(), strange]);
    must_read(talk, "messages of an unknown kind", payload)?;
    talk.must_answer("after a message of an unknown kind")
}

fn malformed_message(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let malformed = match talk.role {
        // A Stop whose bool is 7, and a Path with 17 waypoints.
        Role::Robot => [
            Note { number: 11, body: vec![1, 7] },
            Note { number: 10, body: [vec![1, 17], vec![0; 34]].concat() },
        ],
        // A State whose option is 2, and an Interest that ends early.
        Role::Server => [
            Note { number: ToServerKind::State.into(), body: vec![2, 0, 0, 0] },
            Note { number: ToServerKind::Interest.into(), body: vec![1, 2] },
        ],
    };
    for note in malformed {
        let payload = payload(&[note, talk.question()]);
        must_read(talk, "a malformed message before it", payload)?;
    }
    Ok(())
}

/// A time request in the server's case, a command in the robot's: with these bytes as its number.
fn numbered(talk: &mut Talk<'_>, number: &[u8], rest: &[u8], what: &str) -> Result<(), Halt> {
    let wanted = 5;
    let note = match talk.role {
        Role::Robot => {
            let command = ParameterCommand { number: wanted, action: ParameterAction::List };
            let mut note = Note::new::<ToRobot, _>(&command);
            note.body = [number, &note.body[1..], rest].concat();
            note
        }
        Role::Server => Note { number: 2, body: [number, rest].concat() },
    };
    talk.asked = wanted;
    talk.reliable(&[note])?;
    let answered = talk.find(talk.patience(), |talk, seen| match talk.role {
        Role::Robot => talk.answers(seen).contains(&wanted),
        Role::Server => seen.bodies::<ToRobot, TimeReply>().any(|reply| reply.nonce == wanted),
    })?;
    match answered {
        Some(_) => Ok(()),
        None => fail(format!("an answer to a message with {what}"), "none"),
    }
}

fn added_fields(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    numbered(talk, &[5], &[0xAA, 0xBB, 0xCC], "three bytes after its fields")?;
    if talk.role == Role::Server {
        return Ok(());
    }
    // Obstacles of an earlier server, of this one, and of a later one.
    let person = [[1, 0, 0, 0, 0, 0, 0], [2, 0, 0, 0, 0, 0, 0]].concat();
    for (time, rest) in [(1, &[][..]), (2, &[0b1110]), (3, &[0b0110, 0xAA, 0xBB])] {
        let body = [&[time, 2], &person[..], rest].concat();
        let payload = payload(&[Note { number: 9, body }, talk.question()]);
        must_read(talk, &format!("Obstacles with {} bytes after the list", rest.len()), payload)?;
    }
    Ok(())
}

fn long_varint(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    numbered(talk, &[0x85, 0x80, 0x00], &[], "the number 5 written as 85 80 00")
}

fn empty_frame(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let sequence = talk.reliable(&[])?;
    if talk.is_acknowledged(sequence)? {
        return Ok(());
    }
    fail("an empty reliable frame is acknowledged", "no acknowledgement")
}
