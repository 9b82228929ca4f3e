//! The pose of a camera that is knocked, or drifts, after it was calibrated.

use nalgebra::{Isometry3, Translation3};
use ubimap_protocol::time::Instant;

use super::scenario::KnockConfig;
use crate::camera::Orientation;

/// Steps of a slow movement, in metres and degrees: the room is rendered anew after each.
const STEP_M: f64 = 0.000_1;
const STEP_DEG: f64 = 0.002;

/// The pose of a camera at a moment, if `stated` was its pose before all knocks.
pub(super) fn displaced(
    stated: &Isometry3<f64>,
    knocks: &[KnockConfig],
    moment: Instant,
) -> Isometry3<f64> {
    let seconds = moment.micros() as f64 / 1e6;
    let mut pose = *stated;
    for knock in knocks {
        let part = part(knock, seconds);
        if part > 0.0 {
            let mut angles = Orientation::of(&pose.rotation);
            angles.heading_rad += part * knock.heading_deg.to_radians();
            angles.tilt_rad += part * knock.tilt_deg.to_radians();
            angles.roll_rad += part * knock.roll_deg.to_radians();
            let shift = Translation3::from(knock.shift_m.map(|metres| part * metres));
            pose = Isometry3::from_parts(shift * pose.translation, angles.rotation());
        }
    }
    pose
}

/// The part of a knock's way that is done: in small steps if it takes time.
fn part(knock: &KnockConfig, seconds: f64) -> f64 {
    if seconds < knock.at_s {
        return 0.0;
    }
    let since = seconds - knock.at_s;
    if since >= knock.over_s {
        return 1.0;
    }
    let metres = knock.shift_m.map(f64::abs).into_iter().fold(0.0, f64::max);
    let angles = [knock.heading_deg, knock.tilt_deg, knock.roll_deg];
    let degrees = angles.map(f64::abs).into_iter().fold(0.0, f64::max);
    let steps = (metres / STEP_M).max(degrees / STEP_DEG).ceil().max(1.0);
    (since / knock.over_s * steps).floor() / steps
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_knock_is_at_once_and_a_drift_takes_its_time() {
        let stated = Isometry3::from_parts(
            Translation3::new(1.0, 2.0, 3.0),
            Orientation { tilt_rad: 0.8, ..Orientation::default() }.rotation(),
        );
        let knock = KnockConfig { at_s: 1.0, shift_m: [0.1, 0.0, -0.2], ..KnockConfig::default() };
        let drift =
            KnockConfig { at_s: 2.0, over_s: 100.0, tilt_deg: 1.0, ..KnockConfig::default() };
        let at = |millis: u64| displaced(&stated, &[knock, drift], Instant(millis * 1_000));
        assert_eq!(at(999), stated);
        let moved = at(1_000);
        assert!((moved.translation.vector - nalgebra::Vector3::new(1.1, 2.0, 2.8)).norm() < 1e-12);
        assert!(moved.rotation.angle_to(&stated.rotation) < 1e-9);
        for (millis, degrees) in [(27_000, 0.25), (102_000, 1.0), (500_000, 1.0)] {
            let turned = Orientation::of(&at(millis).rotation).tilt_rad - 0.8;
            assert!((turned.to_degrees() - degrees).abs() <= STEP_DEG, "{turned}");
        }
    }
}
