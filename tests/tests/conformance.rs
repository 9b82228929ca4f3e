//! The conformance runner: our agent and our server pass it, and each of some broken ones fails the
//! check that its fault is about.

use std::{
    env,
    fs::{self, File},
    path::Path,
    process, time,
};

use clap::Parser;

use ubimap_protocol::{
    frame::{Direction, FrameKind, HEADER_LEN, Header, SessionId, VERSION, is_sealed, seal},
    message::{
        Ack, Digests, Hello, Interest, ParameterOutcome, ParameterReport, ParameterValue, Refusal,
        RefusalReason, Reset, TimeReply, TimeRequest, ToRobot, ToServer, Welcome,
    },
    time::Duration,
    units::Millimetres,
};
use ubimap_sim_host::conformance::{
    Bench, CheckResult, ConformanceReport, Frame, Keys, Note, Role, Verdict, checks, payload, run,
    unstuffed,
};
use ubimap_sim_host::run::conformance::{self, options::ConformanceOptions};
use ubimap_tests::conformance::{
    Context, Gate, Hooks, KEY, Leak, Peer, Reaction, RobotPeer, ServerPeer, Spoiled, VirtualBench,
    edit, without,
};
use ubimap_tests::emulator::{
    Core, Emulator, firmware, leave_out, pico_firmware, provision, rp2040js,
};

/// A robot or a server with one fault, and the check that must find it.
struct Mutant {
    fault: &'static str,
    check: &'static str,
    hooks: Hooks,
}

const fn inwards(
    fault: &'static str,
    check: &'static str,
    hook: fn(&mut Context, Frame) -> Vec<Frame>,
) -> Mutant {
    Mutant { fault, check, hooks: Hooks { inwards: hook, ..Hooks::NONE } }
}

const fn outwards(
    fault: &'static str,
    check: &'static str,
    hook: fn(&mut Context, Frame) -> Vec<Frame>,
) -> Mutant {
    Mutant { fault, check, hooks: Hooks { outwards: hook, ..Hooks::NONE } }
}

const fn bad(
    fault: &'static str,
    check: &'static str,
    hook: fn(&mut Context, &[u8], SessionId) -> Reaction,
) -> Mutant {
    Mutant { fault, check, hooks: Hooks { bad: hook, ..Hooks::NONE } }
}

/// Whether a frame has a message of a kind.
fn has(frame: &Frame, number: u8) -> bool {
    frame.notes().0.iter().any(|note| note.number == number)
}

/// A bad frame of a direction, sealed anew in a session after `change` has altered its header and
/// payload.
fn resealed(
    wire: &[u8],
    session: SessionId,
    direction: Direction,
    change: fn(&mut [u8]),
) -> Option<Vec<u8>> {
    let mut contents = unstuffed(wire).ok()?;
    let body = contents.len().checked_sub(4).filter(|&len| len >= 2)?;
    contents.truncate(body);
    change(&mut contents);
    let tail = seal(session, direction, &contents);
    contents.extend_from_slice(&tail);
    Some(ubimap_sim_host::conformance::stuffed(&contents))
}

/// A frame that is marked as sealed, with a checksum and without the mark, as from either side.
fn unmarked(wire: &[u8], session: SessionId) -> Option<Vec<u8>> {
    let contents = unstuffed(wire).ok()?;
    let (header, _) = Header::decode(&contents).filter(|_| is_sealed(&contents))?;
    let payload = contents.get(HEADER_LEN..contents.len().checked_sub(4)?)?.to_vec();
    let as_from = |direction| Frame { session, direction, header, payload: payload.clone() }.wire();
    Some([Direction::ToRobot, Direction::ToServer].map(as_from).concat())
}

