//! A recording that `ubimap serve` plays gives what `ubimap watch` gives, digest for digest: real processes, in real
//! time and faster.

use std::{
    fmt::Write,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::Value;

#[path = "../../tests/src/data.rs"]
#[allow(dead_code, unreachable_pub, reason = "public in `tests`, whose file it is")]
mod data;

const SCENARIO: &str = include_str!("two_cameras.toml");

/// The scenario, over a number of seconds.
fn lasting(seconds: u32) -> String {
    let stated = "duration_s = 7";
    assert!(SCENARIO.contains(stated));
    SCENARIO.replace(stated, &format!("duration_s = {seconds}"))
}

/// A new folder for the files of a test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    folder
}

fn run(folder: &Path, arguments: &[&str]) -> Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    let output = command.current_dir(folder).args(arguments).output().unwrap();
    let words = String::from_utf8_lossy(&output.stderr);
    // Serving without robots ends with 1.
    assert!(output.status.code().is_some_and(|code| code < 2), "{words}");
    serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{words}"))
}

/// What must be the same: for each camera its frames, its looks and the digest of what was seen, and the map's
/// digest.
fn seen(report: &Value) -> Value {
    let of_camera = |camera: &Value| {
        let of = |key: &str| camera[key].clone();
        Value::from_iter([of("frames"), of("looks"), of("digest")])
    };
    let cameras = report["cameras"].as_array().unwrap().iter();
    cameras.map(of_camera).chain([report["map"]["digest"].clone()]).collect()
}

fn watched(folder: &Path) -> Value {
    run(folder, &["watch", "rec", "--trust-floor", "never", "--json", "--out", "watched"])
}

/// Serves the cameras of `rec` with its robots until the end of the recording.
fn served(folder: &Path, speed: u32, duration_s: u32) -> Value {
    let mut text =
        format!("out = 'served'\nplayback = {{ every_frame = true, speed = {speed}.0 }}\n");
    let mut cameras: Vec<PathBuf> =
        fs::read_dir(folder.join("rec")).unwrap().map(|entry| entry.unwrap().path()).collect();
    cameras.retain(|path| path.is_dir());
    cameras.sort();
    for path in cameras {
        let name = path.file_name().unwrap().to_str().unwrap();
        writeln!(text, "[[cameras]]\nname = '{name}'\nsource = 'folder:rec/{name}'").unwrap();
    }
    text += &fs::read_to_string(folder.join("rec/robots.toml")).unwrap_or_default();
    fs::write(folder.join("deployment.toml"), text).unwrap();
    let duration = duration_s.to_string();
    let report = run(folder, &["serve", "deployment.toml", "--json", "--duration", &duration]);
    for camera in report["cameras"].as_array().unwrap() {
        assert_eq!(camera["skipped"], 0, "{report}");
    }
    report
}

#[test]
#[ignore = "plays a recording in real time: half a minute"]
fn a_recording_played_live_gives_what_watch_gives() {
    let folder = folder("recorded");
    // Longer than a step of the map's time.
    fs::write(folder.join("room.toml"), lasting(12)).unwrap();
    let recording = ["simulate", "room.toml", "--scripted", "--record", "rec", "--json"];
    run(&folder, &recording);
    let report = watched(&folder);
    let looks = |camera: usize| report["cameras"][camera]["looks"].as_u64().unwrap();
    assert!(looks(0) > 20 && looks(1) > 20 && report["robots"][0]["sightings"] != 0, "{report}");
    // It ends before the next step of the map's time, at 20 s.
    for (speed, duration_s) in [(1, 14), (2, 16)] {
        assert_eq!(seen(&served(&folder, speed, duration_s)), seen(&report), "speed {speed}");
    }

    // One depth image of another moment makes the difference.
    let depth = folder.join("rec/camera-01/depth");
    let mut images: Vec<PathBuf> =
        fs::read_dir(depth).unwrap().map(|entry| entry.unwrap().path()).collect();
    images.sort();
    // One of three is looked at.
    for index in 120..123 {
        fs::copy(&images[20], &images[index]).unwrap();
    }
    let altered = served(&folder, 2, 16);
    assert_eq!(seen(&altered)[0], seen(&report)[0]);
    assert_ne!(seen(&altered)[1][2], seen(&report)[1][2]);
    fs::remove_dir_all(folder).unwrap();
}

