//! Checks of a server's handshake and clock (SPEC 4 and 9).

use ubimap_protocol::{
    frame::{FrameKind, MAX_FRAME, MIN_VERSION, SessionId, VERSION},
    message::{Hello, RefusalReason, Reset, TimeReply, TimeRequest, ToRobot, ToServer, Welcome},
    tile::TileId,
    time::{Duration, Instant},
    units::Millimetres,
};

use super::super::{
    check::{Check, Halt, fail, skip},
    frames::{Frame, Note},
    robot_side::{Said, room},
    talk::Talk,
};

pub(super) const CHECKS: &[Check] = &[
    Check {
        name: "welcome",
        section: "4.3",
        rule: "a matching Hello gets a Welcome with its nonce, in at most 36 bytes",
        run: welcome,
    },
    Check {
        name: "hello-twice",
        section: "4.3",
        rule: "the same Hello gets the same Welcome again",
        run: hello_twice,
    },
    Check {
        name: "hello-version",
        section: "4.5",
        rule: "versions that do not overlap are refused, overlapping ones are welcome",
        run: hello_version,
    },
    Check {
        name: "hello-resolution",
        section: "4.5",
        rule: "another resolution is refused with the server's; a version is named before it",
        run: hello_resolution,
    },
    Check {
        name: "hello-frame",
        section: "4.5",
        rule: "frames below 32 bytes are refused, and the smallest one is agreed on",
        run: hello_frame,
    },
    Check {
        name: "hello-added-fields",
        section: "10",
        rule: "bytes after the fields of a Hello are ignored",
        run: hello_added,
    },
    Check {
        name: "session-numbers",
        section: "4.3",
        rule: "session numbers are not 0 and do not repeat",
        run: session_numbers,
    },
    Check {
        name: "late-hello",
        section: "4.3",
        rule: "a late or repeated Hello ends no session",
        run: late_hello,
    },
    Check {
        name: "offer",
        section: "4.3",
        rule: "a good frame of an offer makes it the session, and ends the one before",
        run: offer,
    },
    Check {
        name: "offer-beside-session",
        section: "4.3",
        rule: "a session that is heard after an offer goes on",
        run: offer_beside,
    },
    Check {
        name: "no-reset-in-session",
        section: "4.3",
        rule: "a bad frame gets no Reset while the session is alive",
        run: no_reset,
    },
    Check {
        name: "reset-after-silence",
        section: "4.3",
        rule: "a bad frame gets a Reset if the session is 15 s silent, at most every 200 ms",
        run: reset,
    },
    Check {
        name: "silent-session",
        section: "4.4",
        rule: "silence of the robot does not end a session",
        run: silent,
    },
    Check {
        name: "first-epoch",
        section: "4.3",
        rule: "`first_epoch` is above every epoch of the robot's tiles",
        run: first_epoch,
    },
    Check {
        name: "renumber",
        section: "4.3",
        rule: "`renumber` is false for the next attempt of the same boot, and true for another boot",
        run: renumber,
    },
    Check {
        name: "time-reply",
        section: "9",
        rule: "a time request is answered at once, with its nonce and the server's time",
        run: time_reply,
    },
];

fn welcome(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let hello = talk.next_hello();
    let first = talk.must_welcome(&hello)?;
    talk.handshake(Note::new::<ToServer, _>(&Hello {
        resolution: talk.robot.resolution,
        ..hello
    }))?;
    let seen = talk.find(talk.patience(), |_, seen| {
        seen.bodies::<ToRobot, Welcome>().any(|it| it.nonce == hello.nonce)
    })?;
    let Some(seen) = seen else { return fail("a Welcome again", "none") };
    let is_sound = first.version == VERSION
        && first.session != SessionId::NONE
        && first.frame >= talk.min_frame()
        && first.frame <= hello.frame
        && first.server_epoch != 0
        && seen.wire.len() <= talk.max_handshake();
    if is_sound {
        return Ok(());
    }
    fail(
        format!("version 1, a session, a frame of at most {}, an epoch, in 36 bytes", hello.frame),
        format!("{first:?} in {} bytes", seen.wire.len()),
    )
}

fn hello_twice(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let hello = talk.next_hello();
    let first = talk.must_welcome(&hello)?;
    let second = talk.must_welcome(&hello)?;
    if first != second {
        return fail(format!("{first:?} again"), format!("{second:?}"));
    }
    talk.enter(&first)?;
    talk.must_answer("in the session")?;
    if talk.is_keyed() {
        // Section 12 does not ask for an answer once the session has been heard.
        return Ok(());
    }
    let third = talk.must_welcome(&hello)?;
    if first.session != third.session || first.renumber != third.renumber {
        return fail(format!("{first:?} again, in the session"), format!("{third:?}"));
    }
    talk.must_answer("in the session, after its Hello has come again")
}

