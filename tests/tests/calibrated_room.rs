//! Cameras calibrated by what they see of robots: in a recording, and before a simulation.
//!
//! This command prints the table of `tests/README.md`, and fails if a figure exceeds its bound:
//!
//! ```sh
//! UBIMAP_SEEDS=4 cargo test --release -p ubimap-tests --test calibrated_room -- --nocapture --include-ignored
//! ```

use std::{
    fs,
    path::{Path, PathBuf},
};

use clap::Parser;
use nalgebra::Isometry3;
use ubimap_sim_host::{
    camera::{CamerasFile, MountedCamera},
    report::Report,
    run::{
        calibrate::{self, options::CalibrateOptions},
        options::{SimulateOptions, WatchOptions},
        simulate, watch,
    },
};
use ubimap_tests::seeds::seeds;

/// Maximum errors of a camera: metres and degrees.
const BOUND: [f64; 2] = [0.010, 0.2];

#[derive(Parser)]
struct Simulate {
    #[command(flatten)]
    options: SimulateOptions,
}

#[derive(Parser)]
struct Calibrate {
    #[command(flatten)]
    options: CalibrateOptions,
}

#[derive(Parser)]
struct Watch {
    #[command(flatten)]
    options: WatchOptions,
}

fn simulated(words: &[&str]) -> Report {
    let line = ["simulate"].iter().chain(words);
    simulate::run(&Simulate::parse_from(line).options).unwrap().report
}

#[test]
#[ignore = "long: cargo camera-server"]
fn a_room_on_calibrated_cameras_is_as_good() {
    println!("| seed | true poses | calibrated | cameras within |\n|---|---|---|---|");
    for seed in seeds(1) {
        let seed = seed.to_string();
        let words = ["--scripted", "--duration", "60", "--seed", &seed];
        let run = |more: &[&str]| simulated(&[&words, more].concat());
        let [exact, found] = [run(&[]), run(&["--calibrate"])];
        let [before, after] = [&exact, &found].map(|it| it.truth.unwrap().f1_occupied);
        let errors = found.calibration.unwrap();
        let (millimetres, degrees) = (1000.0 * errors.position_m, errors.angle_deg);
        println!(
            "| {seed} | {before:.3} | {after:.3} | {millimetres:.1} mm, {degrees:.3} degrees |"
        );
        assert!(errors.position_m < BOUND[0] && errors.angle_deg < BOUND[1], "{errors:?}");
        assert!((before - after).abs() < 0.01, "seed {seed}: {before}, {after}");
    }
}

/// Two cameras that look at each other over a robot that drives round and round.
const TWO_CAMERAS: &str = "
duration_s = 25.0
slice_height_m = 0.2
[room]
height_m = 3.0
wall_thickness_m = 0.1
outline_m = [[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]]
[[cameras]]
position_m = [1.4, 2.0, 2.8]
heading_deg = 0.0
tilt_deg = 70.0
[[cameras]]
position_m = [4.6, 2.0, 2.7]
heading_deg = 180.0
tilt_deg = 68.0
[[robots]]
id = 4
start = { x_m = 2.7, y_m = 1.3 }
route.waypoints_m = [[3.3, 1.3], [3.3, 2.7], [2.7, 2.7]]
";

fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("calibrated").join(name);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    folder
}

/// The poses that `ubimap calibrate` finds in a recording, and the file of them.
fn calibrated(recording: &Path) -> (Vec<Isometry3<f64>>, PathBuf) {
    let options = Calibrate::parse_from(["calibrate".as_ref(), recording.as_os_str()]).options;
    let outcome = calibrate::run(&options).unwrap();
    println!("{}", outcome.report);
    assert!(outcome.report.is_complete());
    let path = recording.with_extension("toml");
    fs::write(&path, &outcome.cameras).unwrap();
    let file = CamerasFile::parse(&outcome.cameras).unwrap();
    (file.cameras.iter().map(|it| MountedCamera::pose(it).unwrap()).collect(), path)
}

/// Asserts that the second camera is where it should be relative to the first one.
#[track_caller]
fn assert_close(poses: &[Isometry3<f64>], truth: &[Isometry3<f64>], bound: [f64; 2]) {
    let [found, truth] = [poses, truth].map(|it| it[0].inv_mul(&it[1]));
    let metres = (found.translation.vector - truth.translation.vector).norm();
    let degrees = found.rotation.angle_to(&truth.rotation).to_degrees();
    println!("{:.1} mm, {degrees:.3} degrees", 1000.0 * metres);
    assert!(metres < bound[0] && degrees < bound[1], "{metres} m, {degrees} degrees");
}

#[test]
#[ignore = "long: cargo thorough"]
fn a_recording_gives_the_poses_of_its_cameras() {
    let folder = folder("recording");
    let scenario = folder.join("two.toml");
    fs::write(&scenario, TWO_CAMERAS).unwrap();
    let recording = folder.join("frames");
    let [scenario_path, frames] = [&scenario, &recording].map(|path| path.to_str().unwrap());
    simulated(&[scenario_path, "--scripted", "--record", frames]);
    let file = CamerasFile::parse(TWO_CAMERAS).unwrap();
    let truth: Vec<_> = file.cameras.iter().map(|it| it.pose().unwrap()).collect();
    assert_close(&calibrated(&recording).0, &truth, BOUND);

    // Without any pose the pictures count as taken by the depth sensor, which is 15 mm beside it.
    for camera in ["camera-00", "camera-01"] {
        let camera = recording.join(camera);
        fs::remove_file(camera.join("pose.txt")).unwrap();
        let line: [&std::ffi::OsStr; 2] = ["calibrate".as_ref(), recording.as_os_str()];
        let refused = calibrate::run(&Calibrate::parse_from(line).options).unwrap_err();
        assert!(refused.to_string().contains("no pose.txt"), "{refused}");
        fs::remove_file(camera.join("color/pose.txt")).unwrap();
    }
    let (poses, path) = calibrated(&recording);
    assert_close(&poses, &truth, [0.040, 0.4]);

    // Its origin is below the first camera, with the x axis in the direction in which that looks.
    assert!(poses[0].translation.vector.xy().norm() < 1e-9);
    assert!((poses[0].translation.vector.z - 2.8).abs() < 0.01);
    let line = [frames, "--cameras", path.to_str().unwrap()];
    let options = Watch::parse_from(["watch"].iter().chain(&line)).options;
    let report = watch::run(&options).unwrap().report;
    assert!(report.map.known > 1_000 && report.robots.len() == 1, "{:?}", report.map);
}
