//! How a robot has moved between two views of the same surroundings.

use ubimap_protocol::units::Pose;

use super::view::{Point, View, signed};

/// Two neighbouring points farther apart than this are not one surface, in metres.
const JUMP: f64 = 0.25;
/// Difference of two distances to the same surface, in metres: the unit of a vector, and noise.
const SAME: f64 = 0.04;
/// Minimum number of points of a view that see surfaces of the other, and share of those that agree.
const LEAST_COMMON: usize = 6;
const LEAST_AGREED: f64 = 0.75;
/// Another motion that explains more than this part of the best one's columns, and them about as well, may be the
/// true one.
const RIVAL: f64 = 0.8;
/// Standard deviation of points across their line from which on they are more than a wall, in metres.
const WIDE: f64 = 0.08;
/// Number of places at which a motion is looked for closely.
const PLACES: usize = 5;
/// The farthest motion that is looked for, and the turn up to which the wheels have counted straight ahead.
const FARTHEST: Motion = Motion { ahead: 1.2, turn: std::f64::consts::PI };
const STRAIGHT: f64 = 0.25;
/// The error of a way by a single column, in metres: their errors are not independent, so few are worth little.
const FEW: f64 = 0.3;
/// Number of columns that are compared at first.
const COARSE_COLUMNS: usize = 24;

/// A motion in the robot's frame: metres along the arc's chord ahead, and radians to the left.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Motion {
    /// Forward.
    pub(super) ahead: f64,
    /// Counter-clockwise.
    pub(super) turn: f64,
}

impl Motion {
    /// The motion from one pose to another: the chord in the direction of its middle.
    pub(super) fn between(from: Pose, to: Pose) -> Self {
        let [x, y] = [(to.x - from.x).metres(), (to.y - from.y).metres()];
        let turn = signed(to.heading - from.heading);
        let middle = from.heading.radians() + turn / 2.0;
        Self { ahead: x * libm::cos(middle) + y * libm::sin(middle), turn }
    }
}

/// A motion by what was seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Sensed {
    /// The motion.
    pub(super) motion: Motion,
    /// By how much the way may be wrong, in metres.
    pub(super) error_m: f64,
}

/// The motion between two views of the same surroundings; `None` if they do not tell: they have too little in
/// common, or another motion explains them as well. The wheels have counted `counted`. If that is straight ahead,
/// a motion like it is preferred, even by a single wall; any other one needs a corner or a thing to be seen.
pub(super) fn sensed(before: &View, after: &View, counted: Motion) -> Option<Sensed> {
    let (points, most): (Vec<Point>, _) = (before.points().collect(), FARTHEST);
    if counted.turn.abs() < STRAIGHT {
        let turns = || Steps::around(counted.turn, STRAIGHT, 0.035);
        let arcs = Steps::around(0.0, most.ahead, 0.02)
            .flat_map(|ahead| turns().map(move |turn| Shift::arc(ahead, turn)));
        let places = candidates(&points, &after.seen, arcs, SAME);
        return chosen(&points, after, &places, true).map(|(_, sensed)| sensed);
    }
    // Few columns are enough to find the places of the optima.
    let every = after.seen.len().div_ceil(COARSE_COLUMNS).max(1);
    let few: Vec<(f64, f64)> = after.seen.iter().copied().step_by(every).collect();
    let all = Steps::around(0.0, most.ahead, 0.06).flat_map(|x| {
        Steps::around(0.0, most.ahead / 2.0, 0.06).flat_map(move |y| {
            Steps::around(0.0, most.turn, 0.07).map(move |turn| Shift { x, y, turn })
        })
    });
    let places = candidates(&points, &few, all, 3.0 * SAME);
    let (shift, found) = chosen(&points, after, &places, false)?;
    Some(found).filter(|_| !is_line(&points, after, shift))
}

/// Numbers around another one.
struct Steps;

impl Steps {
    fn around(middle: f64, most: f64, step: f64) -> impl Iterator<Item = f64> {
        let count = (most / step).ceil() as i32;
        (-count..=count).map(move |index| middle + f64::from(index) * step)
    }
}

/// A pose in the frame of another one: metres ahead and to the left, and radians.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shift {
    x: f64,
    y: f64,
    turn: f64,
}

impl Shift {
    fn arc(ahead: f64, turn: f64) -> Self {
        let middle = turn / 2.0;
        Self { x: ahead * libm::cos(middle), y: ahead * libm::sin(middle), turn }
    }

