//! Over- and underexposed pixels of stereo cameras, whose depths are wrong (Aluckal III.C).

use parry2d_f64::glamx::DVec2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::{
    plane_pose::PlanePose, room::footprint, scenario::Scenario, sensor::RangeSensor,
    shapes::Footprint,
};

/// Brightness of well exposed pixels.
const WELL: u8 = 128;
/// Share of the badly exposed pixels that have no depth; the others have an arbitrary one.
const MISSING: f64 = 0.4;
/// Depths of these, as multiples of the true one.
const WRONG: std::ops::Range<f64> = 0.6..1.7;

/// The badly exposed surfaces of a room, by the ground under them.
pub(super) struct Glare {
    spots: Vec<(Footprint, u8)>,
}

impl Glare {
    pub(super) fn of(scenario: &Scenario) -> Self {
        let spots = scenario.glare.iter();
        let spots = spots.filter_map(|spot| Some((footprint(&spot.footprint)?, spot.brightness)));
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
        let Some(focal) = sensor.focal_px() else { return vec![WELL; readings_mm.len()] };
        let middle = (readings_mm.len() as f64 - 1.0) / 2.0;
        let light = readings_mm.iter_mut().enumerate().map(|(column, reading)| {
            let aside = (middle - column as f64) / focal;
            let point = eye + (ahead + ahead.perp() * aside) * (f64::from(*reading) / 1_000.0);
            let spot = self.spots.iter().find(|(ground, _)| ground.contains(point));
            let Some(&(_, brightness)) = spot.filter(|_| *reading > 0) else { return WELL };
            let (fate, factor) = (dice.random_range(0.0..1.0), dice.random_range(WRONG));
            let wrong = f64::from(*reading) * factor;
            *reading = if fate < MISSING { 0 } else { wrong.round() as u16 };
            brightness
        });
        light.collect()
    }
}
