//! The closed form of the rigid transform between two sets of paired points.

use nalgebra::{
    DMatrix, Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3,
};

/// Minimum second singular value of the points' scatter, as a fraction of the first: below it, the
/// points are on a line.
const LINE: f64 = 1e-9;

/// The transform `T` that minimises the sum of `|T p - q|^2` over pairs `(p, q)`, by the singular
/// value decomposition of the cross-covariance (Arun, Huang and Blostein 1987; Umeyama 1991, eq. 40,
/// without scale). Points in a plane are enough: a reflection is never returned.
///
/// `None` if there are fewer than three pairs, or if the points of either set are on a line.
pub fn rigid_transform<'a>(
    pairs: impl IntoIterator<Item = (&'a Point3<f64>, &'a Point3<f64>)> + Clone,
) -> Option<Isometry3<f64>> {
    let mut count = 0;
    let (mut from, mut to) = (Vector3::zeros(), Vector3::zeros());
    for (p, q) in pairs.clone() {
        from += p.coords;
        to += q.coords;
        count += 1;
    }
    if count < 3 {
        return None;
    }
    let [from, to] = [from, to].map(|sum| sum / f64::from(count));
    let mut scatter = Matrix3::zeros();
    for (p, q) in pairs {
        scatter += (q.coords - to) * (p.coords - from).transpose();
    }
    let rotation = nearest_rotation(&scatter)?;
    let translation = to - rotation * from;
    Some(Isometry3::from_parts(
        Translation3::from(translation),
        UnitQuaternion::from_rotation_matrix(&rotation),
    ))
}

