//! Checks of a robot's handshake, liveness and clock (SPEC 4, 5 and 9).

use std::collections::BTreeSet;

use ubimap_protocol::{
    frame::{FrameKind, MIN_FRAME, SessionId, VERSION},
    message::{
        Hello, Interest, Refusal, RefusalReason, Reset, State, TimeReply, TimeRequest, ToRobot,
        ToServer, Welcome,
    },
    time::{Duration, Instant},
    units::Millimetres,
};

use super::super::{
    check::Check,
    frames::Note,
    halt::{Halt, fail, skip},
    server_side::STANDS,
    talk::{Seen, Talk},
};

/// The step from one attempt's nonce to the next.
const NONCE_STEP: u32 = 0x9E37_79B9;

pub(super) const CHECKS: &[Check] = &[
    Check {
        name: "hello",
        section: "4.1",
        rule: "a Hello is a handshake frame of at most 36 bytes with plausible fields",
        run: hello,
    },
    Check {
        name: "hello-repeated",
        section: "4.2",
        rule: "a Hello is repeated with its nonce, after 200, 400, 800, 1,600 and 3,200 ms",
        run: hello_repeated,
    },
    Check {
        name: "welcome-of-another-nonce",
        section: "4.2",
        rule: "a Welcome with another nonce is ignored",
        run: stale_welcome,
    },
    Check {
        name: "welcome-of-another-version",
        section: "4.2",
        rule: "a Welcome with a version that the robot does not speak is ignored",
        run: strange_welcome,
    },
    Check {
        name: "refused",
        section: "4.2",
        rule: "after a Refusal the next Hello comes in 10 s",
        run: refused,
    },
    Check {
        name: "refused-number",
        section: "4.2",
        rule: "if its number is in use, the next Hello comes in 3 s",
        run: refused_number,
    },
    Check {
        name: "refusal-of-another-nonce",
        section: "4.2",
        rule: "a Refusal with another nonce is ignored",
        run: stale_refusal,
    },
    Check {
        name: "second-welcome",
        section: "4.2",
        rule: "a Welcome in a session is ignored",
        run: second_welcome,
    },
    Check {
        name: "refusal-in-session",
        section: "4.2",
        rule: "a Refusal in a session is ignored",
        run: refusal_in_session,
    },
    Check {
        name: "reset",
        section: "4.2",
        rule: "a Reset after 300 ms without a good frame makes the robot knock, with its next nonce",
        run: reset,
    },
    Check {
        name: "reset-while-heard",
        section: "4.2",
        rule: "a Reset within 300 ms of a good frame is ignored",
        run: reset_while_heard,
    },
    Check {
        name: "state",
        section: "4.4",
        rule: "a State comes at least every 2 s, also without any answer",
        run: state,
    },
    Check {
        name: "session-without-answers",
        section: "4.4",
        rule: "silence of the server does not end a session",
        run: silence,
    },
    Check {
        name: "session-version",
        section: "2.3",
        rule: "the frames of a session have the version of its Welcome",
        run: session_version,
    },
    Check {
        name: "time-requests",
        section: "9",
        rule: "time is asked for often at first, then rarely, by nonces that count up",
        run: time_requests,
    },
    Check {
        name: "clock",
        section: "9",
        rule: "a synchronised robot knows the server's time within 50 ms",
        run: clock,
    },
    Check {
        name: "clock-of-another-server",
        section: "4.2",
        rule: "a Welcome of another server epoch makes the robot forget the server's time",
        run: forgotten_clock,
    },
    Check {
        name: "late-time-reply",
        section: "9",
        rule: "a reply to an earlier time request is ignored",
        run: late_reply,
    },
    Check {
        name: "interest",
        section: "5",
        rule: "an Interest's window has at most `fused_tiles` tiles, and its number counts up",
        run: interest,
    },
];

fn hello(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.hello()?;
    // The next one, to see its frame.
    let seen = talk.find(Duration::from_millis(7_000), |_, seen| {
        seen.bodies::<ToServer, Hello>().next().is_some()
    })?;
    let Some(seen) = seen else { return fail("another Hello within 7 s", "none") };
    let header = seen.frame.as_ref().ok().map(|frame| (frame.header.kind, frame.header.sequence));
    if header != Some((FrameKind::Handshake, 0)) || seen.wire.len() > talk.max_handshake() {
        let found = format!("{header:?}, {} bytes", seen.wire.len());
        return fail(
            "a handshake frame with sequence number 0, at most 36 bytes (64 if sealed)",
            found,
        );
    }
    let Some(hello) = seen.bodies::<ToServer, Hello>().next() else { return skip("no Hello") };
    let is_sound = hello.version >= hello.min_version
        && usize::from(hello.frame) >= MIN_FRAME
        && hello.resolution > Millimetres(0);
    if is_sound {
        return Ok(());
    }
    fail("version >= min_version, frame >= 32, resolution > 0", format!("{hello:?}"))
}

