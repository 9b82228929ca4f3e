//! The directions of a range sensor's beams, computed once.

use libm::atan2f;
use ubimap_protocol::units::{Angle, Pose};

use crate::trigonometry::{angle, radians, round, sin_cos};

use super::camera::{Camera, Rays};

/// The geometry of a sensor's readings. Beam 0 belongs to the first reading of a scan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SensorModel {
    /// Readings are distances along the beams, at bearings of `first + index * step` (radians,
    /// counter-clockwise from the sensor's x axis).
    Radial {
        /// The bearing of beam 0.
        first: f32,
        /// Angle from one beam to the next; negative for clockwise.
        step: f32,
    },
    /// Readings are depths along the optical axis (the sensor's x-axis), one per column of a row,
    /// of an ideal pinhole camera.
    Pinhole {
        /// The focal length in pixels.
        focal: f32,
        /// The column of the optical axis.
        centre: f32,
    },
    /// Readings are depths of one row of a camera's image, one per column. Supports the paper's
    /// pixel model, lens distortion and a tilt. In a row that is not level the points differ in
    /// height; the table contains their directions projected to the floor.
    Row {
        /// The camera.
        camera: Camera,
        /// The row; it may lie between two rows of pixels.
        row: f32,
    },
}

/// Readings that are never mapped: the paper's selective removal of pixels (Aluckal III.D).
/// [`Validity`](super::Validity) removes readings by distance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Removal {
    /// By index in a scan, both ends included.
    Pixels {
        /// The first index.
        first: u16,
        /// The last index.
        last: u16,
    },
    /// By bearing in `base_link`, counter-clockwise from one bearing to the other: for example the
    /// robot's own mast.
    Bearings {
        /// The clockwise end.
        from: Angle,
        /// The counter-clockwise end.
        to: Angle,
    },
}

/// Fractional bits of a beam's direction.
pub const DIRECTION_BITS: u32 = 14;

/// The direction of a beam in `base_link`, scaled for a reading of one millimetre.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Beam {
    /// Forward, in 1/16,384 mm per mm of reading.
    pub forward: i16,
    /// Left, in 1/16,384 mm per mm of reading.
    pub left: i16,
}

impl Beam {
    /// A removed beam: its readings are never mapped.
    pub const NONE: Self = Self { forward: 0, left: 0 };

    /// The squared distance in the plane for a reading of one millimetre, in 2^-28 mm^2; 0 for
    /// [`Beam::NONE`].
    #[inline(always)]
    pub(crate) fn square(self) -> u32 {
        let (forward, left) = (i32::from(self.forward), i32::from(self.left));
        (forward * forward) as u32 + (left * left) as u32
    }

    /// The reading at which the beam ends `range` millimetres from the sensor, accurate to 1 mm
    /// plus 1/3,000. Takes 30 instructions.
    #[inline(never)]
    pub(crate) fn reading_at(self, range: u16) -> u32 {
        let square = self.square().max(1);
        // Normalised to [1/4, 1) in units of 1/2^16 by an even shift, whose square root is a whole
        // shift.
        let shift = square.leading_zeros() & !1;
        let part = square << shift >> 16;
        // The inverse square root in 1/2^14: a linear estimate with an error of 10 %, then Newton
        // steps.
        let mut inverse = 34_900 - part * 39 / 131;
        for _ in 0..2 {
            let one = (part * ((inverse * inverse) >> 14)) >> 16;
            inverse = (inverse * ((3 << 14) - one)) >> 15;
        }
        ((u32::from(range) * inverse) >> (16 - shift / 2)).min(u16::MAX.into())
    }
}

/// Fills the table of a sensor mounted at `mounting` in `base_link`, whose heading is included in
/// the table; its position is ignored.
///
/// Beams whose direction does not fit the number format (more than 63 degrees off a pinhole's
/// axis), and columns beyond the lens's view, become [`Beam::NONE`].
pub fn fill_beams(beams: &mut [Beam], model: SensorModel, mounting: Pose) {
    let row_of = |camera, row| Some((Rays::new(camera, beams.len()), row));
    let rays = match model {
        SensorModel::Radial { .. } => None,
        SensorModel::Pinhole { focal, centre } => {
            row_of(Camera::new((focal, focal), (centre, 0.0)), 0.0)
        }
        SensorModel::Row { camera, row } => row_of(camera, row),
    };
    let (turn_sin, turn_cos) = sin_cos(radians(mounting.heading));
    for (index, beam) in beams.iter_mut().enumerate() {
        *beam = Beam::NONE;
        let (x, y) = match model {
            SensorModel::Radial { first, step } => {
                let bearing = first + index as f32 * step;
                let (sin, cos) = sin_cos(bearing);
                (cos, sin)
            }
            SensorModel::Pinhole { .. } | SensorModel::Row { .. } => {
                let ray = rays.as_ref().and_then(|(rays, row)| rays.at(index as f32, *row));
                let Some(ray) = ray else { continue };
                (ray.forward, ray.left)
            }
        };
        let scale = (1 << DIRECTION_BITS) as f32;
        let forward = (x * turn_cos - y * turn_sin) * scale;
        let left = (x * turn_sin + y * turn_cos) * scale;
        let fits = |value: f32| value.abs() <= f32::from(i16::MAX);
        if fits(forward) && fits(left) {
            *beam = Beam { forward: round(forward) as i16, left: round(left) as i16 };
        }
    }
}

