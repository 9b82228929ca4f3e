//! The command line as users see it: exit codes, standard output and standard error.

use std::{
    path::Path,
    process::{Command, Output},
};

#[path = "command_line/place.rs"]
mod place;

/// Runs `ubimap` in the tests' temporary folder, which keeps its default output out of the
/// checkout.
fn ubimap(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    command.current_dir(env!("CARGO_TARGET_TMPDIR")).env_remove("RUST_LOG");
    command.args(arguments).output().unwrap()
}

/// Checks that wrong usage or invalid input gives exit code 2, one line on standard error and
/// nothing on standard output.
#[track_caller]
fn refused(arguments: &[&str], expected: &str) {
    let output = ubimap(arguments);
    let words = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{words}");
    assert!(words.starts_with("ubimap: ") && words.contains(expected), "{words}");
    assert_eq!(words.lines().count(), 1, "{words}");
    assert!(output.stdout.is_empty());
}

#[test]
fn wrong_usage_and_invalid_input_are_refused_in_one_line() {
    refused(&[], "no command given");
    refused(&["frob"], "frob");
    refused(&["simulat"], "did you mean simulate?");
    refused(&["simulate", "--duratio", "1"], "did you mean --duration?");
    refused(
        &["simulate", "rom"],
        "no scenario \"rom\"; did you mean \"room\"? The built-in ones are",
    );
    refused(&["simulate", "zzz"], "no scenario \"zzz\"; the built-in ones are room, ");
    refused(&["simulate", "-q", "-v"], "--quiet");
    refused(&["simulate", "--outside", "a,b"], "must be three ports");
    refused(&["simulate", "--outside", "a,b,c"], "choose one with --robots 1");
    refused(&["simulate", "--robots", "1", "--outside", "/no/a,b,c"], "/no/a: ");
    refused(&["simulate", "--outside", "a,b,c", "--loss", "0.1"], "--loss");
    refused(&["simulate", "--in-step", "x", "--policy", "full"], "--policy");
    refused(
        &["simulate", "aluckal-room", "--robots", "1", "--in-step", "x"],
        "the scenario has no fixed cameras",
    );
    refused(&["simulate", "room", "--map", "bad.yaml"], "scenario room with --map bad.yaml: ");
    refused(&["simulate", "--out", "/dev/null/x"], "/dev/null/x: ");
    refused(&["replay"], "LOG");
    refused(&["replay", "x", "--loss", "1.5"], "--loss");
    refused(&["replay", "x", "--corrupt", "nan"], "--corrupt");
    refused(&["replay", "x", "--latency", "-5"], "--latency");
    refused(&["replay", "x", "--robots", "0"], "--robots");
    refused(&["replay", "x", "--resolution", "0"], "--resolution");
    refused(&["replay", "x", "--format", "png"], "--format");
    refused(&["simulate", "--duration", "-1"], "--duration");
    refused(&["simulate", "--record", "x", "--ideal-cameras"], "--record");
    refused(&["simulate", "--record", "/dev/null/x"], "/dev/null/x: ");
    refused(&["simulate", "--log", "/dev/null/x"], "/dev/null/x: ");
    refused(&["watch"], "FOLDER");
    refused(&["watch", "/no-such-folder"], "/no-such-folder: No such file");
    refused(&["watch", "x", "--resolution", "0"], "--resolution");
    refused(&["serve"], "PORT");
    refused(&["serve", "/dev/no-such-port"], "/dev/no-such-port: ");
    refused(&["serve", "x", "--baud", "0"], "--baud");
    refused(&["serve", "x", "--pose", "-1,2"], "--pose");
    refused(&["serve", "x", "--pose", "1,2,3", "--pose", "1,2,3"], "--pose");
    refused(&["simulate", "--store", "/dev/null/map.db"], "/dev/null/map.db: can't be opened");
    refused(&["compare", "a.yaml"], "REFERENCE.yaml");
    refused(&["compare", "a.yaml", "b.yaml", "--tolerance", "-1"], "--tolerance");
    refused(&["compare", "a.yaml", "b.yaml"], "a.yaml");
}

#[test]
fn help_and_version_go_to_standard_output() {
    for arguments in [&["--help"][..], &["replay", "--help"], &["--version"]] {
        let output = ubimap(arguments);
        assert_eq!(output.status.code(), Some(0));
        assert!(!output.stdout.is_empty() && output.stderr.is_empty());
    }
}

