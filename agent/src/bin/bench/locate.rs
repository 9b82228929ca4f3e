//! Instruction counts of the filter: a late fix, odometry, and the pose of a scan.

use core::hint::black_box;

use ubimap_agent::locate::{
    FixOutcome, Located, Locator, OdometryNoise, PoseSource, UncertaintyLimit,
};
use ubimap_protocol::{
    message::Certainty,
    time::Instant,
    units::{Angle, Millimetres, Pose},
};

use super::counter::Bench;

/// A robot drives along a curve, with odometry at 20 Hz and fixes at 15 Hz. One fix is 100 ms late,
/// or as late as the filter accepts. Then the pose of a scan is requested.
#[inline(never)]
pub(super) fn run(bench: &mut Bench) -> Option<()> {
    let at = |millis: i32| Pose {
        x: Millimetres(millis / 2),
        y: Millimetres(millis / 7),
        heading: Angle(millis as u16),
    };
    let certainty = Certainty { x: 20, y: 20, heading: 182 };
    let moment = |millis: i32| Instant(millis as u64 * 1_000);
    for lateness in [100, 500] {
        let limit = UncertaintyLimit::default();
        let mut locator = Locator::new(PoseSource::Fixes, &OdometryNoise::default(), limit);
        let fix = |locator: &mut Locator, millis: i32| {
            let then = moment(millis);
            locator.fix(then, Some(then), at(millis), certainty, then).ok()
        };
        let now = 2_020;
        let late = now - lateness;
        for millis in 0..=now {
            if millis % 50 == 0 {
                locator.odometry(moment(millis), at(millis)).ok()?;
            }
            if (millis - late) % 67 == 0 && millis != late && millis > 0 {
                fix(&mut locator, millis)?;
            }
        }
        let taken = bench.measure(format_args!("a pose fix, late by {lateness} ms"), || {
            fix(&mut locator, black_box(late))
        });
        (taken?.0 == FixOutcome::Taken).then_some(())?;
        bench
            .measure("a reading of the odometry", || {
                locator.odometry(black_box(moment(now + 30)), at(now + 30))
            })
            .ok()?;
        let found = bench.measure("the pose of a scan since", || {
            locator.at(black_box(moment(now)), moment(now + 30), true)
        });
        matches!(found, Located::At(..)).then_some(())?;
    }
    Some(())
}