/// Removes readings from the table permanently: they become [`Beam::NONE`], at no cost per frame.
pub fn remove_beams(beams: &mut [Beam], removal: Removal) {
    for (index, beam) in beams.iter_mut().enumerate() {
        let is_removed = match removal {
            Removal::Pixels { first, last } => {
                (usize::from(first)..=usize::from(last)).contains(&index)
            }
            Removal::Bearings { from, to } => {
                let bearing = atan2f(f32::from(beam.left), f32::from(beam.forward));
                (angle(bearing) - from).0 <= (to - from).0
            }
        };
        if is_removed {
            *beam = Beam::NONE;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const AT_CENTRE: Pose = Pose {
        x: ubimap_protocol::units::Millimetres(0),
        y: ubimap_protocol::units::Millimetres(0),
        heading: Angle(0),
    };

    #[test]
    fn a_pinhole_row_of_a_flat_wall_is_flat() {
        let mut beams = [Beam::default(); 640];
        let model = SensorModel::Pinhole { focal: 343.1, centre: 319.5 };
        fill_beams(&mut beams, model, AT_CENTRE);
        assert!(beams.iter().all(|beam| beam.forward == 1 << DIRECTION_BITS));
        // 86 degrees across (Aluckal II.D): the outermost columns look 43 degrees sideways.
        let aside = f64::from(beams[0].left) / f64::from(1 << DIRECTION_BITS);
        assert!((aside.atan().to_degrees() - 43.0).abs() < 0.1);
    }

    proptest! {
        #[test]
        fn a_beam_is_at_the_range_at_its_reading(
            forward: i16, left: i16, shift in 0u32..14, range: u16,
        ) {
            let beam = Beam { forward: forward >> shift, left: left >> shift };
            prop_assume!(beam != Beam::NONE);
            let length = f64::from(beam.forward).hypot(f64::from(beam.left));
            let exact = (f64::from(range) * f64::from(1 << DIRECTION_BITS) / length).min(65_535.0);
            let found = f64::from(beam.reading_at(range));
            prop_assert!((found - exact).abs() <= 1.0 + exact / 3_000.0, "{found} {exact}");
        }
    }

    #[test]
    fn a_sensor_that_looks_left_sees_to_the_left() {
        let mut beams = [Beam::default(); 3];
        let model = SensorModel::Radial { first: -0.5, step: 0.5 };
        let mounting = Pose { heading: Angle::from_degrees(90.0), ..AT_CENTRE };
        fill_beams(&mut beams, model, mounting);
        assert!(beams[1].forward.abs() <= 1);
        assert_eq!(beams[1].left, 1 << DIRECTION_BITS);
        assert!(beams[0].forward > 0 && beams[2].forward < 0);
    }

    #[test]
    fn a_row_that_looks_down_is_shorter_on_the_floor() {
        let mut beams = [Beam::default(); 640];
        let camera = Camera { pitch: 0.3, ..Camera::new((343.1, 343.1), (319.5, 239.5)) };
        let forward = |beam: Beam| f64::from(beam.forward) / f64::from(1 << DIRECTION_BITS);
        // The row on the optical axis gives Z cos(pitch), the level row Z / cos(pitch).
        for (row, expected) in
            [(239.5, 0.3f64.cos()), (239.5 - 343.1 * 0.3f32.tan(), 1.0 / 0.3f64.cos())]
        {
            fill_beams(&mut beams, SensorModel::Row { camera, row }, AT_CENTRE);
            assert!(beams.iter().all(|&beam| (forward(beam) - expected).abs() < 1e-4));
        }
        assert!((camera.level_row().unwrap() - (239.5 - 343.1 * 0.3f32.tan())).abs() < 1e-3);
    }

    #[test]
    fn exactly_the_removed_pixels_and_bearings_are_invalid() {
        let model = SensorModel::Radial { first: -3.0, step: 0.1 };
        let bearing = |index: usize| 0.5 - 3.0 + 0.1 * index as f64;
        let mounting = Pose { heading: Angle::from_radians(0.5), ..AT_CENTRE };
        let left_out = |removal| {
            let mut beams = [Beam::default(); 61];
            fill_beams(&mut beams, model, mounting);
            remove_beams(&mut beams, removal);
            move |index: usize| beams[index] == Beam::NONE
        };
        let is_out = left_out(Removal::Pixels { first: 3, last: 7 });
        assert!((0..61).all(|index| is_out(index) == (3..=7).contains(&index)));
        // A range of bearings across the back, where they jump from pi to -pi.
        let (from, to) = (Angle::from_radians(2.95), Angle::from_radians(-2.35));
        let is_out = left_out(Removal::Bearings { from, to });
        for index in 0..61 {
            let bearing = bearing(index);
            assert_ne!(is_out(index), (-2.35..=2.95).contains(&bearing), "{bearing}");
        }
    }
}
