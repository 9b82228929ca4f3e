//! Where something is and how fast, from positions that err.

use ubimap_protocol::time::Duration;

/// How far the middle of what a camera sees may be from that of the thing, one sigma in metres: it
/// sees one side.
const POSITION_M: f64 = 0.08;
/// How people change their pace, in metres and seconds.
const ACCELERATION: f64 = 1.5;

/// A Kalman filter of constant velocity; both axes share their covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Motion {
    position: [f64; 2],
    velocity: [f64; 2],
    /// The variances of position and velocity, and their covariance between them.
    covariance: [f64; 3],
}

impl Motion {
    /// Of something that was seen once.
    pub(super) fn at(position: [f64; 2]) -> Self {
        let covariance = [POSITION_M * POSITION_M, 0.0, 1.0];
        Self { position, velocity: [0.0; 2], covariance }
    }

    /// Where it will be some time after it was seen last.
    pub(super) fn position_at(&self, later: Duration) -> [f64; 2] {
        let seconds = later.micros() as f64 / 1e6;
        let ([x, y], [vx, vy]) = (self.position, self.velocity);
        [x + vx * seconds, y + vy * seconds]
    }

    /// In metres a second.
    pub(super) fn velocity(&self) -> [f64; 2] {
        self.velocity
    }

    /// It was seen here, some time after it was seen last.
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
