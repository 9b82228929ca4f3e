//! A robot's map when the cameras lose it, mistake it, or it is carried.

use std::collections::VecDeque;

use ubimap_agent::{Bounds, Config, Memory, Statistics, sense::SensorModel};
use ubimap_protocol::{
    time::Duration,
    units::{Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    channel::fault::Faults,
    deployment,
    run::fleet::{Event, Fleet},
    run::heap::BOUNDS,
};
use ubimap_tests::{deployments::deployed, script::Script};

const READINGS: usize = 30;
const ROBOT: RobotId = RobotId(1);

/// A robot that drives back and forth along 2 m of a line.
struct Drive<'b> {
    fleet: Fleet<'b>,
    driven: u64,
}

impl Drive<'_> {
    /// Drives for some seconds, and returns the increase of the robot's counters. `seen` returns
    /// the position at which the cameras see the robot, given the distance driven in metres and the
    /// number of the frame.
    fn on(&mut self, seconds: u64, seen: impl Fn(f64, u64) -> Option<f64>) -> Statistics {
        let before = self.fleet.robots()[0].robot().statistics();
        let start = self.fleet.now() + Duration::from_millis(10);
        let mut events = VecDeque::new();
        for millis in (0..seconds * 1_000).step_by(10) {
            let now = start + Duration::from_millis(millis);
            self.driven += 10;
            // The robot drives back and forth at half a metre per second.
            let phase = (self.driven % 8_000) as f64 / 4_000.0;
            let along = 2.0 * if phase < 1.0 { phase } else { 2.0 - phase };
            if millis % 70 == 0
                && let Some(x) = seen(along, millis / 70)
            {
                let robots = vec![Sighting::usual(ROBOT, Pose::from_metres(x, 0.0, 0.0))];
                let observation =
                    Observation { camera: 0, captured: now, robots, ..Observation::default() };
                events.push_back((now, Event::Observation(observation)));
            }
            if millis % 50 == 0 {
                let pose = Pose::from_metres(along, 0.0, 0.0);
                events.push_back((now, Event::Odometry { robot: 0, pose }));
            }
            // After a pause, the wheels give a reading before the first scan.
            if millis % 200 == 100 {
                events.push_back((now, Event::Scan { robot: 0, readings: vec![2_000; READINGS] }));
            }
        }
        self.fleet.run(&mut Script(events), |_| {}).unwrap();
        let after = self.fleet.robots()[0].robot().statistics();
        println!("{after:?}");
        Statistics {
            mapped: after.mapped - before.mapped,
            unsure: after.unsure - before.unsure,
            expired: after.expired - before.expired,
            fixes: after.fixes - before.fixes,
            fixes_rejected: after.fixes_rejected - before.fixes_rejected,
            moves: after.moves - before.moves,
            ..after
        }
    }
}

#[test]
fn it_stops_mapping_before_it_is_lost_and_resumes_when_it_is_found() {
    let model = SensorModel::Radial { first: -1.5, step: 0.1 };
    let bounds = Bounds { readings: READINGS, ..BOUNDS };
    let config = Config::new(ROBOT, model, bounds).with_drive(None);
    let mut memory = [Memory::new(&bounds)];
    let faults = Faults { latency: Duration::from_millis(30), ..Faults::default() };
    // No fixes are derived from distance vectors.
    let deployment = deployment::Config {
        corrects_errors: false,
        ..deployment::Config::new(config.bounds.resolution)
    };
    let fleet = Fleet::new(&[config], &mut memory, faults, 1, deployed(deployment)).unwrap();
    let mut drive = Drive { fleet, driven: 0 };

    // Time for clock synchronisation, in view of the cameras.
    drive.on(5, |along, _| Some(along));
    let seen = drive.on(10, |along, _| Some(along));
    assert!(seen.mapped >= 45 && seen.unsure == 0, "{seen:?}");
    assert_eq!((seen.fixes_rejected, seen.moves), (0, 0));

    // One frame in ten is wrong. It is rejected, and everything is mapped as before.
    let mistaken =
        drive.on(10, |along, frame| Some(along + if frame % 10 == 9 { 4.0 } else { 0.0 }));
    assert_eq!((mistaken.fixes_rejected, mistaken.moves), (14, 0));
    assert!(mistaken.mapped >= 45 && mistaken.unsure == 0, "{mistaken:?}");

    // The robot leaves the view after one second, and keeps mapping until the deviation of its
    // heading is 3 degrees, after about 30 m. One second after its return to the view, it maps
    // again.
    let lost = drive.on(80, |along, frame| (frame < 15).then_some(along));
    assert!(lost.mapped >= 230 && lost.unsure >= 50, "{lost:?}");
    assert_eq!(lost.expired, 0);
    drive.on(1, |along, _| Some(along));
    let found = drive.on(5, |along, _| Some(along));
    assert!(found.mapped >= 20 && found.unsure == 0, "{found:?}");

    // The robot is carried away; its new position is accepted after five fixes.
    let carried = drive.on(10, |along, frame| Some(along + if frame < 50 { 0.0 } else { 5.0 }));
    assert_eq!((carried.fixes_rejected, carried.moves), (4, 1));
    let pose = drive.fleet.robots()[0].robot().pose().unwrap().1;
    assert!((5.0..=7.0).contains(&pose.x.metres()), "{pose:?}");
}
