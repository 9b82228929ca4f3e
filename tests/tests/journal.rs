//! The same inputs give the same bytes on a Cortex-M and on a PC: the journal of a robot that
//! explored a simulated room is replayed here and in the emulator.

use std::{cell::RefCell, rc::Rc};

use ubimap_agent::{Memory, Robot, drive::Driving};
use ubimap_protocol::{
    time::{Duration, Instant},
    units::RobotId,
};
use ubimap_sim_host::{
    channel::fault::Faults,
    deployment,
    run::{
        fleet::Fleet,
        heap::Heap,
        member::Entry,
        room_stage::RoomStage,
        simulate::{RESOLUTION, deployment_config},
    },
    server::coordination::Settings,
    world::{Scenario, World},
};
use ubimap_tests::{
    deployments::deployed,
    emulator::{Core, count, image, leave_out},
};

#[path = "../../agent/src/bin/bench/player.rs"]
mod player;

/// Two rooms with a door, a camera above the first, and a person who walks there.
const ROOMS: &str = r#"
    duration_s = 90.0
    slice_height_m = 0.2

    [room]
    height_m = 3.0
    outline_m = [[0.0, 0.0], [7.0, 0.0], [7.0, 4.0], [0.0, 4.0]]
    [[room.walls]]
    points_m = [[3.5, 0.0], [3.5, 1.4]]
    [[room.walls]]
    points_m = [[3.5, 2.6], [3.5, 4.0]]

    [[furniture]]
    footprint.box = { centre_m = [5.4, 2.0], size_m = [0.8, 0.6] }
    top_m = 1.5

    [[cameras]]
    position_m = [0.3, 2.0, 2.8]
    look_at_m = [1.6, 2.0, 0.0]
    range_m = 4.5

    [[robots]]
    id = 1
    start = { x_m = 1.0, y_m = 1.2, heading_deg = 0.0 }
    route.waypoints_m = [[1.5, 1.2]]
    sensor = { beams = 100, fov_deg = 78.0, rate_hz = 15.0 }

    [[people]]
    waypoints_m = [[2.2, 0.6], [2.2, 3.4]]
    pause_s = 4.0
"#;

/// Number of entries of each kind in which a bit is flipped.
const TRIED: usize = 8;

/// A journal, and the robot's outputs.
#[derive(Default)]
struct Session {
    journal: Vec<u8>,
    given: String,
    /// Number of entries of each kind.
    counts: [usize; 7],
    /// The kinds of the entries, and the offsets of their bodies in the journal.
    bodies: Vec<(u8, usize)>,
}

impl Session {
    fn note(&mut self, moment: Instant, entry: Entry<'_>) {
        match entry {
            Entry::Received(bytes) => {
                let body = [&(bytes.len() as u16).to_le_bytes(), bytes].concat();
                self.push(player::RECEIVED, moment, &body);
            }
            Entry::Odometry(pose) => {
                let place = [pose.x.0.to_le_bytes(), pose.y.0.to_le_bytes()].concat();
                self.push(
                    player::ODOMETRY,
                    moment,
                    &[&place[..], &pose.heading.0.to_le_bytes()].concat(),
                );
            }
            Entry::Scan(readings) => {
                let body: Vec<u8> = readings.iter().flat_map(|it| it.to_le_bytes()).collect();
                self.push(player::SCAN, moment, &body);
            }
            Entry::Timeout => self.push(player::TIMEOUT, moment, &[]),
            Entry::Transmit(frame) => {
                self.push(player::TRANSMIT, moment, &[]);
                if let Some(frame) = frame {
                    player::write_frame(frame, &mut self.given).unwrap();
                }
            }
            Entry::Commanded(command) => player::write_command(command, &mut self.given).unwrap(),
        }
    }

    fn push(&mut self, kind: u8, moment: Instant, body: &[u8]) {
        self.counts[usize::from(kind)] += 1;
        self.journal.push(kind);
        self.journal.extend(moment.0.to_le_bytes());
        self.bodies.push((kind, self.journal.len()));
        self.journal.extend(body);
    }
}