#[test]
fn a_run_restores_the_map_that_an_earlier_run_stored() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("store");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("map.db");
    let store = path.to_str().unwrap();
    let log = |name: &str, x: f64| {
        let scan = |time: u32| {
            format!("FLASER 180{} {x} 0 0 {x} 0 0 {time} host {time}\n", " 2.0".repeat(180))
        };
        let path = folder.join(name);
        std::fs::write(&path, (1..4).map(scan).collect::<String>()).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let [here, there] = [log("here.log", 0.0), log("there.log", 20.0)];
    let known = |arguments: &[&str]| {
        let output = ubimap(&[&["replay", "--json"], arguments].concat());
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        report["map"]["known"].as_u64().unwrap()
    };
    let [first, second] = [known(&[&here, "--store", store]), known(&[&there])];
    assert!(first > 1_000 && second > 1_000);
    assert_eq!(known(&[&there, "--store", store]), first + second);

    std::fs::write(&path, "no map. ".repeat(100)).unwrap();
    refused(&["simulate", "--store", store], "map.db: not a ubimap store");
}

#[test]
#[cfg(target_os = "linux")]
fn a_report_that_can_not_be_written_is_a_failure() {
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    let output = command.arg("--help").stdout(full).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let words = String::from_utf8(output.stderr).unwrap();
    assert!(words.starts_with("ubimap: standard output: can't write the report: "), "{words}");
}

#[test]
fn a_replay_that_maps_nothing_fails_and_says_so() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("late");
    std::fs::create_dir_all(&folder).unwrap();
    let log = folder.join("late.log");
    let scan = |time: u32| {
        format!("FLASER 180{} {time} 0 0 {time} 0 0 {time} host {time}\n", " 2.0".repeat(180))
    };
    std::fs::write(&log, (1..6).map(scan).collect::<String>()).unwrap();
    let [log, out] = [log, folder.join("out")].map(|it| it.to_str().unwrap().to_owned());
    let output = ubimap(&["replay", &log, "--out", &out, "--latency", "60000"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let words = String::from_utf8(output.stderr).unwrap();
    assert!(words.contains("nothing was mapped: none of 5 scans"), "{words}");
    let words = String::from_utf8(output.stdout).unwrap();
    assert!(words.contains("agreement: NOT reached: nothing was mapped"), "{words}");
}

#[test]
#[cfg(target_os = "linux")]
fn endless_and_blocking_files_are_refused() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("endless");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let pipe = folder.join("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let pipe = pipe.to_str().unwrap();
    let yaml = folder.join("map.yaml");
    let text = "image: pipe\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n\
                occupied_thresh: 0.65\nfree_thresh: 0.196\n";
    std::fs::write(&yaml, text).unwrap();
    let yaml = yaml.to_str().unwrap();
    for path in ["/dev/zero", pipe] {
        let expected = format!("{path}: is a device or a pipe");
        refused(&["simulate", path], &expected);
        refused(&["replay", path], &expected);
        refused(&["compare", path, path], &expected);
        refused(&["place", "room", "--camera", path], &expected);
    }
    refused(&["compare", yaml, yaml], "pipe: is a device or a pipe");
}

#[test]
fn more_tiles_than_memory_holds_are_refused() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("tiles");
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("tiles.log");
    let scan = |time: u32| format!("FLASER 2 1 1 0 0 0 0 0 0 {time}.5 host {time}\n");
    std::fs::write(&path, (0..1_000).map(scan).collect::<String>()).unwrap();
    refused(
        &["replay", path.to_str().unwrap(), "--robots", "1000", "--tiles", "65536"],
        "1000 robots with 65536 tiles each",
    );
}

#[test]
fn compare_scores_two_maps() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("compare");
    std::fs::create_dir_all(&folder).unwrap();
    let map = |name: &str, pixels: &str| {
        let yaml = format!(
            "image: {name}.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n\
             occupied_thresh: 0.65\nfree_thresh: 0.196\n"
        );
        std::fs::write(folder.join(format!("{name}.pgm")), format!("P2 4 1 255 {pixels}")).unwrap();
        let path = folder.join(format!("{name}.yaml"));
        std::fs::write(&path, yaml).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let a = map("a", "0 254 254 0");
    let b = map("b", "0 254 205 254");

    let output = ubimap(&["compare", &a, &b, "--json"]);
    assert_eq!(output.status.code(), Some(0));
    let scores: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(scores["precision"], 0.5);
    assert_eq!(scores["recall"], 1.0);
    assert_eq!(scores["agreement_known"], 2.0 / 3.0);

    let output = ubimap(&["compare", &a, &b, "--tolerance", "0.31"]);
    assert!(String::from_utf8(output.stdout).unwrap().contains("F1 1.0000"));

    let torn = map("torn", "0 254");
    refused(&["compare", &torn, &b], "torn.pgm");
}

/// A room with one camera of low resolution and one robot.
const ROOM: &str = r#"
duration_s = 1
slice_height_m = 0.2
[room]
height_m = 3.0
outline_m = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0]]
[[cameras]]
position_m = [1.5, 1.5, 2.8]
look_at_m = [1.5, 1.6, 0.0]
depth = { width = 80, height = 60 }
picture = { width = 320, height = 180 }
[[robots]]
id = 1
radius_m = 0.2
marker_size_m = 0.25
start = { x_m = 1.5, y_m = 1.5 }
"#;

