//! `ubimap place`, from its input files to its output files.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Duration,
};

use serde_json::Value;

use super::{ROOM, refused, ubimap};

/// An empty hall, for the paper's cameras.
const HALL: &str = "duration_s = 1\nslice_height_m = 0.2\n[room]\nheight_m = 3.0\n\
                    outline_m = [[0, 0], [10, 0], [10, 8], [0, 8]]\n";
/// Half the sides of the paper's footprint at a height of 3 m, across and along the image, in
/// metres.
const HALF_M: [f64; 2] = [2.061_84, 1.561_70];

struct Files(PathBuf);

impl Files {
    fn new(name: &str) -> Self {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir_all(&folder).unwrap();
        let files = Self(folder);
        files.write("hall.toml", HALL);
        files.write("camera.toml", "horizontal_fov_deg = 69.0\nvertical_fov_deg = 55.0\n");
        files
    }

    fn path(&self, name: &str) -> String {
        self.0.join(name).to_str().unwrap().to_owned()
    }

    fn write(&self, name: &str, text: &str) -> String {
        std::fs::write(self.0.join(name), text).unwrap();
        self.path(name)
    }

    /// Writes an image of grey pixels, the northern row first.
    fn image(&self, name: &str, width: usize, grey: &[u8]) -> String {
        let pixels: Vec<String> = grey.iter().map(u8::to_string).collect();
        let height = grey.len() / width;
        self.write(name, &format!("P2 {width} {height} 255 {}", pixels.join(" ")))
    }

    /// The report on the hall with the paper's cameras.
    fn place_in_hall(&self, options: &[&str]) -> Value {
        let (room, camera) = (self.path("hall.toml"), self.path("camera.toml"));
        let fixed = ["place", &room, "--camera", &camera, "--model", "paper", "--height", "3"];
        report(&[&fixed, options].concat())
    }
}

