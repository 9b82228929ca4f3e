//! Whatever happens to links, robots and the server, all of them end with the same map.
//!
//! ```text
//! cargo test -p ubimap-tests --test schedules                   300 schedules
//! UBIMAP_SCHEDULES=10000 cargo test --release -p ubimap-tests --test schedules
//! UBIMAP_SCHEDULE=4711 cargo test -p ubimap-tests --test schedules    only this schedule,
//!                                                  with UBIMAP_SCHEDULES this one and those after it
//! ```

use std::{
    env,
    panic::{self, AssertUnwindSafe},
    sync::atomic::{AtomicU64, Ordering},
    thread,
};

use ubimap_tests::schedule::{Newcomer, Schedule};

/// Number of schedules, unless set by `UBIMAP_SCHEDULES`.
const SCHEDULES: u64 = 100;

fn number(name: &str) -> Option<u64> {
    let text = env::var(name).ok()?;
    Some(text.parse().unwrap_or_else(|_| panic!("{name} must be a number, not {text:?}")))
}

/// Runs the schedule of a seed; if it fails, returns the reason and the command that reproduces it.
fn failure(seed: u64) -> Option<String> {
    let ending = panic::catch_unwind(AssertUnwindSafe(|| Schedule::of(seed).run()));
    let why = match ending {
        Ok(ending) => ending.level.err()?,
        Err(panic) => match (panic.downcast_ref::<String>(), panic.downcast_ref::<&str>()) {
            (Some(text), _) => text.clone(),
            (None, text) => text.unwrap_or(&"a panic").to_string(),
        },
    };
    eprintln!("schedule {seed}: {why}");
    Some(format!(
        "schedule {seed}: {why}\n  reproduce with: UBIMAP_SCHEDULE={seed} cargo test -p ubimap-tests --test schedules"
    ))
}

#[test]
fn every_schedule_ends_in_one_map() {
    let one = number("UBIMAP_SCHEDULE");
    let first = one.unwrap_or(0);
    let count = number("UBIMAP_SCHEDULES").unwrap_or(one.map_or(SCHEDULES, |_| 1));
    converge(first, count);
}

#[test]
#[ignore = "long: cargo thorough"]
fn more_schedules_end_in_one_map() {
    converge(SCHEDULES, 2 * SCHEDULES);
}

/// Runs `count` schedules from seed `first` on.
fn converge(first: u64, count: u64) {
    let next = AtomicU64::new(first);
    let threads = thread::available_parallelism().map_or(1, usize::from);
    let mut failures = Vec::new();
    thread::scope(|scope| {
        let work = || {
            let mut failures = Vec::new();
            loop {
                let seed = next.fetch_add(1, Ordering::Relaxed);
                if seed >= first + count {
                    return failures;
                }
                failures.extend(failure(seed));
            }
        };
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        failures.extend(workers.into_iter().flat_map(|it| it.join().unwrap()));
    });
    assert!(failures.is_empty(), "{} of {count}:\n{}", failures.len(), failures.join("\n"));
}

/// Verifies that the fault channel has an effect: without retransmission, the same schedules do not
/// converge.
#[test]
fn without_retransmission_a_lossy_wire_leaves_the_map_incomplete() {
    for seed in 0..5 {
        let schedule = Schedule::lossy(seed, 0.3);
        let with = schedule.clone().run();
        assert!(with.level.is_ok() && with.retransmissions > 0, "schedule {seed}: {with}");
        let without = schedule.without_retransmissions().run();
        assert!(without.level.is_err(), "schedule {seed}: {without}");
        assert!(without.known < with.known, "schedule {seed}: {without}, not {with}");
    }
}

/// A robot whose tile's epoch was closed by a second robot with its number must move the tile to a
/// new epoch; otherwise what it draws would be lost.
#[test]
fn a_robot_loses_nothing_when_its_number_is_used_meanwhile() {
    let closed: usize = (0..6).map(|seed| Schedule::newcomer(seed).take_over()).sum();
    assert!(closed > 0, "no epoch was closed");
}

/// A robot that joins late or reboots is up to date after two round trips plus the time to send its
/// tiles, minus the one second's worth of bytes that the downlink budget may save up.
#[test]
#[ignore = "long: cargo thorough"]
fn a_new_robot_is_level_as_soon_as_the_downlink_allows() {
    let mut paced = 0;
    for seed in 0..60 {
        let schedule = Schedule::newcomer(seed);
        for who in [Newcomer::Joins, Newcomer::Reboots] {
            let level = schedule.level_after(who);
            assert!(level.tiles > 0, "schedule {seed}: {level:?}");
            assert!(level.took <= level.bound(), "schedule {seed}, {who:?}: {level:?}");
            paced += u32::from(level.bytes > 2_000);
        }
    }
    assert!(paced > 10, "only {paced} cases were limited by the budget");
}