/// The times of the next Hellos, beginning with a new attempt.
fn hellos(talk: &mut Talk<'_>, span: Duration) -> Result<Vec<(Instant, u32)>, Halt> {
    let seen = talk.collect(span)?;
    let hellos = seen.iter().flat_map(|it| {
        it.bodies::<ToServer, Hello>().map(|hello| (it.at, hello.nonce)).collect::<Vec<_>>()
    });
    Ok(hellos.collect())
}

/// Ends the robot's session, so that an attempt begins. Returns the time and the nonce of its first
/// Hello.
fn new_attempt(talk: &mut Talk<'_>) -> Result<(Instant, Hello), Halt> {
    talk.open()?;
    let hello = talk.hello()?;
    Ok((talk.now(), hello))
}

fn hello_repeated(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let (first, hello) = new_attempt(talk)?;
    let again = hellos(talk, Duration::from_millis(6_800))?;
    if let Some((_, nonce)) = again.iter().find(|(_, nonce)| *nonce != hello.nonce) {
        return fail(format!("the same nonce, {}", hello.nonce), format!("{nonce}"));
    }
    let offsets: Vec<u64> = again.iter().map(|(at, _)| at.since(first).micros() / 1_000).collect();
    let expected = [200, 600, 1_400, 3_000, 6_200];
    let slack = talk.slack().micros() / 1_000 + 10;
    let is_close = offsets.len() == expected.len()
        && expected.iter().zip(&offsets).all(|(&wanted, &found)| found.abs_diff(wanted) <= slack);
    if is_close {
        Ok(())
    } else {
        fail(format!("Hellos after {expected:?} ms"), format!("{offsets:?} ms"))
    }
}

/// Fails unless the robot goes on knocking.
fn must_knock_on(talk: &mut Talk<'_>, what: &str) -> Result<(), Halt> {
    let span = Duration::from_millis(3_400) + talk.slack();
    let seen = talk.collect(span)?;
    if let Some(seen) =
        seen.iter().find(|seen| seen.kind().is_some_and(|it| it != FrameKind::Handshake))
    {
        return fail(
            format!("{what} opens no session"),
            format!("a frame of a session: {:?}", seen.notes),
        );
    }
    if seen.iter().any(|seen| seen.bodies::<ToServer, Hello>().next().is_some()) {
        return Ok(());
    }
    fail(format!("after {what}, a Hello within 3.2 s"), "none")
}

fn stale_welcome(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let (_, hello) = new_attempt(talk)?;
    let welcome = talk.welcome_for(&hello);
    talk.send_welcome(&Welcome { nonce: hello.nonce.wrapping_sub(NONCE_STEP), ..welcome })?;
    must_knock_on(talk, "a Welcome with the nonce of an earlier attempt")
}

fn strange_welcome(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let (_, hello) = new_attempt(talk)?;
    let welcome = talk.welcome_for(&hello);
    talk.send_welcome(&Welcome { version: hello.version.max(VERSION) + 1, ..welcome })?;
    must_knock_on(talk, "a Welcome with a version above the Hello's")
}

/// The time from a refusal to the next Hello.
fn wait_after(talk: &mut Talk<'_>, reason: RefusalReason, wanted: u64) -> Result<(), Halt> {
    let (_, hello) = new_attempt(talk)?;
    talk.handshake(Note::new::<ToRobot, _>(&Refusal { nonce: hello.nonce, reason }))?;
    let refused = talk.now();
    let again = hellos(talk, Duration::from_millis(wanted + 800) + talk.slack())?;
    let expected = format!("the next Hello {wanted} ms after the Refusal");
    // A Hello may have crossed the Refusal.
    let next = again.iter().map(|(at, _)| at.since(refused)).find(|it| *it > talk.slack());
    match next.map(|it| it.micros() / 1_000) {
        Some(ms) if ms.abs_diff(wanted) <= 250 + talk.slack().micros() / 1_000 => Ok(()),
        Some(ms) => fail(expected, format!("after {ms} ms")),
        None => fail(expected, "none"),
    }
}

fn refused(talk: &mut Talk<'_>) -> Result<(), Halt> {
    wait_after(talk, RefusalReason::Resolution(Millimetres(49)), 10_000)
}

fn refused_number(talk: &mut Talk<'_>) -> Result<(), Halt> {
    wait_after(talk, RefusalReason::NumberInUse, 3_000)
}