/// The rotation `R` that maximises `tr(R^T M)`; `None` if the rank of `M` is below two.
fn nearest_rotation(matrix: &Matrix3<f64>) -> Option<Rotation3<f64>> {
    // The decomposition of a `Matrix3` squares it, which loses half of the digits of points in a
    // plane; that of a matrix of any size does not.
    let general = DMatrix::from_iterator(3, 3, matrix.iter().copied());
    let svd = general.try_svd(true, true, f64::EPSILON, 1000)?;
    let values = &svd.singular_values;
    if values[1].is_nan() || values[1] <= LINE * values[0] {
        return None;
    }
    let u: Matrix3<f64> = svd.u?.fixed_view::<3, 3>(0, 0).into();
    let v_t: Matrix3<f64> = svd.v_t?.fixed_view::<3, 3>(0, 0).into();
    // Umeyama's S: the axis of least scatter is flipped if the product would be a reflection.
    let sign = if u.determinant() * v_t.determinant() < 0.0 { -1.0 } else { 1.0 };
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    Some(Rotation3::from_matrix_unchecked(rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix4, Quaternion};
    use proptest::prelude::*;

    /// Horn's closed form (1987): the unit quaternion is the eigenvector of the greatest eigenvalue
    /// of a 4 x 4 matrix, here by plain power iteration.
    fn by_quaternion(pairs: &[(Point3<f64>, Point3<f64>)]) -> Isometry3<f64> {
        let mean = |points: &mut dyn Iterator<Item = Point3<f64>>| {
            points.fold(Vector3::zeros(), |sum, it| sum + it.coords) / pairs.len() as f64
        };
        let from = mean(&mut pairs.iter().map(|it| it.0));
        let to = mean(&mut pairs.iter().map(|it| it.1));
        let mut n = Matrix4::zeros();
        for (p, q) in pairs {
            let (a, b) = (p.coords - from, q.coords - to);
            // |b q - q a|^2 as a quadratic form of the quaternion (w, x, y, z), negated.
            let (d, s) = (b - a, a + b);
            let m = Matrix4::new(
                0.0, -d.x, -d.y, -d.z, //
                d.x, 0.0, -s.z, s.y, //
                d.y, s.z, 0.0, -s.x, //
                d.z, -s.y, s.x, 0.0,
            );
            n -= m.transpose() * m;
        }
        // Shifted, so that the greatest eigenvalue has the greatest magnitude.
        let shifted = n + Matrix4::identity() * n.norm();
        let mut power = shifted / shifted.norm();
        for _ in 0..60 {
            power *= power;
            power /= power.norm();
        }
        let column =
            (0..4).max_by(|&a, &b| power.column(a).norm().total_cmp(&power.column(b).norm()));
        let axis = power.column(column.unwrap());
        let turn =
            UnitQuaternion::new_normalize(Quaternion::new(axis[0], axis[1], axis[2], axis[3]));
        Isometry3::from_parts(Translation3::from(to - turn * from), turn)
    }

    fn points() -> impl Strategy<Value = Vec<[f64; 3]>> {
        prop::collection::vec(prop::array::uniform3(-3.0..3.0), 3..12)
    }

    fn transforms() -> impl Strategy<Value = Isometry3<f64>> {
        let vector = || prop::array::uniform3(-3.0f64..3.0).prop_map(Vector3::from);
        (vector(), vector()).prop_map(|(at, turn)| Isometry3::new(at, turn))
    }

    /// Standard deviation of the points from the line through them.
    fn width(points: &[[f64; 3]]) -> f64 {
        let at = DMatrix::from_fn(3, points.len(), |row, column| points[column][row]);
        let centred =
            DMatrix::from_fn(3, points.len(), |row, column| at[(row, column)] - at.row(row).mean());
        let mut values: Vec<f64> = centred.singular_values().iter().copied().collect();
        values.sort_by(f64::total_cmp);
        values[values.len() - 2] / (points.len() as f64).sqrt()
    }

    proptest! {
        #[test]
        fn exact_points_give_the_transform_to_the_last_digits(
            points in points(), planar: bool, truth in transforms(),
        ) {
            let flat = |it: [f64; 3]| if planar { [it[0], it[1], 0.5 * it[0]] } else { it };
            let points: Vec<_> = points.into_iter().map(flat).collect();
            prop_assume!(width(&points) > 0.05);
            let pairs: Vec<_> =
                points.iter().map(|it| (Point3::from(*it), truth * Point3::from(*it))).collect();
            let found = rigid_transform(pairs.iter().map(|(p, q)| (p, q))).unwrap();
            prop_assert!((found.to_homogeneous() - truth.to_homogeneous()).abs().max() < 1e-9);
        }

        #[test]
        fn noisy_points_give_the_same_as_horns_quaternions(
            points in points(), truth in transforms(),
            noise in prop::collection::vec(prop::array::uniform3(-0.05..0.05), 12),
        ) {
            let points = &points[..points.len().min(noise.len())];
            prop_assume!(width(points) > 0.3);
            let pairs: Vec<_> = points
                .iter()
                .zip(&noise)
                .map(|(it, noise)| {
                    let p = Point3::from(*it);
                    (p, truth * p + Vector3::from(*noise))
                })
                .collect();
            let found = rigid_transform(pairs.iter().map(|(p, q)| (p, q))).unwrap();
            let slow = by_quaternion(&pairs);
            prop_assert!((found.to_homogeneous() - slow.to_homogeneous()).abs().max() < 1e-6);
        }
    }

    #[test]
    fn points_on_a_line_and_too_few_points_give_none() {
        let line: Vec<_> = (0..5).map(|it| Point3::new(1.0, 2.0, 3.0) * f64::from(it)).collect();
        assert_eq!(rigid_transform(line.iter().zip(&line)), None);
        let two = [Point3::origin(), Point3::new(1.0, 0.0, 0.0)];
        assert_eq!(rigid_transform(two.iter().zip(&two)), None);
        assert_eq!(rigid_transform([(&two[0], &two[0]); 4]), None);
    }

    #[test]
    fn a_mirrored_set_never_gives_a_reflection() {
        let points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]];
        let from = points.map(Point3::from);
        let to = from.map(|it| Point3::new(-it.x, it.y, it.z));
        let found = rigid_transform(from.iter().zip(&to)).unwrap();
        assert!((found.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-12);
    }
}