/// Faults of the link, which a robot and a server can both have.
const OF_THE_LINK: &[Mutant] = &[
    outwards("acknowledges nothing", "acknowledged-in-time", |_, frame| without(frame, 0)),
    outwards("acknowledges after 200 ms", "acknowledged-in-time", |context, frame| {
        if !has(&frame, 0) {
            return vec![frame];
        }
        context.delayed.push((context.now + Duration::from_millis(200), frame));
        Vec::new()
    }),
    inwards("ignores duplicates altogether", "duplicate-acknowledged", |context, frame| {
        if context.copies(&frame) > 0 { Vec::new() } else { vec![frame] }
    }),
    inwards("acts on duplicates", "duplicate-without-effect", |context, frame| {
        let header = Header { kind: FrameKind::Datagram, ..frame.header };
        let again = Frame { header, ..frame.clone() };
        if context.copies(&frame) > 0 { vec![frame, again] } else { vec![frame] }
    }),
    inwards("takes frames in order only", "reordered-frames", |context, frame| {
        if frame.header.kind == FrameKind::Reliable {
            let next = context.passed[frame.direction as usize].keys().next().copied();
            let is_late = frame.header.sequence > 0
                && next.is_some_and(|first| first == frame.header.sequence)
                || context.passed[frame.direction as usize]
                    .range(..frame.header.sequence)
                    .next_back()
                    .is_some_and(|(last, _)| last + 1 < frame.header.sequence);
            if is_late {
                context.passed[frame.direction as usize].remove(&frame.header.sequence);
                return Vec::new();
            }
        }
        vec![frame]
    }),
    outwards("sends nothing again", "retransmitted", |context, frame| {
        if context.copies(&frame) > 0 { Vec::new() } else { vec![frame] }
    }),
    outwards("alters what it sends again", "retransmitted", |context, frame| {
        if context.copies(&frame) == 0 {
            return vec![frame];
        }
        let mut notes = frame.notes().0;
        notes.push(Note { number: 250, body: Vec::new() });
        vec![Frame { payload: payload(&notes), ..frame }]
    }),
    outwards("sends again after 50 ms", "retransmission-times", |context, frame| {
        if frame.header.kind == FrameKind::Reliable {
            context.delayed.push((context.now + Duration::from_millis(50), frame.clone()));
        }
        vec![frame]
    }),
    inwards("does not hear acknowledgements", "quiet-once-acknowledged", |_, frame| {
        without(frame, 0)
    }),
    inwards("reads `next` of an acknowledgement alone", "selective-acknowledgement", |_, frame| {
        let cut = |ack: &mut Ack| ack.later = 0;
        vec![match frame.direction {
            Direction::ToRobot => edit::<ToRobot, Ack>(frame, cut),
            Direction::ToServer => edit::<ToServer, Ack>(frame, cut),
        }]
    }),
    inwards("takes any version of a frame", "frame-version", |_, frame| {
        let header = Header { version: VERSION, ..frame.header };
        vec![Frame { header, ..frame }]
    }),
    inwards("drops frames with unknown kinds", "unknown-kind", |_, frame| {
        if has(&frame, 200) { Vec::new() } else { vec![frame] }
    }),
    inwards("drops frames whose payload is cut", "cut-payload", |_, frame| {
        if frame.notes().1 { Vec::new() } else { vec![frame] }
    }),
    inwards("does not acknowledge empty frames", "empty-reliable-frame", |_, frame| {
        let is_empty = frame.payload.is_empty() && frame.header.kind == FrameKind::Reliable;
        if is_empty { Vec::new() } else { vec![frame] }
    }),
    inwards(
        "takes frames sealed outside the session",
        "sealed-outside-session",
        |context, frame| {
            let is_outside =
                frame.session == SessionId::NONE && frame.header.kind != FrameKind::Handshake;
            let session = context.session();
            vec![if is_outside { Frame { session, ..frame } } else { frame }]
        },
    ),
    bad(
        "takes frames that are marked as sealed",
        "sealed-frame-on-open-link",
        |_, wire, session| (unmarked(wire, session), Vec::new()),
    ),
    inwards("takes handshakes in the session", "handshake-sealed-in-session", |_, frame| {
        let is_inside = frame.header.kind == FrameKind::Handshake;
        vec![if is_inside { Frame { session: SessionId::NONE, ..frame } } else { frame }]
    }),
];

