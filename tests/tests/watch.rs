//! Watching recorded frames: a recorded simulation gives the same results as the simulation, and
//! public recordings are accepted unchanged.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use image::{ImageBuffer, Luma};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use ubimap_protocol::{
    message::ObstacleClass,
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};
use ubimap_sim_host::{
    channel::fault::Faults,
    deployment::Config,
    recording::ExposureRule,
    report::{SeenFloor, WatchReport},
    run::{
        Outcome,
        fleet::Fleet,
        options::{DepthUnit, ResultOptions, TrustFloor, WatchOptions},
        record::{Recorded, Recording},
        room_stage::RoomStage,
        simulate::{RESOLUTION, deployment_config},
        watch,
    },
    world::{Scenario, World},
};
use ubimap_tests::{data, deployments::deployed};

/// Two cameras whose frames overtake each other and get lost, a robot with a tag, one with a colour
/// marker, and a walking person.
const SCENARIO: &str = include_str!("../../sim-host/tests/two_cameras.toml");

/// An empty folder for a test.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("watch").join(name);
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

fn watched(folder: &Path) -> Outcome<WatchReport> {
    watched_with(folder, TrustFloor::default())
}

fn watched_with(folder: &Path, trust_floor: TrustFloor) -> Outcome<WatchReport> {
    let options = WatchOptions {
        cameras: None,
        folders: vec![folder.to_owned()],
        robots: None,
        trust_floor,
        obstacles: None,
        unit: DepthUnit::default(),
        resolution: RESOLUTION,
        exposure: ExposureRule::default(),
        labels: None,
        results: ResultOptions { out: PathBuf::new(), json: true },
    };
    watch::run(&options).unwrap()
}

/// The poses in `robots.csv`: microseconds, robot id, millimetres and hundredths of a degree.
fn poses(outcome: &Outcome<WatchReport>) -> Vec<[i64; 5]> {
    let [(name, table)] = &outcome.tables[..] else { panic!("one table") };
    assert_eq!(*name, "robots.csv");
    let row = |line: &str| {
        let numbers: Vec<f64> = line.split(',').map(|it| it.parse().unwrap()).collect();
        let whole = |index: usize, scale: f64| (numbers[index] * scale).round() as i64;
        [whole(0, 1e6), whole(1, 1.0), whole(2, 1e3), whole(3, 1e3), whole(4, 100.0)]
    };
    table.lines().skip(1).map(row).collect()
}

