//! How soon robots are told of people who sat or lay there from the beginning, after they have risen,
//! and how soon the map shows that their place is free.

use std::cell::{Cell as Slot, RefCell};

use ubimap_protocol::{
    message::ObstacleClass,
    time::{Duration, Instant},
};

use super::{fleet::Fleet, map_age::occupied, markers};
use crate::{
    report::RisingSummary,
    world::{Scenario, World},
};

/// Interval between two looks at the map.
const INTERVAL: Duration = Duration::from_millis(100);
/// Maximum distance, in metres, between a person and the place of the track that is theirs.
const NEAR_M: f64 = 0.8;

/// The people of a scenario who rise, and when that was noticed.
pub(super) struct Risings {
    risings: RefCell<Vec<Rising>>,
    next: Slot<Instant>,
}

struct Rising {
    at: Instant,
    place_m: [f64; 2],
    speed_m_s: f64,
    /// The free cells of the room under the person.
    ground: Vec<(i32, i32)>,
    /// Number of these that were occupied when the person rose.
    drawn: usize,
    told: Option<Duration>,
    freed: Option<Duration>,
}

impl Risings {
    /// Those of a scenario. `world` is as it begins.
    pub(super) fn of(scenario: &Scenario, world: &World, side_m: f64) -> Self {
        let people = scenario.people.iter().zip(world.people());
        let risings = people.filter_map(|(config, person)| {
            let (place, radius) = (person.position_m(), person.radius_m());
            let is_under = |&&(x, y): &&(i32, i32)| {
                let [x, y] = [x, y].map(|cell| (f64::from(cell) + 0.5) * side_m);
                (x - place[0]).hypot(y - place[1]) <= radius
            };
            Some(Rising {
                at: Instant((config.rises_s? * 1e6) as u64),
                place_m: place,
                speed_m_s: config.speed_m_s,
                ground: world.truth().free.iter().filter(is_under).copied().collect(),
                drawn: 0,
                told: None,
                freed: None,
            })
        });
        Self { risings: RefCell::new(risings.collect()), next: Slot::new(Instant(0)) }
    }

    /// Looks at what robots are told, and at the map, once per [`INTERVAL`].
    pub(super) fn look(&self, fleet: &Fleet<'_>) {
        let now = fleet.now();
        if now < self.next.get() {
            return;
        }
        self.next.set(now + INTERVAL);
        for rising in self.risings.borrow_mut().iter_mut() {
            let count = || occupied(fleet.server().fused(), &rising.ground);
            if now < rising.at {
                rising.drawn = count();
                continue;
            }
            let since = now.since(rising.at);
            // The person may have walked since.
            let reach = NEAR_M + rising.speed_m_s * since.micros() as f64 / 1e6;
            let is_near =
                |x: f64, y: f64| (x - rising.place_m[0]).hypot(y - rising.place_m[1]) <= reach;
            if rising.told.is_none()
                && markers::followed(fleet.deployment(), now).iter().any(|(it, _)| {
                    it.class == ObstacleClass::Person && is_near(it.x.metres(), it.y.metres())
                })
            {
                rising.told = Some(since);
            }
            if rising.freed.is_none() && 10 * count() <= rising.drawn {
                rising.freed = Some(since);
            }
        }
    }

    pub(super) fn summary(&self) -> Vec<RisingSummary> {
        let seconds = |time: Duration| time.micros() as f64 / 1e6;
        let summary = |rising: &Rising| RisingSummary {
            at_s: rising.at.0 as f64 / 1e6,
            cells: rising.drawn as u64,
            told_s: rising.told.map(seconds),
            freed_s: rising.freed.map(seconds),
        };
        self.risings.borrow().iter().map(summary).collect()
    }
}
