//! The plane of the floor in a camera's optical frame, from its depth images alone.

use nalgebra::{Isometry3, Matrix3, Point3, UnitQuaternion, UnitVector3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::camera::{DepthImage, DepthNoise, Intrinsics};

/// Approximate number of sampled columns of an image.
const COLUMNS: u32 = 160;
/// Maximum number of images: their mean has a sixth of the noise of one.
const MOST_IMAGES: usize = 31;
/// Number of images that leave passers-by out.
const LEAST_IMAGES: usize = 5;
/// Number of random planes, of which the best is refined. A plane through a fifth of the pixels is
/// missed in one of 50 cases.
const TRIALS: usize = 500;
/// Number of refining steps.
const STEPS: usize = 20;
/// Distance at which a point has no weight, in standard deviations of the points below the plane. Those
/// above it have more, from walls and furniture that stand on the floor; a plane through all that is
/// near would be raised at the walls.
const TUKEY: f64 = 2.0;
/// The ratio of a normal distribution's standard deviation and its median absolute deviation.
const MAD: f64 = 1.4826;
/// Distance from the plane within which a point belongs to it, in metres and in standard deviations
/// of its depth.
const BELONGS_M: f64 = 0.02;
const BELONGS_SIGMAS: f64 = 2.5;
/// Distance below the floor, in metres, and maximum share of the points that are there: in gloss,
/// and through a door to a lower floor.
const BELOW_M: f64 = 0.15;
const BELOW_SHARE: f64 = 0.05;
/// Minimum height of a camera above the floor, in metres.
const LEAST_HEIGHT_M: f64 = 0.2;
/// Minimum number of points of a floor.
const LEAST_POINTS: usize = 50;
/// Difference from the median, in standard deviations, up to which a depth counts.
const OUTLIER: f64 = 3.0;

/// Depths of some pixels of a camera, over several images.
#[derive(Clone, Debug)]
pub struct DepthSamples {
    noise: DepthNoise,
    /// The sampled pixels, each with its ray: a point at a depth of one metre.
    pixels: Vec<([u32; 2], Vector3<f64>)>,
    /// The depths in millimetres, by pixel.
    depths: Vec<Vec<u16>>,
    images: usize,
}

/// A measured point in the optical frame and the standard deviation of its depth, in metres.
type Sample = (Point3<f64>, f64);

impl DepthSamples {
    /// Samples of a depth sensor, none yet.
    pub fn new(intrinsics: &Intrinsics, noise: DepthNoise) -> Self {
        let Intrinsics { width, height, .. } = *intrinsics;
        let step = (width / COLUMNS).max(1) as usize;
        let rows = (step as u32 / 2..height).step_by(step);
        let pixels = rows.flat_map(|row| {
            (step as u32 / 2..width).step_by(step).map(move |column| [column, row])
        });
        let ray = |[column, row]: [u32; 2]| {
            let pixel = [f64::from(column), f64::from(row)];
            ([column, row], intrinsics.direction(pixel))
        };
        let pixels: Vec<_> = pixels.map(ray).collect();
        Self { noise, depths: vec![Vec::new(); pixels.len()], pixels, images: 0 }
    }

    /// Whether there are enough images to tell the floor.
    pub fn is_enough(&self) -> bool {
        self.images >= LEAST_IMAGES
    }

    /// Whether no more images are needed.
    pub fn is_full(&self) -> bool {
        self.images >= MOST_IMAGES
    }

    /// Adds an image. Images far apart in time see less of people and robots.
    pub fn add(&mut self, image: &DepthImage) {
        self.images += 1;
        for (([column, row], _), depths) in self.pixels.iter().zip(&mut self.depths) {
            let depth = image.get_pixel_checked(*column, *row).map_or(0, |pixel| pixel.0[0]);
            if depth > 0 {
                depths.push(depth);
            }
        }
    }

    /// The points of pixels that half of the images measure: means of what is near the median, which
    /// leaves passers-by out.
    fn points(&self) -> Vec<Sample> {
        let measured = self.pixels.iter().zip(&self.depths);
        let points = measured.filter(|(_, depths)| 2 * depths.len() > self.images);
        points
            .map(|((_, ray), depths)| {
                let mut depths = depths.clone();
                let middle = depths.len() / 2;
                let median = f64::from(*depths.select_nth_unstable(middle).1);
                let reach = OUTLIER * 1000.0 * self.noise.sigma_m(median / 1000.0);
                let near = depths.iter().map(|depth| f64::from(*depth));
                let near = near.filter(|depth| (depth - median).abs() <= reach);
                let (sum, count) =
                    near.fold((0.0, 0.0), |(sum, count), it| (sum + it, count + 1.0));
                let depth_m = sum / count / 1000.0;
                (Point3::from(ray * depth_m), self.noise.sigma_m(depth_m) / f64::sqrt(count))
            })
            .collect()
    }
}

/// The floor's plane in an optical frame: all points with `normal * p = -height_m`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FloorPlane {
    /// The upward normal.
    pub normal: UnitVector3<f64>,
    /// Height of the optical centre above the floor, in metres.
    pub height_m: f64,
    /// The share of the measured pixels that belong to the floor.
    pub share: f64,
    /// The covariance of the normal's errors along [`FloorPlane::axes`], in radians, and of the height's, in
    /// metres, by the noise of the depths; zero if it was not fitted.
    pub covariance: Matrix3<f64>,
}

