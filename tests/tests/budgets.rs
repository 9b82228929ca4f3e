//! What a conversation costs on the wire.

use ubimap_agent::{Config, locate::PoseSource, sense::SensorModel};
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    channel::fault::Faults,
    run::fleet::{AgentMemory, Event, FUSED_TILES, Fleet, OWN_TILES, Stage},
};

/// Readings of a scan.
const BEAMS: usize = 30;

/// A robot that does nothing until some moment.
struct Idle(Option<Instant>);

impl Stage for Idle {
    fn next_event(&self) -> Option<Instant> {
        self.0
    }

    fn poll(&mut self, _: Instant) -> Option<Event> {
        self.0 = None;
        None
    }
}

/// A robot that stands still and looks at a wall, five times a second until some moment.
struct Standing {
    next: Instant,
    end: Instant,
    odometry_read: bool,
}

impl Stage for Standing {
    fn next_event(&self) -> Option<Instant> {
        (self.next <= self.end).then_some(self.next)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        self.next_event().filter(|next| *next <= now)?;
        self.odometry_read = !self.odometry_read;
        if self.odometry_read {
            return Some(Event::Odometry { robot: 0, pose: Pose::default() });
        }
        self.next = self.next + Duration::from_millis(200);
        Some(Event::Scan { robot: 0, readings: vec![1_000; BEAMS] })
    }
}

/// Bytes that a robot has sent after a stage, and the distance vectors that have come.
fn sent(mut stage: impl Stage, faults: Faults) -> (u64, u32) {
    let model = SensorModel::Radial { first: -1.5, step: 0.1 };
    let pose_source = PoseSource::Odometry(Pose::default());
    let config = Config { pose_source, ..Config::new(RobotId(1), model) };
    let mut memory = [AgentMemory::new(&config, BEAMS, OWN_TILES, FUSED_TILES)];
    let mut fleet = Fleet::new(&[config], &mut memory, faults, Millimetres(50), 1).unwrap();
    fleet.run(&mut stage, |_| {});
    let vectors = fleet.server().distance_vectors(RobotId(1));
    (fleet.robots()[0].agent().statistics().bytes_sent, vectors)
}

#[test]
fn an_idle_robot_sends_twenty_bytes_a_second_at_most() {
    let bad =
        Faults { loss: 0.3, duplicate: 0.05, reorder: 0.1, corrupt: 0.02, ..Faults::default() };
    for faults in [Faults::default(), bad] {
        let idle = |end| sent(Idle(Some(end)), faults);
        let standing = |end| sent(Standing { next: Instant(0), end, odometry_read: false }, faults);
        for (name, run) in [("idle", &idle as &dyn Fn(Instant) -> _), ("standing", &standing)] {
            // The first minute is for the clocks.
            let [(start, _), (end, vectors)] =
                [60, 660].map(|seconds| run(Instant(0) + Duration::from_secs(seconds)));
            let rate = (end - start) as f64 / 600.0;
            println!(
                "a robot, {name}: {rate:.1} bytes/s up, {vectors} distance vectors, loss {}",
                faults.loss
            );
            assert!(rate <= 20.0, "{name}: {rate} bytes/s");
            // One that has no scan sends none; one that stands still, one in a minute.
            let expected = if name == "idle" { 0..=0 } else { 5..=12 };
            assert!(expected.contains(&vectors), "{name}: {vectors}");
        }
    }
}
