//! The beams of a range sensor: where each one points, computed once.

use libm::{cosf, sinf, sqrtf};
use ubimap_protocol::units::Pose;

/// What a sensor's readings mean. Beam 0 is the first reading of a scan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SensorModel {
    /// Readings are distances along the beams, at bearings of `first + index * step` (radians,
    /// counter-clockwise from the sensor's x axis).
    Radial {
        /// The bearing of beam 0.
        first: f32,
        /// From one beam to the next; negative for clockwise.
        step: f32,
    },
    /// Readings are depths along the optical axis (the sensor's x axis), one for each column of
    /// a row: the true pinhole.
    Pinhole {
        /// The focal length in pixels.
        focal: f32,
        /// The column of the optical axis.
        centre: f32,
    },
}

/// Fractional bits of a beam's direction.
pub const DIRECTION_BITS: u32 = 14;

/// One beam: what a reading of one millimetre stands for, in `base_link`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Beam {
    /// Forward, in 1/16,384 mm for each mm of reading.
    pub forward: i16,
    /// Left, in 1/16,384 mm for each mm of reading.
    pub left: i16,
    /// The reading at which the beam reaches the range of the map, in millimetres.
    pub limit: u16,
}

/// Fills the table of a sensor that is mounted at `mounting` in `base_link` (only its heading
/// counts here). `max_range` is radial, in millimetres.
///
/// A pinhole's columns beyond 63 degrees from the axis do not fit the table; their limit is 0,
/// which makes their readings invalid.
pub fn fill_beams(beams: &mut [Beam], model: SensorModel, mounting: Pose, max_range: u16) {
    let turn = mounting.heading.radians() as f32;
    let (turn_sin, turn_cos) = (sinf(turn), cosf(turn));
    for (index, beam) in beams.iter_mut().enumerate() {
        let (x, y) = match model {
            SensorModel::Radial { first, step } => {
                let bearing = first + index as f32 * step;
                (cosf(bearing), sinf(bearing))
            }
            SensorModel::Pinhole { focal, centre } => (1.0, (centre - index as f32) / focal),
        };
        let length = sqrtf(x * x + y * y);
        let scale = (1 << DIRECTION_BITS) as f32;
        let forward = (x * turn_cos - y * turn_sin) * scale;
        let left = (x * turn_sin + y * turn_cos) * scale;
        let fits = |value: f32| value.abs() <= f32::from(i16::MAX);
        *beam = if fits(forward) && fits(left) {
            Beam {
                forward: libm::roundf(forward) as i16,
                left: libm::roundf(left) as i16,
                limit: (f32::from(max_range) / length) as u16,
            }
        } else {
            Beam::default()
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::units::Angle;

    const AT_CENTRE: Pose = Pose {
        x: ubimap_protocol::units::Millimetres(0),
        y: ubimap_protocol::units::Millimetres(0),
        heading: Angle(0),
    };

    #[test]
    fn a_pinhole_row_of_a_flat_wall_is_flat() {
        let mut beams = [Beam::default(); 640];
        let model = SensorModel::Pinhole { focal: 343.1, centre: 319.5 };
        fill_beams(&mut beams, model, AT_CENTRE, 4_000);
        assert!(beams.iter().all(|beam| beam.forward == 1 << DIRECTION_BITS));
        // 86 degrees across (Aluckal II.D): the outermost columns look 43 degrees aside.
        let aside = f64::from(beams[0].left) / f64::from(1 << DIRECTION_BITS);
        assert!((aside.atan().to_degrees() - 43.0).abs() < 0.1);
        assert!((f64::from(beams[0].limit) - 4_000.0 * 43f64.to_radians().cos()).abs() < 5.0);
    }

    #[test]
    fn a_sensor_that_looks_left_sees_to_the_left() {
        let mut beams = [Beam::default(); 3];
        let model = SensorModel::Radial { first: -0.5, step: 0.5 };
        let mounting = Pose { heading: Angle::from_degrees(90.0), ..AT_CENTRE };
        fill_beams(&mut beams, model, mounting, 4_000);
        assert!(beams[1].forward.abs() <= 1);
        assert_eq!(beams[1].left, 1 << DIRECTION_BITS);
        assert!(beams[0].forward > 0 && beams[2].forward < 0);
    }
}
