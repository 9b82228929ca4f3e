//! A depth camera: the direction of each pixel, and the point at its depth.

use crate::trigonometry::sin_cos;

/// How the column of a pixel becomes a bearing. In both models a reading is the depth `d` along the
/// optical axis, and the radial distance of the point is `D = d / cos(theta)` (Aluckal, equation
/// 1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PixelModel {
    /// `tan(theta) = (centre - column) / focal`: a lens without distortion.
    Pinhole,
    /// The paper's model: all columns have the same angular width, `theta = field / 2 * (n / 2 -
    /// column) / (n / 2)` for `n` columns (Aluckal, equation 2; 0.134 degrees per column with 86
    /// degrees over 640 columns). Its error there is up to 3.6 degrees, halfway between the axis
    /// and the edge.
    LinearAngle {
        /// The angle between the outermost columns, in radians.
        field: f32,
    },
}

/// The lens distortion of Brown and Conrady, with the names and signs of OpenCV; all zero for
/// rectified images.
///
/// ```text
/// r2 = x*x + y*y,  radial = 1 + k1*r2 + k2*r2^2 + k3*r2^3
/// x' = x * radial + 2*p1*x*y + p2*(r2 + 2*x*x)
/// y' = y * radial + p1*(r2 + 2*y*y) + 2*p2*x*y
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[expect(missing_docs, reason = "the formulas name them")]
pub struct Distortion {
    pub k1: f32,
    pub k2: f32,
    pub p1: f32,
    pub p2: f32,
    pub k3: f32,
}

/// The geometry of a depth camera. Columns count from the left of the image, rows from its top;
/// pixel centres lie at integers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// The focal length in pixels, horizontal and vertical; both positive.
    pub focal: (f32, f32),
    /// The column and row of the optical axis.
    pub centre: (f32, f32),
    /// The lens distortion.
    pub distortion: Distortion,
    /// How columns become bearings.
    pub pixels: PixelModel,
    /// Downward tilt, in radians: less than a quarter turn.
    pub pitch: f32,
    /// Rotation about the optical axis, in radians: positive lowers the right of the image.
    pub roll: f32,
}

impl Camera {
    /// A level pinhole camera without distortion.
    pub const fn new(focal: (f32, f32), centre: (f32, f32)) -> Self {
        let distortion = Distortion { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0 };
        Self { focal, centre, distortion, pixels: PixelModel::Pinhole, pitch: 0.0, roll: 0.0 }
    }

    /// The row that looks level in the centre column: points seen in it are at the height of the
    /// camera, at any distance. `None` if the camera has no such row.
    pub fn level_row(&self) -> Option<f32> {
        let (sin, cos) = sin_cos(self.roll);
        let (pitch_sin, pitch_cos) = sin_cos(self.pitch);
        let down = -pitch_sin / pitch_cos;
        let (_, y) = self.distortion.apply(down * sin, down * cos);
        let row = self.centre.1 + y * self.focal.1;
        (row.is_finite() && row >= 0.0).then_some(row)
    }
}

/// The direction of a pixel: the position of its point at a depth of one, in level axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Forward, parallel to the floor.
    pub forward: f32,
    /// Left, parallel to the floor.
    pub left: f32,
    /// Down from the camera.
    pub down: f32,
}

/// The rays of a camera's pixels.
#[derive(Clone, Copy, Debug)]
pub struct Rays {
    camera: Camera,
    width: f32,
    /// Sine and cosine of each angle.
    pitch: (f32, f32),
    roll: (f32, f32),
}

impl Rays {
    /// The rays of a camera whose images are `width` pixels wide.
    pub fn new(camera: Camera, width: usize) -> Self {
        let (pitch, roll) = (sin_cos(camera.pitch), sin_cos(camera.roll));
        Self { camera, width: width as f32, pitch, roll }
    }

    /// The ray of a pixel, or of a point between pixels. `None` where the lens model has no
    /// solution.
    pub fn at(&self, column: f32, row: f32) -> Option<Ray> {
        let Camera { focal, centre, distortion, pixels, .. } = self.camera;
        let (right, below) = ((column - centre.0) / focal.0, (row - centre.1) / focal.1);
        let (right, below) = distortion.remove(right, below)?;
        let right = match pixels {
            PixelModel::Pinhole => right,
            PixelModel::LinearAngle { field } => {
                let half = self.width / 2.0;
                let angle = field / 2.0 * (half - (centre.0 + right * focal.0)) / half;
                let (sin, cos) = sin_cos(angle);
                -sin / cos
            }
        };
        let (sin, cos) = self.roll;
        let (right, below) = (right * cos - below * sin, right * sin + below * cos);
        let (sin, cos) = self.pitch;
        Some(Ray { forward: cos - below * sin, left: -right, down: sin + below * cos })
    }

