//! Robots without cameras and server, for comparison: odometry alone, and each robot's own scan
//! matching (a small SLAM without loop closure).

use std::collections::HashMap;

use nalgebra::{Matrix3, Vector3};
use ubimap_protocol::{time::Instant, units::Pose};

use crate::{
    report::{BaselineErrors, BaselineSummary},
    world::{ScanEvent, World},
};

/// Motion after which a scan is matched and added to the map, in metres and radians.
const STEP_M: f64 = 0.1;
const STEP_RAD: f64 = 0.09;
/// Side of the squares in which points of the map are kept and looked for, in metres.
const SQUARE_M: f64 = 0.1;
/// Points of the map nearer to each other than this are one, in metres.
const SAME_M: f64 = 0.025;
/// Distance of points that form a line, and the greatest ratio of the variances across it and along it.
const NEAR_M: f64 = 0.1;
const FLAT: f64 = 0.1;
/// Iterations of a match, and the least number of pairs that count.
const ITERATIONS: usize = 8;
const PAIRS: usize = 20;
/// Weight of the guess in a match, for x, y and the heading, in pairs.
const PRIOR: [f64; 3] = [1.0, 1.0, 1.0];
/// Number of stretches of time.
const STRETCHES: usize = 6;

/// A pose in metres and radians.
type Plane = [f64; 3];

/// One robot on its own.
struct Alone {
    start: Plane,
    /// The matched pose, and the odometry there; `None` before the first scan.
    matched: Option<(Plane, Plane)>,
    points: HashMap<[i32; 2], Vec<[f64; 2]>>,
}

/// All robots on their own.
pub(super) struct Onboard {
    robots: Vec<Alone>,
    /// For each scan: time, and the errors of odometry and of scan matching.
    errors: Vec<(Instant, [f64; 2])>,
    distances: u64,
    scans: u64,
}

impl Onboard {
    pub(super) fn new(world: &World) -> Self {
        let robots = world.robots().iter().map(|robot| Alone {
            start: plane(robot.truth()),
            matched: None,
            points: HashMap::new(),
        });
        Self { robots: robots.collect(), errors: Vec::new(), distances: 0, scans: 0 }
    }

    /// Lets the robot of a scan estimate its pose in both ways.
    pub(super) fn note(&mut self, scan: &ScanEvent, world: &World) {
        let (Some(alone), Some(robot)) =
            (self.robots.get_mut(scan.robot), world.robots().get(scan.robot))
        else {
            return;
        };
        let (odometry, truth) = (plane(scan.odometry), plane(scan.truth));
        let dead = compose(alone.start, odometry);
        let (last, then) = alone.matched.unwrap_or((alone.start, [0.0; 3]));
        let guess = compose(last, relative(then, odometry));
        let way = relative(then, odometry);
        let moved = way[0].hypot(way[1]) >= STEP_M || way[2].abs() >= STEP_RAD;
        let mut pose = guess;
        if alone.matched.is_none() || moved {
            let sensor = robot.sensor();
            let mount = plane(sensor.mount());
            let points: Vec<[f64; 2]> = scan
                .readings_mm
                .iter()
                .enumerate()
                .filter(|(_, reading)| **reading > 0)
                .map(|(beam, &reading)| {
                    let range = f64::from(reading) / 1_000.0;
                    let [x, y] = sensor.direction(beam);
                    place(mount, [x * range, y * range])
                })
                .collect();
            if alone.matched.is_some() {
                pose = alone.matched_pose(&points, guess, &mut self.distances);
                self.scans += 1;
            }
            alone.add(&points, pose);
            alone.matched = Some((pose, odometry));
        }
        let off = |pose: Plane| (pose[0] - truth[0]).hypot(pose[1] - truth[1]);
        self.errors.push((scan.taken, [off(dead), off(pose)]));
    }

    /// The mean errors in equal stretches of time. `cameras` gives the times and errors of the poses that
    /// robots with cameras had.
    pub(super) fn summary(&self, cameras: &[(Instant, f64)]) -> BaselineSummary {
        let end = self.errors.last().map_or(1, |(at, _)| at.0 + 1);
        let stretch = |at: Instant| (at.0 as usize * STRETCHES / end as usize).min(STRETCHES - 1);
        let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let errors = (0..STRETCHES).map(|index| {
            let own = |which: usize| {
                let of_it = self.errors.iter().filter(|(at, _)| stretch(*at) == index);
                mean(of_it.map(|(_, errors)| errors[which]).collect())
            };
            let seen = cameras.iter().filter(|(at, _)| stretch(*at) == index);
            BaselineErrors {
                until_s: end as f64 * (index + 1) as f64 / STRETCHES as f64 / 1e6,
                cameras_m: mean(seen.map(|(_, error)| *error).collect()),
                odometry_m: own(0),
                matching_m: own(1),
            }
        });
        BaselineSummary {
            errors: errors.collect(),
            distances_per_scan: self.distances as f64 / self.scans.max(1) as f64,
            matched: self.scans,
        }
    }
}

