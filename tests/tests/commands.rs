//! The server's commands reach a robot over a bad link and are answered; so do the robot's events and states reach
//! the server.

use ubimap_agent::{
    Bounds, Config, Memory, Parameter,
    locate::PoseSource,
    sense::{Exposure, SensorModel},
};
use ubimap_protocol::{
    link::Terms,
    message::{
        EventCode, ParameterAction, ParameterCommand, ParameterOutcome, ParameterValue, Path, Stop,
        Waypoint,
    },
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    channel::fault::Faults,
    run::heap::BOUNDS,
    server::{Command, CommandError},
};
use ubimap_tests::star::{Finds, Member, Star};

/// A robot with few readings and few tiles.
const SENSOR: SensorModel = SensorModel::Radial { first: -1.5, step: 0.1 };
const SMALL: Bounds = Bounds { readings: 30, own_tiles: 4, fused_tiles: 4, ..BOUNDS };

fn seconds(seconds: u64) -> Instant {
    Instant(0) + Duration::from_secs(seconds)
}

#[test]
fn commands_arrive_over_a_bad_link_and_parameters_are_reported() {
    let config = Config::new(RobotId(7), SENSOR, SMALL);
    for (seed, frame) in [(1, 250), (2, 250), (3, 32), (4, 32)] {
        let mut memory = Memory::new(&config.bounds);
        let terms =
            Terms { resolution: config.bounds.resolution, frame, server_epoch: 1, stores: false };
        let mut star = Star::new(terms, 1, seed);
        star.members.push(Member::new(config.robot, 0));
        let latency = Duration::from_millis(5);
        let bad = Faults {
            loss: 0.4,
            duplicate: 0.1,
            reorder: 0.2,
            corrupt: 0.05,
            latency,
            ..Faults::default()
        };
        star.members[0].up.weather(bad, seed);
        star.members[0].down.weather(bad, seed + 100);
        let stop = Command::Stop(Stop { number: 1, stop: true });
        assert_eq!(star.command(0, stop.clone()), Err(CommandError::NoSession(config.robot)));
        star.boot(0, config, &mut memory);
        star.run_until(seconds(20));

        let waypoint = Waypoint { x: Millimetres(100), y: Millimetres(-5) };
        let path = Path { number: 1, waypoints: [waypoint].into_iter().collect() };
        star.command(0, Command::Path(path.clone())).unwrap();
        star.command(0, stop).unwrap();
        if frame == 32 {
            let path = Path { number: 2, waypoints: [waypoint; 16].into_iter().collect() };
            let sent = star.command(0, Command::Path(path));
            assert_eq!(sent, Err(CommandError::TooLong(config.robot)));
        }
        let value = ParameterValue { parameter: Parameter::GateDistance as u16, value: 50 };
        let set = ParameterCommand { number: 9, action: ParameterAction::Set(value) };
        star.command(0, Command::Parameter(set)).unwrap();
        // Two more commands at the same time: both arrive.
        let value = |parameter, value| ParameterValue { parameter: parameter as u16, value };
        let values = [value(Parameter::GateTurn, 70), value(Parameter::Hold, 300)];
        for (number, value) in (10..).zip(values) {
            let set = ParameterCommand { number, action: ParameterAction::Set(value) };
            star.command(0, Command::Parameter(set)).unwrap();
        }
        let mut answered = Vec::new();
        while star.now() < seconds(60) {
            star.run_until(star.now() + Duration::from_millis(1));
            answered.extend(star.server().parameters(config.robot).map(|report| report.number));
            answered.dedup();
        }

        let commands = star.members[0].robot().unwrap().commands();
        assert!(commands.must_stop(), "seed {seed}");
        assert_eq!(commands.path(), Some(&path), "seed {seed}");
        let report = star
            .server()
            .parameters(config.robot)
            .unwrap_or_else(|| panic!("seed {seed}: no report"));
        assert_eq!((report.number, report.outcome), (11, ParameterOutcome::Done));
        assert_eq!(&report.values[..], &values[1..]);
        assert_eq!(answered, [9, 10, 11], "seed {seed}");

        star.command(0, Command::Stop(Stop { number: 2, stop: false })).unwrap();
        star.run_until(seconds(100));
        assert!(!star.members[0].robot().unwrap().commands().must_stop(), "seed {seed}");
    }
}

