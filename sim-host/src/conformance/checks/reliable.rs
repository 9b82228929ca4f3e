//! Checks of acknowledgement and retransmission (SPEC 3), for robots and servers alike.

use ubimap_protocol::{
    frame::{FrameKind, SEQUENCE_MODULUS},
    message::Ack,
    time::{Duration, Instant},
};

use super::super::{
    check::{Check, Halt, fail, skip},
    talk::{Seen, Talk, ahead, covers},
};

pub(super) const CHECKS: &[Check] = &[
    Check {
        name: "acknowledged-in-time",
        section: "3.1",
        rule: "a reliable frame is acknowledged within 5 ms",
        run: in_time,
    },
    Check {
        name: "duplicate-acknowledged",
        section: "3.1",
        rule: "a duplicate is acknowledged again",
        run: duplicate_acknowledged,
    },
    Check {
        name: "duplicate-without-effect",
        section: "2.6",
        rule: "a duplicate has no effect but its acknowledgement",
        run: duplicate_effect,
    },
    Check {
        name: "reordered-frames",
        section: "3.1",
        rule: "frames are delivered as they arrive, and acknowledged selectively",
        run: reordered,
    },
    Check {
        name: "receive-window",
        section: "3.1",
        rule: "a frame up to 32 ahead is accepted, and one further ahead is refused",
        run: window,
    },
    Check {
        name: "sequence-wraps",
        section: "3",
        rule: "sequence numbers wrap after 2,047",
        run: wraps,
    },
    Check {
        name: "sequence-starts-at-zero",
        section: "2.3",
        rule: "the reliable frames of a session count up from 0",
        run: starts_at_zero,
    },
    Check {
        name: "retransmitted",
        section: "3.2",
        rule: "a frame that is not acknowledged is sent again, unchanged",
        run: retransmitted,
    },
    Check {
        name: "retransmission-times",
        section: "3.2",
        rule: "retransmissions come 150 ms to 3 s apart, and the interval at most doubles",
        run: retransmission_times,
    },
    Check {
        name: "quiet-once-acknowledged",
        section: "3.2",
        rule: "a frame that has been acknowledged is not sent again",
        run: quiet,
    },
    Check {
        name: "selective-acknowledgement",
        section: "3.2",
        rule: "a frame acknowledged by a bit of `later` is not sent again; the one before it is",
        run: selective,
    },
    Check {
        name: "acknowledgement-never-revokes",
        section: "3.2",
        rule: "a late acknowledgement does not revoke a newer one",
        run: never_revokes,
    },
    Check {
        name: "send-window",
        section: "3.2",
        rule: "no frame is more than 32 ahead of the oldest that is not acknowledged",
        run: send_window,
    },
];

fn in_time(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let bound = Duration::from_millis(5) + talk.slack();
    for _ in 0..5 {
        let sent = talk.now();
        let sequence = talk.reliable(&[])?;
        talk.is_acknowledged(sequence)?;
        let acknowledged = talk.acks.iter().find(|&&(_, ack)| covers(ack, sequence));
        let expected = format!("an acknowledgement within {} ms", bound.micros() / 1_000);
        match acknowledged {
            None => return fail(expected, "none"),
            Some(&(at, _)) if at.since(sent) > bound => {
                return fail(expected, format!("after {} ms", at.since(sent).micros() / 1_000));
            }
            Some(_) => {}
        }
        talk.wait(Duration::from_millis(30))?;
    }
    Ok(())
}

fn duplicate_acknowledged(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let question = talk.question();
    let frame = talk.next_reliable(&[question]);
    talk.send(&frame)?;
    talk.is_acknowledged(frame.header.sequence)?;
    // Repetitions of the first acknowledgement have passed.
    talk.wait(Duration::from_millis(500))?;
    talk.acks.clear();
    talk.send(&frame)?;
    if talk.is_acknowledged(frame.header.sequence)? {
        return Ok(());
    }
    fail("the second copy of a reliable frame is acknowledged again", "no acknowledgement")
}

fn duplicate_effect(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let question = talk.question();
    let frame = talk.next_reliable(&[question]);
    talk.send(&frame)?;
    let Some(first) = talk.find(talk.patience(), |talk, seen| talk.is_answer(seen))? else {
        return fail("a question is answered", "no answer");
    };
    talk.wait(Duration::from_millis(500))?;
    talk.send(&frame)?;
    let again = talk.find(talk.patience(), |talk, seen| {
        talk.is_answer(seen) && seen.reliable() != first.reliable()
    })?;
    match again {
        None => Ok(()),
        Some(_) => fail("one answer to a question that arrives twice", "a second answer"),
    }
}

