//! Least squares over the distances between the surfels of two clouds, along the surfaces' normals
//! (Censi's PL-ICP, ICRA 2008).

use core::f64::consts::TAU;

use nalgebra::{Matrix3, Vector2, Vector3};

use super::{
    cloud::{Cloud, SQUARE_M, Surfel},
    rigid::{Motion, coordinates, of_coordinates},
};

/// Number of rounds.
const ROUNDS: usize = 12;
/// Greatest distance of a surfel from its surface in the last round, in metres; in the first it is
/// [`SQUARE_M`].
pub(super) const LAST_REACH_M: f64 = 0.1;
/// Smallest cosine between the normals of two surfels of one surface: 40 degrees.
pub(super) const SAME_NORMAL: f64 = 0.77;
/// Standard deviation of a surfel across its surface, in metres: distances in steps of 2 cm, at
/// bearings known to half a column.
const POINT_M: f64 = 0.0225;
/// Factor on the variance, because neighbouring points are off for the same reasons.
const CORRELATION: f64 = 4.0;
/// What does not average out over the points, in metres and radians: surfaces that were drawn from
/// slightly wrong poses.
const FLOOR: (f64, f64) = (0.02, 0.008);
/// Minimum number of surfels on surfaces.
const LEAST: usize = 8;

/// A refined motion.
#[derive(Clone, Debug)]
pub struct Refined {
    /// The motion from the surfels' frame into that of the reference.
    pub motion: Motion,
    /// Covariance of its x, y and turn; huge along a direction that the surfaces do not constrain.
    pub covariance: Matrix3<f64>,
    /// Number of surfels on surfaces of the reference.
    pub matched: usize,
    /// Root mean square of their distances in metres.
    pub rms_m: f64,
}

/// Finds the motion near `guess` that brings the surfels onto the surfaces of the reference. `prior`
/// holds the result: a motion and its information matrix. `None` if too few surfels meet a surface.
pub fn refine(
    reference: &Cloud,
    surfels: &[Surfel],
    guess: &Motion,
    prior: Option<(&Motion, &Matrix3<f64>)>,
) -> Option<Refined> {
    let mut at = coordinates(guess);
    let (held_at, hold) =
        prior.map_or((at, Matrix3::zeros()), |(it, hold)| (coordinates(it), *hold));
    let mut refined = None;
    for round in 0..ROUNDS {
        let part = (ROUNDS - 1 - round) as f64 / (ROUNDS - 1) as f64;
        let reach = LAST_REACH_M + (SQUARE_M - LAST_REACH_M) * part;
        let motion = of_coordinates(at);
        let (mut information, mut gradient) = (hold, Vector3::zeros());
        let (mut matched, mut squares) = (0, 0.0);
        for surfel in surfels {
            let there = surfel.moved(&motion);
            let Some((normal, distance)) = pair(reference, &there, reach) else { continue };
            let weight = surfel_information(distance, reach);
            let arm = there.at - at.xy();
            let row = Vector3::new(normal.x, normal.y, normal.dot(&Vector2::new(-arm.y, arm.x)));
            information += row * row.transpose() * weight;
            gradient += row * (distance * weight);
            matched += 1;
            squares += distance * distance;
        }
        if matched < LEAST {
            return None;
        }
        let back = held_at - at;
        gradient -= hold * Vector3::new(back.x, back.y, libm::remainder(back.z, TAU));
        // The small term keeps the matrix invertible where nothing holds the motion.
        let inverse = (information + Matrix3::identity() * 1e-3).try_inverse()?;
        at -= inverse * gradient;
        let mean_square = squares / matched as f64;
        let excess = (mean_square / (POINT_M * POINT_M)).max(1.0);
        let floor = Vector3::new(FLOOR.0.powi(2), FLOOR.0.powi(2), FLOOR.1.powi(2));
        refined = Some(Refined {
            motion: of_coordinates(at),
            covariance: inverse * excess + Matrix3::from_diagonal(&floor),
            matched,
            rms_m: mean_square.sqrt(),
        });
    }
    refined
}

/// The information of a surfel's distance from its surface, in metres: less the farther it is (Tukey's weight).
pub(super) fn surfel_information(distance: f64, reach: f64) -> f64 {
    let part = distance / reach;
    (1.0 - part * part).powi(2) / (POINT_M * POINT_M * CORRELATION)
}

/// The normal of the reference's surface at a surfel, and the surfel's distance from it: the mean over
/// the surface's surfels, near ones counting most. `None` if there is no surface within `reach`.
pub(super) fn pair(reference: &Cloud, surfel: &Surfel, reach: f64) -> Option<(Vector2<f64>, f64)> {
    let own = surfel.normal?;
    let (mut normal, mut distance, mut total) = (Vector2::zeros(), 0.0, 0.0);
    for (_, other) in reference.around(surfel.at) {
        let Some(its) = other.normal.filter(|its| its.dot(&own) >= SAME_NORMAL) else { continue };
        let off = surfel.at - other.at;
        let across = its.dot(&off);
        let along = off.dot(&Vector2::new(-its.y, its.x));
        if across.abs() > reach || along.abs() > SQUARE_M {
            continue;
        }
        let weight = 1.0 - (along / SQUARE_M).powi(2) + 1e-3;
        normal += its * weight;
        distance += across * weight;
        total += weight;
    }
    (total > 0.0).then(|| (normal / normal.norm(), distance / total))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The surfels of a straight wall, seen from the side to which the normal points.
    fn wall(from: [f64; 2], to: [f64; 2]) -> Vec<Surfel> {
        let (from, to) = (Vector2::from(from), Vector2::from(to));
        let along = (to - from) / (to - from).norm();
        let count = ((to - from).norm() / 0.05) as usize;
        let normal = Some(Vector2::new(-along.y, along.x));
        (0..count).map(|it| Surfel { at: from + along * (it as f64 * 0.05), normal }).collect()
    }

    #[test]
    fn a_room_holds_all_axes_and_a_corridor_only_two() {
        let sides = [wall([3.0, -1.0], [-3.0, -1.0]), wall([-3.0, 1.0], [3.0, 1.0])].concat();
        let ends = [wall([3.0, 1.0], [3.0, -1.0]), wall([-3.0, -1.0], [-3.0, 1.0])].concat();
        let truth = Motion::new(Vector2::new(0.07, -0.05), 0.02);
        for (walls, has_ends) in [(sides.clone(), false), ([sides, ends].concat(), true)] {
            let seen: Vec<_> = walls.iter().map(|it| it.moved(&truth.inverse())).collect();
            let mut room = Cloud::default();
            room.extend(walls);
            let found = refine(&room, &seen, &Motion::identity(), None).unwrap();
            let off = coordinates(&found.motion) - coordinates(&truth);
            assert!(off.y.abs() < 0.002 && off.z.abs() < 0.001, "{off}");
            assert_eq!(off.x.abs() < 0.002, has_ends, "{off}");
            let [along, across] = [0, 1].map(|axis| found.covariance[(axis, axis)].sqrt());
            assert!(across < 0.03, "{across}");
            assert_eq!(along < 0.03, has_ends, "{along}");
            assert!(has_ends || along > 1.0, "{along}");
        }
    }
}