impl Alone {
    /// The pose at which the points of a scan fit the lines through the map's points best, with the guess
    /// as a prior (Gauss-Newton).
    fn matched_pose(&self, points: &[[f64; 2]], guess: Plane, distances: &mut u64) -> Plane {
        let mut pose = guess;
        for _ in 0..ITERATIONS {
            let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
            let mut pairs = 0;
            for &point in points {
                let at = place(pose, point);
                let Some(([x, y], [nx, ny])) = self.nearest_line(at, distances) else { continue };
                let lever = [at[0] - pose[0], at[1] - pose[1]];
                let row = Vector3::new(nx, ny, ny * lever[0] - nx * lever[1]);
                normal += row * row.transpose();
                right += row * (nx * (x - at[0]) + ny * (y - at[1]));
                pairs += 1;
            }
            if pairs < PAIRS {
                return guess;
            }
            for axis in 0..3 {
                let back = guess[axis] - pose[axis];
                normal[(axis, axis)] += PRIOR[axis];
                right[axis] += PRIOR[axis] * back;
            }
            let Some(step) = normal.cholesky().map(|it| it.solve(&right)) else { return guess };
            pose = [pose[0] + step[0], pose[1] + step[1], pose[2] + step[2]];
        }
        pose
    }

    /// The line through the points of the map around a place: their mean, and the normal. `None` if they
    /// are few or form no line.
    fn nearest_line(&self, at: [f64; 2], distances: &mut u64) -> Option<([f64; 2], [f64; 2])> {
        let (mut count, mut sum, mut squares) = (0.0, [0.0; 2], [0.0; 3]);
        for &[x, y] in self.around(at) {
            *distances += 1;
            let (dx, dy) = (x - at[0], y - at[1]);
            if dx.hypot(dy) < NEAR_M {
                count += 1.0;
                sum = [sum[0] + dx, sum[1] + dy];
                squares = [squares[0] + dx * dx, squares[1] + dx * dy, squares[2] + dy * dy];
            }
        }
        if count < 4.0 {
            return None;
        }
        let mean = sum.map(|it| it / count);
        let xx = squares[0] / count - mean[0] * mean[0];
        let xy = squares[1] / count - mean[0] * mean[1];
        let yy = squares[2] / count - mean[1] * mean[1];
        let apart = (xx - yy).hypot(2.0 * xy);
        let [wide, narrow] = [(xx + yy + apart) / 2.0, (xx + yy - apart) / 2.0];
        let angle = (2.0 * xy).atan2(xx - yy) / 2.0;
        let normal = [-angle.sin(), angle.cos()];
        (narrow < FLAT * wide).then(|| ([at[0] + mean[0], at[1] + mean[1]], normal))
    }

    /// The points of the map in the squares around a place.
    fn around(&self, at: [f64; 2]) -> impl Iterator<Item = &[f64; 2]> {
        let [x, y] = square(at);
        let squares = (-1..=1).flat_map(move |dy| (-1..=1).map(move |dx| [x + dx, y + dy]));
        squares.filter_map(|square| self.points.get(&square)).flatten()
    }

    fn add(&mut self, points: &[[f64; 2]], pose: Plane) {
        for &point in points {
            let at = place(pose, point);
            let is_far = |it: &[f64; 2]| (it[0] - at[0]).hypot(it[1] - at[1]) > SAME_M;
            if self.around(at).all(is_far) {
                self.points.entry(square(at)).or_default().push(at);
            }
        }
    }
}

fn square(at: [f64; 2]) -> [i32; 2] {
    at.map(|metres| (metres / SQUARE_M).floor() as i32)
}

fn plane(pose: Pose) -> Plane {
    [pose.x.metres(), pose.y.metres(), pose.heading.radians()]
}

/// A point given in the frame of a pose.
fn place([x, y, heading]: Plane, [px, py]: [f64; 2]) -> [f64; 2] {
    let (sin, cos) = heading.sin_cos();
    [x + px * cos - py * sin, y + px * sin + py * cos]
}

fn compose(frame: Plane, pose: Plane) -> Plane {
    let [x, y] = place(frame, [pose[0], pose[1]]);
    [x, y, frame[2] + pose[2]]
}

/// A pose in the frame of another.
fn relative(frame: Plane, pose: Plane) -> Plane {
    let (sin, cos) = frame[2].sin_cos();
    let (dx, dy) = (pose[0] - frame[0], pose[1] - frame[1]);
    let turn = (pose[2] - frame[2] + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU);
    [dx * cos + dy * sin, dy * cos - dx * sin, turn - std::f64::consts::PI]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scan_of_a_corner_is_matched_with_the_map_of_it() {
        let line = |step: i32| f64::from(step) * 0.02;
        let corner: Vec<[f64; 2]> =
            (0..100).flat_map(|step| [[line(step), 2.0], [2.0, line(step)]]).collect();
        let mut alone = Alone { start: [0.0; 3], matched: None, points: HashMap::new() };
        alone.add(&corner, [0.0; 3]);
        let truth = [0.03, -0.02, 0.02];
        let seen: Vec<[f64; 2]> = corner
            .iter()
            .map(|&[x, y]| {
                let [x, y, _] = relative(truth, [x, y, 0.0]);
                [x, y]
            })
            .collect();
        let found = alone.matched_pose(&seen, [0.0; 3], &mut 0);
        assert!(found.iter().zip(truth).all(|(a, b)| (a - b).abs() < 0.004), "{found:?}");
        let again = compose([1.0, 2.0, 3.0], relative([1.0, 2.0, 3.0], truth));
        assert!(again.iter().zip(truth).all(|(a, b)| (a - b).abs() < 1e-9), "{again:?}");
    }
}