fn reordered(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let mut frames = Vec::new();
    let mut numbers = Vec::new();
    for _ in 0..3 {
        let question = talk.question();
        numbers.push(talk.asked);
        frames.push(talk.next_reliable(&[question]));
    }
    let mut answered = Vec::new();
    for frame in frames.iter().rev() {
        let sequence = frame.header.sequence;
        talk.acks.clear();
        talk.send(frame)?;
        let seen = talk.collect(talk.patience())?;
        answered.extend(seen.iter().flat_map(|seen| talk.answers(seen)));
        if !talk.acks.iter().any(|&(_, ack)| covers(ack, sequence)) {
            return fail(format!("frame {sequence} is acknowledged, out of order"), "it is not");
        }
        let earlier = frames.iter().map(|it| it.header.sequence).filter(|&it| it < sequence);
        for missing in earlier {
            if talk.acks.iter().any(|&(_, ack)| covers(ack, missing)) {
                return fail(format!("frame {missing} is missing"), "it is acknowledged");
            }
        }
    }
    match numbers.iter().find(|number| !answered.contains(number)) {
        None => Ok(()),
        Some(number) => {
            fail("the questions in three reordered frames are answered", format!("{number} is not"))
        }
    }
}

fn window(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let next = talk.next_sequence();
    let far = talk.frame(FrameKind::Reliable, (next + 33) % SEQUENCE_MODULUS, &[]);
    talk.acks.clear();
    talk.send(&far)?;
    talk.wait(talk.patience())?;
    if talk.acks.iter().any(|&(_, ack)| covers(ack, far.header.sequence)) {
        return fail(
            "a frame 33 ahead of the oldest missing one is refused",
            "it was acknowledged",
        );
    }
    let last = talk.frame(FrameKind::Reliable, (next + 32) % SEQUENCE_MODULUS, &[]);
    talk.send(&last)?;
    if !talk.is_acknowledged(last.header.sequence)? {
        return fail("a frame 32 ahead of the oldest missing one is acknowledged", "it was not");
    }
    for _ in 0..32 {
        talk.reliable(&[])?;
        talk.wait(Duration::from_millis(2))?;
    }
    talk.wait(talk.patience())?;
    let wanted = (next + 33) % SEQUENCE_MODULUS;
    match talk.acks.last() {
        Some(&(_, ack)) if ack.next == wanted => {}
        other => {
            return fail(format!("`next` is {wanted} once the gap is full"), format!("{other:?}"));
        }
    }
    talk.set_next_sequence(wanted);
    talk.must_answer("after the gap")
}

fn wraps(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    for _ in 0..(usize::from(SEQUENCE_MODULUS) + 40) / 24 {
        let mut last = 0;
        for _ in 0..24 {
            last = talk.reliable(&[])?;
        }
        if !talk.is_acknowledged(last)? {
            return fail(
                format!("frame {last} is acknowledged"),
                format!("{:?}", talk.acks.last()),
            );
        }
        talk.acks.drain(..talk.acks.len() - 1);
        // Only the acknowledgements matter.
        talk.wait(Duration::from_millis(1))?;
    }
    talk.must_answer("after more than 2,048 reliable frames")
}

/// Opens a session and asks in datagrams, without acknowledging anything. Returns the first reliable
/// frame.
fn unacknowledged(talk: &mut Talk<'_>) -> Result<Seen, Halt> {
    talk.open()?;
    talk.wait(Duration::from_millis(300))?;
    talk.is_polite = false;
    ask(talk)
}

fn ask(talk: &mut Talk<'_>) -> Result<Seen, Halt> {
    let question = talk.question();
    talk.reliable(&[question])?;
    let answer =
        talk.find(talk.patience(), |it, seen| it.is_answer(seen) && seen.reliable().is_some())?;
    match answer {
        Some(seen) => Ok(seen),
        None => fail("an answer in a reliable frame", "none"),
    }
}

fn starts_at_zero(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    talk.must_answer("in a session")?;
    // A second session: a number that went on would not be 0.
    talk.open()?;
    for _ in 0..3 {
        talk.must_answer("in another session")?;
    }
    let mut sequences = talk.sequences.clone();
    sequences.sort_unstable();
    sequences.dedup();
    let expected: Vec<u16> = (0..sequences.len() as u16).collect();
    if sequences == expected && !sequences.is_empty() {
        return Ok(());
    }
    fail("reliable frames 0, 1, 2 ... in a new session", format!("{sequences:?}"))
}

fn copies(talk: &mut Talk<'_>, first: &Seen, span: Duration) -> Result<Vec<Seen>, Halt> {
    let sequence = first.reliable();
    let seen = talk.collect(span)?;
    Ok(seen.into_iter().filter(|seen| seen.reliable() == sequence).collect())
}