    /// The way in the direction of its middle.
    fn motion(self) -> Motion {
        let middle = self.turn / 2.0;
        Motion { ahead: self.x * libm::cos(middle) + self.y * libm::sin(middle), turn: self.turn }
    }

    fn is_far_from(self, other: Self) -> bool {
        libm::hypot(self.x - other.x, self.y - other.y) > 0.12
            || libm::remainder(self.turn - other.turn, std::f64::consts::TAU).abs() > 0.15
    }
}

/// Up to [`PLACES`] motions, far from each other, that explain a view, the best one first.
fn candidates(
    points: &[Point],
    seen: &[(f64, f64)],
    motions: impl Iterator<Item = Shift>,
    same: f64,
) -> Vec<Shift> {
    let judged = motions.map(|shift| (shift, Judged::new(points, seen, shift, same)));
    let mut good: Vec<(Shift, f64)> =
        judged.filter(|(_, it)| it.is_good()).map(|(shift, it)| (shift, it.score(same))).collect();
    good.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut places: Vec<Shift> = Vec::new();
    for (shift, _) in good {
        if places.len() < PLACES && places.iter().all(|place| place.is_far_from(shift)) {
            places.push(shift);
        }
    }
    places
}

/// The best motion near these, unless another one explains its columns about as well.
fn chosen(
    points: &[Point],
    after: &View,
    places: &[Shift],
    is_arc: bool,
) -> Option<(Shift, Sensed)> {
    let refined = places.iter().filter_map(|place| refined(points, after, *place, is_arc));
    let refined: Vec<(Shift, Judged, f64)> = refined.collect();
    let score = |it: &Judged| it.score(SAME);
    let &(shift, it, error_m) =
        refined.iter().max_by(|a, b| score(&a.1).total_cmp(&score(&b.1)))?;
    let quality = |it: &Judged| it.score(SAME) / it.common as f64;
    let is_rival = |other: &Judged| {
        other.agreed as f64 > RIVAL * it.agreed as f64 && quality(other) > RIVAL * quality(&it)
    };
    let has_rival =
        refined.iter().any(|(other, judged, _)| other.is_far_from(shift) && is_rival(judged));
    (!has_rival).then_some((shift, Sensed { motion: shift.motion(), error_m }))
}

/// The optimum near a motion, by the mean difference, which the vectors' coarse unit does not spoil; and by how
/// much its way may be wrong.
fn refined(
    points: &[Point],
    after: &View,
    near: Shift,
    is_arc: bool,
) -> Option<(Shift, Judged, f64)> {
    let mut found: Option<(Shift, Judged, f64)> = None;
    for (most, step) in [(0.06, 0.02), (0.03, 0.005)] {
        let from @ Shift { x, y, turn } = found.map_or(near, |(shift, ..)| shift);
        // 20 mm and a degree and a half, in turn.
        let turns = || Steps::around(turn, 1.2 * most, 1.2 * step);
        let tried: Vec<Shift> = if is_arc {
            Steps::around(from.motion().ahead, most, step)
                .flat_map(|ahead| turns().map(move |turn| Shift::arc(ahead, turn)))
                .collect()
        } else {
            let all = Steps::around(x, most, step).flat_map(|x| {
                Steps::around(y, most, step)
                    .flat_map(move |y| turns().map(move |turn| Shift { x, y, turn }))
            });
            all.collect()
        };
        let judge = |shift: Shift| (shift, Judged::new(points, &after.seen, shift, SAME));
        let judged: Vec<(Shift, Judged)> =
            tried.into_iter().map(judge).filter(|(_, it)| it.is_good()).collect();
        let most_agreed = judged.iter().map(|(_, it)| it.agreed).max()?;
        let usable = || judged.iter().filter(|(_, it)| it.agreed + 1 >= most_agreed);
        let &(best, it) = usable().min_by(|a, b| a.1.off.total_cmp(&b.1.off))?;
        // As well as the optimum, by the usual rule of least squares at two standard deviations.
        let limit = it.off * (1.0 + 4.0 / it.agreed.saturating_sub(3).max(1) as f64).sqrt();
        let ways = usable().filter(|(_, it)| it.off <= limit).map(|(it, _)| it.motion().ahead);
        let spread = ways.map(|way| (way - best.motion().ahead).abs()).fold(step, f64::max);
        found = Some((best, it, spread.max(FEW / it.agreed.max(1) as f64)));
    }
    found
}