impl FloorPlane {
    /// The plane with the most points of those that `accepts`, with hardly anything below it. `None`
    /// if there is none.
    pub fn find(samples: &DepthSamples, accepts: impl Fn(&Self) -> bool) -> Option<Self> {
        let points = samples.points();
        if points.len() < LEAST_POINTS {
            return None;
        }
        let mut dice = ChaCha8Rng::seed_from_u64(0);
        let mut best: Option<(usize, Self)> = None;
        for _ in 0..TRIALS {
            let three = [(); 3].map(|()| points[dice.random_range(0..points.len())].0);
            let Some(plane) = Self::through(three) else { continue };
            let count = plane.belonging(&points).count();
            if best.as_ref().is_none_or(|best| count > best.0)
                && plane.is_lowest(&points)
                && accepts(&plane)
            {
                best = Some((count, plane));
            }
        }
        let mut plane = best?.1;
        for _ in 0..STEPS {
            plane = plane.refined(&points)?;
        }
        let count = plane.belonging(&points).count();
        plane.share = count as f64 / points.len() as f64;
        (count >= LEAST_POINTS && accepts(&plane)).then_some(plane)
    }

    /// The pose of the camera in `map`, in metres, whose floor is at z = 0: `pose` with another height,
    /// turned about a horizontal axis.
    pub fn level(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        let normal = pose.rotation * self.normal;
        let turn = UnitQuaternion::rotation_between(&normal, &Vector3::z()).unwrap_or_default();
        let mut level = Isometry3::from_parts(pose.translation, turn * pose.rotation);
        level.translation.z = self.height_m;
        level
    }

    /// The point at a height above the floor that a ray sees, in the optical frame.
    pub fn point_at(
        &self,
        from: &Point3<f64>,
        direction: &Vector3<f64>,
        height_m: f64,
    ) -> Option<Point3<f64>> {
        let above_m = self.above_m(from) - height_m;
        let along = -above_m / self.normal.dot(direction);
        (along > 0.0 && along.is_finite()).then(|| from + direction * along)
    }