#[test]
fn a_simulation_ends_with_four_lines_and_its_pictures() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("simulate");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let scenario = folder.join("small.toml");
    std::fs::write(&scenario, ROOM).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    command.current_dir(&folder).env_remove("RUST_LOG");
    let output = command.args(["simulate", "small.toml", "--ideal-cameras"]).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let words = String::from_utf8(output.stdout).unwrap();
    let starts: Vec<&str> = words.lines().filter_map(|it| Some(it.split_once(':')?.0)).collect();
    assert_eq!(starts, ["quality", "agreement", "time", "results"], "{words}");
    assert!(words.ends_with("in ubimap-out; open ubimap-out/map.png first\n"), "{words}");
    // There is no information, and no warning without anything to act on.
    assert!(output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));

    // The camera has seen most of the floor by the end of the run.
    let picture = image::open(folder.join("ubimap-out/coverage.png")).unwrap().into_rgb8();
    let share = |colour: [u8; 3]| {
        let count = picture.pixels().filter(|pixel| pixel.0 == colour).count();
        count as f64 / picture.pixels().len() as f64
    };
    let (covered, blind) = (share([200, 235, 250]), share([140, 90, 190]));
    assert!(covered > 0.3 && blind < covered, "{covered} covered, {blind} blind");
}

#[test]
fn a_recorded_simulation_can_be_watched_and_its_faults_are_named() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("watch");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let path = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    let [scenario, recording, out] = ["room.toml", "recording", "out"].map(path);
    std::fs::write(&scenario, ROOM).unwrap();
    let simulate = ["simulate", &scenario, "--scripted", "--record", &recording];
    assert_eq!(ubimap(&simulate).status.code(), Some(0));
    refused(&simulate, "recording: the folder is not empty");

    let watch = ["watch", &recording, "--json", "--out", &out];
    let output = ubimap(&watch);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["schema"], "ubimap-watch");
    let frames = report["cameras"][0]["frames"].as_u64().unwrap();
    assert!(frames > 10 && report["robots"][0]["sightings"].as_u64().unwrap() > 10, "{report}");
    let written = |out: &str| {
        let entries = std::fs::read_dir(out).unwrap();
        let mut names: Vec<String> =
            entries.map(|it| it.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names.join(" ")
    };
    assert_eq!(
        written(&out),
        "coverage.png map.pgm map.png map.yaml report.json robots.csv volatility.png"
    );
    let figures = |options: &[&str]| {
        let output = ubimap(&[&["watch", &recording, "--out", &out], options].concat());
        String::from_utf8(output.stdout).unwrap()
    };
    let (brief, all) = (figures(&[]), figures(&["-v"]));
    assert_eq!(brief.lines().count(), 4, "{brief}");
    assert!(brief.contains(&format!("results:   in {out}; open {out}/map.png")), "{brief}");
    assert!(all.contains("camera-00") && all.lines().count() > 4, "{all}");

    // A truncated image ends the run when its frame is due, and no results are left behind.
    let picture = path("recording/camera-00/color/000000000000.png");
    let whole = std::fs::read(&picture).unwrap();
    std::fs::write(&picture, &whole[..whole.len() / 2]).unwrap();
    let fresh = path("fresh");
    refused(
        &["watch", &recording, "--out", &fresh],
        "color/000000000000.png: not a readable image",
    );
    assert!(!Path::new(&fresh).exists());
    std::fs::write(&picture, whole).unwrap();
    let robot = "[[robots]]\nid = 1\nmarker_size_m = 0.1\nheight_m = 0.3\n";
    let twice = format!("{robot}{}tag_id = 1\n", robot.replace("id = 1", "id = 2"));
    std::fs::write(path("twice.toml"), twice).unwrap();
    let robots = path("twice.toml");
    refused(
        &["watch", &recording, "--robots", &robots],
        "robots 1 and 2 carry the same identifier",
    );
    std::fs::remove_file(path("recording/camera-00/intrinsics.toml")).unwrap();
    refused(&["watch", &recording], "camera-00/intrinsics.toml: intrinsics: missing; write");
}

#[test]
fn a_recording_without_frames_can_be_watched() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("watch-nothing");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let [scenario, recording] =
        ["room.toml", "recording"].map(|name| folder.join(name).to_str().unwrap().to_owned());
    let silent = ROOM.replace("[[cameras]]\n", "[[cameras]]\nlost_frames = 1.0\n");
    std::fs::write(&scenario, silent).unwrap();
    let simulate = ["simulate", &scenario, "--scripted", "--record", &recording];
    // No camera saw anything, so there is no agreement.
    assert_eq!(ubimap(&simulate).status.code(), Some(1));
    let output = ubimap(&["watch", &recording, "--json", "-v"]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["cameras"][0]["frames"], 0);
    let words = String::from_utf8(output.stderr).unwrap();
    assert!(words.contains("camera-00: no image in it"), "{words}");
}