#[test]
fn a_recorded_simulation_gives_the_simulations_results() {
    let recording = folder("recorded");
    let scenario = Scenario::from_toml(SCENARIO, "two cameras").unwrap();
    let world = World::new(&scenario, None, RESOLUTION, 1).unwrap();
    // No robot reports its own pose, as in a recording.
    let config = Config { keeps_sightings: true, ..deployment_config(&scenario, &world, true) };
    let written = Recording::create(&recording, &config.cameras, &config.registry).unwrap();
    let mut fleet = Fleet::new(&[], &mut [], Faults::default(), 1, deployed(config)).unwrap();
    let stage = RoomStage::filmed(world, Instant(0) + Duration::from_secs(7));
    let mut stage = Recorded { stage, recording: Some(written) };
    fleet.run(&mut stage, |_| {}).unwrap();
    stage.finish().unwrap();

    let outcome = watched(&recording);
    let report = &outcome.report;
    let mut sightings = fleet.deployment().sightings().to_vec();
    sightings.sort_by_key(|(captured, it)| (it.robot, *captured));
    let live: Vec<[i64; 5]> = sightings
        .iter()
        .map(|(captured, it)| {
            let degrees = (it.pose.heading.degrees() * 100.0).round() as i64;
            let [x, y] = [it.pose.x, it.pose.y].map(|Millimetres(mm)| i64::from(mm));
            [captured.micros() as i64, it.robot.0.into(), x, y, degrees]
        })
        .collect();
    assert_eq!(poses(&outcome), live);
    for robot in [3, 4] {
        let seen = report.robots.iter().find(|it| it.id == robot).unwrap().sightings;
        let of_robot = sightings.iter().filter(|(_, it)| it.robot == RobotId(robot));
        assert!(seen == of_robot.count() as u64 && seen > 90, "robot {robot}: {seen}");
    }

    let server = fleet.server();
    assert_eq!(report.map.digest.0, server.fused().digest().0);
    // There are 6,400 cells; the others are learnt later, or hidden by a person.
    assert!(report.map.free > 3_000 && report.map.occupied > 100, "{:?}", report.map);
    assert!(report.map.in_view > 3_000, "{:?}", report.map);
    let live: Vec<[f64; 2]> =
        server.obstacles().1.iter().map(|(it, _)| [it.x.metres(), it.y.metres()]).collect();
    assert_eq!(report.things.iter().map(|it| it.position_m).collect::<Vec<_>>(), live);
    let people =
        server.obstacles().1.iter().filter(|(it, _)| it.class == ObstacleClass::Person).count();
    assert!(people > 0, "{:?}", report.things);
    // Robots, people, cameras.
    assert_eq!(outcome.markers.len(), 2 + people + 2);
    let begun: u64 = server.sighting_events().iter().map(|(_, count, _)| count).sum();
    assert_eq!(report.events.iter().map(|it| it.count).sum::<u64>(), begun);

    // The frames did arrive out of order, and some were lost.
    let text = fs::read_to_string(recording.join("camera-00/times.txt")).unwrap();
    let captured: Vec<&str> = text.lines().skip(1).map(|it| &it[..12]).collect();
    assert_eq!(report.cameras[0].frames, captured.len() as u64);
    assert!(!captured.is_sorted() && (80..106).contains(&captured.len()), "{}", captured.len());
    fs::remove_dir_all(recording).unwrap();
}

/// A public depth image: its depth unit, its intrinsics (fx, fy, cx, cy), and three pixels on the
/// floor, which give the camera's pose.
struct Still {
    name: &'static str,
    depth: &'static str,
    per_metre: f64,
    intrinsics: [f64; 4],
    floor: [[u32; 2]; 3],
}

/// The public depth images.
const STILLS: [Still; 2] = [
    Still {
        name: "rgbd_frames/icl_nuim",
        depth: "1.png",
        per_metre: 5000.0,
        intrinsics: [481.2, 480.0, 319.5, 239.5],
        floor: [[232, 450], [292, 450], [262, 474]],
    },
    Still {
        name: "rgbd_frames/handheld",
        depth: "1.pgm",
        per_metre: 1000.0,
        intrinsics: [518.0, 519.0, 325.5, 253.5],
        floor: [[80, 440], [220, 440], [140, 320]],
    },
];

impl Still {
    /// The camera above the origin of `map`; its pitch, roll and height follow from three points on
    /// the floor.
    fn pose(&self, image: &ImageBuffer<Luma<u16>, Vec<u16>>) -> Isometry3<f64> {
        let [fx, fy, cx, cy] = self.intrinsics;
        let point = |[column, row]: [u32; 2]| {
            let about =
                (0..25).map(|it| image.get_pixel(column + it % 5 - 2, row + it / 5 - 2).0[0]);
            let mut depths: Vec<u16> = about.filter(|depth| *depth > 0).collect();
            depths.sort_unstable();
            let depth = f64::from(depths[depths.len() / 2]) / self.per_metre;
            depth * Vector3::new((f64::from(column) - cx) / fx, (f64::from(row) - cy) / fy, 1.0)
        };
        let [a, b, c] = self.floor.map(point);
        let normal = (b - a).cross(&(c - a)).normalize();
        // The camera's y axis points down.
        let up = normal * -normal.y.signum();
        let forward = (Vector3::z() - up * up.z).normalize();
        let axes = [forward, up.cross(&forward), up].map(|axis| axis.transpose());
        let turn = Rotation3::from_matrix_unchecked(Matrix3::from_rows(&axes));
        let turn = UnitQuaternion::from_rotation_matrix(&turn);
        Isometry3::from_parts(Translation3::new(0.0, 0.0, -up.dot(&a)), turn)
    }