fn stale_refusal(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let (_, hello) = new_attempt(talk)?;
    let reason = RefusalReason::NumberInUse;
    talk.handshake(Note::new::<ToRobot, _>(&Refusal { nonce: hello.nonce ^ 1, reason }))?;
    let refused = talk.now();
    match hellos(talk, Duration::from_millis(1_000) + talk.slack())?.first() {
        Some(_) => Ok(()),
        None => fail(
            "Hellos go on after a Refusal with another nonce",
            format!("none for {} ms", talk.now().since(refused).micros() / 1_000),
        ),
    }
}

fn second_welcome(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let hello = talk.hello()?;
    let welcome = talk.welcome_for(&hello);
    talk.send_welcome(&welcome)?;
    talk.must_answer("in the session of the first Welcome")?;
    let second = Welcome { session: SessionId(welcome.session.0 ^ 0x0F00_0000), ..welcome };
    talk.handshake(Note::new::<ToRobot, _>(&second))?;
    talk.wait(Duration::from_millis(50))?;
    talk.must_answer("in the session of the first Welcome, after a second one")
}

fn refusal_in_session(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let hello = talk.hello()?;
    let welcome = talk.welcome_for(&hello);
    talk.send_welcome(&welcome)?;
    talk.must_answer("in a session")?;
    let reason = RefusalReason::TooManyRobots;
    talk.handshake(Note::new::<ToRobot, _>(&Refusal { nonce: hello.nonce, reason }))?;
    talk.wait(Duration::from_millis(50))?;
    talk.must_answer("after a Refusal with the nonce of the session's Hello")
}

fn reset(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let Some(before) = talk.server.hello else { return skip("no Hello") };
    talk.is_polite = false;
    talk.wait(Duration::from_millis(600) + talk.slack())?;
    let reset = talk.now();
    talk.handshake(Note::new::<ToRobot, _>(&Reset))?;
    let Some((at, nonce)) = hellos(talk, talk.patience())?.first().copied() else {
        return fail("a Hello at once after a Reset in silence", "none");
    };
    if nonce != before.nonce.wrapping_add(NONCE_STEP) {
        let expected = format!("the nonce {}", before.nonce.wrapping_add(NONCE_STEP));
        return fail(expected, format!("{nonce}"));
    }
    if at.since(reset) > Duration::from_millis(100) + talk.slack() {
        return fail("a Hello at once", format!("after {} ms", at.since(reset).micros() / 1_000));
    }
    Ok(())
}

fn reset_while_heard(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    for _ in 0..5 {
        talk.datagram(&[])?;
        talk.wait(Duration::from_millis(100))?;
        talk.datagram(&[])?;
        talk.handshake(Note::new::<ToRobot, _>(&Reset))?;
    }
    talk.must_answer("after a Reset within 300 ms of a good frame")
}

fn state(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.is_polite = false;
    let began = talk.now();
    let seen = talk.collect(Duration::from_secs(9))?;
    let states = seen.iter().filter(|it| it.bodies::<ToServer, State>().next().is_some());
    let times: Vec<Instant> =
        [began].into_iter().chain(states.map(|it| it.at)).chain([talk.now()]).collect();
    let longest = times.windows(2).map(|it| it[1].since(it[0]).micros() / 1_000).max();
    match longest {
        Some(ms) if ms <= 2_050 + talk.slack().micros() / 1_000 => Ok(()),
        other => {
            fail("a State at least every 2,000 ms", format!("{} ms without", other.unwrap_or(0)))
        }
    }
}

fn silence(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.is_polite = false;
    let seen = talk.collect(Duration::from_secs(17))?;
    if seen.iter().any(|it| it.bodies::<ToServer, Hello>().next().is_some()) {
        return fail("no Hello in 17 s of silence", "one");
    }
    talk.is_polite = true;
    talk.must_answer("after 17 s of silence")
}

fn session_version(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let seen = talk.collect(Duration::from_secs(3))?;
    let versions: BTreeSet<u8> =
        seen.iter().filter_map(|it| Some(it.frame.as_ref().ok()?.header.version)).collect();
    if versions == BTreeSet::from([VERSION]) {
        return Ok(());
    }
    fail(format!("version {VERSION} in all headers"), format!("{versions:?}"))
}

fn requests(seen: &[Seen]) -> Vec<(Instant, u16)> {
    let requests = seen.iter().flat_map(|it| {
        it.bodies::<ToServer, TimeRequest>()
            .map(|request| (it.at, request.nonce))
            .collect::<Vec<_>>()
    });
    requests.collect()
}

