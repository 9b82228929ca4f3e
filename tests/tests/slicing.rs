//! Plane slicing of recorded depth frames, compared with all 3-D points of the same frames. Also:
//! small sensors, shaking and removed pixels, tested with complete robots.

use std::{fs, path::Path};

use ubimap_agent::{
    Bounds, Config, Memory, Robot,
    locate::PoseSource,
    sense::{Beam, Camera, DIRECTION_BITS, Pick, Removal, Slice, Slicer, Validity, fill_beams},
};
use ubimap_protocol::{
    time::Instant,
    units::{Angle, Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    recording::{self, DepthSlice, Log, PixelModel, Slicing, UpAxis},
    run::heap::{BOUNDS, Heap},
};
use ubimap_tests::data;

/// Folders of frames and their intrinsics, from the data's README: fx, fy, cx, cy, and depth units
/// per metre.
const FOLDERS: [(&str, [f64; 5]); 3] = [
    ("rgbd_redwood", [525.0, 525.0, 319.5, 239.5, 1000.0]),
    ("rgbd_frames/icl_nuim", [481.2, -480.0, 319.5, 239.5, 5000.0]),
    ("rgbd_frames/handheld", [518.0, 519.0, 325.5, 253.5, 1000.0]),
];

/// Maximum mapped range, in metres.
const RANGE_M: f64 = 4.0;

type Vector = [f64; 3];

fn dot(a: Vector, b: Vector) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn mix(a: Vector, p: f64, b: Vector, q: f64) -> Vector {
    [0, 1, 2].map(|axis| p * a[axis] + q * b[axis])
}

fn unit(a: Vector) -> Vector {
    mix(a, 1.0 / dot(a, a).sqrt(), a, 0.0)
}

/// A camera's pose in the world: its position, and the axes of its images (right, y, forward).
struct Station {
    position: Vector,
    axes: [Vector; 3],
}

fn numbers(text: &str) -> Vec<f64> {
    text.split_whitespace().map(|word| word.parse().unwrap()).collect()
}

fn stations(folder: &Path) -> Vec<Station> {
    if let Ok(text) = fs::read_to_string(folder.join("pose.txt")) {
        let lines = text.lines().filter(|line| !line.trim().is_empty());
        return lines
            .map(|line| {
                let values = numbers(line);
                let [x, y, z, a, b, c, w] = values[values.len() - 7..].try_into().unwrap();
                let axes = [
                    [1.0 - 2.0 * (b * b + c * c), 2.0 * (a * b + c * w), 2.0 * (a * c - b * w)],
                    [2.0 * (a * b - c * w), 1.0 - 2.0 * (a * a + c * c), 2.0 * (b * c + a * w)],
                    [2.0 * (a * c + b * w), 2.0 * (b * c - a * w), 1.0 - 2.0 * (a * a + b * b)],
                ];
                Station { position: [x, y, z], axes }
            })
            .collect();
    }
    let text = fs::read_to_string(folder.join("trajectory.log")).unwrap();
    let lines: Vec<_> = text.lines().map(numbers).collect();
    lines
        .chunks(5)
        .map(|rows| Station {
            position: [1, 2, 3].map(|row| rows[row][3]),
            axes: [0, 1, 2].map(|axis| [1, 2, 3].map(|row| rows[row][axis])),
        })
        .collect()
}

/// The depths of a folder's frames in metres, ordered by number.
fn frames(folder: &Path, per_metre: f64) -> Vec<Vec<f64>> {
    let mut files: Vec<_> =
        fs::read_dir(folder.join("depth")).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort_by_key(|path| path.file_stem().unwrap().to_str().unwrap().parse::<u32>().unwrap());
    let depths = |path| {
        let image = image::open(path).unwrap().into_luma16();
        assert_eq!(image.dimensions(), (640, 480));
        image.into_raw().into_iter().map(|sample| f64::from(sample) / per_metre).collect()
    };
    files.iter().map(depths).collect()
}

/// The points of a scan's readings, computed with the robot's table of beams, and their columns:
/// forward and left of the camera, in metres.
fn mapped(log: &Log, scan: usize) -> Vec<(usize, [f64; 2])> {
    let mut beams = vec![Beam::default(); log.sensor.readings()];
    fill_beams(&mut beams, log.sensor.model(), Pose::default());
    let readings = log.scans[scan].readings_mm.iter().zip(&beams).enumerate();
    let valid = readings.filter(|(_, (reading, beam))| **reading > 0 && **beam != Beam::NONE);
    let point = |(column, (reading, beam)): (usize, (&u16, &Beam))| {
        let metres = |direction: i16| {
            f64::from(direction) / f64::from(1 << DIRECTION_BITS) * f64::from(*reading) / 1e3
        };
        (column, [metres(beam.forward), metres(beam.left)])
    };
    valid.map(point).filter(|(_, [x, y])| x.hypot(*y) <= RANGE_M).collect()
}

/// Errors in millimetres: root mean square, 95th percentile, maximum.
struct Errors {
    rms: f64,
    most_of: f64,
    largest: f64,
}

impl Errors {
    fn of(mut metres: Vec<f64>) -> Self {
        metres.sort_by(f64::total_cmp);
        let squares: f64 = metres.iter().map(|error| error * error).sum();
        Self {
            rms: 1e3 * (squares / metres.len() as f64).sqrt(),
            most_of: 1e3 * metres[metres.len() * 95 / 100],
            largest: 1e3 * metres[metres.len() - 1],
        }
    }
}

impl std::fmt::Display for Errors {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { rms, most_of, largest } = self;
        write!(f, "{rms:.1} mm RMS, 95 % within {most_of:.1}, all within {largest:.1}")
    }
}