    /// Writes the image twenty times, as if a fixed camera had taken it. `None` without the data.
    fn recording(&self) -> Option<(PathBuf, Isometry3<f64>)> {
        let data = data::file(self.name)?;
        let path = folder(self.name);
        fs::create_dir_all(path.join("depth")).unwrap();
        let original = data.join("depth").join(self.depth);
        let image = image::open(&original).unwrap().into_luma16();
        let pose = self.pose(&image);
        let [fx, fy, cx, cy] = self.intrinsics;
        let intrinsics = format!(
            "width = 640\nheight = 480\nfx = {fx}\nfy = {fy}\ncx = {cx}\ncy = {cy}\n\
             depth_per_metre = {}\n",
            self.per_metre
        );
        fs::write(path.join("intrinsics.toml"), intrinsics).unwrap();
        let mut times = String::new();
        for number in 0..20 {
            let extension = original.extension().unwrap().to_str().unwrap();
            fs::copy(&original, path.join(format!("depth/{number}.{extension}"))).unwrap();
            times += &format!("{number} {}\n", 0.3 * f64::from(number));
        }
        fs::write(path.join("times.txt"), times).unwrap();
        Some((path, pose))
    }
}

fn write_pose(folder: &Path, pose: &Isometry3<f64>) {
    let (at, turn) = (pose.translation, pose.rotation);
    let [i, j, k, w] = [turn.i, turn.j, turn.k, turn.w];
    let line = format!("{} {} {} {i} {j} {k} {w}\n", at.x, at.y, at.z);
    fs::write(folder.join("pose.txt"), line).unwrap();
}

/// Free and occupied cells of a still image, with its pose off by a height in metres and a tilt in
/// degrees.
fn cells(
    path: &Path,
    pose: &Isometry3<f64>,
    off: [f64; 2],
    trust: TrustFloor,
) -> ([i64; 2], Option<SeenFloor>) {
    let tilt = UnitQuaternion::from_euler_angles(0.0, off[1].to_radians(), 0.0);
    let rotation = pose.rotation * pose.rotation.inverse() * tilt * pose.rotation;
    let height = Translation3::new(0.0, 0.0, off[0]);
    write_pose(path, &Isometry3::from_parts(height * pose.translation, rotation));
    let WatchReport { cameras, map, things, .. } = watched_with(path, trust).report;
    assert_eq!((cameras[0].frames, cameras[0].lost), (20, 0));
    assert!(cameras[0].looks >= 3 && things.is_empty(), "{things:?}");
    ([map.free as i64, map.occupied as i64], cameras[0].floor)
}

/// A depth image of a real room, repeated as if a fixed camera had taken it several times: the camera
/// learns the room, and sees the floor and the furniture; nothing has moved. If its pose is off, its
/// floor tells.
#[test]
fn real_depth_images_are_watched_and_wrong_poses_corrected() {
    println!(
        "| image | pose off by | free and occupied cells | corrected | floor off by |\n|---|---|---|---|---|"
    );
    let (mut found, mut there) = (0, 0);
    for still in STILLS {
        let Some((path, pose)) = still.recording() else { continue };
        there += 1;
        let ([free, occupied], _) = cells(&path, &pose, [0.0; 2], TrustFloor::Always);
        assert!(free > 50 && occupied > 20, "{free} {occupied}");
        for off in [[0.0, 0.0], [0.05, 0.0], [-0.05, 0.0], [0.0, 2.0], [0.0, -2.0]] {
            let (as_stated, floor) = cells(&path, &pose, off, TrustFloor::Never);
            let (corrected, _) = cells(&path, &pose, off, TrustFloor::Auto);
            let seen = floor.map_or("no floor".to_owned(), |floor| floor.to_string());
            println!("| {} | {off:?} | {as_stated:?} | {corrected:?} | {seen} |", still.name);
            if floor.is_none() {
                assert_eq!(corrected, as_stated);
                continue;
            }
            found += 1;
            let differs =
                (corrected[0] - free).abs() * 50 > free || (corrected[1] - occupied).abs() > 10;
            assert!(!differs, "{corrected:?} instead of {free}, {occupied}");
        }
    }
    // The floor of one of them fills less than a twentieth of the view.
    assert!(there == 0 || found == 5, "{found} floors");
}