/// Faults of a robot.
const OF_ROBOTS: &[Mutant] = &[
    bad("does not check the seal", "damaged-frame", |_, wire, session| {
        (resealed(wire, session, Direction::ToRobot, |_| ()), Vec::new())
    }),
    outwards("says hello once", "hello-repeated", |context, frame| {
        let nonces = |frame: &Frame| {
            let mut nonce = None;
            edit::<ToServer, Hello>(frame.clone(), |hello| nonce = Some(hello.nonce));
            nonce
        };
        match nonces(&frame) {
            Some(nonce) if nonce == context.number => Vec::new(),
            Some(nonce) => {
                context.number = nonce;
                vec![frame]
            }
            None => vec![frame],
        }
    }),
    Mutant {
        fault: "takes a Welcome with any nonce",
        check: "welcome-of-another-nonce",
        hooks: Hooks {
            inwards: |context, frame| {
                let nonce = context.number;
                vec![edit::<ToRobot, Welcome>(frame, |welcome| welcome.nonce = nonce)]
            },
            outwards: |context, frame| {
                vec![edit::<ToServer, Hello>(frame, |hello| context.number = hello.nonce)]
            },
            ..Hooks::NONE
        },
    },
    inwards("takes a Welcome of any version", "welcome-of-another-version", |_, frame| {
        vec![edit::<ToRobot, Welcome>(frame, |welcome| welcome.version = VERSION)]
    }),
    inwards("ignores a Refusal", "refused", |_, frame| without(frame, 5)),
    inwards("waits 10 s after any Refusal", "refused-number", |_, frame| {
        let change = |refusal: &mut Refusal| refusal.reason = RefusalReason::TooManyRobots;
        vec![edit::<ToRobot, Refusal>(frame, change)]
    }),
    inwards("ignores a Reset", "reset", |_, frame| without(frame, 7)),
    Mutant {
        fault: "keeps its nonce in the next attempt",
        check: "reset",
        hooks: Hooks {
            inwards: |context, frame| {
                let nonce = context.number;
                vec![edit::<ToRobot, Welcome>(frame, |welcome| welcome.nonce = nonce)]
            },
            outwards: |context, frame| {
                vec![edit::<ToServer, Hello>(frame, |hello| {
                    context.number = hello.nonce;
                    hello.nonce = 99;
                })]
            },
            ..Hooks::NONE
        },
    },
    outwards("sends no State", "state", |_, frame| without(frame, 4)),
    inwards("is a second off", "clock", |_, frame| {
        let change = |reply: &mut TimeReply| reply.received.0 += 1_000_000;
        vec![edit::<ToRobot, TimeReply>(frame, change)]
    }),
    inwards("keeps the clock of another server", "clock-of-another-server", |_, frame| {
        vec![edit::<ToRobot, Welcome>(frame, |welcome| welcome.server_epoch = 1)]
    }),
    Mutant {
        fault: "takes any time reply",
        check: "late-time-reply",
        hooks: Hooks {
            inwards: |context, frame| {
                let nonce = context.number as u16;
                vec![edit::<ToRobot, TimeReply>(frame, |reply| reply.nonce = nonce)]
            },
            outwards: |context, frame| {
                let change = |asked: &mut TimeRequest| context.number = asked.nonce.into();
                vec![edit::<ToServer, TimeRequest>(frame, change)]
            },
            ..Hooks::NONE
        },
    },
    outwards("numbers its Interests from 0", "interest", |_, frame| {
        vec![edit::<ToServer, Interest>(frame, |interest| interest.number -= 1)]
    }),
    outwards("knows every parameter", "parameter-list", |_, frame| {
        let change = |report: &mut ParameterReport| report.outcome = ParameterOutcome::Done;
        vec![edit::<ToServer, ParameterReport>(frame, change)]
    }),
    outwards("says that nothing was ever set", "parameter-stored", |_, frame| {
        let is_stored = |it: &mut ParameterValue| it.parameter == 13 && it.value == 0;
        let change = |report: &mut ParameterReport| {
            report
                .values
                .iter_mut()
                .filter_map(|it| is_stored(it).then_some(it))
                .for_each(|it| it.value = 1);
        };
        vec![edit::<ToServer, ParameterReport>(frame, change)]
    }),
    outwards("writes layer 2", "robot-tiles", |_, frame| {
        let mut notes = frame.notes().0;
        notes.iter_mut().filter(|note| note.number == 3).for_each(|note| note.body[0] = 2);
        vec![Frame { payload: payload(&notes), ..frame }]
    }),
    inwards("stays in epochs that were used", "first-epoch", |_, frame| {
        vec![edit::<ToRobot, Welcome>(frame, |welcome| {
            welcome.renumber = false;
            welcome.first_epoch = 1;
        })]
    }),
    inwards("ignores Requests", "tile-requested", |_, frame| without(frame, 6)),
    outwards("sends no Digests", "robot-digests", |_, frame| without(frame, 9)),
    outwards("sends wrong hashes", "robot-digests", |_, frame| {
        let change = |digests: &mut Digests| digests.tiles.iter_mut().for_each(|it| it.hash ^= 1);
        vec![edit::<ToServer, Digests>(frame, change)]
    }),
    inwards("agrees on 32 bytes and sends 250", "robot-frame-size", |_, frame| {
        vec![edit::<ToRobot, Welcome>(frame, |welcome| welcome.frame = 250)]
    }),
    outwards("requests nothing", "base-missing", |_, frame| without(frame, 6)),
    inwards("ignores Digests", "digest-differs", |_, frame| without(frame, 14)),
];

