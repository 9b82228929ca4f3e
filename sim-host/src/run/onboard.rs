//! Robots without cameras and server, for comparison: odometry alone, and each robot's own scan
//! matching (a small SLAM without loop closure).

use std::collections::HashMap;

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
const SAME_M: f64 = 0.03;
/// Iterations of a match, and the least number of pairs that count.
const ITERATIONS: usize = 12;
const PAIRS: usize = 20;
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
    /// The pose at which the points of a scan fit those of the map best: pairs of nearest points, and the
    /// rigid motion that is best for all pairs, again and again.
    fn matched_pose(&self, points: &[[f64; 2]], guess: Plane, distances: &mut u64) -> Plane {
        let mut pose = guess;
        for _ in 0..ITERATIONS {
            let mut pairs: Vec<([f64; 2], [f64; 2])> = Vec::new();
            for &point in points {
                let at = place(pose, point);
                pairs.extend(self.nearest(at, distances).map(|there| (at, there)));
            }
            if pairs.len() < PAIRS {
                return guess;
            }
            let step = rigid(&pairs);
            pose = [
                pose[0] * step[2].cos() - pose[1] * step[2].sin() + step[0],
                pose[0] * step[2].sin() + pose[1] * step[2].cos() + step[1],
                pose[2] + step[2],
            ];
        }
        pose
    }

    /// The nearest point of the map in the squares around.
    fn nearest(&self, at: [f64; 2], distances: &mut u64) -> Option<[f64; 2]> {
        let [x, y] = square(at);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| [x + dx, y + dy]));
        let points = around.filter_map(|square| self.points.get(&square)).flatten();
        let mut best: Option<(f64, [f64; 2])> = None;
        for &point in points {
            *distances += 1;
            let far = (point[0] - at[0]).hypot(point[1] - at[1]);
            if far < SQUARE_M && best.is_none_or(|(least, _)| far < least) {
                best = Some((far, point));
            }
        }
        best.map(|(_, point)| point)
    }

    fn add(&mut self, points: &[[f64; 2]], pose: Plane) {
        for &point in points {
            let at = place(pose, point);
            let near = self.points.entry(square(at)).or_default();
            if near.iter().all(|it| (it[0] - at[0]).hypot(it[1] - at[1]) > SAME_M) {
                near.push(at);
            }
        }
    }
}

/// The rotation about the origin and the shift that bring the first points of all pairs to the second
/// (least squares): x, y and angle.
fn rigid(pairs: &[([f64; 2], [f64; 2])]) -> Plane {
    let count = pairs.len() as f64;
    let mean = |pick: fn(&([f64; 2], [f64; 2])) -> [f64; 2]| {
        let sum = pairs.iter().map(pick).fold([0.0; 2], |sum, it| [sum[0] + it[0], sum[1] + it[1]]);
        [sum[0] / count, sum[1] / count]
    };
    let (from, to) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let (mut dot, mut cross) = (0.0, 0.0);
    for (a, b) in pairs {
        let (ax, ay, bx, by) = (a[0] - from[0], a[1] - from[1], b[0] - to[0], b[1] - to[1]);
        dot += ax * bx + ay * by;
        cross += ax * by - ay * bx;
    }
    let angle = cross.atan2(dot);
    let (sin, cos) = angle.sin_cos();
    [to[0] - from[0] * cos + from[1] * sin, to[1] - from[0] * sin - from[1] * cos, angle]
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
    fn a_rigid_motion_is_found_again() {
        let truth = [0.3, -0.2, 0.4];
        let points = [[1.0, 0.0], [0.0, 2.0], [-1.0, 1.5], [3.0, -1.0]];
        let pairs: Vec<_> = points.iter().map(|&point| (point, place(truth, point))).collect();
        let found = rigid(&pairs);
        assert!(found.iter().zip(truth).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
        let pose = [1.0, 2.0, 3.0];
        let again = compose(pose, relative(pose, truth));
        assert!(again.iter().zip(truth).all(|(a, b)| (a - b).abs() < 1e-9), "{again:?}");
    }
}
