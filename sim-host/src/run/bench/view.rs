//! What a robot sees, from its distance vectors: points around it, a line that moves along with it, and how it
//! has moved between two views.

use ubimap_protocol::{
    message::DistanceVector,
    units::{Angle, Pose},
};

/// Half of the points that are farthest ahead must be this near to one line for a flat view, in metres.
const FLAT: f64 = 0.03;
/// Minimum number of points on that line, and share of all points.
const FLAT_POINTS: usize = 6;
const FLAT_SHARE: f64 = 0.4;
/// Two neighbouring points farther apart than this are not one surface, in metres.
const JUMP: f64 = 0.25;
/// Difference of two distances to the same surface, in metres: the unit of a vector, and noise.
const SAME: f64 = 0.04;
/// Minimum number of points of a view that see surfaces of the other, and share of those that agree.
const LEAST_COMMON: usize = 8;
const LEAST_AGREED: f64 = 0.75;

/// A point that the robot sees, in `base_link`: metres ahead and to the left.
pub(super) type Point = [f64; 2];

/// A view: its columns, each with a bearing in radians and a distance in metres. Columns without a return are
/// left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct View {
    /// Bearing and distance, in the order of the columns.
    pub(super) seen: Vec<(f64, f64)>,
    /// Number of columns, those without a return included.
    pub(super) columns: usize,
    /// The first and the last bearing, in radians.
    pub(super) from_to: [f64; 2],
}

impl View {
    /// The view of a vector.
    pub(super) fn of(vector: &DistanceVector) -> Self {
        let first = signed(vector.first);
        let step = f64::from(vector.step) * std::f64::consts::TAU / 65_536.0;
        let bearing = |index: usize| first + index as f64 * step;
        let columns = vector.distances.len();
        let unit = DistanceVector::UNIT.metres();
        let known = |&(_, code): &(usize, &u8)| *code != 0 && *code != DistanceVector::BEYOND;
        let seen = vector.distances.iter().enumerate().filter(known);
        let seen = seen.map(|(index, code)| (bearing(index), f64::from(*code) * unit)).collect();
        Self { seen, columns, from_to: [first, bearing(columns.saturating_sub(1))] }
    }

    /// The points.
    pub(super) fn points(&self) -> impl Iterator<Item = Point> {
        self.seen.iter().map(|&(bearing, distance)| {
            [distance * libm::cos(bearing), distance * libm::sin(bearing)]
        })
    }

    /// How far ahead of `base_link` the line across is that limits the view, if it is flat: nothing lies
    /// beyond, and many points lie on it. That is a wall across, or the floor before a sensor that looks down.
    pub(super) fn flat_m(&self) -> Option<f64> {
        let mut ahead: Vec<f64> = self.points().map(|[x, _]| x).filter(|&x| x > 0.0).collect();
        ahead.sort_by(f64::total_cmp);
        let farthest = ahead.len().checked_sub(1)?;
        // The farthest ones but one in ten, which may be outliers.
        let limit = ahead[farthest - farthest / 10];
        let on = |x: f64| (x - limit).abs() <= FLAT;
        let line: Vec<f64> = ahead.iter().copied().filter(|&x| on(x)).collect();
        let is_flat =
            line.len() >= FLAT_POINTS && line.len() as f64 >= FLAT_SHARE * self.seen.len() as f64;
        is_flat.then(|| line.iter().sum::<f64>() / line.len() as f64)
    }

    /// How far it is to this view's surfaces along a ray from a point.
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
            if gap > JUMP || (a[1] > 0.0) == (b[1] > 0.0) {
                return None;
            }
            let part = a[1] / (a[1] - b[1]);
            Some(a[0] + part * (b[0] - a[0])).filter(|&distance| distance > 0.0)
        });
        hits.reduce(f64::min)
    }
}

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