/// Faults of a server.
const OF_SERVERS: &[Mutant] = &[
    bad("does not check the seal", "damaged-frame", |_, wire, session| {
        (resealed(wire, session, Direction::ToServer, |_| ()), Vec::new())
    }),
    outwards("answers with another nonce", "welcome", |_, frame| {
        vec![edit::<ToRobot, Welcome>(frame, |welcome| welcome.nonce ^= 1)]
    }),
    outwards("answers a second Hello otherwise", "hello-twice", |context, frame| {
        let count = &mut context.number;
        vec![edit::<ToRobot, Welcome>(frame, |welcome| {
            *count += 1;
            welcome.first_epoch += *count;
        })]
    }),
    inwards("compares no versions", "hello-version", |_, frame| {
        vec![edit::<ToServer, Hello>(frame, |hello| {
            hello.version = VERSION;
            hello.min_version = VERSION;
        })]
    }),
    inwards("welcomes any resolution", "hello-resolution", |_, frame| {
        vec![edit::<ToServer, Hello>(frame, |hello| hello.resolution = Millimetres(50))]
    }),
    inwards("welcomes frames of 31 bytes", "hello-frame", |_, frame| {
        vec![edit::<ToServer, Hello>(frame, |hello| hello.frame = hello.frame.max(32))]
    }),
    inwards("ends a session at any Hello", "late-hello", |context, frame| {
        if has(&frame, 1) && frame.session == SessionId::NONE {
            context.number = context.session().0;
        } else if frame.session.0 == context.number && context.number != 0 {
            return Vec::new();
        }
        vec![frame]
    }),
    bad("resets a living session", "no-reset-in-session", |_, wire, _| {
        let note = Note::new::<ToRobot, _>(&Reset);
        let kind = (FrameKind::Handshake, 0);
        let reset = Frame::new(SessionId::NONE, Direction::ToRobot, kind, &[note]);
        (Some(wire.to_vec()), vec![reset])
    }),
    outwards("never resets", "reset-after-silence", |_, frame| without(frame, 7)),
    outwards("resets at every bad frame", "reset-after-silence", |_, frame| {
        if has(&frame, 7) && frame.session == SessionId::NONE {
            return vec![frame.clone(), frame];
        }
        vec![frame]
    }),
    outwards("counts epochs from 1 always", "first-epoch", |_, frame| {
        vec![edit::<ToRobot, Welcome>(frame, |welcome| welcome.first_epoch = 1)]
    }),
    outwards("never renumbers", "renumber", |_, frame| {
        vec![edit::<ToRobot, Welcome>(frame, |welcome| welcome.renumber = false)]
    }),
    outwards("replies without the nonce", "time-reply", |_, frame| {
        vec![edit::<ToRobot, TimeReply>(frame, |reply| reply.nonce = 0)]
    }),
    outwards("never requests", "base-missing", |_, frame| without(frame, 6)),
    inwards("ignores Digests", "digest-differs", |_, frame| without(frame, 9)),
    inwards("takes a robot's fused tiles", "layer-of-the-server", |_, frame| {
        let (mut notes, is_cut) = frame.notes();
        if is_cut {
            return vec![frame];
        }
        notes.iter_mut().filter(|note| note.number == 3).for_each(|note| note.body[0] = 0);
        vec![Frame { payload: payload(&notes), ..frame }]
    }),
    inwards("sends tiles around the window", "interest", |_, frame| {
        vec![edit::<ToServer, Interest>(frame, |interest| interest.to.x += 9)]
    }),
    inwards("takes the last Interest", "older-interest", |context, frame| {
        let count = &mut context.number;
        vec![edit::<ToServer, Interest>(frame, |interest| {
            *count += 1;
            interest.number = 1_000 + *count;
        })]
    }),
    inwards("ignores Requests", "tile-requested", |_, frame| without(frame, 6)),
    outwards("sends no Digests", "server-digests", |_, frame| without(frame, 14)),
    outwards("sends wrong hashes", "server-digests", |_, frame| {
        let change = |digests: &mut Digests| digests.tiles.iter_mut().for_each(|it| it.hash ^= 1);
        vec![edit::<ToRobot, Digests>(frame, change)]
    }),
    Mutant {
        fault: "agrees on 32 bytes and sends 250",
        check: "server-frame-size",
        hooks: Hooks {
            inwards: |context, frame| {
                vec![edit::<ToServer, Hello>(frame, |hello| {
                    context.number = hello.frame.into();
                    hello.frame = hello.frame.max(250);
                })]
            },
            outwards: |context, frame| {
                let frame_size = context.number as u16;
                let change = |welcome: &mut Welcome| welcome.frame = welcome.frame.min(frame_size);
                vec![edit::<ToRobot, Welcome>(frame, change)]
            },
            ..Hooks::NONE
        },
    },
    outwards("sends every tile three times", "budget", |_, frame| {
        if has(&frame, 3) { vec![frame.clone(), frame.clone(), frame] } else { vec![frame] }
    }),
];

