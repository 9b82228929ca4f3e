//! The firmware in an emulated STM32F405, over its serial port.

use std::{fs, path::Path, sync::Mutex, time::Duration};

use clap::Parser;

use ubimap_protocol::{
    tile::Epoch,
    units::{Millimetres, Pose, RobotId},
};

use ubimap_sim_host::{
    channel::serial::{SerialPort, SerialReader},
    channel::wire::{Wire, WireError, WireReader, WireWriter},
    channel::write_queue::WriteQueue,
    deployment::Life,
    report::Report,
    run::{
        options::SimulateOptions,
        serve::{Attached, CAPTURE_INTERVAL, Station},
        simulate,
    },
};
use ubimap_tests::{
    elf::Image,
    emulator::{Core, Emulator, EmulatorError, firmware, image, in_step, leave_out},
    seeds::seeds,
};

/// The firmware's robot id.
const ROBOT: RobotId = RobotId(1);
/// The firmware's cell size.
const RESOLUTION: Millimetres = Millimetres(50);

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: SimulateOptions,
}

/// Maximum sizes of an image in bytes: flash, and RAM with the stack.
///
/// The flash is the current size, rounded up to a KiB, and changes only in a commit that says why; the
/// targets are 72 and 96 KiB. The RAM is the target.
const FITS: [(&str, [usize; 2]); 2] =
    [("mapping", [79 * 1024, 24 * 1024]), ("firmware", [106 * 1024, 36 * 1024])];

/// Only one emulator runs at a time, because some of the runs are in real time, and all images are built at one place.
static ALONE: Mutex<()> = Mutex::new(());

/// The unmodified images map, and one drives, in the simulated room in real time, by the bytes of a simulated A010
/// and Create 2; and they fit.
#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn the_images_fit() {
    let mut table =
        String::from("| image | flash | static RAM | with the stack |\n|---|---|---|---|\n");
    for (name, [flash, ram]) in FITS {
        let run = match run(name) {
            Ok(run) => run,
            Err(error) => return leave_out("the firmware in the simulated room", &error),
        };
        let Run { image, stack, report } = run;
        assert!(image.symbols.iter().any(|name| name == "main"), "no symbols: {image:?}");
        assert_eq!(image.panics_and_heap(), [""; 0]);
        assert!(report.map.converged);

        let deep = image.ram + stack;
        let [kib, fixed, all] = [image.flash, image.ram, deep].map(|it| it as f64 / 1024.0);
        table += &format!("| {name} | {kib:.1} KiB | {fixed:.1} KiB | {all:.1} KiB |\n");
        assert!(image.flash <= flash, "{name}: {} bytes of flash", image.flash);
        assert!(deep <= ram, "{name}: {deep} bytes of RAM");
    }
    println!("{table}");
}

/// The image drives alone, in step with the simulation, without a collision, to the ground that no camera sees.
#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn the_image_maps_the_blind_ground() {
    let _alone = ALONE.lock();
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("in-step");
    fs::create_dir_all(&folder).unwrap();
    let command = match in_step(&folder, None) {
        Ok(command) => command,
        Err(error) => return leave_out("the firmware drives", &error),
    };
    println!("| seed | blind ground | F1 | poses, RMS | collisions |\n|---|---|---|---|---|");
    for seed in seeds(1) {
        let seed = seed.to_string();
        let line = ["simulate", "--robots", "1", "--ideal-cameras", "--in-step", &command];
        let report = report(line.into_iter().chain(["--seed", &seed, "--duration", "150"]));
        let (driving, truth, pose) =
            (report.driving.unwrap(), report.truth.unwrap(), report.pose.unwrap());
        println!(
            "| {seed} | {:.1} % | {:.3} | {:.1} cm, {:.2} degrees | {} |",
            100.0 * driving.blind_mapped,
            truth.f1_occupied,
            100.0 * pose.rmse_m,
            pose.rmse_deg,
            driving.collisions,
        );
        assert_eq!(driving.collisions, 0);
        assert!(driving.blind_mapped >= BLIND_MAPPED);
        assert!(report.map.converged);
    }
}

/// Minimum share of the blind ground mapped after 150 s, with any seed. The target is 0.95.
const BLIND_MAPPED: f64 = 0.8;

/// The report of a run.
fn report<'a>(line: impl Iterator<Item = &'a str>) -> Report {
    simulate::run(&CommandLine::parse_from(line).options).unwrap().report
}

/// A run of an image.
struct Run {
    image: Image,
    /// Maximum depth of its stack in bytes.
    stack: usize,
    report: Report,
}

/// Runs an image as the only robot of the default scenario, with ideal cameras, for 40 s of real time.
fn run(name: &str) -> Result<Run, EmulatorError> {
    let _alone = ALONE.lock();
    let path = image(name, Core::M4)?;
    let emulator = Emulator::start(&path)?;
    let image = Image::parse(&fs::read(path).unwrap()).unwrap();
    let ports = emulator.ports().each_ref().map(|port| port.display().to_string()).join(",");
    let line = ["simulate", "--robots", "1", "--ideal-cameras", "--outside", &ports];
    let report = report(line.into_iter().chain(["--duration", "40"]));
    let stack = emulator.stack(&image).unwrap();
    Ok(Run { image, stack, report })
}

