//! Over- and underexposed pixels of stereo cameras, whose depths are wrong (Aluckal III.C).
//!
//! A camera exposes for the mean of its picture, as automatic exposure does: bright surfaces in view make
//! all others dark. Pixels that are clipped, or so dark that their texture is lost in the noise, have no
//! depth or an arbitrary one.

use parry2d_f64::glamx::DVec2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::{
    plane_pose::PlanePose, room::footprint, scenario::Scenario, sensor::RangeSensor,
    shapes::Footprint,
};

/// Mean brightness for which a camera exposes, and that of a room's usual surfaces in a picture without
/// any others.
const WELL: f64 = 128.0;
/// Maximum gain of the exposure above the usual one.
const MOST_GAIN: f64 = 8.0;
/// Range of brightness in which a pixel has a depth.
const MATCHED: std::ops::RangeInclusive<u8> = 3..=250;
/// Share of the badly exposed pixels that have no depth; the others have an arbitrary one.
const MISSING: f64 = 0.4;
/// Depths of these, as multiples of the true one.
const WRONG: std::ops::Range<f64> = 0.6..1.7;

/// The surfaces of a room with unusual light, by the ground under them, each with its light as a multiple
/// of the usual one.
pub(super) struct Glare {
    spots: Vec<(Footprint, f64)>,
}

impl Glare {
    pub(super) fn of(scenario: &Scenario) -> Self {
        let spots = scenario.glare.iter();
        let spots = spots.filter_map(|spot| Some((footprint(&spot.footprint)?, spot.light)));
        Self { spots: spots.collect() }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.spots.is_empty()
    }

    /// Spoils the readings of badly exposed pixels. Returns the brightness of all.
    pub(super) fn expose(
        &self,
        sensor: &RangeSensor,
        robot: PlanePose,
        readings_mm: &mut [u16],
        dice: &mut ChaCha8Rng,
    ) -> Vec<u8> {
        let (eye, axis, _) = sensor.view(robot);
        let ahead = DVec2::new(libm::cos(axis), libm::sin(axis));
        let Some(focal) = sensor.focal_px() else { return vec![WELL as u8; readings_mm.len()] };
        let middle = (readings_mm.len() as f64 - 1.0) / 2.0;
        let lights: Vec<f64> = readings_mm
            .iter()
            .enumerate()
            .map(|(column, reading)| {
                let aside = (middle - column as f64) / focal;
                let point = eye + (ahead + ahead.perp() * aside) * (f64::from(*reading) / 1_000.0);
                let spot = self.spots.iter().find(|(ground, _)| ground.contains(point));
                spot.filter(|_| *reading > 0).map_or(1.0, |(_, light)| *light)
            })
            .collect();
        let gain = gain(&lights);
        let pixels = readings_mm.iter_mut().zip(lights).map(|(reading, light)| {
            let brightness = (WELL * gain * light).round().clamp(0.0, 255.0) as u8;
            if !MATCHED.contains(&brightness) && *reading > 0 {
                let (fate, factor) = (dice.random_range(0.0..1.0), dice.random_range(WRONG));
                let wrong = f64::from(*reading) * factor;
                *reading = if fate < MISSING { 0 } else { wrong.round() as u16 };
            }
            brightness
        });
        pixels.collect()
    }
}

/// The gain of the exposure at which pixels with these lights have the mean [`WELL`]: by bisection, as
/// clipped pixels count as white.
fn gain(lights: &[f64]) -> f64 {
    let mean = |gain: f64| {
        let sum: f64 = lights.iter().map(|light| (WELL * gain * light).min(255.0)).sum();
        sum / lights.len().max(1) as f64
    };
    let (mut low, mut high) = (0.0, MOST_GAIN);
    for _ in 0..24 {
        let gain = (low + high) / 2.0;
        if mean(gain) > WELL {
            high = gain;
        } else {
            low = gain;
        }
    }
    (low + high) / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bright_surface_makes_the_others_dark() {
        let of = |bright: usize| {
            let lights: Vec<f64> =
                (0..100).map(|at| if at < bright { 40.0 } else { 1.0 }).collect();
            WELL * gain(&lights)
        };
        assert!((of(0) - 128.0).abs() < 0.1, "{}", of(0));
        // 30 white pixels leave 128 * 100 - 255 * 30 for the other 70.
        assert!((of(30) - 73.6).abs() < 0.2, "{}", of(30));
        // Half of the picture is at the edge of white: the others have a fortieth of it.
        assert!((of(60) - 128.0 * 100.0 / (60.0 * 40.0 + 40.0)).abs() < 0.1, "{}", of(60));
        let dark = gain(&[0.02; 10]);
        assert!((dark - MOST_GAIN).abs() < 0.01, "{dark}");
    }
}