/// A robot that explores the rooms, over a channel that loses and damages frames.
fn session() -> Session {
    let scenario = Scenario::from_toml(ROOMS, "the rooms").unwrap();
    let world = World::new(&scenario, None, RESOLUTION, 1).unwrap();
    let config = player::config();
    let config = config.with_drive(Some(config.drive));
    let coordination = Some(Settings { view_m: 1.8, range_m: 2.0, ..Settings::default() });
    let deployment =
        deployment::Config { coordination, ..deployment_config(&scenario, &world, false) };
    let mut deployment = deployed(deployment);
    deployment.explore(RobotId(1), true);
    let latency = Duration::from_millis(20);
    let faults = Faults { latency, loss: 0.02, corrupt: 0.01, ..Faults::default() };
    let session = Rc::new(RefCell::new(Session::default()));
    let heard = Rc::clone(&session);
    let mut memory = [Memory::new(&config.bounds)];
    let mut fleet = Fleet::new(&[config], &mut memory, faults, 1, deployment).unwrap();
    fleet.keep_journal(0, Box::new(move |moment, entry| heard.borrow_mut().note(moment, entry)));
    let mut stage = RoomStage::new(world, Instant(0) + Duration::from_secs(80));
    stage.hand_over();
    fleet.run(&mut stage, |_| {}).unwrap();
    let end = fleet.now();
    drop(fleet);
    let mut session = session.take();
    session.push(player::END, end, &[]);
    session
}

/// The outputs of the robot on the host.
fn played(journal: &[u8]) -> String {
    let config = player::config();
    let mut memory = Memory::<Heap, Driving>::new(&config.bounds);
    let mut robot = Robot::new(config, &mut memory).unwrap();
    let mut bytes = journal.iter().copied();
    let mut given = String::new();
    player::play(&mut robot, || bytes.next(), &mut given).unwrap();
    given
}

/// Compares line by line.
#[track_caller]
fn assert_same(one: &str, other: &str) {
    for (number, (one, other)) in (1..).zip(one.lines().zip(other.lines())) {
        assert_eq!(one, other, "line {number}");
    }
    assert_eq!(one.lines().count(), other.lines().count());
}

#[test]
#[ignore = "runs an image in the emulator: cargo thorough"]
fn a_journal_gives_the_same_in_the_emulator_and_here() {
    let session = session();
    let [_, received, odometry, scans, ..] = session.counts;
    assert!(scans >= 1_000 && odometry > 1_000 && received > 500, "{:?}", session.counts);
    let given = played(&session.journal);
    // The robot that recorded the journal produced the same outputs; its tiles were not recorded.
    assert_same(&session.given, &given[..session.given.len()]);
    let lines = |kind: &str| given.lines().filter(|line| line.starts_with(kind)).count();
    let counts = ["sent", "wheels", "own", "fused"].map(lines);
    println!("frames, commands, own and fused tiles: {counts:?}");
    assert!(counts.iter().zip([200, 200, 5, 5]).all(|(count, least)| *count > least), "{counts:?}");

    let told = image("journal", Core::M4).and_then(|image| count(&image, session.journal));
    match told {
        Ok(told) => {
            let (_, told) = told.split_once('\n').unwrap();
            assert_same(told, &given);
        }
        Err(error) => leave_out("a journal in the emulator", &error),
    }
}

/// The number of entries of a kind, sampled over the session, in which a flipped bit changes the
/// outputs.
fn noticed(session: &Session, given: &str, (kind, offset, bit): (u8, usize, u8)) -> usize {
    let bodies: Vec<usize> =
        session.bodies.iter().filter(|(it, _)| *it == kind).map(|(_, body)| *body).collect();
    let differs = |body: usize| {
        let mut journal = session.journal.clone();
        journal[body + offset] ^= bit;
        played(&journal) != given
    };
    (1..=TRIED).filter(|part| differs(bodies[bodies.len() * part / (TRIED + 1)])).count()
}

#[test]
#[ignore = "long: cargo thorough"]
fn flipped_bits_are_detected() {
    let session = session();
    let given = played(&session.journal);
    // The bit is in a frame, in a position, or in a range (512 mm). Some flips have no effect: in
    // damaged frames, in odometry readings that are thinned out, and in scans at standstill, which
    // are not mapped.
    for (which, least) in [
        ((player::RECEIVED, 6, 0x10), TRIED / 2),
        ((player::ODOMETRY, 0, 0x40), TRIED / 2),
        ((player::SCAN, 101, 0x02), TRIED / 4),
    ] {
        let count = noticed(&session, &given, which);
        assert!(count >= least, "{count} of {TRIED}: {which:?}");
    }
}
