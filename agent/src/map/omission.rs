//! The readings that came into view by a turn (Aluckal II.C-D, "selective omission").

use core::ops::Range;

use libm::atan2f;
use ubimap_protocol::units::Angle;

use crate::{sense::Beam, trigonometry::round};

/// The angular order of a sensor's beams.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Sweep {
    /// Mean angle from one beam to the next, in radians; negative for clockwise.
    step: f32,
}

impl Sweep {
    /// Computes the mean angle from a sensor's table: the angle between the outermost beams,
    /// divided by their number (the paper's 86 / 640 = 0.134 degrees per pixel).
    pub(super) fn of(beams: &[Beam]) -> Self {
        let used = |beam: &&Beam| **beam != Beam::NONE;
        let bearing = |beam: &Beam| atan2f(f32::from(beam.left), f32::from(beam.forward));
        let first = beams.iter().position(|beam| *beam != Beam::NONE);
        let last = beams.iter().rposition(|beam| *beam != Beam::NONE);
        let pairs = beams.iter().filter(used).zip(beams.iter().filter(used).skip(1));
        // Added up pair by pair, as the outermost beams may be more than half a turn apart.
        let turn = pairs.map(|(a, b)| {
            let turn = bearing(b) - bearing(a);
            let whole = 2.0 * core::f32::consts::PI;
            turn - whole * libm::rintf(turn / whole)
        });
        let steps = first.zip(last).map_or(0, |(first, last)| last - first);
        Self { step: turn.sum::<f32>() / steps.max(1) as f32 }
    }

    /// The same by the letter of the paper's listing, with its yaw (clockwise): `inter_p = (g_angle -
    /// yaw) / 0.134` is negative in its second branch, `640 - inter_p` lies beyond the last pixel, and
    /// so nothing is left between start and end after a turn to the right.
    pub(super) fn as_printed(self, before: Angle, now: Angle, count: usize) -> Range<usize> {
        if ((now - before).0 as i16) < 0 {
            return count..count;
        }
        self.new_in_view(before, now, count)
    }

    /// The indices of the readings, out of `count`, that came into view when the robot turned from
    /// heading `before` to `now` (the paper's start and end pixel); all indices if it did not turn.
    ///
    /// Corrects two misprints. The paper's sense of rotation is opposite to REP-103, where a turn
    /// to the left increases the yaw and brings new pixels into view on the left. And its second
    /// branch subtracts a negative number of pixels from 640, which gives a start pixel beyond the
    /// last: the absolute value is meant.
    pub(super) fn new_in_view(self, before: Angle, now: Angle, count: usize) -> Range<usize> {
        let turn = (now - before).0 as i16;
        let step = self.step * (32_768.0 / core::f32::consts::PI);
        if turn == 0 || step == 0.0 {
            return 0..count;
        }
        let pixels = round(f32::from(turn) / step) as i32;
        let new = (pixels.unsigned_abs() as usize).min(count);
        // If the beams are ordered from right to left, a turn to the left brings new ones into view
        // at the end of the scan.
        if pixels > 0 { count - new..count } else { 0..new }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sense::{SensorModel, fill_beams};
    use ubimap_protocol::units::Pose;

    fn sweep(model: SensorModel, count: usize) -> Sweep {
        let mut beams = std::vec![Beam::default(); count];
        fill_beams(&mut beams, model, Pose::default());
        Sweep::of(&beams)
    }

    #[test]
    fn the_papers_pixels() {
        // 640 pixels from left to right in 86 degrees: 0.134 degrees per pixel.
        let step = -(86f32 / 640.0).to_radians();
        let sweep = sweep(SensorModel::Radial { first: 43f32.to_radians(), step }, 640);
        assert!((sweep.step.to_degrees() + 0.134).abs() < 0.001);
        let view = |before: f64, now: f64| {
            sweep.new_in_view(Angle::from_degrees(before), Angle::from_degrees(now), 640)
        };
        // Ten degrees are 74 pixels (10 / 0.134 = 74.6; with 86 / 640 degrees 74.4).
        assert_eq!(view(0.0, 10.0), 0..74, "to the left: from the left-hand side");
        let printed = |before: f64, now: f64| {
            sweep.as_printed(Angle::from_degrees(before), Angle::from_degrees(now), 640)
        };
        assert_eq!(printed(0.0, 10.0), 0..74);
        assert_eq!(printed(0.0, -10.0), 640..640, "640 + 75 = 715 is the printed start");
        assert_eq!(printed(30.0, 30.0), 0..640);
        assert_eq!(view(0.0, -10.0), 566..640, "to the right: from the right-hand side");
        assert_eq!(view(175.0, -175.0), 0..74, "across 180 degrees");
        assert_eq!(view(30.0, 30.0), 0..640, "no turn");
        assert_eq!(view(0.0, 120.0), 0..640, "more than is in view");
    }

    #[test]
    fn a_counter_clockwise_lidar_is_mirrored() {
        let half_turn = core::f32::consts::PI;
        let model = SensorModel::Radial { first: -half_turn, step: half_turn / 180.0 };
        let sweep = sweep(model, 361);
        assert_eq!(sweep.new_in_view(Angle(0), Angle::from_degrees(7.0), 361), 354..361);
        assert_eq!(sweep.new_in_view(Angle(0), Angle::from_degrees(-7.0), 361), 0..7);
    }
}
