//! Moments of hellos, acknowledgements and retransmissions, and a clock that ages. All in
//! microseconds.

use serde_json::{Value, json};
use ubimap_protocol::{
    frame::{FrameKind, SessionId},
    link::{ClockSync, Endpoint, Fill, Knocking},
    message::{Ack, TimeReply, TimeRequest, ToRobot, ToServer},
    time::Instant,
};

use super::{TO_ROBOT, header, message, sealed};

type Robot = Endpoint<ToServer, u16, 8, 250>;

const SESSION: u32 = 5;

/// The cases.
pub(super) fn timing() -> Value {
    json!({
        "hellos": hellos(),
        "acknowledgements": acknowledgements(),
        "retransmissions": retransmissions(),
        "acknowledged": acknowledged(),
        "clocks": clocks(),
    })
}

fn hellos() -> Value {
    let mut knocking = Knocking::new(7);
    let mut moments = Vec::new();
    while moments.len() < 9 {
        let now = knocking.poll_timeout();
        assert!(knocking.poll(now));
        moments.push(now.0);
    }
    json!([{ "name": "hellos that nobody answers", "moments": moments }])
}

/// Reliable frames that arrive at a robot, and the acknowledgements that it sends.
fn acknowledgements() -> Value {
    let cases: [(&str, &[(u64, u16)]); 4] = [
        ("in order", &[(10_000, 0), (12_000, 1), (90_000, 2)]),
        ("a frame is missing", &[(10_000, 0), (20_000, 2)]),
        ("a frame comes twice", &[(10_000, 0), (300_000, 0)]),
        ("a frame between the repetitions", &[(10_000, 1), (60_000, 0)]),
    ];
    let case = |(name, arrivals): &(&str, &[(u64, u16)])| {
        let mut robot = Robot::new();
        robot.begin(SessionId(SESSION), 250);
        let mut sent: Vec<Value> = Vec::new();
        let mut until = |robot: &mut Robot, end: u64| {
            while let Some(due) = robot.poll_timeout().filter(|due| due.0 < end) {
                let mut out = [0; 250];
                let frame = robot.poll_transmit(due, &mut out, false, |_, _| Fill::Nothing);
                sent.push(json!([due.0, super::hex(&out[..frame.unwrap().len])]));
            }
        };
        for &(at, sequence) in *arrivals {
            until(&mut robot, at);
            let wire = sealed(TO_ROBOT, SESSION, header(FrameKind::Reliable, sequence), &[200, 0]);
            let _ = robot.receive(&mut &wire[..], Instant(at));
        }
        until(&mut robot, u64::MAX);
        json!({ "name": name, "session": SESSION, "arrivals": arrivals, "sent": sent })
    };
    cases.iter().map(case).collect()
}

/// What happens to a sender.
enum Step {
    Send,
    Ack(u16, u32),
}

/// Frames that a robot sends, acknowledgements that it gets, and what it then sends again and when.
fn retransmissions() -> Value {
    use Step::{Ack as Got, Send};
    let cases: [(&str, &[(u64, Step)]); 8] = [
        ("never acknowledged", &[(0, Send)]),
        ("after a first sample of 100 ms", &[(0, Send), (100_000, Got(1, 0)), (200_000, Send)]),
        (
            "after samples of 20, 30 and 25 ms",
            &[
                (0, Send),
                (20_000, Got(1, 0)),
                (40_000, Send),
                (70_000, Got(2, 0)),
                (80_000, Send),
                (105_000, Got(3, 0)),
                (110_000, Send),
            ],
        ),
        (
            "overtaken by a frame sent 70 ms later",
            &[(0, Send), (10_000, Send), (100_000, Send), (200_000, Got(0, 2))],
        ),
        (
            "after samples of 400, 417 and 253 ms",
            &[
                (0, Send),
                (400_000, Got(1, 0)),
                (500_000, Send),
                (917_000, Got(2, 0)),
                (1_000_000, Send),
                (1_253_000, Got(3, 0)),
                (1_300_000, Send),
            ],
        ),
        (
            "after samples of 203 and 209 ms, and overtaken by a frame sent 60 ms later",
            &[
                (0, Send),
                (203_000, Got(1, 0)),
                (300_000, Send),
                (509_000, Got(2, 0)),
                (600_000, Send),
                (660_000, Send),
                (760_000, Got(2, 1)),
            ],
        ),
        (
            "after samples of 450 and 440 ms, and overtaken by a frame sent 112 ms later",
            &[
                (0, Send),
                (450_000, Got(1, 0)),
                (500_000, Send),
                (940_000, Got(2, 0)),
                (1_000_000, Send),
                (1_112_300, Send),
                (1_450_000, Got(2, 1)),
            ],
        ),
        (
            "frames that were sent twice give no sample",
            &[(0, Send), (900_000, Got(1, 0)), (1_000_000, Send)],
        ),
    ];
    let case = |(name, steps): &(&str, &[(u64, Step)])| {
        let mut robot = Robot::new();
        robot.begin(SessionId(SESSION), 250);
        let (mut events, mut out) = (Vec::new(), [0; 250]);
        let until = |robot: &mut Robot, events: &mut Vec<Value>, end: u64| {
            let mut out = [0; 250];
            while let Some(due) = robot.poll_timeout().filter(|due| due.0 < end) {
                let sent = robot.poll_transmit(due, &mut out, false, |_, _| Fill::Nothing).unwrap();
                events.push(json!([due.0, "again", sent.token]));
            }
        };
        let mut next = 0;
        for (at, step) in *steps {
            until(&mut robot, &mut events, *at);
            match step {
                Send => {
                    let sent = robot.poll_transmit(Instant(*at), &mut out, false, |writer, _| {
                        assert!(writer.push(&TimeRequest { nonce: next }));
                        Fill::Reliable(next)
                    });
                    events.push(json!([at, "sends", sent.unwrap().token]));
                    next += 1;
                }
                Got(next, later) => {
                    let ack = message::<ToRobot>(&Ack { next: *next, later: *later });
                    let header = header(FrameKind::Datagram, 0);
                    let wire = sealed(TO_ROBOT, SESSION, header, &ack);
                    let _ = robot.receive(&mut &wire[..], Instant(*at));
                    while robot.poll_acknowledged().is_some() {}
                    events.push(json!([at, "ack", next, later]));
                }
            }
        }
        until(&mut robot, &mut events, steps.last().unwrap().0 + 20_000_000);
        json!({ "name": name, "events": events })
    };
    cases.iter().map(case).collect()
}

