//! Registers all views with each other at once (Lu and Milios 1997), by the distances between their surfels along the
//! surfaces' normals (Censi's PL-ICP, ICRA 2008).
//!
//! Submaps are rigid, and a match with one is off by what the submap is bent. Here each view moves alone, and what pulls
//! at one view is passed on to all.

use nalgebra::{Vector2, Vector3};

use super::{
    chain::driven,
    cloud::{Cloud, SQUARE_M, Surfel},
    columns::Columns,
    pose_graph::{Edge, PoseGraph},
    refinement::{LAST_REACH_M, SAME_NORMAL, surfel_information},
    rigid::{Motion, fit},
    sparse::System,
    view::View,
};
use crate::mapping::Reading;

/// Number of rounds.
const ROUNDS: usize = 10;
/// Greatest distance of two surfels along their surface, in metres.
const ALONG_M: f64 = 0.15;
/// Maximum number of other views with which a surfel is paired.
const PAIRED: usize = 8;

/// Moves views from these poses to where the surfaces that several of them saw coincide, and calibrates the columns of
/// their sensor, which it returns. Odometry holds each view to the next. The map as a whole stays where it was.
/// Cost: some 40 s for 2,500 views in a building.
pub(super) fn register(views: &mut [View], poses: &mut Vec<Motion>) -> Columns {
    let edge = |(from, pair): (usize, &[View])| {
        let step = driven(&pair[0].reported, &pair[1].reported);
        let information = step.information();
        Edge { from, to: from + 1, motion: step.motion, information, is_doubted: false }
    };
    let edges = views.windows(2).enumerate().map(edge).collect();
    let before = poses.clone();
    let mut graph = PoseGraph { poses: core::mem::take(poses), edges, absolutes: Vec::new() };
    let mut columns = Columns::default();
    for round in 0..ROUNDS {
        let part = (ROUNDS - 1 - round) as f64 / (ROUNDS - 1) as f64;
        let reach = LAST_REACH_M + (SQUARE_M - LAST_REACH_M) * part;
        let mut equations = Equations::of(&graph, &columns);
        for pair in Surfaces::of(views, &graph.poses).pairs(reach) {
            let weight = pair.share * surfel_information(pair.distance, reach);
            let [one, other] = pair.ends.map(|end| end.row(&pair.normal, &graph.poses));
            let rows = [one, -other];
            for (end, row) in pair.ends.iter().zip(rows) {
                columns.add(end.reading, row.z, pair.distance, weight);
            }
            equations.add(&pair, rows, weight);
        }
        let Some((steps, nearer)) = equations.solve() else { break };
        graph.move_by(&steps);
        columns.solve(nearer);
        views.iter_mut().for_each(|view| view.calibrate(&columns));
    }
    let back = fit(&graph.poses, &before);
    *poses = graph.poses.iter().map(|pose| back * pose).collect();
    columns
}

/// The normal equations of the steps of all poses, and of the mean share by which readings are nearer, on which the size of
/// the map depends.
struct Equations {
    system: System,
    right: Vec<Vector3<f64>>,
    /// The column and row of that share, its element and its right side.
    beside: Vec<Vector3<f64>>,
    own: f64,
    own_right: f64,
}

impl Equations {
    /// Those of the odometry, and of what is expected of the columns.
    fn of(graph: &PoseGraph, columns: &Columns) -> Self {
        let (system, right) = graph.linearised();
        let beside = vec![Vector3::zeros(); right.len()];
        let (own, own_right) = columns.expected_nearer();
        Self { system, right, beside, own, own_right }
    }