fn time_requests(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    let first = requests(&talk.collect(Duration::from_secs(2))?);
    if first.len() < 2 {
        return fail("several time requests in the first 2 s", format!("{}", first.len()));
    }
    if let Some(pair) = first.windows(2).find(|it| it[1].1 != it[0].1.wrapping_add(1)) {
        return fail("nonces that count up by one", format!("{} after {}", pair[1].1, pair[0].1));
    }
    // By then there have been 64 replies at any interval up to a quarter of a second.
    talk.wait(Duration::from_secs(16))?;
    let late = requests(&talk.collect(Duration::from_secs(11))?);
    if (1..=6).contains(&late.len()) {
        return Ok(());
    }
    fail("one to six time requests in 11 s, after 64 replies", format!("{}", late.len()))
}

/// The states with a pose in a time, and how far their times are from the server's, in milliseconds.
fn states(talk: &mut Talk<'_>, span: Duration) -> Result<Vec<(Instant, State)>, Halt> {
    let seen = talk.collect_with_fixes(span)?;
    let states = seen.iter().flat_map(|it| {
        it.bodies::<ToServer, State>().map(|state| (it.at, state)).collect::<Vec<_>>()
    });
    Ok(states.collect())
}

fn clock(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.collect_with_fixes(Duration::from_secs(5))?;
    let states = states(talk, Duration::from_secs(5))?;
    let timed: Vec<_> =
        states.iter().filter_map(|(at, it)| Some((*at, it.time?, it.pose))).collect();
    let Some(&(at, time, pose)) = timed.last() else {
        return skip("the robot reports no time of a pose; it may have no odometry");
    };
    // The pose may be older than its message, but it can't be of the future.
    let now = talk.server.time(at);
    let bound = Duration::from_millis(50) + talk.slack();
    if time > now + bound || now.since(time) > Duration::from_millis(1_000) + bound {
        return fail(
            format!("a State's time within the last second, by the server's clock ({} us)", now.0),
            format!("{} us", time.0),
        );
    }
    match pose {
        Some(pose) if (pose.x.metres() - STANDS.0).hypot(pose.y.metres() - STANDS.1) > 0.3 => {
            fail(format!("a pose within 0.3 m of the fixes, {STANDS:?}"), format!("{pose:?}"))
        }
        _ => Ok(()),
    }
}

fn forgotten_clock(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    talk.collect_with_fixes(Duration::from_secs(5))?;
    if !states(talk, Duration::from_secs(3))?.iter().any(|(_, it)| it.time.is_some()) {
        return skip("the robot reports no time of a pose; it may have no odometry");
    }
    // Its time requests get no answer.
    talk.is_polite = false;
    talk.welcome_by_another_server(|_| ())?;
    let seen = talk.collect(Duration::from_secs(5))?;
    let states: Vec<State> = seen.iter().flat_map(|it| it.bodies::<ToServer, State>()).collect();
    match states.iter().find(|it| it.time.is_some()) {
        None => Ok(()),
        Some(state) => {
            fail("no time of the server before its first reply", format!("{:?}", state.time))
        }
    }
}

fn late_reply(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.is_polite = false;
    talk.welcome_by_another_server(|_| ())?;
    let mut earlier = None;
    // Each request gets a reply with the nonce of the one before it.
    let end = talk.now() + Duration::from_secs(4);
    while let Some(seen) = talk.next(end)? {
        for TimeRequest { nonce } in seen.bodies::<ToServer, TimeRequest>() {
            if let Some(nonce) = earlier.replace(nonce) {
                let received = talk.server.time(seen.at);
                talk.datagram(&[Note::new::<ToRobot, _>(&TimeReply {
                    nonce,
                    received,
                    held_micros: 0,
                })])?;
            }
        }
    }
    let states = states(talk, Duration::from_secs(3))?;
    match states.iter().find_map(|(_, it)| it.time) {
        None => Ok(()),
        Some(time) => fail(
            "no time of the server: all replies were to earlier requests",
            format!("{} us", time.0),
        ),
    }
}

fn interest(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.welcome_by_another_server(|_| ())?;
    let seen = talk.collect_with_fixes(Duration::from_secs(8))?;
    let Some(hello) = talk.server.hello else { return skip("no Hello") };
    let interests: Vec<Interest> =
        seen.iter().flat_map(|it| it.bodies::<ToServer, Interest>()).collect();
    if interests.is_empty() {
        return skip("the robot sent no Interest within 8 s of fixes");
    }
    let mut numbers: Vec<u32> = interests.iter().map(|it| it.number).collect();
    numbers.dedup();
    if numbers.contains(&0) || numbers.windows(2).any(|it| it[1] <= it[0]) {
        return fail("numbers from 1 that count up", format!("{numbers:?}"));
    }
    match interests.iter().find(|it| it.tiles() > u32::from(hello.fused_tiles) || it.tiles() == 0) {
        None => Ok(()),
        Some(it) => fail(
            format!("a window of 1 to {} tiles", hello.fused_tiles),
            format!("{} tiles", it.tiles()),
        ),
    }
}