#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn a_robot_gets_session_time_and_pose_again_from_the_next_server() {
    let _alone = ALONE.lock();
    let emulator = match firmware().and_then(|image| Emulator::start(&image)) {
        Ok(emulator) => emulator,
        Err(error) => return leave_out("the firmware's conversation with the server", &error),
    };

    let mut noise = Noise(1);
    let pose = Pose::from_metres(1.25, -0.5, 1.0);
    let mut station = station(&emulator, 7, pose, &mut noise);
    wait_for_pose(&mut station, pose, Duration::from_secs(20));
    // A robot with enough usable replies asks every 5 s; one without usable replies asks eight
    // times per second.
    let mut asked = (0, station.now());
    turn_until(&mut station, "the clocks agree", Duration::from_secs(60), |station| {
        let now = station.now();
        let times = station.deployment().server().time_requests(ROBOT);
        if times != asked.0 {
            asked = (times, now);
        }
        times >= 64 && now.since(asked.1).micros() >= 2_000_000
    });
    let report = station.report();
    assert!(report.ports[0].link.bad > 0, "no noise arrived: {report:?}");
    drop(station);

    // A restarted server has another epoch and another clock, so the robot's session and its time
    // from before are invalid.
    let pose = Pose::from_metres(-2.0, 3.0, -3.0);
    let mut station = self::station(&emulator, 8, pose, &mut noise);
    wait_for_pose(&mut station, pose, Duration::from_secs(20));
}

/// A server on the emulator's port, after noise was sent to the firmware.
fn station(emulator: &Emulator, epoch: u32, pose: Pose, noise: &mut Noise) -> Station {
    let mut port = SerialPort::open(&emulator.ports()[0], 115_200).unwrap();
    port.write(&noise.bytes(700)).unwrap();
    let (reader, writer) = port.split();
    let reader = NoisyReader { port: reader, noise: Noise(noise.next()), quiet: 0 };
    let writer = NoisyWriter { port: writer, noise: Noise(noise.next()), writes: 0 };
    let mut wire = Some(Wire { reader: Box::new(reader), writer: Box::new(writer) });
    // It is opened once: the emulator does not hang up.
    let opener = Box::new(move || Ok(wire.take().expect("the emulator has disconnected")));
    let attached = Attached::open("the firmware".into(), opener, Some(pose)).unwrap();
    Station::new(RESOLUTION, Life::new(Epoch(epoch)), (vec![attached], Vec::new()), None, None)
        .unwrap()
}

/// Waits until the robot reports the pose seen by the camera, at the capture time of a frame by the
/// server's clock.
#[track_caller]
fn wait_for_pose(station: &mut Station, pose: Pose, patience: Duration) {
    turn_until(station, "the robot knows its pose", patience, |station| {
        let state = station.deployment().server().state(ROBOT);
        let Some((found, time)) = state.and_then(|state| state.pose.zip(state.time)) else {
            return false;
        };
        assert_eq!(found, pose);
        assert!(time <= station.now() && station.now().since(time).micros() < 500_000, "{time:?}");
        // The first poses may be told with a better estimate of the clocks' difference than they were received with.
        time.micros().is_multiple_of(CAPTURE_INTERVAL.micros())
    });
}

#[track_caller]
fn turn_until(
    station: &mut Station,
    what: &str,
    patience: Duration,
    mut done: impl FnMut(&Station) -> bool,
) {
    let start = station.now();
    while !done(station) {
        let waited = Duration::from_micros(station.now().since(start).micros());
        assert!(waited < patience, "timeout while waiting until {what}: {:?}", station.report());
        assert!(station.is_attached(), "the emulator has disconnected");
        station.turn();
    }
}

/// Inserts noise into the received bytes after every [`QUIET_BYTES`]. The noise corrupts the frame that
/// follows it.
struct NoisyReader {
    port: SerialReader,
    noise: Noise,
    /// Bytes read since the last noise.
    quiet: usize,
}

/// Inserts noise before every fifth write.
struct NoisyWriter {
    port: WriteQueue,
    noise: Noise,
    writes: u32,
}

/// A Hello is five times shorter than this, so most of them arrive undamaged.
const QUIET_BYTES: usize = 150;

impl WireReader for NoisyReader {
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, WireError> {
        let noise = self.noise.bytes(5);
        let (head, rest) = buffer.split_at_mut(noise.len());
        let count = self.port.read_within(rest, wait)?;
        self.quiet += count;
        if count == 0 || self.quiet < QUIET_BYTES {
            buffer.copy_within(noise.len()..noise.len() + count, 0);
            return Ok(count);
        }
        self.quiet = 0;
        head.copy_from_slice(&noise);
        Ok(noise.len() + count)
    }
}

impl WireWriter for NoisyWriter {
    fn write(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        self.writes += 1;
        if self.writes.is_multiple_of(5) {
            let length = self.noise.next() % 300;
            let noise = self.noise.bytes(length as usize);
            self.port.write(&noise)?;
        }
        self.port.write(bytes)
    }
}

/// Pseudo-random bytes from a linear congruential generator.
struct Noise(u32);

impl Noise {
    fn next(&mut self) -> u32 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        self.0 >> 8
    }

    fn bytes(&mut self, count: usize) -> Vec<u8> {
        (0..count).map(|_| (self.next() >> 8) as u8).collect()
    }
}