/// The noise of the depths along a row in millimetres, estimated from the frames: white noise with
/// deviation s has second differences with deviation s * sqrt(6). Steps above 10 cm are edges.
fn noise_mm(frames: &[Vec<f64>], row: usize) -> f64 {
    let mut squares = Vec::new();
    for frame in frames {
        for three in frame[640 * row..640 * (row + 1)].windows(3) {
            let is_smooth = three.windows(2).all(|two| (two[0] - two[1]).abs() < 0.1);
            if is_smooth && three.iter().all(|&depth| depth > 0.0 && depth < RANGE_M) {
                squares.push((three[0] - 2.0 * three[1] + three[2]).powi(2));
            }
        }
    }
    1e3 * (squares.iter().sum::<f64>() / squares.len() as f64 / 6.0).sqrt()
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn read(folder: &Path, slice: DepthSlice, pixels: PixelModel) -> Log {
    recording::read(
        folder,
        None,
        Slicing { slice, pixels, up: UpAxis::Cameras, ..Slicing::default() },
    )
    .unwrap()
}

#[test]
fn the_row_of_a_recorded_frame_lies_on_its_3_d_points() {
    for (name, [fx, _, cx, cy, per_metre]) in FOLDERS {
        let Some(recorded) = data::frames(name) else { return };
        let folder = recorded.path();
        let frames = frames(folder, per_metre);
        let row = cy.round() as usize;
        let errors = |pixels| {
            let log = read(folder, DepthSlice::Row, pixels);
            let off = frames.iter().enumerate().flat_map(|(index, frame)| {
                mapped(&log, index).into_iter().map(move |(column, point)| {
                    let depth = frame[640 * row + column];
                    distance(point, [depth, (cx - column as f64) * depth / fx])
                })
            });
            Errors::of(off.collect())
        };
        let (pinhole, linear) = (errors(PixelModel::Pinhole), errors(PixelModel::Linear));
        let noise = noise_mm(&frames, row);
        println!("{name}, a row: depth noise {noise:.1} mm");
        println!("  pinhole {pinhole}");
        println!("  linear  {linear}");
        // Readings are rounded to millimetres, so the bound is at least 0.3 mm.
        assert!(pinhole.rms <= noise.max(0.3) && pinhole.largest < 1.0, "{name}");
        assert!(linear.rms > 10.0 * pinhole.rms, "{name}");
    }
}

#[test]
fn a_height_of_tilted_frames_lies_on_their_3_d_points_at_that_height() {
    for (name, [fx, fy, cx, cy, per_metre]) in FOLDERS {
        let Some(recorded) = data::frames(name) else { return };
        let folder = recorded.path();
        let frames = frames(folder, per_metre);
        let stations = stations(folder);
        let down = |station: &Station| mix(station.axes[1], fy.signum(), station.axes[1], 0.0);
        let sum = stations.iter().map(down).fold([0.0; 3], |sum, it| mix(sum, 1.0, it, 1.0));
        let up = unit(mix(sum, -1.0, sum, 0.0));
        let height = |point| dot(up, point);
        let mean = stations.iter().map(|station| height(station.position)).sum::<f64>()
            / stations.len() as f64;
        let level = |axis: Vector| mix(axis, 1.0, up, -dot(up, axis));

        // The points of each frame at the mean height of the cameras, relative to its camera.
        let truths: Vec<Vec<[f64; 2]>> = frames
            .iter()
            .zip(&stations)
            .map(|(frame, station)| {
                let ahead = unit(level(station.axes[2]));
                let right = level(station.axes[0]);
                let right = unit(mix(right, 1.0, ahead, -dot(ahead, right)));
                let pixels = frame.iter().enumerate().filter(|(_, depth)| **depth > 0.0);
                let points = pixels.map(|(index, &depth)| {
                    let (column, row) = ((index % 640) as f64, (index / 640) as f64);
                    let aside = mix(
                        station.axes[0],
                        (column - cx) / fx * depth,
                        station.axes[1],
                        (row - cy) / fy * depth,
                    );
                    mix(aside, 1.0, station.axes[2], depth)
                });
                points
                    .filter(|&seen| (height(seen) + height(station.position) - mean).abs() < 0.025)
                    .map(|seen| [dot(ahead, seen), -dot(right, seen)])
                    .collect()
            })
            .collect();

        let errors = |slice, pixels| {
            let log = read(folder, slice, pixels);
            let off = truths.iter().enumerate().flat_map(|(index, truth)| {
                mapped(&log, index).into_iter().map(move |(_, point)| {
                    truth.iter().map(|&it| distance(it, point)).fold(f64::INFINITY, f64::min)
                })
            });
            let off: Vec<f64> = off.filter(|off| off.is_finite()).collect();
            (off.len(), Errors::of(off))
        };
        let noise = noise_mm(&frames, cy.round() as usize);
        let (count, pinhole) = errors(DepthSlice::Height, PixelModel::Pinhole);
        let (_, linear) = errors(DepthSlice::Height, PixelModel::Linear);
        let (_, row) = errors(DepthSlice::Row, PixelModel::Pinhole);
        println!("{name}, {count} points at a height: depth noise {noise:.1} mm");
        println!("  pinhole {pinhole}");
        println!("  linear  {linear}");
        println!("  the row on the axis instead {row}");
        assert!(count > 1_000, "{name}: {count}");
        // Adjacent points are a pixel apart, so the nearest one is up to half a pixel away.
        let pixel = 1e3 * RANGE_M / fx;
        assert!(pinhole.rms <= noise.hypot(pixel / 12f64.sqrt()), "{name}");
        assert!(pinhole.largest <= pixel, "{name}");
        assert!(linear.rms > 10.0 * pinhole.rms, "{name}");
    }
}

/// The sizes of the robots' memory.
const fn bounds(readings: usize) -> Bounds {
    Bounds { readings, own_tiles: 24, fused_tiles: 4, ..BOUNDS }
}

/// A default robot that starts at the origin and has only odometry.
fn config(slice: Slice, camera: Camera, readings: usize) -> Config {
    let pose_source = PoseSource::Odometry(Pose::default());
    Config { pose_source, ..Config::new(RobotId(1), slice.sensor(camera), bounds(readings)) }
}

const fn at(millis: u64) -> Instant {
    Instant(millis * 1_000)
}

/// A robot that stands at the origin, with odometry every 20 ms until `end`.
fn stand(robot: &mut Robot<'_>, start: u64, end: u64) {
    for moment in (start..end).step_by(20) {
        robot.odometry(at(moment), Pose::default(), at(moment));
    }
}

#[test]
fn time_of_flight_sensors_map_with_the_same_code() {
    // 8 x 8 zones over 45 degrees, and 100 x 100 pixels over 78 degrees, tilted 17 degrees down. A
    // wall is at 1.5 m. Both middle rows of the small sensor see it, as does the row of the large
    // one that meets it 100 mm below the camera, which is 260 mm above the floor.
    let small = Camera::new((9.66, 9.66), (3.5, 3.5));
    let large = Camera { pitch: 0.3, ..Camera::new((61.7, 61.7), (49.5, 49.5)) };
    let band = Slice::Band { first: 3, rows: 2, pick: Pick::Nearest };
    let height = Slice::Height { below: Millimetres(100), tolerance: Millimetres(20) };
    for (camera, width, slice, least) in [(small, 8, band, 8), (large, 100, height, 98)] {
        let (sin, cos) = f64::from(camera.pitch).sin_cos();
        let depth = |row: usize| {
            let below = (row as f64 - f64::from(camera.centre.1)) / f64::from(camera.focal.1);
            let (wall, floor) = (1_500.0 / (cos - below * sin), 260.0 / (sin + below * cos));
            if floor > 0.0 { wall.min(floor) } else { wall }.round() as u16
        };
        let lines: Vec<Vec<u16>> = (0..width).map(|row| vec![depth(row); width]).collect();

        let mut memory = Memory::<Heap>::new(&bounds(width));
        let mut robot = Robot::new(config(slice, camera, width), &mut memory).unwrap();
        let mut buffer = vec![0; slice.buffer_len(width)];
        let mut slicer =
            Slicer::new(slice, camera, width, Validity::default(), &mut buffer).unwrap();
        for (row, line) in lines.iter().enumerate() {
            slicer.line(row as u16, line).unwrap();
        }
        let readings = slicer.finish().unwrap();
        assert!(readings.iter().all(|&it| it == 0 || it.abs_diff(1_500) <= 2), "{readings:?}");
        stand(&mut robot, 0, 100);
        robot.scan(at(50), readings, at(100)).unwrap();
        let statistics = robot.statistics();
        assert_eq!((statistics.mapped, statistics.pixels.seen), (1, width as u32));
        assert!(statistics.pixels.invalid + least <= width as u32, "{statistics:?}");
        // The table takes the readings as depths, not as ranges along the rays.
        let beams = robot.beams().iter().filter(|beam| **beam != Beam::NONE);
        assert!(beams.map(|beam| beam.forward).all(|forward| forward == 1 << DIRECTION_BITS));
    }
}

#[test]
fn removed_and_flying_pixels_are_not_mapped() {
    let camera = Camera::new((343.1, 343.1), (319.5, 239.5));
    let sensor = Slice::Row(240).sensor(camera);
    let pose_source = PoseSource::Odometry(Pose::default());
    let usual = Config { pose_source, ..Config::new(RobotId(1), sensor, bounds(640)) };
    let mut row = [3_000; 640];
    row[300..340].fill(1_200);
    // There are flying pixels at both edges of the box.
    (row[299], row[340]) = (1_800, 2_200);
    let invalid = |config| {
        let mut memory = Memory::<Heap>::new(&bounds(640));
        let mut robot = Robot::new(config, &mut memory).unwrap();
        stand(&mut robot, 0, 100);
        robot.scan(at(50), &row, at(100)).unwrap();
        // Invalid readings do not count as a change of the view either.
        robot.scan(at(60), &row, at(100)).unwrap();
        assert_eq!((robot.statistics().mapped, robot.statistics().gated), (1, 1));
        robot.statistics().pixels.invalid
    };
    assert_eq!(invalid(usual), 2);
    let mut config = usual;
    config.validity.flying = 0;
    assert_eq!(invalid(config), 0);
    config.validity.removed = (1_000, 1_500);
    assert_eq!(invalid(config), 40);
    config.removed[0] = Some(Removal::Pixels { first: 0, last: 9 });
    assert_eq!(invalid(config), 50);
    // Removes the right half, by bearing: the columns from 320 on.
    let (from, to) = (Angle::from_degrees(-90.0), Angle(0));
    config.removed[1] = Some(Removal::Bearings { from, to });
    assert_eq!(invalid(config), 10 + 320 + 20);
}

#[test]
fn a_scan_of_a_robot_that_shakes_is_counted_and_not_mapped() {
    let camera = Camera::new((61.7, 61.7), (49.5, 0.0));
    let mut memory = Memory::<Heap>::new(&bounds(100));
    let mut config = config(Slice::Row(0), camera, 100);
    config.gate.distance = Millimetres(0);
    config.gate.turn = Angle(0);
    let mut robot = Robot::new(config, &mut memory).unwrap();
    let scan = |robot: &mut Robot<'_>, moment: u64| {
        robot.scan(at(moment), &[1_500; 100], at(moment + 20)).unwrap();
        (robot.statistics().mapped, robot.statistics().shaken)
    };
    stand(&mut robot, 0, 1_000);
    assert_eq!(scan(&mut robot, 950), (1, 0));
    // The robot turns by 180 degrees in one second, then stands still.
    for moment in (1_000..2_000).step_by(20) {
        let heading = Angle::from_degrees((moment - 1_000) as f64 * 0.18);
        robot.odometry(at(moment), Pose { heading, ..Pose::default() }, at(moment));
    }
    assert_eq!(scan(&mut robot, 1_950), (1, 1));
    robot.jolt(at(2_500));
    for moment in (2_000..3_000).step_by(20) {
        let heading = Angle::from_degrees(180.0);
        robot.odometry(at(moment), Pose { heading, ..Pose::default() }, at(moment));
    }
    assert_eq!(scan(&mut robot, 2_500), (1, 2));
    robot.gyro(at(2_700), Angle::from_degrees(100.0));
    assert_eq!(scan(&mut robot, 2_710), (1, 3));
    assert_eq!(scan(&mut robot, 2_900), (2, 3));
}