/// A camera that is knocked is noticed, left out and used again at its new pose, as in the recording's simulation.
/// One without a pose is shown and not used.
#[test]
#[ignore = "plays a recording: ten seconds"]
fn a_knocked_camera_is_followed_and_one_without_a_pose_is_shown() {
    let folder = folder("recorded-knock");
    let room = lasting(22);
    fs::write(folder.join("room.toml"), room).unwrap();
    let knock = "0@9:0.03,0,0,0,2,0";
    let recording =
        ["simulate", "room.toml", "--scripted", "--knock", knock, "--record", "rec", "--json"];
    run(&folder, &recording);
    let report = watched(&folder);
    let whats = |report: &Value| {
        let moves = report["camera_moves"].as_array().unwrap().iter();
        moves.map(|it| (it["camera"].clone(), it["what"].clone())).collect::<Vec<_>>()
    };
    assert_eq!(whats(&report), [(0.into(), "knocked".into()), (0.into(), "returned".into())]);

    // The frames of the second camera once more, before both, by a camera that nobody has placed: the cameras'
    // numbers in the deployment are not perception's.
    let (second, unplaced) = (folder.join("rec/camera-01"), folder.join("rec/a"));
    for images in ["depth", "color"] {
        fs::create_dir_all(unplaced.join(images)).unwrap();
        for entry in fs::read_dir(second.join(images)).unwrap() {
            let entry = entry.unwrap();
            if entry.file_name() != "pose.txt" {
                fs::hard_link(entry.path(), unplaced.join(images).join(entry.file_name())).unwrap();
            }
        }
    }
    for file in ["times.txt", "intrinsics.toml"] {
        fs::copy(second.join(file), unplaced.join(file)).unwrap();
    }
    let mut live = served(&folder, 2, 27);
    let whole = live["cameras"].clone();
    let third = live["cameras"].as_array_mut().unwrap().remove(0);
    assert_eq!(third["frames"], report["cameras"][1]["frames"]);
    assert_eq!((&third["has_pose"], &third["looks"]), (&false.into(), &0.into()), "{whole}");
    assert_eq!(seen(&live), seen(&report));
    for moved in live["camera_moves"].as_array_mut().unwrap() {
        assert_eq!(moved["camera"], 1);
        moved["camera"] = 0.into();
    }
    assert_eq!(live["camera_moves"], report["camera_moves"]);
    fs::remove_dir_all(folder).unwrap();
}

/// Real depth images and pictures, in turn, as if a fixed camera had taken them.
#[test]
#[ignore = "plays a recording: ten seconds"]
fn real_images_played_live_give_what_watch_gives() {
    let Some(data) = data::file("rgbd_frames/handheld") else { return };
    let folder = folder("recorded-images");
    let camera = folder.join("rec/camera-00");
    let mut times = String::new();
    for (images, extension) in [("depth", "pgm"), ("color", "png")] {
        fs::create_dir_all(camera.join(images)).unwrap();
        let originals = fs::read_dir(data.join(images)).unwrap().map(|entry| entry.unwrap().path());
        let mut originals: Vec<PathBuf> =
            originals.filter(|path| path.extension().is_some_and(|it| it == extension)).collect();
        originals.sort();
        for number in 0..60 {
            let copy = camera.join(format!("{images}/{number}.{extension}"));
            fs::copy(&originals[number % originals.len()], copy).unwrap();
        }
    }
    (0..60).for_each(|number| writeln!(times, "{number} {}", 0.3 * f64::from(number)).unwrap());
    fs::write(camera.join("times.txt"), times).unwrap();
    let intrinsics = "width = 640\nheight = 480\nfx = 518.0\nfy = 519.0\ncx = 325.5\ncy = 253.5\n";
    fs::write(camera.join("intrinsics.toml"), intrinsics).unwrap();
    // 1.4 m above the floor, tilted down by 30 degrees.
    fs::write(camera.join("pose.txt"), "0 0 1.4 0.8660254 0 0 -0.5\n").unwrap();
    let report = watched(&folder);
    assert!(report["map"]["known"].as_u64().unwrap() > 100, "{report}");
    assert_eq!(seen(&served(&folder, 3, 19)), seen(&report));
    fs::remove_dir_all(folder).unwrap();
}
