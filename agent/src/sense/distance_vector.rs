//! From a distance vector in pixels to points on the map (Ahmed 2.3, equations 2 to 5).

use nalgebra::Point2;

use super::{floor::COLUMNS, scale_curve::ScaleCurve};

/// A reading beyond any range.
const BEYOND: u16 = u16::MAX - 2;

/// Converts a distance vector to a scan: the distance to the boundary in each column (equation 2),
/// in the unit of the curve, which should be millimetres; 0 (no reading) outside the curve's range.
///
/// The sensor model decides where the boundary is drawn. A line of the image has a constant depth,
/// not a constant range: with [`Pinhole`](super::SensorModel::Pinhole) the boundary lies where the
/// camera saw it. The paper takes the distances as ranges along bearings spread evenly over its 90
/// degrees ([`Radial`](super::SensorModel::Radial)), which is correct only at the centre of the
/// image: at the sides a boundary is mapped at 0.71 of its distance. About 100 instructions per
/// column.
pub fn floor_readings(distances: &[u8; COLUMNS], curve: &ScaleCurve) -> [u16; COLUMNS] {
    distances.map(|pixels| curve.distance(pixels).map_or(0, |it| libm::roundf(it) as u16))
}

/// The same, but a column whose floor goes on beyond the far end of the curve has a reading beyond any
/// range: there is no boundary, and the floor was seen to be free, which counts as much as any reading. The
/// map's range must not exceed [`ScaleCurve::far`].
pub fn open_floor_readings(distances: &[u8; COLUMNS], curve: &ScaleCurve) -> [u16; COLUMNS] {
    let mut readings = floor_readings(distances, curve);
    for (reading, &pixels) in readings.iter_mut().zip(distances) {
        if pixels > curve.far().0 {
            *reading = BEYOND;
        }
    }
    readings
}

/// The position of a boundary (equations 3 to 5): at `distance` from the robot, in the direction of
/// `towards`, another point on the ray of the boundary's column. `None` if `towards` is the robot's
/// own position.
///
/// Equation 5 as printed uses the slope of the ray (equation 4), which is the same for the opposite
/// ray: everything to the left of the robot (smaller x) is mirrored to its right, and a ray along
/// the y-axis has no slope. Here the direction is a unit vector and keeps its quadrant.
pub fn boundary_point(
    robot: Point2<f32>,
    towards: Point2<f32>,
    distance: f32,
) -> Option<Point2<f32>> {
    let way = towards - robot;
    let length = way.norm();
    (length > 0.0 && length.is_finite()).then(|| robot + way * (distance / length))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Equations 4 and 5 as printed.
    fn printed(robot: Point2<f32>, towards: Point2<f32>, distance: f32) -> Point2<f32> {
        let slope = (towards.y - robot.y) / (towards.x - robot.x);
        let root = (1.0 + slope * slope).sqrt();
        Point2::new(distance / root + robot.x, slope * distance / root + robot.y)
    }

    fn towards(robot: Point2<f32>, bearing: f32) -> Point2<f32> {
        Point2::new(robot.x + 300.0 * bearing.cos(), robot.y + 300.0 * bearing.sin())
    }

    #[test]
    fn distances_outside_the_curve_are_no_readings() {
        let mut distances = [0; COLUMNS];
        for (column, distance) in distances.iter_mut().enumerate() {
            *distance = column.min(255) as u8;
        }
        let curve = ScaleCurve::fit(&super::super::TABLE_1).unwrap().scaled(10.0);
        for (pixels, reading) in floor_readings(&distances, &curve).into_iter().enumerate() {
            assert_eq!(reading != 0, (62..=121).contains(&pixels), "{pixels}: {reading}");
        }
        for (pixels, reading) in open_floor_readings(&distances, &curve).into_iter().enumerate() {
            let expected =
                if pixels > 121 { BEYOND } else { floor_readings(&distances, &curve)[pixels] };
            assert_eq!(reading, expected, "{pixels}");
        }
        let reading = floor_readings(&[93; COLUMNS], &curve)[0];
        assert!(reading.abs_diff(1_190) < 20, "{reading} is not 119 of 10 mm");
    }

    #[test]
    fn a_robot_has_no_boundary_towards_itself() {
        let robot = Point2::new(3.0, 4.0);
        assert_eq!(boundary_point(robot, robot, 10.0), None);
        assert_eq!(boundary_point(robot, Point2::new(f32::NAN, 0.0), 10.0), None);
    }

    proptest! {
        #[test]
        fn a_boundary_lies_on_its_ray_in_every_direction(
            x in -500.0f32..500.0, y in -500.0f32..500.0,
            bearing in -3.2f32..3.2, distance in 70.0f32..260.0,
        ) {
            let robot = Point2::new(x, y);
            let towards = towards(robot, bearing);
            let found = boundary_point(robot, towards, distance).unwrap();
            // Compared by bearing and distance, not by slopes or unit vectors.
            let seen = (found.y - y).atan2(found.x - x);
            let off = (f64::from(seen) - f64::from(bearing)).sin();
            prop_assert!(off.abs() < 1e-3 && (seen - bearing).cos() > 0.9, "{seen} {bearing}");
            prop_assert!(((found - robot).norm() - distance).abs() < 0.01);
            // The printed equation is correct to the right of the robot; to the left it gives the
            // opposite point.
            prop_assume!(bearing.cos().abs() > 0.01);
            let printed = printed(robot, towards, distance);
            let expected = if bearing.cos() > 0.0 { found } else { robot - (found - robot) };
            prop_assert!((printed - expected).norm() < 0.1, "{printed} {expected}");
        }
    }
}
