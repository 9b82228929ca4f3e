//! The same inputs give the same bytes on microcontrollers and on a PC: the journals of a robot in the
//! simulation and of the firmware in the emulator are replayed here and on three emulated cores.

use std::{
    cell::{Cell, RefCell},
    fs,
    path::{Path, PathBuf},
    rc::Rc,
};

use clap::Parser;
use configuration::{BOUNDS, SLICE_LENGTH};
use driving::driving;
use ubimap_agent::{
    Memory, Port,
    drive::Driving,
    journal::{Entry, Reader, Writer},
};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    time::{Duration, Instant},
    units::RobotId,
};
use ubimap_sim_host::{
    channel::fault::Faults,
    deployment,
    run::{
        fleet::{Bodies, Fleet},
        heap::Heap,
        options::SimulateOptions,
        room_stage::RoomStage,
        simulate::{self, RESOLUTION, deployment_config},
    },
    server::coordination::Settings,
    world::{Scenario, World},
};
use ubimap_tests::{
    deployments::deployed,
    emulator::{Core, in_step, leave_out, replay},
};

#[path = "../../agent/src/bin/firmware/configuration.rs"]
mod configuration;
// Its features are the images'; this robot has none of them.
#[allow(unexpected_cfgs)]
#[path = "../../agent/src/bin/firmware/driving.rs"]
mod driving;
#[path = "../../agent/src/bin/bench/player.rs"]
mod player;

/// Two rooms with a door, a camera above the first, and a person who walks there.
const ROOMS: &str = r#"
    duration_s = 130.0
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
    sensor.preset = "tof100"

    [[people]]
    waypoints_m = [[2.2, 0.6], [2.2, 3.4]]
    pause_s = 4.0
"#;

/// Number of entries of each kind in which a bit is flipped.
const TRIED: usize = 8;

/// The length of the random number at a journal's beginning.
const NONCE: usize = 4;

/// Where a test keeps its journal.
fn folder(test: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("journal").join(test);
    fs::create_dir_all(&folder).unwrap();
    folder
}

/// The journal of a simulated robot that explores the rooms, over a channel that loses and damages
/// frames.
fn simulated() -> Vec<u8> {
    let mut scenario = Scenario::from_toml(ROOMS, "the rooms").unwrap();
    scenario.robots[0] = scenario.robots[0].on_create2(BOUNDS.readings);
    let world = World::new(&scenario, None, RESOLUTION, 1).unwrap();
    let nonce = 77_u32;
    let config = configuration::config(nonce).with_drive(Some(driving()));
    let coordination = Some(Settings { view_m: 1.8, range_m: 2.0, ..Settings::default() });
    let deployment =
        deployment::Config { coordination, ..deployment_config(&scenario, &world, false) };
    let mut deployment = deployed(deployment);
    deployment.explore(RobotId(1), true);
    let latency = Duration::from_millis(20);
    let faults = Faults { latency, loss: 0.02, corrupt: 0.01, ..Faults::default() };
    let journal = Rc::new(RefCell::new((Writer::new(), nonce.to_le_bytes().to_vec())));
    let kept = Rc::clone(&journal);
    let (mut memory, mut buffers) = ([Memory::new(&config.bounds)], [[0; SLICE_LENGTH]]);
    let configs = [config];
    let mut fleet = Fleet::of_bodies(
        &configs,
        &mut memory,
        Bodies::Machines(&mut buffers),
        faults,
        1,
        deployment,
    )
    .unwrap();
    let note = move |now, entry: Entry<'_>| {
        let (writer, journal) = &mut *kept.borrow_mut();
        writer.write(now, entry, |bytes| journal.extend(bytes));
    };
    fleet.keep_journal(0, Box::new(note));
    let mut stage = RoomStage::new(world, Instant(0) + Duration::from_secs(110));
    stage.hand_over();
    fleet.run(&mut stage, |_| {}).unwrap();
    drop(fleet);
    let (_, journal) = journal.take();
    ended(journal)
}

/// A journal up to its last complete entry, with an end.
fn ended(mut journal: Vec<u8>) -> Vec<u8> {
    let (_, complete) = entries(&journal);
    journal.truncate(complete);
    Writer::new().write(Instant(0), Entry::End, |bytes| journal.extend(bytes));
    journal
}

/// The ports of a journal's received bytes with the offsets after them, and the offset after the last
/// complete entry.
fn entries(journal: &[u8]) -> (Vec<(Port, usize)>, usize) {
    let offset = Cell::new(NONCE);
    let next = || {
        let byte = journal.get(offset.get()).copied();
        offset.set(offset.get() + usize::from(byte.is_some()));
        byte
    };
    let mut reader = Reader::new(next);
    let mut buffer = [0; DEFAULT_FRAME];
    let (mut received, mut complete) = (Vec::new(), NONCE);
    while let Ok((_, entry)) = reader.entry(&mut buffer) {
        match entry {
            Entry::Received(port, _) => received.push((port, offset.get())),
            Entry::Timeout | Entry::Transmitted(..) => {}
            Entry::End => break,
        }
        complete = offset.get();
    }
    (received, complete)
}

/// The outputs of the robot on the host.
fn played(journal: &[u8]) -> String {
    let mut memory = Memory::<Heap, Driving>::new(&BOUNDS);
    let mut slice = [0; SLICE_LENGTH];
    let mut bytes = journal.iter().copied();
    let mut given = String::new();
    player::play(&mut memory, &mut slice, || bytes.next(), &mut given, &mut ()).unwrap();
    given
}

