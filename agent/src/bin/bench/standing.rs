//! Instruction counts of a robot at standstill with an unchanged view: the whole robot, from a
//! scan's readings on.

use core::hint::black_box;

use ubimap_agent::{Config, Memory, Robot, Storage, locate::PoseSource, sense::SensorModel};
use ubimap_protocol::{
    time::Instant,
    units::{Pose, RobotId},
};

use super::{counter::Bench, planes::BOUNDS};

/// Measures a scan that is not mapped, after one that was. `None` if either is not as expected.
///
/// Not inlined, like the other stages with a robot: their stack frames would add up.
#[inline(never)]
pub(super) fn run(
    bench: &mut Bench,
    memory: &mut Memory<impl Storage>,
    sensor: SensorModel,
    readings: &[u16],
) -> Option<()> {
    let pose_source = PoseSource::Odometry(Pose::default());
    let config = Config { pose_source, ..Config::new(RobotId(1), sensor, BOUNDS) };
    let mut robot = Robot::new(config, memory).ok()?;
    for frame in 1..=3u64 {
        let now = Instant(frame * 66_667);
        robot.odometry(now, Pose::default(), now);
        let mut scan = || robot.scan(now, black_box(readings), now);
        match frame {
            3 => bench.measure("a row of 640 from a robot that stands and sees no change", scan),
            _ => scan(),
        }
        .ok()?;
    }
    let count = robot.statistics();
    (count.mapped == 1 && count.gated == 2).then_some(())
}