/// Five images of a hand-held camera count as five cameras, none of which has enough time to learn
/// the room.
#[test]
fn images_of_a_moving_camera_are_accepted() {
    for name in ["rgbd_redwood", "rgbd_frames/icl_nuim", "rgbd_frames/handheld"] {
        let Some(recorded) = data::frames(name) else { continue };
        let WatchReport { cameras, map, .. } = watched(recorded.path()).report;
        assert_eq!(cameras.iter().map(|it| it.frames).collect::<Vec<_>>(), [1; 5], "{name}");
        assert_eq!(map.known, 0, "{name}");
    }
}

/// Photographs of tags by a camera without a depth sensor, and of an arena in which the robot
/// carries a marker of another family.
#[test]
fn real_photographs_are_watched_without_depths() {
    // At a height of 3 m, looking straight down.
    let camera = |name: &str, size: [u32; 2], focal: f64, photographs: &[PathBuf]| {
        let path = folder(name);
        fs::create_dir_all(path.join("color")).unwrap();
        for (number, photograph) in photographs.iter().enumerate() {
            fs::copy(photograph, path.join(format!("color/{number}.png"))).unwrap();
        }
        let [width, height] = size;
        let intrinsics = format!(
            "width = {width}\nheight = {height}\nfx = {focal}\nfy = {focal}\ncx = {}\ncy = {}\n",
            width / 2,
            height / 2
        );
        fs::write(path.join("intrinsics.toml"), intrinsics).unwrap();
        fs::write(path.join("pose.txt"), "0 0 3 1 0 0 0\n").unwrap();
        path
    };
    if let Some(photographs) = data::file("fiducials/apriltag") {
        // Each photograph twice, because a single detection is not reported.
        let twice = ["test_image_multiple_01.png"; 2].map(|name| photographs.join(name));
        let path = camera("tags", [640, 480], 338.6, &twice);
        let times = "0 1305031453.25\n1 1305031453.75 1305031453.8\n2 1305031454.5\n";
        fs::write(path.join("times.txt"), times).unwrap();
        let WatchReport { cameras, events, map, .. } = watched(&path).report;
        let [camera] = &cameras[..] else { panic!("one camera") };
        assert_eq!((camera.name.as_str(), camera.frames, camera.lost), ("tags", 2, 1));
        let events: BTreeMap<&str, f64> =
            events.iter().map(|it| (it.what.as_str(), it.last_s)).collect();
        let expected =
            [144, 58, 85, 24, 22].map(|tag| format!("tag {tag} belongs to no registered robot"));
        for event in &expected {
            let seen = events.iter().find(|(what, _)| what.starts_with(event));
            assert_eq!(seen.map(|(_, last)| *last), Some(1305031453.75), "{events:?}");
        }
        assert_eq!(map.known, 0);
    }
    if let Some(arena) = data::file("fiducials/overhead_arena") {
        let both = ["terrain_1.png", "terrain_2.png"].map(|name| arena.join(name));
        let report = watched(&camera("arena", [1515, 1055], 1_500.0, &both)).report;
        assert_eq!((report.cameras[0].frames, &report.events[..]), (2, &[][..]));
    }
}