fn told(report: &ConformanceReport) -> String {
    report.checks.iter().map(CheckResult::to_string).collect()
}

fn must_pass(bench: &mut dyn Bench, role: Role, keys: &Keys, skipped: &[&str]) {
    let mut last = time::Instant::now();
    let report = run(bench, role, (keys, &[]), |result| {
        print!("{} ms {result}", last.elapsed().as_millis());
        last = time::Instant::now();
    });
    assert!(report.conforms(), "{}", told(&report));
    let skips = report.checks.iter().filter(|it| matches!(it.verdict, Verdict::Skipped(_)));
    let skips: Vec<&str> = skips.map(|it| it.name).collect();
    assert_eq!(skips, skipped, "{}", told(&report));
}

/// The checks of sealed links, which an open one skips.
const SEALED: [&str; 6] = [
    "unsealed-frame",
    "replayed-frame",
    "replay-window",
    "replayed-handshake",
    "unsealed-handshake",
    "reset-of-another-frame",
];

#[test]
fn our_agent_passes() {
    let mut bench = VirtualBench::new(RobotPeer::default());
    must_pass(&mut bench, Role::Robot, &Keys::None, &SEALED);
}

#[test]
fn our_server_passes() {
    let mut bench = VirtualBench::new(ServerPeer::default());
    let skipped = [&["stored"], &SEALED[..]].concat();
    must_pass(&mut bench, Role::Server, &Keys::None, &skipped);
}

/// Runs one check. Returns how it ended.
fn check(role: Role, peer: impl Peer, keys: &Keys, name: &str) -> CheckResult {
    let number = 1 + checks(role).iter().position(|it| it.name == name).unwrap();
    let report = run(&mut VirtualBench::new(peer), role, (keys, &[number]), |_| {});
    report.checks[0].clone()
}

/// A server says what is on disk; one that doesn't, or does so once only, fails. The failure of a check of tiles
/// shows the frame at fault, however long ago it came.
#[test]
fn a_server_that_does_not_say_what_is_stored_fails() {
    let found = check(Role::Server, ServerPeer::storing(), &Keys::None, "stored");
    assert_eq!(found.verdict, Verdict::Passed, "{found}");
    let silent = Hooks { outwards: |_, frame| without(frame, 13), ..Hooks::NONE };
    let once = Hooks {
        outwards: |context, frame| {
            context.number += u32::from(has(&frame, 13));
            if context.number > 1 { without(frame, 13) } else { vec![frame] }
        },
        ..Hooks::NONE
    };
    for (hooks, told) in [(silent, "after a tile"), (once, "in the next session")] {
        let peer = Spoiled::new(ServerPeer::storing(), Direction::ToServer, hooks);
        let found = check(Role::Server, peer, &Keys::None, "stored");
        let Verdict::Failed { expected, .. } = &found.verdict else { panic!("{found}") };
        assert!(expected.contains(told), "{found}");
    }
}