#[track_caller]
fn report(arguments: &[&str]) -> Value {
    let output = ubimap(&[arguments, &["--json"]].concat());
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Number of the report's cameras that see a point of the hall, by the paper's formulas.
fn overlap(report: &Value, point: [f64; 2]) -> usize {
    let cameras = report["cameras"].as_array().unwrap();
    let sees = |camera: &&Value| {
        let apart = [0, 1].map(|axis| point[axis] - camera["position_m"][axis].as_f64().unwrap());
        // With the top of the image to the north, its width lies along x.
        let along_x = usize::from(camera["heading_deg"] != 90.0);
        apart[0].abs() <= HALF_M[along_x] && apart[1].abs() <= HALF_M[1 - along_x]
    };
    cameras.iter().filter(sees).count()
}

#[test]
fn the_report_counts_what_the_cameras_see() {
    let files = Files::new("place-report");
    let out = files.path("out");
    let report = files.place_in_hall(&["--cameras", "4", "--max-overlap", "2", "--out", &out]);
    let mut by_overlap = [0u64; 3];
    for (column, row) in (0..20).flat_map(|column| (0..16).map(move |row| (column, row))) {
        let centre = [column, row].map(|it| 0.5 * f64::from(it) + 0.25);
        by_overlap[overlap(&report, centre)] += 1;
    }
    let placement = &report["placement"];
    let found: Vec<u64> =
        placement["by_overlap"].as_array().unwrap().iter().map(|it| it.as_u64().unwrap()).collect();
    assert_eq!(found, by_overlap[..found.len()]);
    // HiGHS finds 252 of 320 cells for the same programme.
    assert_eq!(placement["value"], 252);
    assert_eq!(placement["is_optimal"], true);

    // The share of unseen floor in the picture is that of the cells, except below the few markers.
    let picture = image::open(Path::new(&out).join("coverage.png")).unwrap().into_rgb8();
    let share_of = |colour: [u8; 3]| {
        picture.pixels().filter(|pixel| pixel.0 == colour).count() as f64
            / f64::from(picture.width() * picture.height())
    };
    let unseen = share_of([240, 170, 165]) / by_overlap[0] as f64;
    let seen = share_of([206, 226, 246]) / by_overlap[1] as f64;
    assert!((unseen / seen - 1.0).abs() < 0.05, "{unseen} and {seen} of the picture per cell");
    assert_eq!(share_of([150, 90, 130]), 0.0, "no cell of an empty hall is blind");
    let written = std::fs::read_to_string(Path::new(&out).join("report.json")).unwrap();
    let written: Value = serde_json::from_str(&written).unwrap();
    assert_eq!(written["cameras"], report["cameras"]);
}

#[test]
fn the_image_of_critical_floor_has_north_up() {
    let files = Files::new("place-critical");
    // The two northern rows of the hall.
    let mask: Vec<u8> = (0..320).map(|pixel| if pixel < 40 { 255 } else { 0 }).collect();
    let mask = files.image("mask.pgm", 20, &mask);
    let report = files.place_in_hall(&["--critical", &mask]);
    let least = |row: usize| {
        let centres =
            (0..20).map(|column| [0.5 * f64::from(column) + 0.25, row as f64 * 0.5 + 0.25]);
        centres.map(|centre| overlap(&report, centre)).min()
    };
    assert_eq!([0, 14, 15].map(least), [Some(1), Some(2), Some(2)]);
    let only = files.place_in_hall(&["--critical", &mask, "--critical-rule", "only"]);
    assert_eq!(only["placement"]["cameras"], 3, "three cameras are 12.4 m wide");
}

#[test]
fn walls_of_a_map_separate_the_overlap_and_unknown_cells_are_no_floor() {
    let files = Files::new("place-map");
    // A hall of 6 x 4 m with a wall across.
    let mut grey = vec![254; 60 * 40];
    for row in 0..40 {
        grey[row * 60 + 40] = 0;
    }
    files.image("map.pgm", 60, &grey);
    let map = files.write(
        "map.yaml",
        "image: map.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n\
         free_thresh: 0.196\n",
    );
    let report = report(&["place", &map]);
    assert_eq!(report["placement"]["coverage"], 1.0);
    // The wall divides the floor, and no overlap crosses it.
    assert_eq!(report["placement"]["fewest_pieces"], 2);
    assert_eq!(report["placement"]["pieces"], 2);
    files.image("map.pgm", 60, &vec![205; 60 * 40]);
    refused(&["place", &map], "map.yaml: has no floor");
}

#[test]
fn the_cameras_file_works_in_a_scenario_and_beside_a_recording() {
    let files = Files::new("place-files");
    let room = files.write("room.toml", ROOM);
    let camera = files.write(
        "camera.toml",
        "range_m = 6.0\ndepth = { width = 80, height = 60 }\n\
         picture = { width = 320, height = 180 }\n",
    );
    let out = files.path("out");
    let placed = report(&["place", &room, "--camera", &camera, "--out", &out]);
    let cameras = std::fs::read_to_string(files.path("out/cameras.toml")).unwrap();
    let (before, after) = ROOM.split_once("[[cameras]]").unwrap();
    let (_, robots) = after.split_once("[[robots]]").unwrap();
    let scenario = files.write("placed.toml", &format!("{before}{cameras}\n[[robots]]{robots}"));
    let recording = files.path("recording");
    let simulate = ["simulate", &scenario, "--scripted", "--record", &recording];
    assert_eq!(ubimap(&simulate).status.code(), Some(0));

    let watched = report(&["watch", &recording]);
    assert_eq!(
        watched["cameras"].as_array().unwrap().len(),
        placed["cameras"].as_array().unwrap().len()
    );
    assert!(watched["robots"][0]["sightings"].as_u64().unwrap() > 5, "{watched}");
    // cameras.toml states the same as the camera folders.
    files.write("recording/cameras.toml", &cameras);
    for camera in placed["cameras"].as_array().unwrap() {
        let name = camera["name"].as_str().unwrap();
        std::fs::remove_file(files.path(&format!("recording/{name}/pose.txt"))).unwrap();
        std::fs::remove_file(files.path(&format!("recording/{name}/intrinsics.toml"))).unwrap();
    }
    let by_file = report(&["watch", &recording]);
    assert_eq!(by_file["robots"][0]["sightings"], watched["robots"][0]["sightings"]);
    let known = |report: &Value| report["map"]["known"].as_f64().unwrap();
    assert!((known(&by_file) - known(&watched)).abs() <= 0.01 * known(&watched));
}

#[test]
fn impossible_requests_are_refused_in_one_line() {
    let files = Files::new("place-refused");
    let hall = files.path("hall.toml");
    let mask = files.image("mask.pgm", 2, &[255; 4]);
    let dark = files.image("dark.pgm", 20, &[0; 320]);
    let posed = files.write("posed.toml", "range_m = 5.0\ntilt_deg = 3.0\n");
    let wide = files.write("wide.toml", "horizontal_fov_deg = 190.0\n");
    let torn = files.write("torn.toml", "range_m = \n");
    for (options, expected) in [
        (&["--min-overlap", "3", "--max-overlap", "2"][..], "at least 3 and at most 2"),
        (&["--height", "3.1"], "above the ceiling"),
        (&["--tilt", "-30"], "can't see the floor"),
        (&["--critical", &mask], "mask.pgm: 2 x 2 pixels, but the room in cells has 20 x 16"),
        (&["--critical", &dark], "no cell of the floor is critical"),
        (&["--critical", "/no-such.png"], "/no-such.png: "),
        (&["--camera", &posed], "posed.toml: tilt_deg is a result of the placement"),
        (&["--camera", &wide], "wide.toml: fields of view"),
        (&["--camera", &torn], "torn.toml: "),
        (&["--cell", "0.05", "--spacing", "0.05"], "candidates are too many"),
        (&["--cameras", "2", "--coverage", "0.5"], "--coverage"),
        (&["--coverage", "1.5"], "--coverage"),
        (&["--time-limit", "0"], "--time-limit"),
    ] {
        refused(&[&["place", &hall][..], options].concat(), expected);
    }
    refused(&["place"], "ROOM");
    refused(&["place", "/no-such-room.toml"], "/no-such-room.toml: ");
}

#[test]
fn disconnected_overlap_is_reported_and_repaired_on_request() {
    let files = Files::new("place-connect");
    // Only the western and the eastern column of cells: two cameras cover each, and cameras of
    // different columns do not overlap.
    let mask: Vec<u8> = (0..320).map(|pixel| if pixel % 20 % 19 == 0 { 255 } else { 0 }).collect();
    let mask = files.image("mask.pgm", 20, &mask);
    let ends = ["--critical", &mask, "--critical-rule", "only"];
    let apart = files.place_in_hall(&ends);
    let placement = &apart["placement"];
    assert_eq!([&placement["cameras"], &placement["pieces"]], [4, 2]);
    assert_eq!(placement["fewest_pieces"], 1);
    // The gap of 10 m minus two depths of 4.12 m takes one more camera in the middle.
    let connected = files.place_in_hall(&[&ends[..], &["--connect"]].concat());
    let placement = &connected["placement"];
    assert_eq!([&placement["cameras"], &placement["added"], &placement["pieces"]], [5, 1, 1]);
    assert_eq!([&placement["value"], &placement["bound"]], [4, 4]);
}

/// Ctrl-C ends the search with the best placement found.
#[test]
#[cfg(target_os = "linux")]
fn an_interrupt_returns_the_best_placement_found() {
    let files = Files::new("place-interrupt");
    let room = files.write("room.toml", &HALL.replace("10", "40").replace('8', "30"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    command.current_dir(env!("CARGO_TARGET_TMPDIR"));
    command.args(["place", &room, "--time-limit", "600", "--json"]).stdout(Stdio::piped());
    let child = command.spawn().unwrap();
    let pid = child.id().to_string();
    let catches_interrupts = || {
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
        u64::from_str_radix(caught.trim(), 16).unwrap() & 1 << 1 != 0
    };
    while !catches_interrupts() {
        std::thread::sleep(Duration::from_millis(10));
    }
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["was_interrupted"], true);
    assert_eq!(report["placement"]["coverage"], 1.0);
    let [value, bound] = ["value", "bound"].map(|it| report["placement"][it].as_u64().unwrap());
    assert!(bound <= value && value < 200, "{value} cameras, at least {bound}");
}