/// Fails unless the server refuses a Hello for this reason.
fn must_refuse(talk: &mut Talk<'_>, hello: &Hello, reason: RefusalReason) -> Result<(), Halt> {
    match talk.said_to(hello)? {
        Said::Refusal(found) if found == reason => Ok(()),
        other => fail(format!("a Refusal with {reason:?}"), format!("{other:?}")),
    }
}

const VERSIONS: RefusalReason = RefusalReason::Version { min: MIN_VERSION, current: VERSION };

fn hello_version(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let hello = talk.next_hello();
    must_refuse(talk, &Hello { version: 9, min_version: VERSION + 1, ..hello }, VERSIONS)?;
    let hello = talk.next_hello();
    must_refuse(talk, &Hello { version: MIN_VERSION - 1, min_version: 0, ..hello }, VERSIONS)?;
    let hello = talk.next_hello();
    let welcome = talk.must_welcome(&Hello { version: 9, min_version: VERSION, ..hello })?;
    if welcome.version != VERSION {
        return fail(
            format!("version {VERSION} for versions {VERSION} to 9"),
            format!("{welcome:?}"),
        );
    }
    talk.must_answer("in the session, which refusals leave alone")
}

fn hello_resolution(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let side = talk.robot.resolution;
    let reason = RefusalReason::Resolution(side);
    let other = Millimetres(side.0 + 1);
    let hello = talk.next_hello();
    must_refuse(talk, &Hello { resolution: other, ..hello }, reason)?;
    let hello = talk.next_hello();
    must_refuse(talk, &Hello { resolution: other, frame: 31, ..hello }, reason)?;
    let hello = talk.next_hello();
    must_refuse(talk, &Hello { resolution: other, min_version: 9, version: 9, ..hello }, VERSIONS)
}

fn hello_frame(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let hello = talk.next_hello();
    let min = talk.min_frame();
    let least = RefusalReason::Frame(min);
    must_refuse(talk, &Hello { frame: min - 1, ..hello }, least)?;
    for frame in [min, 64, 250, 1_024, 5_000] {
        let hello = talk.next_hello();
        let welcome = talk.must_welcome(&Hello { frame, ..hello })?;
        let most = frame.min(MAX_FRAME as u16);
        if welcome.frame > most || welcome.frame < min || (frame == min && welcome.frame != min) {
            return fail(format!("a frame of {min} to {most} bytes"), format!("{}", welcome.frame));
        }
    }
    Ok(())
}

fn hello_added(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let hello = talk.next_hello();
    let mut note = Note::new::<ToServer, _>(&hello);
    note.body.extend([1, 2, 3]);
    talk.handshake(note)?;
    match talk.said(hello.nonce)? {
        Said::Welcome(_) => Ok(()),
        other => {
            fail("a Welcome for a Hello with three bytes after its fields", format!("{other:?}"))
        }
    }
}

fn session_numbers(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let mut numbers = Vec::new();
    for _ in 0..6 {
        talk.open()?;
        numbers.push(talk.session);
    }
    let is_new = |(index, number): (usize, &SessionId)| {
        *number != SessionId::NONE && !numbers[..index].contains(number)
    };
    if numbers.iter().enumerate().all(is_new) {
        return Ok(());
    }
    fail("six numbers that differ and are not 0", format!("{numbers:?}"))
}

fn late_hello(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let late = talk.next_hello();
    talk.open()?;
    talk.must_answer("in a session")?;
    for _ in 0..3 {
        talk.said_to(&late)?;
        talk.must_answer("in the session, after a Hello of an earlier attempt")?;
    }
    Ok(())
}

fn offer(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.must_answer("in a session")?;
    let before = talk.session;
    let question = talk.question();
    let old = talk.next_reliable(&[question]);
    talk.wait(Duration::from_millis(100))?;
    talk.join_server(|_| ())?;
    if talk.session == before {
        return fail("a session number of its own for another Hello", format!("{before:?} again"));
    }
    talk.must_answer("in the session that was offered")?;
    talk.must_ignore_frame(&old, &old, "a frame of the session before")
}