/// A frame in flight, an Ack, and whether the frame counts as acknowledged.
fn acknowledged() -> Value {
    let cases: [(u16, u16, u32); 14] = [
        (5, 5, 0),
        (5, 6, 0),
        (5, 5, u32::MAX),
        (5, 4, 1),
        (5, 4, !1),
        (5, 3, 2),
        (40, 8, 1 << 31),
        (40, 8, !(1 << 31)),
        (40, 7, u32::MAX),
        (5, 1_029, 0),
        (5, 1_030, 0),
        (2_047, 0, 0),
        (2_047, 2_040, 1 << 6),
        (0, 2_047, 1),
    ];
    let case = |&(sequence, next, later): &(u16, u16, u32)| {
        let mut robot = Robot::new();
        robot.begin(SessionId(SESSION), 250);
        let mut out = [0; 250];
        let ack = |robot: &mut Robot, next: u16, later: u32| {
            let ack = message::<ToRobot>(&Ack { next, later });
            let wire = sealed(TO_ROBOT, SESSION, header(FrameKind::Datagram, 0), &ack);
            let _ = robot.receive(&mut &wire[..], Instant(1));
            robot.poll_acknowledged()
        };
        for number in 0..=sequence {
            let sent = robot.poll_transmit(Instant(0), &mut out, true, |writer, _| {
                assert!(writer.push(&TimeRequest { nonce: number }));
                Fill::Reliable(number)
            });
            assert_eq!(sent.unwrap().token, Some(number));
            if number < sequence {
                assert_eq!(ack(&mut robot, (number + 1) % 2_048, 0), Some(number));
            }
        }
        let arrived = ack(&mut robot, next, later) == Some(sequence);
        json!({ "sequence": sequence, "next": next, "later": later, "arrived": arrived })
    };
    cases.iter().map(case).collect()
}

/// Exchanges `[t0, t1, t2, t3]`, and by how much the server's clock then is ahead.
fn clocks() -> Value {
    let mut state = 1u32;
    let mut random = |below: u64| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        u64::from(state >> 8) % below
    };
    let mut case = |name: &str, exchanges: usize, ahead: i64, ppm: u64| {
        let mut clock = ClockSync::default();
        let mut lines = Vec::new();
        let start = 1_000_000;
        for _ in 0..exchanges {
            let t0 = clock.poll_timeout().0.max(start);
            let request = clock.poll_request(Instant(t0)).unwrap();
            let there =
                |local: u64| (local + local * ppm / 1_000_000).checked_add_signed(ahead).unwrap();
            let t1 = there(t0 + random(20_000));
            let held_micros = 300;
            let t2 = t1 + u64::from(held_micros);
            let t3 = t0 + 600 + random(20_000) + t2.saturating_sub(there(t0));
            let reply = TimeReply { nonce: request.nonce, received: Instant(t1), held_micros };
            clock.reply(&reply, Instant(t3));
            let told = clock.to_server(Instant(t3)).unwrap().0 as i64 - t3 as i64;
            lines.push(json!([[t0, t1, t2, t3], told]));
        }
        json!({ "name": name, "exchanges": lines })
    };
    json!([
        case("the first replies", 5, 5_000_000, 0),
        case("a server that started later", 9, -900_000, 0),
        case("generations, and drift", 100, 1_234_567, 25),
    ])
}
