//! The pointset of Aluckal et al.: the points of the readings that a policy selects, at the poses of
//! the robot's own odometry.

use std::{collections::HashSet, fmt::Write};

use image::{Rgb, RgbImage};
use ubimap_agent::{
    Config,
    map::{Policy, Selected, Selection},
    sense::{Beam, DIRECTION_BITS, Validity, fill_beams},
};
use ubimap_protocol::units::Pose;

use crate::{
    report::PointsSummary,
    world::{ScanEvent, World},
};

/// Side of the squares in which points are redundant, in metres.
const SQUARE_M: f64 = 0.025;
/// Maximum distance of a point from its surface that counts as roughness, in metres.
const ROUGH_M: f64 = 0.1;
/// Distance beyond a surface from which on a point is beyond it, in metres.
const BEYOND_M: f64 = 0.05;
/// Pixels of the picture per metre, and its margin in metres.
const SCALE: f64 = 120.0;
const MARGIN_M: f64 = 0.5;

/// A point in `map`, in metres, and how far beyond the surface of its ray it lies; negative before it.
struct Point {
    at: [f64; 2],
    beyond_m: Option<f64>,
}

/// One robot's part in a pointset.
struct Draughtsman {
    config: Config<()>,
    beams: Vec<Beam>,
    selection: Selection,
    start: Pose,
}

/// The points of all robots.
pub(super) struct Pointset {
    robots: Vec<Draughtsman>,
    points: Vec<Point>,
    squares: HashSet<[i32; 2]>,
    summary: PointsSummary,
}

impl Pointset {
    /// No points yet of robots with these configurations and true poses.
    pub(super) fn new<D: Copy>(robots: impl Iterator<Item = (Config<D>, Pose)>) -> Self {
        let robots = robots.map(|(config, start)| {
            let mut beams = vec![Beam::default(); config.bounds.readings];
            fill_beams(&mut beams, config.sensor, config.mounting);
            let selection = Selection::new(config.policy, &beams);
            Draughtsman { config: config.with_drive(()), beams, selection, start }
        });
        Self {
            robots: robots.collect(),
            points: Vec::new(),
            squares: HashSet::new(),
            summary: PointsSummary::default(),
        }
    }

    /// Notes how many readings of a scan were masked.
    pub(super) fn masked(&mut self, readings: u64) {
        self.summary.masked += readings;
    }

    /// Adds the points of a scan that the policy selects.
    pub(super) fn note(&mut self, scan: &ScanEvent, world: &World) {
        let (Some(robot), Some(simulated)) =
            (self.robots.get_mut(scan.robot), world.robots().get(scan.robot))
        else {
            return;
        };
        self.summary.scans += 1;
        let pose = within(robot.start, scan.odometry);
        let selected = robot.selection.select(robot.config.gate, pose, &scan.readings_mm);
        robot.selection.mapped(pose, Some(scan.odometry), &scan.readings_mm, &selected);
        let (Selected::Moved(part) | Selected::Changed(part)) = selected else { return };
        let mut readings = scan.readings_mm.clone();
        Validity::of(robot.config.sensor).clean(&mut readings);
        let mount = simulated.sensor().mount();
        let eye = within(scan.truth, mount);
        let height_m = simulated.sensor().height_m();
        let before = self.points.len();
        let mut filled = Vec::new();
        for index in part {
            let (Some(&reading), Some(&beam)) = (readings.get(index), robot.beams.get(index))
            else {
                continue;
            };
            let Some(at) = robot.point(pose, beam, reading) else { continue };
            let square = at.map(|metres| (metres / SQUARE_M).floor() as i32);
            let is_known = self.squares.contains(&square);
            if is_known && robot.config.policy == Policy::Full {
                continue;
            }
            self.summary.redundant += u64::from(is_known);
            filled.push(square);
            let eye = [eye.x.metres(), eye.y.metres()];
            let far = (at[0] - eye[0]).hypot(at[1] - eye[1]);
            let surface = world.range_m(eye, at, height_m);
            self.points.push(Point { at, beyond_m: surface.map(|surface| far - surface) });
        }
        self.squares.extend(filled);
        self.summary.mapped += u64::from(self.points.len() > before);
    }

