//! The documented file, key by key, and what is wrong with others.

use std::collections::BTreeSet;

use super::*;
use crate::testing::Folder;

fn parse_in(folder: &Path, text: &str) -> Result<DeploymentFile, String> {
    DeploymentFile::parse(&folder.join("a.toml"), folder, text)
}

fn parse(text: &str) -> Result<DeploymentFile, String> {
    parse_in(Path::new("d"), text)
}

#[test]
fn the_example_is_a_deployment() {
    let file = parse(EXAMPLE).unwrap();
    assert_eq!(file.resolution, Millimetres(50));
    assert_eq!(file.interval, Duration::from_secs(60));
    assert_eq!((file.floor, file.plan), (None, None));
    assert_eq!(file.store.as_deref(), Some(Path::new("d/map.db")));
    assert_eq!(
        file.ports.iter().map(Address::to_string).collect::<Vec<_>>(),
        ["udp:127.0.0.1:4000"]
    );
    let [north, south] = &file.cameras[..] else { panic!("{:?}", file.cameras) };
    assert_eq!(north.source, CameraSource::UnixStream("d/north.sock".into()));
    assert!(north.is_placed && !south.is_placed);
    let (depth, picture) = north.calibration.depth.zip(north.calibration.picture).unwrap();
    assert!((depth.centre().z - 2.8).abs() < 1e-9);
    assert!(((depth.centre() - picture.centre()).norm() - 0.015).abs() < 1e-9);
    assert_eq!(file.registry.robots.len(), 2);
}

/// The lines of the example, with those that are only suggested: `# key = value`.
fn with_suggestions() -> String {
    let line = |line: &str| match line.strip_prefix("# ") {
        Some(suggested) if suggested.split_once(" = ").is_some_and(|(key, _)| is_key(key)) => {
            suggested.to_owned()
        }
        _ => line.to_owned(),
    };
    EXAMPLE.lines().map(|it| line(it) + "\n").collect()
}

fn is_key(text: &str) -> bool {
    text.chars().all(|it| it.is_ascii_lowercase() || it == '_')
}

/// The beginning of a map with one wall, which its file names.
const MAP: &str = "image: map.pgm\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\n\
                   occupied_thresh: 0.65\nfree_thresh: 0.196\n";

/// A folder with all files that the example names.
fn folder(name: &str) -> Folder {
    let folder = Folder::new(name);
    folder.file("map.pgm", b"P5 2 1 255\n\xfe\x00");
    for name in ["plan.yaml", "floor.yaml"] {
        folder.file(name, MAP.as_bytes());
    }
    folder.file(
        "labels.toml",
        b"[[labels]]\nclass = \"chair\"\npolygon_m = [[0, 0], [1, 0], [0, 1]]\n",
    );
    let pose = "[[cameras]]\nname = \"south\"\nposition_m = [2.0, 0.2, 2.5]\nheading_deg = 90.0\n\
                tilt_deg = 40.0\n";
    folder.file("cameras.toml", pose.as_bytes());
    folder
}

#[test]
fn each_key_of_the_example_does_something() {
    let folder = folder("deployment-keys");
    let all = with_suggestions();
    let whole = format!("{:?}", parse_in(folder.path(), &all).unwrap());
    assert_ne!(whole, format!("{:?}", parse_in(folder.path(), EXAMPLE).unwrap()));
    let mut keys = BTreeSet::new();
    for (number, line) in all.lines().enumerate() {
        let Some((key, _)) = line.split_once(" = ").filter(|(key, _)| is_key(key)) else {
            continue;
        };
        keys.insert(key);
        // Without it the deployment is refused, or another one.
        let without: String = all
            .lines()
            .enumerate()
            .filter(|(index, _)| *index != number)
            .map(|(_, line)| format!("{line}\n"))
            .collect();
        let is_default = match parse_in(folder.path(), &without) {
            Err(_) => false,
            Ok(file) => format!("{file:?}") == whole,
        };
        // Some lines state the default.
        let states_default = ["resolution_m", "out", "every_s"].contains(&key);
        assert_eq!(is_default, states_default, "line {}: {line}", number + 1);
    }
    for (from, to) in [
        ("resolution_m = 0.05", "resolution_m = 0.1"),
        ("out = \"ubimap-out\"", "out = \"other\""),
        ("every_s = 60.0", "every_s = 61.0"),
    ] {
        let other = parse_in(folder.path(), &all.replacen(from, to, 1)).unwrap();
        assert_ne!(format!("{other:?}"), whole, "{to}");
    }
    // Every key that can be given is documented, but those that only scenarios have.
    let text = toml::from_str::<Keys>("no_such_key = 1").err().unwrap().to_string();
    let listed: Vec<&str> = text.split('`').skip(3).step_by(2).collect();
    assert!(listed.len() > 10, "{text}");
    let robots = text_of_unknown_robot_key();
    let of_robots: Vec<&str> = robots.split('`').skip(3).step_by(2).collect();
    assert!(of_robots.len() > 6, "{robots}");
    let of_scenarios = [
        "horizontal_fov_deg",
        "vertical_fov_deg",
        "range_m",
        "rate_hz",
        "latency_ms",
        "cells_rate_hz",
    ];
    let known = listed.into_iter().chain(CAMERA_KEYS).chain(of_robots);
    for key in known.filter(|key| !of_scenarios.contains(key)) {
        assert!(EXAMPLE.contains(key), "{key} is not documented");
    }
}

fn text_of_unknown_robot_key() -> String {
    let robot = "[[robots]]\nid = 1\nno_such_key = 1\n";
    toml::from_str::<Keys>(robot).err().unwrap().message().to_owned()
}