    /// Adds a pair; `rows` are its distance's derivatives by the steps of both poses.
    fn add(&mut self, pair: &Pair<'_>, rows: [Vector3<f64>; 2], weight: f64) {
        let leans = [0, 1].map(|it| pair.ends[it].reading.lean * rows[it].z);
        let lean = leans[0] + leans[1];
        for (end, row) in pair.ends.iter().zip(rows) {
            self.system.add(end.view, end.view, &(row * row.transpose() * weight));
            self.right[end.view] -= row * (pair.distance * weight);
            self.beside[end.view] += row * (lean * weight);
        }
        let across = rows[0] * rows[1].transpose() * weight;
        self.system.add(pair.ends[0].view, pair.ends[1].view, &across);
        self.own += lean * lean * weight;
        self.own_right -= lean * pair.distance * weight;
    }

    /// The poses' steps, and what is to be added to the share. `None` if something holds a pose too loosely.
    fn solve(&self) -> Option<(Vec<Vector3<f64>>, f64)> {
        let (steps, beside) =
            (self.system.solve_roughly(&self.right)?, self.system.solve_roughly(&self.beside)?);
        let by = |steps: &[Vector3<f64>]| -> f64 {
            self.beside.iter().zip(steps).map(|(one, other)| one.dot(other)).sum()
        };
        let more = (self.own_right - by(&steps)) / (self.own - by(&beside));
        Some((steps.iter().zip(beside).map(|(step, beside)| step - beside * more).collect(), more))
    }
}

/// The surfels of all views, in the map.
struct Surfaces<'v> {
    cloud: Cloud,
    /// For each surfel, its view and reading.
    from: Vec<(usize, &'v Reading)>,
}

/// Surfels of two views on the same surface.
struct Pair<'v> {
    ends: [End<'v>; 2],
    /// The mean normal of both.
    normal: Vector2<f64>,
    /// How far the first lies before the second, in metres.
    distance: f64,
    /// However many views saw a surface, it counts once for each.
    share: f64,
}

/// A surfel of a pair.
#[derive(Clone, Copy)]
struct End<'v> {
    view: usize,
    at: Vector2<f64>,
    reading: &'v Reading,
}

impl End<'_> {
    /// The derivative of its distance from a surface with this normal by the step of its view's pose. That by the turn is
    /// the same as by the reading's bearing.
    fn row(&self, normal: &Vector2<f64>, poses: &[Motion]) -> Vector3<f64> {
        let arm = self.at - poses[self.view].translation.vector;
        Vector3::new(normal.x, normal.y, normal.y * arm.x - normal.x * arm.y)
    }
}

impl<'v> Surfaces<'v> {
    fn of(views: &'v [View], poses: &[Motion]) -> Self {
        let (mut cloud, mut from) = (Cloud::default(), Vec::new());
        for (number, (view, pose)) in views.iter().zip(poses).enumerate() {
            cloud.extend(view.surfels.iter().map(|surfel| surfel.moved(pose)));
            from.extend(view.readings.iter().map(|reading| (number, reading)));
        }
        Self { cloud, from }
    }

