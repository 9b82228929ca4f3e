//! Checks of sealed links (SPEC 12), for robots and servers alike; and of open ones, which ignore
//! seals.

use ubimap_protocol::{
    frame::{FrameKind, SessionId, seal},
    message::{Hello, Reset, ToRobot, ToServer, Welcome},
    time::Duration,
};

use super::super::{
    check::{Check, Halt, Role, fail, skip},
    frames::{Note, stuffed},
    talk::Talk,
};

pub(super) const CHECKS: &[Check] = &[
    Check {
        name: "sealed-frame-on-open-link",
        section: "12",
        rule: "without keys, a frame that is marked as sealed has no effect",
        run: sealed_on_open,
    },
    Check {
        name: "unsealed-frame",
        section: "12",
        rule: "with keys, a frame with a checksum has no effect",
        run: unsealed,
    },
    Check {
        name: "replayed-frame",
        section: "12",
        rule: "a sealed frame that comes again has no effect, and is not acknowledged",
        run: replayed,
    },
    Check {
        name: "replay-window",
        section: "12",
        rule: "a sealed frame may be overtaken by up to 64 others, and by no more",
        run: replay_window,
    },
    Check {
        name: "replayed-handshake",
        section: "12",
        rule: "a Hello or a Welcome of an earlier attempt that comes again has no effect",
        run: replayed_handshake,
    },
    Check {
        name: "unsealed-handshake",
        section: "12",
        rule: "with keys, a Hello or a Reset with a checksum has no effect",
        run: unsealed_handshake,
    },
    Check {
        name: "reset-of-another-frame",
        section: "12",
        rule: "a sealed Reset that names none of the robot's last frames has no effect",
        run: strange_reset,
    },
];

fn need_keys(talk: &Talk<'_>) -> Result<(), Halt> {
    if talk.is_keyed() { Ok(()) } else { skip("the link is open; give keys with --keys") }
}

fn sealed_on_open(talk: &mut Talk<'_>) -> Result<(), Halt> {
    if talk.is_keyed() {
        return skip("the link has keys");
    }
    talk.open()?;
    let question = talk.question();
    let good = talk.frame(FrameKind::Reliable, talk.next_sequence(), &[question]);
    let mut contents = good.header.encode_sealed().to_vec();
    contents.extend_from_slice(&good.payload);
    let tail = seal(talk.session, talk.outwards(), &contents);
    contents.extend_from_slice(&tail);
    talk.must_ignore(&good, stuffed(&contents), "a frame that is marked as sealed")?;
    talk.must_answer("after a frame that is marked as sealed")
}

fn unsealed(talk: &mut Talk<'_>) -> Result<(), Halt> {
    need_keys(talk)?;
    talk.open()?;
    let question = talk.question();
    let good = talk.frame(FrameKind::Reliable, talk.next_sequence(), &[question]);
    talk.must_ignore(&good, good.wire(), "a frame with a checksum")?;
    talk.must_answer("after a frame with a checksum")
}

fn replayed(talk: &mut Talk<'_>) -> Result<(), Halt> {
    need_keys(talk)?;
    talk.open()?;
    let question = talk.question();
    let frame = talk.next_reliable(&[question]);
    let wire = talk.wire(&frame);
    talk.send_wire(wire.clone())?;
    if !talk.is_answered()? {
        return fail("a question is answered", "no answer");
    }
    talk.wait(Duration::from_millis(500))?;
    talk.acks.clear();
    talk.must_ignore(&frame, wire, "a sealed frame that comes again")?;
    talk.must_answer("after a replay")
}

fn replay_window(talk: &mut Talk<'_>) -> Result<(), Halt> {
    need_keys(talk)?;
    talk.open()?;
    for (others, wanted) in [(60, true), (70, false)] {
        let question = talk.question();
        let asked = talk.asked;
        let held = talk.frame(FrameKind::Datagram, 9, &[question]);
        let wire = talk.wire(&held);
        for _ in 0..others {
            talk.datagram(&[])?;
            talk.wait(Duration::from_millis(2))?;
        }
        talk.asked = asked;
        talk.send_wire(wire)?;
        let found = talk.is_answered()?;
        if found != wanted {
            let word = |is: bool| if is { "an answer" } else { "no answer" };
            return fail(
                format!("{} to a question that {others} frames have overtaken", word(wanted)),
                word(found),
            );
        }
    }
    talk.must_answer("after frames that were overtaken")
}

fn replayed_handshake(talk: &mut Talk<'_>) -> Result<(), Halt> {
    need_keys(talk)?;
    match talk.role {
        Role::Robot => {
            let hello = talk.hello()?;
            let welcome = talk.welcome_for(&hello);
            let note = Note::new::<ToRobot, _>(&welcome);
            let frame = talk.outside(note);
            let old = talk.wire(&frame);
            talk.begin(welcome.session);
            talk.send_wire(old.clone())?;
            talk.must_answer("in a session")?;
            let again = talk.hello()?;
            talk.send_wire(old)?;
            let seen = talk.collect(talk.patience())?;
            let is_of_session =
                |kind: Option<FrameKind>| kind.is_some_and(|it| it != FrameKind::Handshake);
            if again.nonce == hello.nonce || seen.iter().any(|it| is_of_session(it.kind())) {
                return fail("no session by the Welcome of an earlier attempt", "a session");
            }
        }
        Role::Server => {
            let hello = talk.next_hello();
            let frame = talk.outside(Note::new::<ToServer, _>(&hello));
            let old = talk.wire(&frame);
            talk.send_wire(old.clone())?;
            talk.wait(talk.patience())?;
            talk.open()?;
            talk.must_answer("in a later session")?;
            talk.send_wire(old)?;
            if talk.body::<ToRobot, Welcome>(talk.patience())?.is_some() {
                return fail("no Welcome for the Hello of an earlier attempt", "a Welcome");
            }
            talk.must_answer("in the session, after a replayed Hello")?;
        }
    }
    Ok(())
}

fn unsealed_handshake(talk: &mut Talk<'_>) -> Result<(), Halt> {
    need_keys(talk)?;
    talk.open()?;
    match talk.role {
        Role::Robot => {
            talk.is_polite = false;
            talk.wait(Duration::from_millis(700))?;
            let reset = talk.outside(Note::new::<ToRobot, _>(&Reset));
            talk.send_wire(reset.wire())?;
            if talk.body::<ToServer, Hello>(talk.patience())?.is_some() {
                return fail("no Hello after a Reset with a checksum", "a Hello");
            }
        }
        Role::Server => {
            let hello = talk.next_hello();
            let frame = talk.outside(Note::new::<ToServer, _>(&hello));
            talk.send_wire(frame.wire())?;
            if talk.body::<ToRobot, Welcome>(talk.patience())?.is_some() {
                return fail("no Welcome for a Hello with a checksum", "a Welcome");
            }
        }
    }
    Ok(())
}

fn strange_reset(talk: &mut Talk<'_>) -> Result<(), Halt> {
    need_keys(talk)?;
    if talk.role == Role::Server {
        return skip("only robots get a Reset");
    }
    talk.open()?;
    talk.is_polite = false;
    talk.wait(Duration::from_millis(700))?;
    talk.forget_echo();
    talk.handshake(Note::new::<ToRobot, _>(&Reset))?;
    if talk.body::<ToServer, Hello>(talk.patience())?.is_some() {
        return fail("no Hello after a Reset that names none of the last frames", "a Hello");
    }
    if talk.session == SessionId::NONE { skip("no session") } else { Ok(()) }
}