    /// The column in which a level pinhole camera, with the same focal length and position, sees
    /// the points of a ray.
    pub fn level_column(&self, ray: &Ray) -> f32 {
        self.camera.centre.0 - ray.left / ray.forward * self.camera.focal.0
    }
}

impl Distortion {
    /// Maximum number of iterations of `remove`; strong lenses take about 20 at the edge.
    const STEPS: usize = 40;
    /// Convergence tolerance, in focal lengths: 1/200 pixel at a focal length of 500.
    const CLOSE: f32 = 1e-5;

    /// Where the lens shows the point that a pinhole camera shows at `x`, `y` (in focal lengths).
    fn apply(&self, x: f32, y: f32) -> (f32, f32) {
        let (radial, aside, below) = self.parts(x, y);
        (x * radial + aside, y * radial + below)
    }

    /// The radial factor, and the tangential offsets in x and y.
    fn parts(&self, x: f32, y: f32) -> (f32, f32, f32) {
        let Self { k1, k2, p1, p2, k3 } = *self;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let aside = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let below = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        (radial, aside, below)
    }

    /// The inverse of [`Distortion::apply`], by fixed-point iteration. `None` if it does not
    /// converge.
    fn remove(&self, shown_x: f32, shown_y: f32) -> Option<(f32, f32)> {
        let (mut x, mut y) = (shown_x, shown_y);
        for _ in 0..Self::STEPS {
            let (radial, aside, below) = self.parts(x, y);
            let off = (shown_x - aside - x * radial, shown_y - below - y * radial);
            if off.0.abs() < Self::CLOSE && off.1.abs() < Self::CLOSE {
                return Some((x, y));
            }
            (x, y) = ((shown_x - aside) / radial, (shown_y - below) / radial);
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn equation_2_gives_the_printed_angles() {
        let linear = PixelModel::LinearAngle { field: 86f32.to_radians() };
        let camera = Camera { pixels: linear, ..Camera::new((343.1, 343.1), (319.5, 239.5)) };
        let rays = Rays::new(camera, 640);
        let degrees = |column: f32| {
            let ray = rays.at(column, 239.5).unwrap();
            f64::from(ray.left).atan2(f64::from(ray.forward)).to_degrees()
        };
        // The formula as printed: theta_k = 43 * (320 - k) / 320 (Aluckal II.D).
        for k in 0..=640 {
            let printed = 43.0 * f64::from(320 - k) / 320.0;
            assert!((degrees(k as f32) - printed).abs() < 1e-4, "{k}");
            // Equation 1: a depth of one is a radial distance of 1 / cos(theta).
            let ray = rays.at(k as f32, 239.5).unwrap();
            let radial = f64::from(ray.forward).hypot(f64::from(ray.left));
            assert!((radial - 1.0 / printed.to_radians().cos()).abs() < 1e-5, "{k}");
        }
        assert!((degrees(0.0) - degrees(1.0) - 0.134).abs() < 5e-4);
        // A pinhole with the same field of view differs in between.
        let pinhole = Rays::new(Camera::new((343.1, 343.1), (319.5, 239.5)), 640);
        let off = (0..640).map(|column| {
            let ray = pinhole.at(column as f32, 239.5).unwrap();
            (f64::from(ray.left).atan2(1.0).to_degrees() - degrees(column as f32)).abs()
        });
        let most = off.fold(0.0, f64::max);
        assert!((3.4..3.6).contains(&most), "{most}");
    }

    /// Projects a point in the camera's own frame (right, down, forward) through the lens in double
    /// precision: an independent implementation of OpenCV's formulas.
    fn project(camera: &Camera, [x, y, z]: [f64; 3]) -> (f64, f64) {
        let Distortion { k1, k2, p1, p2, k3 } = camera.distortion;
        let [k1, k2, p1, p2, k3] = [k1, k2, p1, p2, k3].map(f64::from);
        let (x, y) = (x / z, y / z);
        let r2 = x * x + y * y;
        let radial = 1.0 + k1 * r2 + k2 * r2.powi(2) + k3 * r2.powi(3);
        let shown_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let shown_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        (
            f64::from(camera.centre.0) + f64::from(camera.focal.0) * shown_x,
            f64::from(camera.centre.1) + f64::from(camera.focal.1) * shown_y,
        )
    }

    proptest! {
        /// Takes a point in level axes, rotates it into the camera's frame by matrices and projects
        /// it through the lens: it must equal the ray of its pixel times its depth.
        #[test]
        fn a_ray_leads_back_to_the_point(
            pitch in -0.5f64..0.9, roll in -0.4f64..0.4,
            k1 in -0.25f32..0.25, k2 in -0.05f32..0.05, p1 in -0.004f32..0.004,
            p2 in -0.004f32..0.004, k3 in -0.02f32..0.02,
            right in -0.8f64..0.8, below in -0.6f64..0.6, depth in 0.3f64..6.0,
        ) {
            let camera = Camera {
                distortion: Distortion { k1, k2, p1, p2, k3 },
                pitch: pitch as f32,
                roll: roll as f32,
                ..Camera::new((343.1, 341.0), (321.5, 238.0))
            };
            let (column, row) = project(&camera, [right * depth, below * depth, depth]);
            let ray = Rays::new(camera, 640).at(column as f32, row as f32);
            let ray = ray.expect("the lens reaches here");
            // The camera's axes in level axes: forward, left, down.
            let ahead = [pitch.cos(), 0.0, pitch.sin()];
            let level_right = [0.0, -1.0, 0.0];
            let straight_below = [-pitch.sin(), 0.0, pitch.cos()];
            let mix = |a: [f64; 3], p: f64, b: [f64; 3], q: f64| {
                [p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]]
            };
            let axis_right = mix(level_right, roll.cos(), straight_below, roll.sin());
            let axis_below = mix(level_right, -roll.sin(), straight_below, roll.cos());
            let aside = mix(axis_right, right * depth, axis_below, below * depth);
            let point = mix(ahead, depth, aside, 1.0);
            for (seen, truth) in [ray.forward, ray.left, ray.down].into_iter().zip(point) {
                prop_assert!((f64::from(seen) * depth - truth).abs() < 3e-4 * depth, "{ray:?}");
            }
        }

        /// Any coefficients give a finite ray or none.
        #[test]
        fn any_lens_gives_finite_rays_or_none(
            coefficients: [f32; 5], focal: (f32, f32), column: f32, row: f32, pitch: f32,
        ) {
            let [k1, k2, p1, p2, k3] = coefficients;
            let distortion = Distortion { k1, k2, p1, p2, k3 };
            let camera = Camera { distortion, pitch, ..Camera::new(focal, (319.5, 239.5)) };
            let _ = (Rays::new(camera, 640).at(column, row), camera.level_row());
        }
    }

    #[test]
    fn the_lens_has_no_ray_where_its_formula_folds_over() {
        // x * (1 - 0.3 x^2) never exceeds 0.703.
        let distortion = Distortion { k1: -0.3, ..Distortion::default() };
        let camera = Camera { distortion, ..Camera::new((100.0, 100.0), (100.0, 0.0)) };
        let rays = Rays::new(camera, 200);
        assert!(rays.at(168.0, 0.0).is_some());
        assert_eq!(rays.at(172.0, 0.0), None);
    }

    #[test]
    fn the_level_row_sees_as_high_as_the_camera() {
        let level = Camera::new((343.1, 343.1), (319.5, 239.5));
        assert_eq!(level.level_row(), Some(239.5));
        let distortion = Distortion { k1: 0.1, p1: 0.002, ..Distortion::default() };
        for (pitch, roll) in [(0.3, 0.0), (-0.2, 0.1), (0.5, -0.2)] {
            let camera = Camera { pitch, roll, distortion, ..level };
            let row = camera.level_row().unwrap();
            // Checked in the column that looks straight ahead.
            let rays = Rays::new(camera, 640);
            let ahead = (0..640)
                .filter_map(|column| rays.at(column as f32, row))
                .min_by(|a, b| a.left.abs().total_cmp(&b.left.abs()))
                .unwrap();
            assert!(ahead.down.abs() < 2e-3, "{pitch} {roll}: {ahead:?}");
        }
        assert_eq!(Camera { pitch: 1.2, ..level }.level_row(), None);
    }
}
