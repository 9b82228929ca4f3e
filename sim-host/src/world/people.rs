//! People who walk from stop to stop, pause there, and wait for whoever is in their way.

use parry2d_f64::glamx::DVec2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::{
    route::{Body, Route},
    scenario::PersonConfig,
};

/// A person stops for anybody this near ahead, in metres.
const GAP: f64 = 0.3;

/// How long a person waits before walking back, in seconds.
const PATIENCE: f64 = 1.5;

/// A person.
#[derive(Clone, Debug)]
pub struct Person {
    position: DVec2,
    radius: f64,
    height: f64,
    speed: f64,
    mean_pause: f64,
    route: Route,
    pause: f64,
    waited: f64,
    dice: ChaCha8Rng,
}

impl Person {
    /// Where the person is, in metres in `map`.
    pub fn position_m(&self) -> [f64; 2] {
        self.position.into()
    }

    /// The radius of the body, in metres.
    pub fn radius_m(&self) -> f64 {
        self.radius
    }

    /// The height of the body, in metres.
    pub fn height_m(&self) -> f64 {
        self.height
    }

    pub(super) fn new(config: &PersonConfig, dice: ChaCha8Rng) -> Self {
        let mut stops = config.waypoints_m.iter().map(|&point| DVec2::from(point));
        let position = stops.next().unwrap_or_default();
        Self {
            position,
            radius: config.radius_m,
            height: config.height_m,
            speed: config.speed_m_s,
            mean_pause: config.pause_s,
            route: Route::new(position, stops),
            pause: 0.0,
            waited: 0.0,
            dice,
        }
    }

    pub(super) fn body(&self) -> Body {
        Body { centre: self.position, radius: self.radius, height: self.height }
    }

    /// Walks on for a moment among the others.
    pub(super) fn step(&mut self, seconds: f64, others: &[Body]) {
        if self.pause > 0.0 {
            self.pause -= seconds;
            return;
        }
        let Some(target) = self.route.target() else { return };
        let way = target - self.position;
        let heading = way.normalize_or_zero();
        let next = self.position + heading * (self.speed * seconds).min(way.length());
        let me = self.body();
        if others.iter().any(|other| {
            me.is_blocked(heading, other, GAP.min(way.length())) || me.would_touch(next, other)
        }) {
            self.waited += seconds;
            if self.waited > PATIENCE {
                self.waited = 0.0;
                self.route.turn_round();
            }
            return;
        }
        self.waited = 0.0;
        self.position = next;
        if next.distance(target) < 1e-9 {
            self.position = target;
            self.route.arrive();
            self.pause = self.mean_pause * self.dice.random_range(0.5..1.5);
        }
    }
}