#[test]
fn a_failed_check_of_tiles_shows_the_frame_at_fault() {
    let hooks = Hooks {
        outwards: |context, frame| {
            let (mut notes, _) = frame.notes();
            // The first tile alone is of another layer; many frames follow.
            let tile = notes.iter_mut().find(|note| note.number == 3);
            if let Some(tile) = tile.filter(|_| context.number == 0) {
                tile.body[0] = 2;
                context.number = 1;
            }
            vec![Frame { payload: payload(&notes), ..frame }]
        },
        ..Hooks::NONE
    };
    let peer = Spoiled::new(RobotPeer::default(), Direction::ToRobot, hooks);
    let found = check(Role::Robot, peer, &Keys::None, "robot-tiles");
    let Verdict::Failed { frames, .. } = &found.verdict else { panic!("{found}") };
    let [title, culprit, _, rest, ..] = &frames[..] else { panic!("{found}") };
    assert_eq!([title.as_str(), rest.as_str()], ["the frame at fault:", "the last frames:"]);
    assert!(culprit.contains("TileUpdate"), "{culprit}");
}

/// The gates behind which an open peer is sealed: the good one passes the checks of seals, and each leak is found
/// by the check that it is about.
#[test]
fn leaky_seals_are_found() {
    let gated = |role, leak, name: &str| match role {
        Role::Robot => {
            let gate = Gate::new(RobotPeer::default(), Direction::ToRobot, leak);
            check(role, gate, &keys(), name)
        }
        Role::Server => {
            let gate = Gate::new(ServerPeer::default(), Direction::ToServer, leak);
            check(role, gate, &keys(), name)
        }
    };
    let mut wrong = Vec::new();
    for role in [Role::Robot, Role::Server] {
        for name in SEALED {
            let found = gated(role, Leak::None, name);
            let is_for_robots = name == "reset-of-another-frame" && role == Role::Server;
            if is_for_robots != (found.verdict != Verdict::Passed) {
                wrong.push(format!("a {role} behind a good gate: {found}"));
            }
        }
        for (leak, name) in [
            (Leak::Checksums, "unsealed-frame"),
            (Leak::Replays, "replayed-frame"),
            (Leak::WideWindow, "replay-window"),
            (Leak::NarrowWindow, "replay-window"),
            (Leak::OldAttempts, "replayed-handshake"),
            (Leak::OpenHandshakes, "unsealed-handshake"),
            (Leak::AnyReset, "reset-of-another-frame"),
        ] {
            let found = gated(role, leak, name);
            let is_for_robots = leak == Leak::AnyReset && role == Role::Server;
            if is_for_robots == matches!(found.verdict, Verdict::Failed { .. }) {
                wrong.push(format!("a {role} behind a gate with {leak:?}: {found}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

fn keys() -> Keys {
    Keys::Of { keys: vec![KEY], salt: 1 << 40, boot: 9 }
}

#[test]
fn our_agent_passes_with_a_key() {
    let mut bench = VirtualBench::new(RobotPeer::sealed());
    let skipped = ["reserved-kind", "sealed-frame-on-open-link"];
    must_pass(&mut bench, Role::Robot, &keys(), &skipped);
}

#[test]
fn our_server_passes_with_a_key() {
    let mut bench = VirtualBench::new(ServerPeer::sealed());
    let skipped = [
        "offer-beside-session",
        "reserved-kind",
        "stored",
        "sealed-frame-on-open-link",
        "reset-of-another-frame",
    ];
    must_pass(&mut bench, Role::Server, &keys(), &skipped);
}

/// Runs the check that must find a mutant's fault.
fn is_caught(role: Role, mutant: &Mutant) -> Result<(), String> {
    let number = 1 + checks(role).iter().position(|it| it.name == mutant.check).unwrap();
    let report = match role {
        Role::Robot => {
            let peer = Spoiled::new(RobotPeer::default(), Direction::ToRobot, mutant.hooks);
            run(&mut VirtualBench::new(peer), role, (&Keys::None, &[number]), |_| {})
        }
        Role::Server => {
            let peer = Spoiled::new(ServerPeer::default(), Direction::ToServer, mutant.hooks);
            run(&mut VirtualBench::new(peer), role, (&Keys::None, &[number]), |_| {})
        }
    };
    match report.checks[..] {
        [CheckResult { verdict: Verdict::Failed { .. }, .. }] => Ok(()),
        _ => Err(format!("a {role} that {}: {}", mutant.fault, told(&report))),
    }
}

fn must_all_be_caught(role: Role, mutants: &[&Mutant]) {
    let missed: Vec<String> =
        mutants.iter().filter_map(|mutant| is_caught(role, mutant).err()).collect();
    assert!(missed.is_empty(), "not caught:\n{}", missed.join("\n"));
    assert!(mutants.len() >= 24);
}

#[test]
fn a_broken_robot_fails_the_check_that_its_fault_is_about() {
    must_all_be_caught(Role::Robot, &OF_THE_LINK.iter().chain(OF_ROBOTS).collect::<Vec<_>>());
}

#[test]
fn a_broken_server_fails_the_check_that_its_fault_is_about() {
    must_all_be_caught(Role::Server, &OF_THE_LINK.iter().chain(OF_SERVERS).collect::<Vec<_>>());
}

/// Runs `ubimap conformance` with these arguments, in real time. All checks must pass, but for those
/// that may be skipped.
fn must_pass_outside(arguments: &[&str], may_skip: &[&str]) {
    let line = ["conformance"].iter().chain(arguments);
    let options = CommandLine::parse_from(line).options;
    let report = conformance::run(&options, |result| print!("{result}")).unwrap();
    assert!(report.conforms(), "{}", told(&report));
    let skips = report.checks.iter().filter(|it| matches!(it.verdict, Verdict::Skipped(_)));
    let skips: Vec<&str> =
        skips.map(|it| it.name).filter(|name| !may_skip.contains(name)).collect();
    assert_eq!(skips, [""; 0], "{}", told(&report));
}

#[derive(clap::Parser)]
struct CommandLine {
    #[command(flatten)]
    options: ConformanceOptions,
}

/// Takes seven minutes.
#[test]
#[ignore = "takes minutes of real time: cargo conforming"]
fn our_agent_passes_as_a_process() {
    let cargo = process::Command::new(env!("CARGO"))
        .args(["build", "--quiet", "--package", "ubimap-agent", "--example", "stdio_robot"])
        .status();
    assert!(cargo.unwrap().success());
    let example = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/debug/examples/stdio_robot");
    let may_skip = [&SEALED[..], &["parameter-stored"]].concat();
    must_pass_outside(&["--exec", example], &may_skip);
}

/// Takes seven minutes. The image gets no bytes of a sensor, so it maps nothing.
#[test]
#[ignore = "runs an image in the emulator: cargo conforming"]
fn our_image_passes_in_the_emulator() {
    let emulator = match firmware().and_then(|image| Emulator::start(&image)) {
        Ok(emulator) => emulator,
        Err(error) => return leave_out("the conformance of the firmware", &error),
    };
    let port = emulator.ports()[0].display().to_string();
    let may_skip = [&OF_TILES[..], &SEALED, &["parameter-stored"]].concat();
    must_pass_outside(&["--serial", &port, "--slack", "200"], &may_skip);
}

/// Takes seven minutes, in which it needs most of a processor. As the other image it maps nothing.
#[test]
#[ignore = "runs an image in an emulator: cargo conforming"]
fn our_image_for_a_pico_passes_in_its_emulator() {
    // `.ci/run` says so.
    if env::var_os("UBIMAP_NO_RP2040JS").is_some() {
        return;
    }
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("conforming-pico");
    fs::create_dir_all(&folder).unwrap();
    let [image, flash] = ["7.uf2", "flash"].map(|name| folder.join(name));
    let (script, elf) = match rp2040js().and_then(|it| Ok((it, pico_firmware(Core::M0)?))) {
        Ok(found) => found,
        Err(error) => return leave_out("the conformance of a Pico's image", &error),
    };
    let [elf, uf2] = [&elf, &image].map(|path| path.to_str().unwrap());
    provision(&[elf, "--id", "7", "--out", uf2]);
    // A boot that flashes it.
    fs::write(&flash, []).unwrap();
    let mut node = process::Command::new("node");
    node.arg(&script).arg(&flash).arg("0.01").stdin(File::open(&image).unwrap());
    assert!(node.status().unwrap().success());
    let command = format!("node {} {} 36000 none -", script.display(), flash.display());
    must_pass_outside(&["--exec", &command, "--slack", "300"], &[&OF_TILES[..], &SEALED].concat());
}

/// What a robot without a sensor can't show.
const OF_TILES: [&str; 14] = [
    "robot-tiles",
    "first-epoch",
    "another-server",
    "one-update-in-flight",
    "tile-requested",
    "all-tiles-requested",
    "robot-digests",
    "base-missing",
    "digest-differs",
    "tile-in-parts",
    "tile-outside-window",
    "clock",
    "clock-of-another-server",
    "interest",
];
