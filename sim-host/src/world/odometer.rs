//! What the wheels of a simulated robot report, with their errors.

use libm::{cos, sin};
use parry2d_f64::glamx::DVec2;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::{
    plane_pose::{PlanePose, wrap},
    scenario::OdometryConfig,
};

/// Standard deviation of the relative errors of distances and turns between robots: a wheel of 65 mm is off by 0.6 mm,
/// or its distance from the other one by a per cent.
const SCALE: f64 = 0.01;

/// The same of the heading's drift in degrees per metre: wheels 150 mm apart that differ by 1.3 parts in a thousand.
const DRIFT_DEG: f64 = 0.5;

/// Measures how far the wheels roll.
#[derive(Clone, Debug)]
pub(super) struct Odometer {
    errors: Errors,
    noise: ChaCha8Rng,
    pose: PlanePose,
    rolled: [f64; 2],
}

/// The errors of a robot's wheels.
#[derive(Clone, Debug)]
struct Errors {
    /// Relative errors of distances and turns.
    way: f64,
    turn: f64,
    /// Heading error in radians per metre.
    drift: f64,
    /// Standard deviations in metres per square root of a metre, and in radians per square root of a metre or radian.
    noise: f64,
    heading_noise: f64,
}

impl Odometer {
    /// The systematic errors that `config` does not state are drawn from `wheels`.
    pub(super) fn new(config: &OdometryConfig, noise: ChaCha8Rng, mut wheels: ChaCha8Rng) -> Self {
        let [way, turn, drift_deg] =
            [(config.slip, SCALE), (config.turn_slip, SCALE), (config.drift_deg_per_m, DRIFT_DEG)]
                .map(|(stated, deviation)| {
                    let drawn: f64 = StandardNormal.sample(&mut wheels);
                    stated.unwrap_or(deviation * drawn)
                });
        let errors = Errors {
            way,
            turn,
            drift: drift_deg.to_radians(),
            noise: config.noise_m,
            heading_noise: config.heading_noise_deg.to_radians(),
        };
        let pose = PlanePose { position: DVec2::ZERO, heading: 0.0 };
        Self { errors, noise, pose, rolled: [0.0; 2] }
    }

    /// `base_link` in `odom`, whose origin is the start.
    pub(super) fn pose(&self) -> PlanePose {
        self.pose
    }

    /// The way in metres and the angle in radians that the wheels have measured since the start.
    pub(super) fn rolled(&self) -> [f64; 2] {
        self.rolled
    }

    /// Notes a distance in metres and an angle in radians driven.
    pub(super) fn measure(&mut self, way: f64, angle: f64) {
        let mut noise = || -> f64 { StandardNormal.sample(&mut self.noise) };
        let errors = &self.errors;
        let measured_way = way * (1.0 + errors.way) + errors.noise * way.abs().sqrt() * noise();
        let measured_angle = angle * (1.0 + errors.turn)
            + errors.drift * way
            + errors.heading_noise * (way.abs() + angle.abs()).sqrt() * noise();
        self.rolled = [self.rolled[0] + measured_way, self.rolled[1] + measured_angle];
        self.pose.heading = wrap(self.pose.heading + measured_angle);
        let heading = self.pose.heading;
        self.pose.position += DVec2::new(cos(heading), sin(heading)) * measured_way;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::streams::Stream;

    fn odometer(config: &OdometryConfig, seed: u64, robot: usize) -> Odometer {
        let [noise, wheels] = [Stream::Odometry, Stream::Wheels].map(|it| it.rng(seed, robot));
        Odometer::new(config, noise, wheels)
    }

    /// The root mean square of a robot's errors, for which `measured` returns one.
    fn deviation(measured: impl Fn(Odometer) -> f64) -> f64 {
        let config =
            OdometryConfig { noise_m: 0.0, heading_noise_deg: 0.0, ..OdometryConfig::default() };
        let squares = (0..200).map(|robot| measured(odometer(&config, 1, robot)).powi(2));
        (squares.sum::<f64>() / 200.0).sqrt()
    }

    #[test]
    fn ways_turns_and_drifts_are_drawn_with_their_deviations() {
        let off = |way: f64, angle: f64, which: usize| {
            deviation(|mut it| {
                it.measure(way, angle);
                it.rolled()[which] - [way, angle][which]
            })
        };
        let (ways, turns, drift) = (off(1.0, 0.0, 0), off(0.0, 1.0, 1), off(1.0, 0.0, 1));
        for (drawn, wanted) in [(ways, 0.01), (turns, 0.01), (drift, 0.5_f64.to_radians())] {
            assert!((drawn / wanted - 1.0).abs() < 0.15, "{drawn} {wanted}");
        }
    }

    #[test]
    fn each_robot_has_errors_of_its_own_in_both_directions() {
        let config = OdometryConfig { noise_m: 0.0, ..OdometryConfig::default() };
        let mut ways: Vec<f64> = (0..50)
            .map(|robot| {
                let mut odometer = odometer(&config, 1, robot);
                odometer.measure(100.0, 0.0);
                odometer.rolled()[0] - 100.0
            })
            .collect();
        ways.sort_by(f64::total_cmp);
        ways.dedup();
        assert_eq!(ways.len(), 50);
        assert!((15..35).contains(&ways.iter().filter(|way| **way < 0.0).count()), "{ways:?}");
    }

    #[test]
    fn stated_errors_hold_whatever_is_drawn() {
        let config = OdometryConfig {
            slip: Some(0.02),
            turn_slip: Some(-0.01),
            drift_deg_per_m: Some(1.0),
            noise_m: 0.0,
            heading_noise_deg: 0.0,
        };
        for seed in 0..3 {
            let mut odometer = odometer(&config, seed, 1);
            odometer.measure(10.0, 2.0);
            let [way, angle] = odometer.rolled();
            assert!((way - 10.2).abs() < 1e-9);
            assert!((angle - (1.98 + 10.0_f64.to_radians())).abs() < 1e-9, "{angle}");
        }
    }
}
