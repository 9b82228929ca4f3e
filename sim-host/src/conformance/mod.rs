//! The conformance runner: plays one side of the protocol, and checks the other.
//!
//! A [`Check`] enforces a rule of SPEC.md. It talks to the implementation under test over a [`Bench`]: a
//! wire with the wall clock, or a peer in the same process with virtual time. Frames and messages are
//! written by the codec of the protocol crate, but sessions, acknowledgements and retransmissions are
//! the runner's own, because it must be able to misbehave. It knows nothing of what it tests beyond its
//! answers.
//!
//! [`Describer`] puts captured bytes into words; failures show the last frames with it.

mod bench;
mod check;
mod checks;
mod describe;
mod envelope;
mod followed;
mod frames;
mod halt;
mod published;
mod report;
mod requests;
mod robot_side;
mod server_side;
mod sides;
mod talk;

pub use bench::{Bench, Gone};
pub use check::{Check, CheckResult, Verdict};
pub use checks::checks;
pub use describe::{Describer, hex, split};
pub use envelope::{Envelope, Keyed, Keys};
pub use frames::{Frame, Note, Unreadable, part_note, payload, stuffed, tile_note, unstuffed};
pub use halt::{Halt, Role};
pub use report::ConformanceReport;
pub use talk::Talk;

/// Runs the checks of a role whose numbers are in `only` (all if it is empty), and tells each result.
pub fn run(
    bench: &mut dyn Bench,
    role: Role,
    (keys, only): (&Keys, &[usize]),
    mut tell: impl FnMut(&CheckResult),
) -> ConformanceReport {
    let began = bench.now();
    let mut talk = Talk::new(bench, role, Envelope::new(keys));
    let mut results = Vec::new();
    let mut gone = false;
    for (number, check) in (1..).zip(checks(role)) {
        if !only.is_empty() && !only.contains(&number) {
            continue;
        }
        talk.rest();
        let start = talk.now();
        let ended = match gone {
            true => Err(Halt::Skipped(format!("the {role} has gone"))),
            false => (check.run)(&mut talk),
        };
        let verdict = match ended {
            Ok(()) => Verdict::Passed,
            Err(Halt::Skipped(reason)) => Verdict::Skipped(reason),
            Err(Halt::Failed { expected, found }) => {
                Verdict::Failed { expected, found, frames: talk.shown() }
            }
            Err(Halt::Gone(reason)) => {
                gone = true;
                let found = reason.to_string();
                let expected = format!("a {role} to talk to");
                Verdict::Failed { expected, found, frames: talk.shown() }
            }
        };
        let Check { name, section, rule, .. } = *check;
        let seconds = talk.now().since(start).micros() / 1_000_000;
        let result = CheckResult { number, name, section, rule, verdict, seconds };
        tell(&result);
        results.push(result);
    }
    ConformanceReport::new(role, results, talk.now().since(began))
}