    /// The height of a point above the floor, in metres.
    fn above_m(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&point.coords) + self.height_m
    }

    fn through([a, b, c]: [Point3<f64>; 3]) -> Option<Self> {
        Self::of((b - a).cross(&(c - a)), &a)
    }

    /// The plane through a point that the camera is above.
    fn of(normal: Vector3<f64>, point: &Point3<f64>) -> Option<Self> {
        let normal = UnitVector3::try_new(normal, 1e-9)?;
        let height_m = -normal.dot(&point.coords);
        let plane = if height_m < 0.0 {
            Self { normal: -normal, height_m: -height_m, share: 0.0, covariance: Matrix3::zeros() }
        } else {
            Self { normal, height_m, share: 0.0, covariance: Matrix3::zeros() }
        };
        (plane.height_m >= LEAST_HEIGHT_M).then_some(plane)
    }

    fn belonging<'p>(&self, points: &'p [Sample]) -> impl Iterator<Item = &'p Sample> {
        points.iter().filter(move |(point, sigma_m)| {
            self.above_m(point).abs() < BELONGS_M + BELONGS_SIGMAS * sigma_m
        })
    }

    fn is_lowest(&self, points: &[Sample]) -> bool {
        let is_below =
            |(point, sigma_m): &&Sample| self.above_m(point) < -BELOW_M - BELONGS_SIGMAS * sigma_m;
        points.iter().filter(is_below).count() as f64 <= BELOW_SHARE * points.len() as f64
    }

    /// The weighted least squares plane through the points that belong to this one (Tukey's biweight).
    fn refined(&self, points: &[Sample]) -> Option<Self> {
        let errors = self.belonging(points).map(|(point, sigma_m)| self.above_m(point) / sigma_m);
        let mut below: Vec<f64> = errors.filter(|error| *error < 0.0).map(f64::abs).collect();
        if below.is_empty() {
            return None;
        }
        let middle = below.len() / 2;
        let scale = MAD * *below.select_nth_unstable_by(middle, f64::total_cmp).1;
        let weighted = || {
            self.belonging(points).filter_map(move |(point, sigma_m)| {
                let ratio = self.above_m(point) / (TUKEY * scale * sigma_m);
                let tukey = (1.0 - ratio * ratio).max(0.0).powi(2);
                (tukey > 0.0).then(|| (point.coords, tukey / (sigma_m * sigma_m)))
            })
        };
        let (sum, total) = weighted()
            .fold((Vector3::zeros(), 0.0), |(sum, total), (at, weight)| {
                (sum + at * weight, total + weight)
            });
        let middle = sum / total;
        let scatter: Matrix3<f64> =
            weighted().map(|(at, weight)| (at - middle) * (at - middle).transpose() * weight).sum();
        let eigen = scatter.symmetric_eigen();
        let least = eigen.eigenvalues.imin();
        let mut plane = Self::of(eigen.eigenvectors.column(least).into_owned(), &middle.into())?;
        let [first, second] = Self::axes(&plane.normal);
        let information: Matrix3<f64> = weighted()
            .map(|(at, weight)| {
                let slope = Vector3::new(first.dot(&at), second.dot(&at), 1.0);
                slope * slope.transpose() * weight
            })
            .sum();
        plane.covariance = information.try_inverse()? * (scale * scale);
        Some(plane)
    }

    /// Two axes at right angles to a normal and to each other, along which the normal may err.
    pub fn axes(normal: &UnitVector3<f64>) -> [Vector3<f64>; 2] {
        let other = if normal.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
        let first = normal.cross(&other).normalize();
        [first, normal.cross(&first)]
    }
}

/// The difference between a camera's floor and z = 0.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FloorError {
    /// Height of the camera in its pose less that above its floor, in metres.
    pub height_m: f64,
    /// Angle between the floor's normal and the z axis, in radians.
    pub tilt_rad: f64,
}