    /// All surfels, each with those of some other views on the surface within `reach` metres.
    fn pairs(&self, reach: f64) -> impl Iterator<Item = Pair<'v>> {
        (0..self.from.len()).flat_map(move |index| {
            let others = self.others(index, reach);
            let stride = others.len().div_ceil(PAIRED).max(1);
            // Not the same views for each surfel.
            let chosen = others.into_iter().skip(index % stride).step_by(stride);
            let share = 1.0 / chosen.len() as f64;
            chosen.map(move |(_, pair)| Pair { share, ..pair })
        })
    }

    /// A surfel with that of each other view beside it, and how far beside, by view.
    fn others(&self, index: usize, reach: f64) -> Vec<(f64, Pair<'v>)> {
        let end = |index: usize, at: Vector2<f64>| {
            let (view, reading) = self.from[index];
            End { view, at, reading }
        };
        let surfel = self.cloud.surfels()[index];
        let own = end(index, surfel.at);
        let Some(facing) = surfel.normal else { return Vec::new() };
        let other = |(index, other): (usize, &Surfel)| {
            let its = other.normal.filter(|its| its.dot(&facing) >= SAME_NORMAL)?;
            let ends = [own, end(index, other.at)];
            let normal = (facing + its).normalize();
            let off = surfel.at - other.at;
            let (distance, along) = (normal.dot(&off), normal.perp(&off).abs());
            (ends[1].view != own.view && distance.abs() < reach && along < ALONG_M)
                .then_some((along, Pair { ends, normal, distance, share: 1.0 }))
        };
        let mut others: Vec<_> = self.cloud.around(surfel.at).filter_map(other).collect();
        others.sort_by(|(one, a), (other, b)| {
            a.ends[1].view.cmp(&b.ends[1].view).then(one.total_cmp(other))
        });
        others.dedup_by_key(|(_, pair)| pair.ends[1].view);
        others
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::{
            rigid::{coordinates, difference, of_coordinates},
            tests::{seen, walls},
        },
        *,
    };

    /// Two rounds through a corridor. Each has bent the map in its own way.
    #[test]
    fn a_bent_map_is_straightened() {
        let walls = walls();
        let sides = [[0.0, 0.0], [10.0, 0.0], [10.0, 7.0], [0.0, 7.0]].map(Vector2::from);
        let mut truths = Vec::new();
        for side in (0..4).cycle().take(8) {
            let (from, to) = (sides[side], sides[(side + 1) % 4]);
            let heading = side as f64 * core::f64::consts::FRAC_PI_2;
            truths.extend(
                (0..20).map(|step| {
                    Motion::new(from + (to - from) * (f64::from(step) / 20.0), heading)
                }),
            );
        }
        let bent = |(index, truth): (usize, &Motion)| {
            let phase = index as f64 / 25.0;
            let off =
                Vector3::new(0.1 * phase.sin(), 0.06 * (1.3 * phase).sin(), 0.02 * phase.sin());
            of_coordinates(coordinates(truth) + off)
        };
        let worst = |poses: &[Motion]| {
            let off = poses.iter().zip(&truths).map(|(pose, truth)| difference(pose, truth).abs());
            off.fold(Vector3::zeros(), |worst: Vector3<f64>, off| worst.sup(&off))
        };
        // With 180 beams, columns have two or three: the nearest is 0.18 or 0.36 beside the middle; 0.3 is assumed.
        for (beams, more) in [(64, -0.3), (180, 0.02)] {
            let view = |(index, truth)| seen(beams, &walls, truth, truth, index as u64);
            let mut views: Vec<View> = truths.iter().enumerate().map(view).collect();
            let mut poses: Vec<Motion> = truths.iter().enumerate().map(bent).collect();
            let before = worst(&poses);
            let columns = register(&mut views, &mut poses);
            let (after, nearer) = (worst(&poses), columns.nearer());
            println!("off by at most {before:.3?}, then {after:.3?}; readings {nearer:.3} nearer");
            assert!(before.x > 0.09 && before.y > 0.05, "{before}");
            assert!(after.x < 0.03 && after.y < 0.03 && after.z < 0.01, "{after}");
            assert!((nearer - more).abs() < 0.1, "{nearer}");
        }
    }

    #[test]
    fn views_that_share_nothing_follow_the_odometry() {
        let alone = |index: usize| {
            let place = Motion::new(Vector2::new(20.0 * index as f64, 0.0), 0.0);
            (seen(64, &walls(), &Motion::identity(), &place, index as u64), place)
        };
        let (mut views, mut poses): (Vec<View>, Vec<Motion>) = (0..3).map(alone).unzip();
        let before = poses.clone();
        poses[1].translation.x += 0.1;
        register(&mut views, &mut poses);
        let step = |poses: &[Motion], from: usize| poses[from].inv_mul(&poses[from + 1]);
        for from in [0, 1] {
            let off = difference(&step(&before, from), &step(&poses, from));
            assert!(off.amax() < 1e-3, "{off}");
        }
        register(&mut [], &mut Vec::new());
    }
}