/// Whether the points that are seen from both places lie on one line: then they do not tell which of two walls
/// they are.
fn is_line(points: &[Point], after: &View, shift: Shift) -> bool {
    let (sin, cos) = (libm::sin(shift.turn), libm::cos(shift.turn));
    let common: Vec<Point> = after
        .seen
        .iter()
        .filter(|(bearing, distance)| {
            let far = cast(points, [shift.x, shift.y], shift.turn + bearing);
            far.is_some_and(|far| (far - distance).abs() <= 3.0 * SAME)
        })
        .map(|(bearing, distance)| {
            let [x, y] = [distance * libm::cos(*bearing), distance * libm::sin(*bearing)];
            [shift.x + x * cos - y * sin, shift.y + x * sin + y * cos]
        })
        .collect();
    let count = common.len().max(1) as f64;
    let mean = |axis: usize| common.iter().map(|p| p[axis]).sum::<f64>() / count;
    let [mx, my] = [mean(0), mean(1)];
    let sum = |of: fn(f64, f64) -> f64| {
        common.iter().map(|p| of(p[0] - mx, p[1] - my)).sum::<f64>() / count
    };
    let [xx, xy, yy] = [sum(|x, _| x * x), sum(|x, y| x * y), sum(|_, y| y * y)];
    // The smaller eigenvalue: the variance across the best line.
    let across = (xx + yy) / 2.0 - libm::hypot((xx - yy) / 2.0, xy);
    across.max(0.0).sqrt() < WIDE
}

/// How well a motion explains a view.
#[derive(Clone, Copy, Debug)]
struct Judged {
    /// Number of columns that see a surface of the other view, and of those that agree with it.
    common: usize,
    agreed: usize,
    /// Root mean square of the differences that count as agreeing, in metres.
    off: f64,
}

impl Judged {
    fn new(points: &[Point], seen: &[(f64, f64)], shift: Shift, same: f64) -> Self {
        let (mut common, mut agreed, mut squares) = (0, 0_usize, 0.0);
        for &(bearing, distance) in seen {
            let far = cast(points, [shift.x, shift.y], shift.turn + bearing);
            let Some(expected) = far else { continue };
            common += 1;
            let off = expected - distance;
            if off.abs() <= same {
                agreed += 1;
                squares += off * off;
            }
        }
        Self { common, agreed, off: (squares / agreed.max(1) as f64).sqrt() }
    }

    fn is_good(&self) -> bool {
        self.common >= LEAST_COMMON && self.agreed as f64 >= LEAST_AGREED * self.common as f64
    }

    /// Higher is better: many that agree, few that don't, and small differences.
    fn score(&self, same: f64) -> f64 {
        let disagreed = self.common - self.agreed;
        self.agreed as f64 * (1.0 - self.off / same / 2.0) - disagreed as f64
    }
}