impl FloorError {
    /// The error of a camera whose optical frame has this pose in `map`, and sees the floor's normal and
    /// its height above the floor.
    pub fn new(pose: &Isometry3<f64>, normal: &UnitVector3<f64>, height_m: f64) -> Self {
        Self {
            height_m: pose.translation.z - height_m,
            tilt_rad: (pose.rotation * normal).angle(&Vector3::z()),
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::camera::Orientation;

    /// Images of a room with a wall 4 m ahead and a table, by a camera at a height of 2.8 m.
    fn samples(tilt_deg: f64, images: usize) -> (DepthSamples, UnitVector3<f64>) {
        let intrinsics = Intrinsics::pinhole(640, 480, 87f64.to_radians());
        let tilt_rad = tilt_deg.to_radians();
        let rotation = Orientation { tilt_rad, ..Orientation::default() }.rotation();
        let pose = Isometry3::from_parts(Translation3::new(0.0, 0.0, 2.8), rotation);
        let mut dice = ChaCha8Rng::seed_from_u64(1);
        let mut samples = DepthSamples::new(&intrinsics, DepthNoise::D435);
        for _ in 0..images {
            samples.add(&DepthImage::from_fn(640, 480, |column, row| {
                let ray = pose.rotation * intrinsics.direction([f64::from(column), f64::from(row)]);
                let floor = if ray.z < 0.0 { 2.8 / -ray.z } else { f64::INFINITY };
                let wall = if ray.x > 0.0 { 4.0 / ray.x } else { f64::INFINITY };
                let is_table = (floor * ray.x - 2.0).abs() < 0.5;
                let depth = if is_table { 0.7 * floor } else { floor.min(wall) };
                let noise: f64 = StandardNormal.sample(&mut dice);
                let depth = depth + noise * DepthNoise::D435.sigma_m(depth);
                image::Luma([if depth < 8.0 { (1000.0 * depth).round() as u16 } else { 0 }])
            }));
        }
        let up = rotation.inverse() * Vector3::z();
        (samples, UnitVector3::new_normalize(up))
    }

    #[test]
    fn the_floor_is_found_beside_walls_and_tables() {
        for (tilt_deg, images) in [(90.0, 15), (60.0, 15), (45.0, 15), (35.0, 31)] {
            let (samples, up) = samples(tilt_deg, images);
            // A wall has nothing behind it either; markers tell it from the floor.
            let is_level = |plane: &FloorPlane| plane.normal.angle(&up) < 0.3;
            let found = FloorPlane::find(&samples, is_level).unwrap();
            let tilt_deg = found.normal.angle(&up).to_degrees();
            assert!((found.height_m - 2.8).abs() < 0.003 && tilt_deg < 0.08, "{found:?}");
            // The stated deviations are of the size of the errors, within a factor of five.
            let [first, second, height] = [0, 1, 2].map(|it| found.covariance[(it, it)].sqrt());
            let stated_deg = first.hypot(second).to_degrees();
            assert!(
                (0.0002..0.08).contains(&stated_deg) && tilt_deg < 5.0 * stated_deg,
                "{found:?}"
            );
            assert!((found.height_m - 2.8).abs() < 5.0 * height && height < 0.003, "{found:?}");
        }
    }

    #[test]
    fn a_pose_is_levelled_by_its_floor() {
        let rotation = Orientation { tilt_rad: 0.9, heading_rad: 0.4, roll_rad: 0.0 }.rotation();
        let truth = Isometry3::from_parts(Translation3::new(1.0, 2.0, 2.8), rotation);
        let normal = UnitVector3::new_normalize(rotation.inverse() * Vector3::z());
        let plane = FloorPlane { normal, height_m: 2.8, share: 1.0, covariance: Matrix3::zeros() };
        // Tilt, roll and height are wrong; the floor can't tell the heading.
        let turn = UnitQuaternion::from_euler_angles(0.03, -0.02, 0.0);
        let stated = Isometry3::from_parts(Translation3::new(1.0, 2.0, 2.85), turn * rotation);
        let error = FloorError::new(&stated, &plane.normal, plane.height_m);
        assert!((error.height_m - 0.05).abs() < 1e-12);
        assert!((error.tilt_rad - 0.036).abs() < 1e-3, "{error:?}");
        let level = plane.level(&stated);
        assert_eq!(FloorError::new(&level, &plane.normal, plane.height_m).height_m, 0.0);
        assert!((level.translation.vector - truth.translation.vector).norm() < 1e-12);
        assert!(level.rotation.angle_to(&truth.rotation) < 1e-3);
    }

    #[test]
    fn a_table_is_no_floor() {
        let (samples, up) = samples(60.0, 9);
        let is_table = |plane: &FloorPlane| plane.normal.angle(&up) < 0.1 && plane.height_m < 2.5;
        assert_eq!(FloorPlane::find(&samples, is_table), None);
    }

    #[test]
    fn without_measurements_there_is_no_floor() {
        let intrinsics = Intrinsics::pinhole(64, 48, 1.0);
        let mut samples = DepthSamples::new(&intrinsics, DepthNoise::D435);
        assert_eq!(FloorPlane::find(&samples, |_| true), None);
        samples.add(&DepthImage::new(64, 48));
        samples.add(&DepthImage::new(2, 2));
        assert_eq!(FloorPlane::find(&samples, |_| true), None);
    }
}