/// Minimum numbers of lines of each kind.
const LEAST: [(&str, usize); 5] =
    [("server", 200), ("sensor", 4), ("wheels", 500), ("own", 5), ("fused", 5)];

/// Checks that the replay transmitted what the journal says, and that the robot was busy.
#[track_caller]
fn assert_repeats(given: &str) {
    let lines = |kind| given.lines().filter(move |line| line.starts_with(kind));
    assert_eq!(lines("but recorded").next(), None);
    for (kind, least) in LEAST {
        let count = lines(kind).count();
        println!("{count:>6} {kind}");
        assert!(count >= least, "{count} {kind}");
    }
    let scans = lines("scans").next().unwrap();
    println!("{scans}");
    assert!(scans.split(' ').nth(1).unwrap().parse::<usize>().unwrap() >= 1_000, "{scans}");
}

/// Compares line by line.
#[track_caller]
fn assert_same<'a>(one: impl Iterator<Item = &'a str>, mut other: impl Iterator<Item = &'a str>) {
    for (number, one) in (1..).zip(one) {
        assert_eq!(Some(one), other.next(), "line {number}");
    }
    assert_eq!(other.next(), None);
}

/// Whether a line says how many instructions the robot took, which only the cores count.
fn is_count(line: &str) -> bool {
    line.starts_with("instructions ")
}

/// Maximum numbers of instructions on a core, by the call of the robot.
const BOUNDS_OF_CALLS: [(Core, &str, u64); 2] =
    [(Core::M4, "a step of the drive", 300_000), (Core::M0, "a step of the drive", 1_500_000)];

/// Prints the instructions that the robot took, and checks their bounds.
#[track_caller]
fn assert_within(core: Core, told: &str) {
    for line in told.lines().filter(|line| is_count(line)) {
        println!("{core:?}: {line}");
        let (count, name) = line.split_once(": ").unwrap();
        let most: u64 = count.split(' ').nth(1).unwrap().parse().unwrap();
        for (_, _, bound) in BOUNDS_OF_CALLS.iter().filter(|it| (it.0, it.1) == (core, name)) {
            assert!(most <= *bound, "{core:?}: {line}");
        }
    }
}

/// Compares the outputs on the emulated cores with those here.
fn assert_same_on_all_cores(folder: &Path, journal: &[u8], given: &str) {
    fs::write(folder.join("journal"), journal).unwrap();
    for core in [Core::M4, Core::M0, Core::M33, Core::RiscV] {
        match replay(core, folder) {
            Ok(told) => {
                assert_within(core, &told);
                assert_same(told.lines().filter(|line| !is_count(line)), given.lines());
            }
            Err(error) => leave_out(&format!("a journal on an emulated {core:?}"), &error),
        }
    }
}

#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn a_journal_gives_the_same_on_four_cores_and_here() {
    let journal = simulated();
    let given = played(&journal);
    assert_repeats(&given);
    assert_same_on_all_cores(&folder("simulated"), &journal, &given);
}

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: SimulateOptions,
}

/// The firmware in the emulator, driving in the simulated room, does what the same robot does here.
#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn the_firmwares_journal_is_repeated_here() {
    let folder = folder("firmware");
    let written = folder.join("written");
    let command = match in_step(&folder, Some(&written)) {
        Ok(command) => command,
        Err(error) => return leave_out("the firmware's journal", &error),
    };
    let line = ["simulate", "--robots", "1", "--ideal-cameras", "--in-step", &command];
    let options = CommandLine::parse_from(line.into_iter().chain(["--duration", "110"])).options;
    let report = simulate::run(&options).unwrap().report;
    println!("{:?}", report.driving);
    let journal = ended(fs::read(&written).unwrap());
    println!("{} bytes", journal.len());
    let given = played(&journal);
    assert_repeats(&given);
}

/// The number of entries of received bytes, sampled over the journal, in which a flipped bit of the
/// last byte changes the outputs.
fn noticed(journal: &[u8], given: &str, port: Port) -> usize {
    let (received, _) = entries(journal);
    let ends = received.into_iter().filter_map(|(it, end)| (it == port).then_some(end));
    let ends: Vec<usize> = ends.collect();
    let differs = |end: usize| {
        let mut journal = journal.to_vec();
        journal[end - 1] ^= 0x10;
        played(&journal) != given
    };
    (1..=TRIED).filter(|part| differs(ends[ends.len() * part / (TRIED + 1)])).count()
}

#[test]
#[ignore = "long: cargo real-time"]
fn flipped_bits_are_detected() {
    let journal = simulated();
    let given = played(&journal);
    // A flip breaks the checksum of a frame, which is then lost. Some flips have no effect: in frames
    // that the channel has damaged already.
    // The wheels' counts are totals, so most often the next frame makes up for a lost one.
    for (port, least) in
        [(Port::Server, TRIED / 2), (Port::Sensor, TRIED / 2), (Port::Wheels, TRIED / 8)]
    {
        let count = noticed(&journal, &given, port);
        println!("{count} of {TRIED}: {port:?}");
        assert!(count >= least, "{count} of {TRIED}: {port:?}");
    }
}