fn offer_beside(talk: &mut Talk<'_>) -> Result<(), Halt> {
    if talk.is_keyed() {
        return skip("with keys, any good frame of an offer makes it the session");
    }
    talk.open()?;
    let hello = talk.next_hello();
    let offered = talk.must_welcome(&hello)?;
    talk.wait(Duration::from_millis(50))?;
    talk.must_answer("in the session, after an offer")?;
    let session = talk.session;
    talk.session = offered.session;
    let question = talk.question();
    let frame = talk.frame(FrameKind::Reliable, 0, &[question]);
    let ignored =
        talk.must_ignore_frame(&frame, &frame, "a frame of an offer older than the session's last");
    talk.session = session;
    ignored?;
    talk.must_answer("in the session, after a frame of an older offer")
}

/// A frame that no session opens.
const BAD: [u8; 8] = [7, 0x01, 0x28, 1, 2, 3, 4, 0];

fn resets(talk: &mut Talk<'_>, span: Duration) -> Result<Vec<Instant>, Halt> {
    let end = talk.now() + span;
    let mut times = Vec::new();
    while talk.now() < end {
        let bad = match talk.is_keyed() {
            // Sealed, but in no session of the server.
            true => {
                let frame = talk.frame(FrameKind::Datagram, 0, &[]);
                talk.wire(&Frame { session: SessionId(0x7777_7777), ..frame })
            }
            false => BAD.to_vec(),
        };
        talk.send_wire(bad)?;
        let seen = talk.collect(Duration::from_millis(20))?;
        times.extend(
            seen.iter().filter(|it| it.bodies::<ToRobot, Reset>().next().is_some()).map(|it| it.at),
        );
    }
    Ok(times)
}

fn no_reset(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    if resets(talk, Duration::from_millis(600))?.is_empty() {
        return talk.must_answer("in the session, after bad frames");
    }
    fail("no Reset while the session is alive", "a Reset")
}

fn reset(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.is_polite = false;
    talk.wait(Duration::from_millis(15_200) + talk.slack())?;
    let times = resets(talk, Duration::from_millis(1_000))?;
    if times.is_empty() {
        return fail("a Reset after a bad frame, 15 s after the last good one", "none");
    }
    let slack = talk.slack().micros() / 1_000;
    let intervals = times.windows(2).map(|it| it[1].since(it[0]).micros() / 1_000);
    match intervals.min() {
        Some(ms) if ms + slack < 200 => {
            fail("at least 200 ms between two Resets", format!("{ms} ms"))
        }
        _ => Ok(()),
    }
}

fn silent(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.is_polite = false;
    talk.wait(Duration::from_secs(17))?;
    talk.is_polite = true;
    talk.must_answer("in a session that was silent for 17 s")
}

fn first_epoch(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let drawn = talk.epoch();
    talk.draw(TileId { x: -900, y: -900 }, &room(6))?;
    talk.open()?;
    if talk.epoch() > drawn {
        return Ok(());
    }
    fail(format!("a `first_epoch` above {}", drawn.0), format!("{}", talk.epoch().0))
}

fn renumber(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.must_answer("in a session")?;
    talk.open()?;
    if talk.robot.welcome.is_some_and(|welcome| welcome.renumber) {
        return fail("renumber false for the next attempt of the same boot", "true");
    }
    talk.must_answer("in a session")?;
    talk.reboot();
    talk.count_boot();
    talk.open()?;
    if talk.robot.welcome.is_some_and(|welcome| welcome.renumber) {
        return Ok(());
    }
    fail("renumber true for a nonce of another boot", "false")
}

fn time_reply(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let mut last: Option<(Instant, Instant)> = None;
    for nonce in [7u16, 8, 65_535, 0] {
        let asked = talk.now();
        talk.datagram(&[Note::new::<ToServer, _>(&TimeRequest { nonce })])?;
        let Some(reply) = talk.body::<ToRobot, TimeReply>(talk.patience())? else {
            return fail(format!("a TimeReply with the nonce {nonce}"), "none");
        };
        if reply.nonce != nonce {
            return fail(format!("the nonce {nonce}"), format!("{}", reply.nonce));
        }
        let took = talk.now().since(asked);
        if took > Duration::from_millis(20) + talk.slack()
            || u64::from(reply.held_micros) > took.0 + 1_000
        {
            return fail(
                "a reply at once",
                format!("{} us, held {} us", took.0, reply.held_micros),
            );
        }
        if let Some((then, received)) = last {
            let (here, there) = (asked.since(then), reply.received.since(received));
            if here.0.abs_diff(there.0) > 20_000 + talk.slack().0 {
                return fail(
                    format!("a clock that has advanced by {} us", here.0),
                    format!("{} us", there.0),
                );
            }
        }
        last = Some((asked, reply.received));
        talk.wait(Duration::from_millis(700))?;
    }
    if last.is_none() { skip("no reply") } else { Ok(()) }
}