/// The motion between two views of the same surroundings, within reach of `most`; `None` if they do not tell:
/// they have too little in common, or another motion explains them as well.
pub(super) fn motion(before: &View, after: &View, most: Motion) -> Option<Motion> {
    let points: Vec<Point> = before.points().collect();
    let judge = |motion: Motion| Judged::new(&points, after, motion);
    let steps = |most: f64, step: f64| {
        let count = (most / step).ceil() as i32;
        (-count..=count).map(move |index| f64::from(index) * step)
    };
    let (way, angle) = (0.02, 2.0_f64.to_radians());
    let coarse: Vec<(Motion, Judged)> = steps(most.ahead, way)
        .flat_map(|ahead| steps(most.turn, angle).map(move |turn| Motion { ahead, turn }))
        .map(|motion| (motion, judge(motion)))
        .filter(|(_, judged)| judged.is_good())
        .collect();
    let (best, judged) =
        coarse.iter().copied().max_by(|a, b| a.1.score().total_cmp(&b.1.score()))?;
    let is_other = |motion: Motion| {
        (motion.ahead - best.ahead).abs() > 0.1 || (motion.turn - best.turn).abs() > 0.2
    };
    if coarse.iter().any(|(other, it)| is_other(*other) && it.score() > 0.9 * judged.score()) {
        return None;
    }
    // Around the best one by the mean difference, which the vectors' coarse unit does not spoil.
    let fine = steps(2.0 * way, way / 8.0).flat_map(|ahead| {
        steps(2.0 * angle, angle / 8.0)
            .map(move |turn| Motion { ahead: best.ahead + ahead, turn: best.turn + turn })
    });
    fine.map(|motion| (motion, judge(motion)))
        .filter(|(_, it)| it.common + 2 >= judged.common && it.is_good())
        .min_by(|a, b| a.1.off.total_cmp(&b.1.off))
        .map(|(motion, _)| motion)
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
    fn new(points: &[Point], after: &View, Motion { ahead, turn }: Motion) -> Self {
        let from = [ahead * libm::cos(turn / 2.0), ahead * libm::sin(turn / 2.0)];
        let (mut common, mut agreed, mut squares) = (0, 0_usize, 0.0);
        for &(bearing, distance) in &after.seen {
            let Some(expected) = View::cast(points, from, turn + bearing) else { continue };
            common += 1;
            let off = expected - distance;
            if off.abs() <= SAME {
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
    fn score(&self) -> f64 {
        let disagreed = self.common - self.agreed;
        self.agreed as f64 * (1.0 - self.off / SAME / 2.0) - disagreed as f64
    }
}

/// An angle between -180 and 180 degrees, in radians.
pub(super) fn signed(angle: Angle) -> f64 {
    f64::from(angle.0 as i16) * std::f64::consts::TAU / 65_536.0
}

#[cfg(test)]
mod tests {
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

    #[test]
    fn the_motion_between_two_views_is_found() {
        let (at, heading) = ([1.0, 0.9], 0.1);
        let before = view(at, heading);
        let most = Motion { ahead: 0.6, turn: 2.0 };
        for (ahead, turn) in [(0.3, 0.0), (-0.2, 0.0), (0.0, 0.7), (0.0, -0.8), (0.25, 0.2)] {
            let middle = heading + turn / 2.0;
            let to = [at[0] + ahead * middle.cos(), at[1] + ahead * middle.sin()];
            let found = motion(&before, &view(to, heading + turn), most);
            let found = found.unwrap_or_else(|| panic!("{ahead} m, {turn} rad: not found"));
            let off = ((found.ahead - ahead).abs(), (found.turn - turn).abs());
            assert!(off.0 < 0.012 && off.1 < 0.02, "{ahead} m, {turn} rad: {found:?}");
        }
    }

    #[test]
    fn views_that_have_little_in_common_or_explain_much_tell_nothing() {
        let most = Motion { ahead: 0.6, turn: 2.0 };
        let before = view([1.0, 0.9], 0.0);
        let behind = view([1.0, 0.9], 3.0);
        assert_eq!(motion(&before, &behind, Motion { ahead: 0.3, turn: 0.3 }), None);
        assert_eq!(motion(&before, &View::default(), most), None);
        // All around at the same distance: any turn explains it.
        let round = (-70..70).map(|degree| (f64::from(degree).to_radians(), 1.0)).collect();
        let round = View { seen: round, columns: 140, from_to: [-1.2, 1.2] };
        assert_eq!(motion(&round, &round, most), None);
    }

    #[test]
    fn a_line_across_that_limits_the_view_is_flat() {
        let across = |x: f64| {
            let seen = (-30..=30).step_by(3).map(|degree| {
                let bearing = f64::from(degree).to_radians();
                (bearing, (x / bearing.cos() / 0.02).round() * 0.02)
            });
            View { seen: seen.collect(), columns: 21, from_to: [-0.5, 0.5] }
        };
        let flat = across(1.43).flat_m().unwrap();
        assert!((flat - 1.43).abs() < 0.01, "{flat}");
        // Something nearer in a part of it changes nothing, something beyond does.
        let mut part = across(1.43);
        part.seen[..7].iter_mut().for_each(|(_, distance)| *distance = 0.8);
        assert!(part.flat_m().is_some());
        part.seen[..7].iter_mut().for_each(|(_, distance)| *distance = 2.4);
        assert_eq!(part.flat_m(), None);
        assert_eq!(View::default().flat_m(), None);
    }

    #[test]
    fn a_vector_is_read_by_its_bearings() {
        let vector = DistanceVector {
            time: ubimap_protocol::time::Instant(0),
            pose: Pose::default(),
            first: Angle::from_degrees(-90.0),
            step: 16_384,
            distances: [50, 0, 255, 100].into_iter().collect(),
        };
        let view = View::of(&vector);
        let degrees: Vec<_> =
            view.seen.iter().map(|(it, m)| (it.to_degrees().round(), *m)).collect();
        assert_eq!((view.columns, degrees), (4, vec![(-90.0, 1.0), (180.0, 2.0)]));
        let [from, to] = [Pose::from_metres(1.0, 1.0, 0.0), Pose::from_metres(1.0, 1.5, 0.0)];
        let from = Pose { heading: Angle::from_degrees(90.0), ..from };
        let moved = Motion::between(from, Pose { heading: Angle::from_degrees(90.0), ..to });
        assert!((moved.ahead - 0.5).abs() < 1e-3 && moved.turn == 0.0, "{moved:?}");
    }
}
