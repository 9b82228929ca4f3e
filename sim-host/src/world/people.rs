//! People who walk from stop to stop, pause there, and wait for anyone in their way; some sit or lie
//! until they rise.

use parry2d_f64::glamx::DVec2;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::{
    render::{Paint, Part},
    route::{Body, Route},
    scenario::{PersonConfig, PostureConfig},
    shapes::{Footprint, Prism},
};

/// Height of a seat in metres.
const SEAT: f64 = 0.45;

/// Distance of a sitting person's knees ahead of the body's centre, in metres.
const KNEES: f64 = 0.45;

/// Height of a lying person in metres.
const LYING: f64 = 0.24;

/// The radius of a head, in metres.
const HEAD: f64 = 0.1;

/// Distance ahead in metres at which a person stops for others.
const GAP: f64 = 0.3;

/// Time in seconds after which a waiting person walks back.
const PATIENCE: f64 = 1.5;

/// A person.
#[derive(Clone, Debug)]
pub struct Person {
    config: PersonConfig,
    posture: PostureConfig,
    /// Seconds until a person who sits or lies rises, if ever.
    rises_in: Option<f64>,
    position: DVec2,
    heading: f64,
    paint: u32,
    route: Route,
    pause: f64,
    waited: f64,
    dice: ChaCha8Rng,
}

impl Person {
    /// Position in `map`, in metres.
    pub fn position_m(&self) -> [f64; 2] {
        self.position.into()
    }

    /// Radius in metres of a circle on the floor around the whole body.
    pub fn radius_m(&self) -> f64 {
        self.body().radius
    }

    /// Height of the highest point above the floor, in metres.
    pub fn height_m(&self) -> f64 {
        self.body().height
    }

    /// The present posture.
    pub fn posture(&self) -> PostureConfig {
        self.posture
    }

    pub(super) fn new(config: &PersonConfig, index: usize, dice: ChaCha8Rng) -> Self {
        let mut stops = config.waypoints_m.iter().map(|&point| DVec2::from(point));
        let position = stops.next().unwrap_or_default();
        Self {
            config: config.clone(),
            posture: config.posture,
            rises_in: config.rises_s,
            position,
            heading: config.heading_deg.to_radians(),
            paint: 1_000 + index as u32,
            route: Route::new(position, stops),
            pause: 0.0,
            waited: 0.0,
            dice,
        }
    }

    pub(super) fn body(&self) -> Body {
        body(&self.config, self.posture, self.position)
    }

    /// The visible parts of the person.
    pub(super) fn parts(&self) -> Vec<Part> {
        let facing = DVec2::new(libm::cos(self.heading), libm::sin(self.heading));
        let clothes = Paint::numbered(self.paint);
        let skin = Paint::Grained([0.62, 0.45, 0.36], self.paint);
        let part = |footprint: Footprint, bottom: f64, top: f64, paint: &Paint| Part {
            prism: Prism { footprint, bottom, top },
            paint: paint.clone(),
        };
        let round =
            |ahead: f64, radius: f64| Footprint::disc(self.position + facing * ahead, radius);
        let long = |ahead: f64, length: f64, width: f64| {
            let centre = self.position + facing * ahead;
            Footprint::rectangle(centre, DVec2::new(length, width), self.heading)
        };
        let (top, stature) = (self.height_m(), self.config.height_m);
        match self.posture {
            PostureConfig::Standing => {
                let neck = 0.84 * top;
                vec![
                    part(round(0.0, self.config.radius_m), 0.0, neck, &clothes),
                    part(round(0.0, HEAD), neck, top, &skin),
                ]
            }
            PostureConfig::Sitting => {
                let (neck, shin) = (top - 0.16 * stature, 0.12);
                vec![
                    // The seat is under the body.
                    part(round(0.0, self.config.radius_m), 0.0, neck, &clothes),
                    part(round(0.0, HEAD), neck, top, &skin),
                    part(long(KNEES / 2.0, KNEES, 0.34), SEAT - 0.05, SEAT + 0.1, &clothes),
                    part(long(KNEES - shin / 2.0, shin, 0.3), 0.0, SEAT, &clothes),
                ]
            }
            PostureConfig::Lying => {
                let body = 0.85 * stature;
                vec![
                    part(
                        long((body - stature) / 2.0, body, 2.0 * self.config.radius_m),
                        0.0,
                        top,
                        &clothes,
                    ),
                    part(round(stature / 2.0 - HEAD, HEAD), 0.0, 0.2, &skin),
                ]
            }
        }
    }

    /// Walks for one time step among `others`, once the person stands.
    pub(super) fn step(&mut self, seconds: f64, others: &[Body]) {
        if self.posture != PostureConfig::Standing {
            self.rises_in = self.rises_in.map(|left| left - seconds);
            if self.rises_in.is_some_and(|left| left <= 0.0) {
                self.posture = PostureConfig::Standing;
            }
            return;
        }
        if self.pause > 0.0 {
            self.pause -= seconds;
            return;
        }
        let Some(target) = self.route.target() else { return };
        let way = target - self.position;
        let heading = way.normalize_or_zero();
        let next = self.position + heading * (self.config.speed_m_s * seconds).min(way.length());
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
            self.pause = self.config.pause_s * self.dice.random_range(0.5..1.5);
        }
    }
}

/// A person in a posture as an obstacle to others.
pub(super) fn body(person: &PersonConfig, posture: PostureConfig, centre: DVec2) -> Body {
    let (radius, height) = match posture {
        PostureConfig::Standing => (0.0, person.height_m),
        // From the seat to the crown is about half the standing height.
        PostureConfig::Sitting => (KNEES, SEAT + 0.52 * person.height_m),
        PostureConfig::Lying => (person.height_m / 2.0, LYING),
    };
    Body { centre, radius: person.radius_m.max(radius), height }
}