/// How far it is to the surfaces through these points along a ray from a point. The points are in the order of
/// their bearings, so that a surface has a front.
fn cast(points: &[Point], from: Point, bearing: f64) -> Option<f64> {
    let (sin, cos) = (libm::sin(bearing), libm::cos(bearing));
    // Along the ray, and to its left.
    let along = |p: Point| {
        let [x, y] = [p[0] - from[0], p[1] - from[1]];
        [x * cos + y * sin, y * cos - x * sin]
    };
    let hits = points.windows(2).filter_map(|pair| {
        let ([a, b], gap) = (
            [along(pair[0]), along(pair[1])],
            libm::hypot(pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]),
        );
        if gap > JUMP || a[1] > 0.0 || b[1] <= 0.0 {
            return None;
        }
        let part = a[1] / (a[1] - b[1]);
        Some(a[0] + part * (b[0] - a[0])).filter(|&distance| distance > 0.0)
    });
    hits.reduce(f64::min)
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::units::Angle;

    use super::*;

    /// What a robot sees in a room of 3 x 2 m with a box in a corner: distances to the walls, in vectors'
    /// units, at bearings from -70 to 70 degrees.
    fn view(at: Point, heading: f64) -> View {
        let corners =
            [[3.0, 0.0], [3.0, 1.4], [2.5, 1.4], [2.5, 2.0], [0.0, 2.0], [0.0, 0.0], [3.0, 0.0]];
        let columns = 57;
        let bearing = |index: usize| (-70.0 + 2.5 * index as f64).to_radians();
        let seen = (0..columns).filter_map(|index| {
            let bearing = bearing(index);
            let far = corners.windows(2).filter_map(|wall| hit(at, heading + bearing, wall));
            far.reduce(f64::min).map(|far| (bearing, (far / 0.02).round() * 0.02))
        });
        let seen = seen.collect();
        View { seen, columns, from_to: [bearing(0), bearing(columns - 1)] }
    }

    /// Distance to a wall of any length.
    fn hit(from: Point, bearing: f64, wall: &[Point]) -> Option<f64> {
        let (way, side) =
            ([bearing.cos(), bearing.sin()], [wall[1][0] - wall[0][0], wall[1][1] - wall[0][1]]);
        let to = [wall[0][0] - from[0], wall[0][1] - from[1]];
        let cross = |a: Point, b: Point| a[0] * b[1] - a[1] * b[0];
        let across = cross(way, side);
        let (far, part) = (cross(to, side) / across, cross(to, way) / across);
        (far > 0.0 && (0.0..=1.0).contains(&part)).then_some(far)
    }

    /// Where a robot in the room is after a motion.
    fn after(at: Point, heading: f64, Motion { ahead, turn }: Motion) -> View {
        let middle = heading + turn / 2.0;
        view([at[0] + ahead * middle.cos(), at[1] + ahead * middle.sin()], heading + turn)
    }

    #[test]
    fn the_motion_between_two_views_is_found_whatever_the_wheels_have_counted() {
        let (at, heading) = ([1.0, 0.9], 0.1);
        let before = view(at, heading);
        let straight = Motion { ahead: 0.3, turn: 0.0 };
        for (ahead, turn) in [(0.3, 0.0), (-0.2, 0.0), (0.25, 0.2), (0.0, 0.7), (0.1, -0.8)] {
            let motion = Motion { ahead, turn };
            let counted = [Motion { ahead: -0.2, turn: 1.0 }, straight];
            // One that the wheels have counted as straight ahead is not looked for elsewhere.
            for counted in &counted[..if turn.abs() < 0.25 { 2 } else { 1 }] {
                let found = sensed(&before, &after(at, heading, motion), *counted);
                let found = found.unwrap_or_else(|| panic!("{motion:?} {counted:?}: not found"));
                let off = (found.motion.ahead - ahead).abs();
                assert!(off < 0.015 && off <= found.error_m + 0.005, "{motion:?}: {found:?}");
                assert!((found.motion.turn - turn).abs() < 0.03, "{motion:?}: {found:?}");
            }
        }
    }

    #[test]
    fn views_that_have_little_in_common_or_explain_much_tell_nothing() {
        let before = view([1.0, 0.9], 0.0);
        for counted in [Motion { ahead: 0.3, turn: 0.0 }, Motion { ahead: 0.0, turn: 1.0 }] {
            assert_eq!(sensed(&before, &View::default(), counted), None);
            // All around at the same distance: any turn explains it.
            let round = (-70..70).map(|degree| (f64::from(degree).to_radians(), 1.0)).collect();
            let round = View { seen: round, columns: 140, from_to: [-1.2, 1.2] };
            let found = sensed(&round, &round, counted);
            assert!(found.is_none_or(|it| counted.turn == 0.0 && it.motion.ahead.abs() < 0.05));
        }
        // One wall, then another one: it could have driven backwards.
        let wall = |x: f64| {
            let degrees = (-30..=30).map(|degree| f64::from(degree).to_radians());
            let seen = degrees.map(|bearing| (bearing, x / bearing.cos())).collect();
            View { seen, columns: 61, from_to: [-0.5, 0.5] }
        };
        assert_eq!(sensed(&wall(1.5), &wall(1.8), Motion { ahead: 0.2, turn: 1.6 }), None);
        let found = sensed(&wall(1.5), &wall(1.2), Motion { ahead: 0.29, turn: 0.0 }).unwrap();
        assert!((found.motion.ahead - 0.3).abs() < 0.01 && found.error_m < 0.03, "{found:?}");
    }

    #[test]
    fn a_motion_between_two_poses_is_in_the_robots_frame() {
        let [from, to] = [Pose::from_metres(1.0, 1.0, 0.0), Pose::from_metres(1.0, 1.5, 0.0)];
        let from = Pose { heading: Angle::from_degrees(90.0), ..from };
        let moved = Motion::between(from, Pose { heading: Angle::from_degrees(90.0), ..to });
        assert!((moved.ahead - 0.5).abs() < 1e-3 && moved.turn == 0.0, "{moved:?}");
    }
}
