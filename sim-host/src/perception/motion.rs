//! Position and velocity estimated from noisy positions.

use ubimap_protocol::time::Duration;

/// Standard deviation of an observed position in metres: a camera sees only one side of an object,
/// so the observed centre is off.
const POSITION_M: f64 = 0.08;
/// Process noise: standard deviation of a person's change of velocity in one second, in m/s.
const ACCELERATION: f64 = 1.5;

/// A constant-velocity Kalman filter; both axes share one covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Motion {
    position: [f64; 2],
    velocity: [f64; 2],
    /// The variance of the position, the covariance of position and velocity, the variance of the
    /// velocity.
    covariance: [f64; 3],
}

impl Motion {
    /// Starts the filter with a single observation.
    pub(super) fn at(position: [f64; 2]) -> Self {
        let covariance = [POSITION_M * POSITION_M, 0.0, 1.0];
        Self { position, velocity: [0.0; 2], covariance }
    }

    /// The predicted position at `later` after the last observation.
    pub(super) fn position_at(&self, later: Duration) -> [f64; 2] {
        let seconds = later.micros() as f64 / 1e6;
        let ([x, y], [vx, vy]) = (self.position, self.velocity);
        [x + vx * seconds, y + vy * seconds]
    }

    /// The velocity in m/s.
    pub(super) fn velocity(&self) -> [f64; 2] {
        self.velocity
    }

    /// Updates the filter with a position that was observed `later` after the last observation.
    pub(super) fn observe(&mut self, later: Duration, position: [f64; 2]) {
        let t = later.micros() as f64 / 1e6;
        let push = ACCELERATION * ACCELERATION * t;
        let [p, c, v] = self.covariance;
        let p = p + 2.0 * t * c + t * t * v + push * t * t / 3.0;
        let c = c + t * v + push * t / 2.0;
        let v = v + push;
        let gain = [p, c].map(|it| it / (p + POSITION_M * POSITION_M));
        let expected = self.position_at(later);
        for axis in 0..2 {
            let surprise = position[axis] - expected[axis];
            self.position[axis] = expected[axis] + gain[0] * surprise;
            self.velocity[axis] += gain[1] * surprise;
        }
        self.covariance = [p * (1.0 - gain[0]), c * (1.0 - gain[0]), v - gain[1] * c];
    }
}