#[test]
fn readings_can_be_removed_remotely() {
    let sensor = SensorModel::Radial { first: -0.5, step: 0.01 };
    let pose_source = PoseSource::Odometry(Pose::default());
    let bounds = Bounds { readings: 100, own_tiles: 12, fused_tiles: 4, ..BOUNDS };
    let mut config = Config { pose_source, ..Config::new(RobotId(7), sensor, bounds) };
    // Makes the robot map every scan.
    config.gate.distance = Millimetres(0);
    let mut memory = Memory::new(&config.bounds);
    let terms =
        Terms { resolution: config.bounds.resolution, frame: 250, server_epoch: 1, stores: false };
    let mut star = Star::new(terms, 1, 5);
    star.members.push(Member::new(config.robot, 0));
    star.boot(0, config, &mut memory);
    star.run_until(seconds(5));
    let mut readings = [1_500; 100];
    readings[50..].fill(1_800);
    let mut invalid = |command: Option<(Parameter, i32)>| {
        if let Some((parameter, value)) = command {
            let value = ParameterValue { parameter: parameter as u16, value };
            let set = ParameterCommand { number: 1, action: ParameterAction::Set(value) };
            star.command(0, Command::Parameter(set)).unwrap();
        }
        star.run_until(star.now() + Duration::from_secs(2));
        let pixels = |star: &Star<'_>| star.members[0].robot().unwrap().statistics().pixels;
        let before = pixels(&star);
        let x = Millimetres(star.now().micros() as i32 / 100_000);
        star.scan(0, Some(Pose { x, ..Pose::default() }), &readings);
        let after = pixels(&star);
        assert_eq!(after.seen - before.seen, 100);
        after.invalid - before.invalid
    };
    assert_eq!(invalid(None), 0);
    assert_eq!(invalid(Some((Parameter::RemovedPixels, 10 << 16 | 14))), 5);
    // The bearings from 28.6 degrees to the right to straight ahead: beams 0 to 50.
    let bearings = (Angle::from_radians(-0.505).0 as i32) << 16 | 5;
    assert_eq!(invalid(Some((Parameter::RemovedBearings, bearings))), 51);
    assert_eq!(invalid(Some((Parameter::RemovedPixels, -1))), 51);
    assert_eq!(invalid(Some((Parameter::RemovedDistances, 1_700 << 16 | 1_900))), 100);
    assert_eq!(invalid(Some((Parameter::RemovedBearings, -1))), 50);
    assert_eq!(invalid(Some((Parameter::RemovedDistances, 0))), 0);
    // Masking by brightness is left to the caller, so no reading becomes invalid.
    assert_eq!(invalid(Some((Parameter::Exposure, 10 << 16 | 240))), 0);
    let exposure = star.members[0].robot().unwrap().settings().exposure;
    assert_eq!(exposure, Exposure { darkest: 10, brightest: 240 });
}

#[test]
fn an_event_arrives_once_over_a_bad_link_and_is_not_repeated_for_a_while() {
    let config = Config::new(RobotId(7), SENSOR, SMALL);
    for seed in 1..4 {
        let mut memory = Memory::new(&config.bounds);
        let terms = Terms {
            resolution: config.bounds.resolution,
            frame: 32,
            server_epoch: 1,
            stores: false,
        };
        let mut star = Star::new(terms, 1, seed);
        star.members.push(Member::new(config.robot, 0));
        let bad =
            Faults { loss: 0.4, duplicate: 0.1, reorder: 0.2, corrupt: 0.05, ..Faults::default() };
        star.members[0].up.weather(bad, seed);
        star.members[0].down.weather(bad, seed + 100);
        star.boot(0, config, &mut memory);
        for second in 20..60 {
            star.run_until(seconds(second));
            // The scan has a wrong number of readings, which is reported once every ten seconds.
            star.scan(0, None, &[1_000; 31]);
        }
        star.run_until(seconds(70));
        let events = star.server().events(config.robot).unwrap();
        let count = |code: EventCode| -> u32 {
            let of_code = events.newest().filter(|it| it.event.code == code as u16);
            of_code.map(|it| it.times).sum()
        };
        let all: u32 = events.newest().map(|it| it.times).sum();
        assert_eq!(events.count(), u64::from(all), "seed {seed}");
        assert_eq!((count(EventCode::Started), count(EventCode::SensorFault)), (1, 4));
    }
}

/// Another server counts time from another zero. The robot's newest pose has its time by the new server's clock,
/// although no camera of that server sees the robot: it stands.
#[test]
fn a_robot_that_stands_tells_its_pose_in_the_time_of_the_server_that_took_over() {
    let config = Config::new(RobotId(7), SENSOR, SMALL);
    let pose = Pose::from_metres(1.0, 2.0, 0.5);
    let tenth = Duration::from_millis(100);
    for seed in 1..=6 {
        let mut memory = Memory::new(&config.bounds);
        let terms = Terms {
            resolution: config.bounds.resolution,
            frame: 250,
            server_epoch: 1,
            stores: false,
        };
        let mut star = Star::new(terms, 1, seed);
        star.members.push(Member::new(config.robot, 0));
        star.boot(0, config, &mut memory);
        for _ in 0..100 {
            star.run_until(star.now() + tenth);
            star.fix(0, pose);
            star.scan(0, Some(Pose::default()), &[1_000; 30]);
        }
        assert!(star.server().state(config.robot).is_some_and(|it| it.pose.is_some()));
        // It has no disk: the new server starts with another clock, which may be ahead or behind.
        let before = star.server_now();
        star.restart_server(250, Finds::Disk, false);
        println!("seed {seed}: from {before:?} to {:?}", star.server_now());
        let mut told = 0;
        for _ in 0..200 {
            star.run_until(star.now() + tenth);
            star.scan(0, Some(Pose::default()), &[1_000; 30]);
            let Some(state) = star.server().state(config.robot) else { continue };
            let (Some(time), Some(_)) = (state.time, state.pose) else { continue };
            told += 1;
            let now = star.server_now();
            // A state is repeated every two seconds.
            let is_recent = time <= now && now.since(time) < Duration::from_millis(2_500);
            assert!(is_recent, "seed {seed}: at {now:?} the newest pose is of {time:?}");
        }
        assert!(told > 100, "seed {seed}: {told}");
    }
}
