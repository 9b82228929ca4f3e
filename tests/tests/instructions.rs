//! Instruction counts from images in the emulator: those of `cargo instructions`, and the coder's
//! over the tile updates of a recorded log.

use std::{
    cell::RefCell,
    rc::Rc,
    sync::{Mutex, PoisonError},
};

use clap::Parser;
use ubimap_agent::sense::SensorModel;
use ubimap_sim_host::{
    recording::{self, Slicing, UpAxis},
    run::{options::ReplayOptions, replay},
};
use ubimap_tests::{
    data,
    emulator::{Core, EmulatorError, count, image, leave_out, lines, sealed_image},
    updates::{Gathering, Update},
};

/// Limits on the lines of the tables; a line is selected by the beginning and the end of its name.
const BOUNDS: [(&str, &str, u64); 20] = [
    ("a row of 640 to planes", "", 25_000),
    ("a row of 640 from a robot that stands", "", 2_500),
    // With the conversion of the row, this makes half a million.
    ("the tiles that fit a frame", "", 475_000),
    ("a grey image", "", 600_000),
    ("a pose fix", "", 6_600),
    ("the pose of a scan", "", 13_220),
    ("a plan across a window", "", 400_000),
    ("no plan", "", 400_000),
    ("a step along a path", "", 15_000),
    ("bytes of a planner", "", 8 * 1_024),
    ("a new tile", "to bytes", 150_000),
    ("its ", "bytes to a tile", 150_000),
    ("a tile update", "the most", 150_000),
    ("a tile update", "", 40_000),
    ("", "bytes of link state", 4_096),
    ("bytes of a robot", "default bounds", 62 * 1_024),
    ("bytes of it that are not tiles", "default bounds", 12 * 1_024),
    ("bytes of a robot", "small bounds", 18 * 1_024),
    ("bytes of a tile of its own", "", 768),
    ("bytes of a fused tile", "", 400),
];

/// Folders of recorded depth frames, and the limit on the middle row of a frame on new ground. The
/// target is 25,000. Higher limits are the current counts; they may only be lowered.
const RECORDED: [(&str, u64); 3] =
    [("rgbd_redwood", 25_000), ("rgbd_frames/icl_nuim", 25_000), ("rgbd_frames/handheld", 34_700)];

/// The bench with seals is built where the one without is, so only one of them may be built and run at a
/// time.
static BENCH: Mutex<()> = Mutex::new(());

/// Only every fourth update is measured, because transferring an update to the emulator takes
/// longer than coding it.
const SAMPLE: usize = 4;

/// Marks the end of the updates.
const END: u8 = 255;

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: ReplayOptions,
}

#[test]
#[ignore = "runs an image in the emulator: cargo thorough"]
fn no_stage_takes_more_than_its_bound() {
    let _alone = BENCH.lock().unwrap_or_else(PoisonError::into_inner);
    match image("bench", Core::M4).and_then(|image| count(&image, Vec::new())) {
        Ok(table) => assert_eq!(bounded(&table), 29, "{table}"),
        Err(error) => leave_out("the stages' instruction counts", &error),
    }
}

#[test]
#[ignore = "runs an image in the emulator: cargo thorough"]
fn sealing_and_opening_a_frame_take_no_more_than_their_bound() {
    let _alone = BENCH.lock().unwrap_or_else(PoisonError::into_inner);
    let table = match sealed_image("bench").and_then(|image| count(&image, Vec::new())) {
        Ok(table) => table,
        Err(error) => return leave_out("the instruction counts of sealed frames", &error),
    };
    let frames: Vec<_> =
        lines(&table).filter(|(_, name)| name.starts_with("a frame of 250 bytes")).collect();
    assert_eq!(frames.len(), 2, "{table}");
    frames.iter().for_each(|(number, name)| assert!(*number <= 40_000, "{name}: {number}"));
}

#[test]
#[ignore = "runs an image in the emulator: cargo thorough"]
fn no_tile_update_of_a_recorded_log_takes_more_than_its_bound() {
    let Some(log) = data::file("carmen_corrected/intel-corrected.log.gz") else { return };
    match updates_table(&log) {
        Ok(table) => assert_eq!(bounded(&table), 8, "{table}"),
        Err(error) => leave_out("the coder's instruction counts over a log", &error),
    }
}

#[test]
#[ignore = "runs an image in the emulator: cargo thorough"]
fn no_row_of_a_recorded_frame_takes_more_than_its_bound() {
    let (mut input, mut bounds) = (Vec::new(), Vec::new());
    for (folder, bound) in RECORDED {
        let Some(frames) = data::frames(folder) else { return };
        let slicing = Slicing { up: UpAxis::Cameras, ..Slicing::default() };
        let log = recording::read(frames.path(), None, slicing).unwrap();
        let SensorModel::Pinhole { focal, centre } = log.sensor.model() else {
            panic!("{:?}", log.sensor)
        };
        for scan in &log.scans {
            input.push(1);
            input.extend([focal, centre].iter().flat_map(|number| number.to_le_bytes()));
            input.extend(scan.readings_mm.iter().flat_map(|reading| reading.to_le_bytes()));
            bounds.push(bound);
        }
    }
    input.push(END);
    let table = match image("recorded", Core::M4).and_then(|image| count(&image, input)) {
        Ok(table) => table,
        Err(error) => return leave_out("the instruction counts of recorded rows", &error),
    };
    print!("{table}");
    let new: Vec<_> = lines(&table).filter(|(_, name)| name.ends_with("new")).collect();
    assert_eq!(new.len(), bounds.len(), "{table}");
    for ((number, name), bound) in new.into_iter().zip(bounds) {
        assert!(number <= bound, "{name}: {number}");
    }
}

fn updates_table(log: &std::path::Path) -> Result<String, EmulatorError> {
    let image = image("updates", Core::M4)?;
    let mut input = Vec::new();
    updates(log).iter().step_by(SAMPLE).for_each(|update| update.write(&mut input));
    input.push(END);
    count(&image, input)
}

/// The tile updates of three robots and their server on lossless links.
fn updates(log: &std::path::Path) -> Vec<Update> {
    let words = ["replay".into(), log.as_os_str().to_owned(), "--robots".into(), "3".into()];
    let options = CommandLine::parse_from(words).options;
    let gathering = Rc::new(RefCell::new(Gathering::default()));
    let heard = Rc::clone(&gathering);
    let tap = move |robot, direction, frame: &[u8]| {
        heard.borrow_mut().hear(robot, direction, frame);
    };
    replay::run_tapped(&options, Box::new(tap)).unwrap();
    gathering.take().updates()
}

/// Prints a table and compares its lines with their limits. Returns the number of lines with a
/// limit.
fn bounded(table: &str) -> usize {
    print!("{table}");
    let bound = |name: &str| {
        BOUNDS.into_iter().find(|(start, end, _)| name.starts_with(start) && name.ends_with(end))
    };
    let bounded = lines(table).filter_map(|(number, name)| Some((number, name, bound(name)?.2)));
    bounded.inspect(|(number, name, bound)| assert!(number <= bound, "{name}: {number}")).count()
}