#[test]
fn the_floor_is_the_area_without_the_walls_of_the_plan() {
    let folder = folder("deployment-floor");
    let floor = |lines: &str| {
        let text = format!("{lines}\nresolution_m = 0.1\n");
        parse_in(folder.path(), &text).unwrap().floor.unwrap()
    };
    // The map is free from x = 0 to 0.5 m and occupied from there to 1 m.
    let open = |floor: &DrivableFloor| (-3..14).filter(|x| floor.allows(*x, 2)).collect::<Vec<_>>();
    assert_eq!(open(&floor("floor = \"floor.yaml\"")), [0, 1, 2, 3, 4]);
    assert_eq!(open(&floor("plan = \"plan.yaml\"")), [-3, -2, -1, 0, 1, 2, 3, 4, 10, 11, 12, 13]);
    let square = "floor = [[0.2, 0], [1.2, 0], [1.2, 1], [0.2, 1.0]]";
    assert_eq!(open(&floor(square)), [2, 3, 4, 5, 6, 7, 8, 9, 10, 11]);
    let both = format!("{square}\nplan = \"plan.yaml\"");
    assert_eq!(open(&floor(&both)), [2, 3, 4, 10, 11]);
}

/// What `watch` and `simulate` read and write beside recordings can be used as it is.
#[test]
fn robots_and_cameras_files_are_parts_of_a_deployment() {
    let robots = Registry::from_toml(
        "[[robots]]\nid = 3\ncolours = [\"red\", \"blue\"]\nmarker_size_m = 0.2\nheight_m = 0.25\n",
    );
    let robots = robots.unwrap();
    let file = parse(&robots.to_toml()).unwrap();
    assert_eq!(file.registry, robots);
    // The other way round: the robots of a deployment are a robots.toml.
    let section = &EXAMPLE[EXAMPLE.find("[[robots]]").unwrap()..];
    assert_eq!(Registry::from_toml(section).unwrap(), parse(EXAMPLE).unwrap().registry);

    let folder = folder("deployment-parts");
    let text = EXAMPLE.replace("# poses = ", "poses = ");
    let file = parse_in(folder.path(), &text).unwrap();
    assert!(file.cameras[1].is_placed);
    assert!((file.cameras[1].calibration.pose().unwrap().translation.z - 2.5).abs() < 1e-9);
}

#[test]
fn a_camera_has_one_device_or_two() {
    let path = |path: &str| Some(PathBuf::from(path));
    let two = "\"v4l2:/dev/video2\"\npicture_source = \"v4l2:/dev/video4\"";
    let file = parse(&EXAMPLE.replace("\"stream:north.sock\"", two)).unwrap();
    let expected = CameraSource::V4l2 { depth: path("/dev/video2"), picture: path("/dev/video4") };
    assert_eq!(file.cameras[0].source, expected);
    let file = parse(&EXAMPLE.replace("stream:south.sock", "v4l2:/dev/video2")).unwrap();
    let expected = CameraSource::V4l2 { depth: path("/dev/video2"), picture: None };
    assert_eq!(file.cameras[1].source, expected);
}

#[test]
fn errors_name_the_place_and_the_remedy() {
    for (from, to, told) in [
        ("ports =", "prts =", "unknown field `prts`"),
        ("tilt_deg", "tilt_dg", "camera north: unknown key `tilt_dg`; the keys are name, "),
        ("tilt_deg = 45.0", "", "position_m needs either look_at_m, or heading_deg and"),
        ("stream:north.sock", "north.sock", "give folder:DIR, stream:SOCKET"),
        ("2.8]", "-2.8]", "its height above the floor must be"),
        ("\"south\"", "\"north\"", "two cameras are named \"north\""),
        ("stream:north.sock", "v4l2:", "source: v4l2 needs a device"),
        ("stream:north.sock", "v4l2:/dev/video0", "picture: needs the device of the pictures"),
        ("\"stream:south.sock\"", "\"v4l2:x\"\npicture_source = \"v4l2:y\"", "intrinsics of both"),
        ("\"stream:south.sock\"", "\"stream:x\"\npicture_source = \"v4l2:y\"", "only a v4l2"),
        ("[\"udp:4000\"]", "[\"udp:x\"]", "ports: udp:x: not an address"),
        ("id = 2", "id = 1", "robot 1 is registered twice"),
        ("0.05", "0.0505", "resolution_m: must be whole millimetres"),
        ("fx = 337.2", "fx = 0.2", "depth: fx must be more than one pixel"),
        ("store =", "playback.speed = 4\nstore =", "playback: camera north lives in real time"),
        ("store =", "playback.sped = 4\nstore =", "unknown field `sped`"),
        ("stream:north.sock", "folder:/no-such", "camera north: /no-such: No such file"),
        ("# floor = [[0.2, 0.2],", "floor = [[0.2, nan],", "floor: must lie within 10 km"),
        (
            "# floor = [[0.2, 0.2],",
            "floor = [[\"a\", 0],",
            "line 17: give a ROS map, as in \"floor.yaml\"",
        ),
        ("# floor = [[0.2, 0.2], [3.8, 0.2], [3.8,", "floor = [[3.8,", "floor: has 2 corners; a"),
        ("# floor = [[0.2", "floor = [[0.2", ""),
        ("# plan =", "plan =", "plan: d/plan.yaml: No such file"),
        ("# every_s = 60.0", "every_s = 0.0", "every_s: must be from 0.1"),
    ] {
        assert!(EXAMPLE.contains(from), "{from}");
        let parsed = parse(&EXAMPLE.replacen(from, to, 1));
        if told.is_empty() {
            assert!(parsed.is_ok(), "{parsed:?}");
            continue;
        }
        let error = parsed.unwrap_err();
        assert!(error.contains(told), "{error}");
        assert_eq!(error.lines().count(), 1, "{error}");
    }
}