    pub(super) fn summary(&self) -> PointsSummary {
        let mut beyond: Vec<f64> = self.points.iter().filter_map(|point| point.beyond_m).collect();
        beyond.sort_by(f64::total_cmp);
        let rough: Vec<f64> = beyond.iter().copied().filter(|it| it.abs() <= ROUGH_M).collect();
        let squares: f64 = rough.iter().map(|it| it * it).sum();
        let most = beyond.get(beyond.len().saturating_mul(99) / 100).copied().unwrap_or_default();
        PointsSummary {
            kept: self.points.len() as u64,
            rough_mm: 1_000.0 * (squares / rough.len().max(1) as f64).sqrt(),
            beyond: beyond.iter().filter(|&&it| it > BEYOND_M).count() as u64,
            overshoot_mm: 1_000.0 * most.max(0.0),
            ..self.summary
        }
    }

    /// The points as a table: x and y in `map`, in metres.
    pub(super) fn table(&self) -> String {
        let mut table = String::from("x_m,y_m\n");
        for Point { at: [x, y], .. } in &self.points {
            // Writing to a string can't fail.
            let _ = writeln!(table, "{x:.3},{y:.3}");
        }
        table
    }

    /// The points in blue over the true surfaces in black (Aluckal, figure 5); those beyond a surface in
    /// red.
    pub(super) fn picture(&self, world: &World, side_m: f64) -> RgbImage {
        let surfaces: Vec<[f64; 2]> = world
            .truth()
            .surfaces
            .iter()
            .map(|&(x, y)| [x, y].map(|cell| (f64::from(cell) + 0.5) * side_m))
            .collect();
        let edge = |axis: usize, fold: fn(f64, f64) -> f64, from: f64| {
            surfaces.iter().map(|at| at[axis]).fold(from, fold)
        };
        let low = [0, 1].map(|axis| edge(axis, f64::min, f64::INFINITY) - MARGIN_M);
        let high = [0, 1].map(|axis| edge(axis, f64::max, f64::NEG_INFINITY) + MARGIN_M);
        let size = [0, 1].map(|axis| ((high[axis] - low[axis]) * SCALE).clamp(1.0, 4e3) as u32);
        let mut image = RgbImage::from_pixel(size[0], size[1], Rgb([255; 3]));
        let mut dot = |at: [f64; 2], half: i64, colour: [u8; 3]| {
            let x = ((at[0] - low[0]) * SCALE) as i64;
            let y = ((high[1] - at[1]) * SCALE) as i64;
            for (x, y) in
                (x - half..=x + half).flat_map(|x| (y - half..=y + half).map(move |y| (x, y)))
            {
                if let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y))
                    && let Some(pixel) = image.get_pixel_mut_checked(x, y)
                {
                    *pixel = Rgb(colour);
                }
            }
        };
        surfaces.iter().for_each(|&at| dot(at, (SCALE * side_m / 2.0) as i64, [0; 3]));
        for point in &self.points {
            let is_beyond = point.beyond_m.is_some_and(|it| it > BEYOND_M);
            dot(point.at, 0, if is_beyond { [220, 40, 40] } else { [60, 110, 230] });
        }
        image
    }
}

impl Draughtsman {
    /// The point of a reading; `None` beyond the range of the map.
    fn point(&self, pose: Pose, beam: Beam, reading: u16) -> Option<[f64; 2]> {
        if reading == 0 || beam == Beam::NONE {
            return None;
        }
        let length = f64::from(reading) / f64::from(1_u32 << DIRECTION_BITS);
        let (forward, left) = (f64::from(beam.forward) * length, f64::from(beam.left) * length);
        let mount = self.config.mounting;
        // The sensor's heading is already in the beams.
        let [x, y] = [mount.x.metres() + forward / 1e3, mount.y.metres() + left / 1e3];
        let (sin, cos) = pose.heading.radians().sin_cos();
        let is_near = forward.hypot(left) <= f64::from(self.config.bounds.max_range);
        is_near.then(|| [pose.x.metres() + x * cos - y * sin, pose.y.metres() + x * sin + y * cos])
    }
}

/// A pose given in the frame of another.
fn within(frame: Pose, pose: Pose) -> Pose {
    let (sin, cos) = frame.heading.radians().sin_cos();
    let (x, y) = (pose.x.metres(), pose.y.metres());
    Pose::from_metres(
        frame.x.metres() + x * cos - y * sin,
        frame.y.metres() + x * sin + y * cos,
        frame.heading.radians() + pose.heading.radians(),
    )
}