fn retransmitted(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let first = unacknowledged(talk)?;
    let copies = copies(talk, &first, Duration::from_secs(5))?;
    if copies.len() < 2 {
        return fail("at least two retransmissions within 5 s", format!("{}", copies.len()));
    }
    match copies.iter().find(|copy| copy.frame != first.frame) {
        None => Ok(()),
        Some(_) => fail("a retransmission equals the first frame", "it differs"),
    }
}

fn retransmission_times(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let first = unacknowledged(talk)?;
    let copies = copies(talk, &first, Duration::from_secs(9))?;
    let times: Vec<Instant> = [first.at].into_iter().chain(copies.iter().map(|it| it.at)).collect();
    let intervals: Vec<u64> =
        times.windows(2).map(|it| it[1].since(it[0]).micros() / 1_000).collect();
    let slack = talk.slack().micros() / 1_000 + 5;
    let is_sound = |&ms: &u64| ms + slack >= 150 && ms <= 3_000 + slack;
    let grows = intervals.windows(2).all(|it| {
        let bound = 2 * it[0];
        it[1] + slack >= it[0] && it[1] <= bound + 2 * slack
    });
    let doubles = intervals
        .windows(2)
        .take(2)
        .all(|it| it[1] >= 3_000 - slack || 2 * it[1] + 4 * slack >= 3 * it[0]);
    if intervals.len() >= 2 && intervals.iter().all(is_sound) && grows && doubles {
        return Ok(());
    }
    fail(
        "intervals of 150 to 3,000 ms, each the double of the one before",
        format!("{intervals:?} ms"),
    )
}

fn quiet(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let first = unacknowledged(talk)?;
    let again = copies(talk, &first, Duration::from_secs(1) + talk.slack())?;
    if again.is_empty() {
        return skip("it sends nothing again (see `retransmitted`)");
    }
    talk.acknowledge()?;
    // A copy may be on its way.
    talk.wait(Duration::from_millis(20) + talk.slack())?;
    let late = copies(talk, &first, Duration::from_secs(4))?;
    if late.is_empty() {
        return Ok(());
    }
    fail("no copy of a frame that has been acknowledged", format!("{} copies", late.len()))
}

fn selective(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let first = unacknowledged(talk)?;
    let second = ask(talk)?;
    let (Some(one), Some(two)) = (first.reliable(), second.reliable()) else {
        return skip("no reliable frames");
    };
    let k = ahead(two, one);
    if !(1..=32).contains(&k) {
        return fail("the second reliable frame comes after the first", format!("{one}, {two}"));
    }
    talk.acknowledge_as(Ack { next: one, later: 1 << (k - 1) })?;
    talk.wait(Duration::from_millis(5) + talk.slack())?;
    let seen = talk.collect(Duration::from_secs(4))?;
    let count = |sequence| seen.iter().filter(|seen| seen.reliable() == Some(sequence)).count();
    match (count(one), count(two)) {
        (0, _) => fail(format!("frame {one} is sent again"), "it is not"),
        (_, 0) => Ok(()),
        (_, copies) => fail(
            format!("frame {two}, acknowledged by a bit of `later`, is not sent again"),
            format!("{copies} copies"),
        ),
    }
}

fn never_revokes(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let first = unacknowledged(talk)?;
    let Some(one) = first.reliable() else { return skip("no reliable frames") };
    talk.acknowledge()?;
    talk.acknowledge_as(Ack { next: one, later: 0 })?;
    talk.wait(Duration::from_millis(20) + talk.slack())?;
    let late = copies(talk, &first, Duration::from_secs(4))?;
    if !late.is_empty() {
        return fail(
            "a frame that was acknowledged stays acknowledged after an older acknowledgement",
            "it is sent again",
        );
    }
    talk.is_polite = true;
    talk.must_answer("after an older acknowledgement")
}

fn send_window(talk: &mut Talk<'_>) -> Result<(), Halt> {
    let first = unacknowledged(talk)?;
    let Some(oldest) = first.reliable() else { return skip("no reliable frames") };
    let mut highest = 0;
    for _ in 0..45 {
        let question = talk.question();
        talk.reliable(&[question])?;
        let seen = talk.collect(Duration::from_millis(40))?;
        let news = seen.iter().filter_map(Seen::reliable).map(|it| ahead(it, oldest));
        highest = news.filter(|&it| it < 1_024).fold(highest, u16::max);
    }
    if highest <= 32 {
        return Ok(());
    }
    fail("reliable frames at most 32 ahead of the oldest in flight", format!("{highest} ahead"))
}
