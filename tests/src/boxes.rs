//! A world of axis-aligned boxes, and walks through it: fast ranging for many short runs.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use ubimap_agent::sense::SensorModel;
use ubimap_protocol::{time::Instant, units::Pose};

/// A box that may disappear and return; in metres in `map`.
#[derive(Clone, Copy, Debug)]
struct Block {
    low: [f64; 2],
    high: [f64; 2],
    /// Period in seconds: the box alternately disappears and returns. `None`: it is always there.
    turns: Option<u64>,
}

/// A room with boxes, some of which come and go.
#[derive(Clone, Debug)]
pub struct Boxes {
    size: [f64; 2],
    blocks: Vec<Block>,
}

impl Boxes {
    /// A room of 6 to 16 m by 4 to 10 m around the origin of `map`.
    pub fn random(rng: &mut ChaCha8Rng) -> Self {
        let size = [rng.random_range(6.0..16.0), rng.random_range(4.0..10.0)];
        let count = rng.random_range(2..9);
        let mut block = |index: u32| {
            let side = |from: f64, rng: &mut ChaCha8Rng| from + rng.random_range(0.1..2.0);
            let low = size.map(|side| rng.random_range(-side / 2.0..side / 2.0));
            let high = low.map(|low| side(low, rng));
            let turns = (index % 2 == 1).then(|| rng.random_range(2..9));
            Block { low, high, turns }
        };
        let blocks = (0..count).map(&mut block).collect();
        Self { size, blocks }
    }

    /// A random point in the room.
    pub fn point(&self, rng: &mut ChaCha8Rng) -> [f64; 2] {
        self.size.map(|side| rng.random_range(-side / 2.0 + 0.2..side / 2.0 - 0.2))
    }

    /// The cells of 5 cm of a strip of 1 by 2 m behind the middle of a wall, more than 20 cm beyond
    /// `reach_mm`.
    pub fn beyond(&self, wall: usize, reach_mm: u16) -> impl Iterator<Item = (i32, i32)> {
        let [across, along] = if wall < 2 { [0, 1] } else { [1, 0] };
        let way = if wall.is_multiple_of(2) { 1 } else { -1 };
        let first = (self.size[across] / 2.0 / 0.05).ceil() as i32 + 8 + i32::from(reach_mm) / 50;
        (first..first + 20).flat_map(move |out| {
            (-20..20).map(move |side| {
                let mut cell = [0; 2];
                (cell[across], cell[along]) = (way * out, side);
                cell.into()
            })
        })
    }

    /// What a sensor at `pose` measures at a given time: millimetres, 0 for no return.
    pub fn scan(&self, sensor: Fan, pose: Pose, now: Instant) -> Vec<u16> {
        let from = [pose.x.metres(), pose.y.metres()];
        let beams = (0..sensor.beams).map(|beam| {
            let bearing = pose.heading.radians() + sensor.first() + beam as f64 * sensor.step();
            let range = self.range(from, [bearing.cos(), bearing.sin()], now);
            // Some beams have no return.
            if beam % 23 == 22 { 0 } else { (range * 1000.0).min(60_000.0) as u16 }
        });
        beams.collect()
    }

    fn range(&self, from: [f64; 2], way: [f64; 2], now: Instant) -> f64 {
        let walls = Block {
            low: self.size.map(|s| -s / 2.0),
            high: self.size.map(|s| s / 2.0),
            turns: None,
        };
        let seconds = now.micros() / 1_000_000;
        let there =
            |block: &&Block| block.turns.is_none_or(|turns| (seconds / turns).is_multiple_of(2));
        let blocks = self.blocks.iter().filter(there).chain([&walls]);
        blocks.filter_map(|block| block.hit(from, way)).fold(60.0, f64::min)
    }
}

impl Block {
    /// Distance to the box's surface, from outside or from inside.
    fn hit(&self, from: [f64; 2], way: [f64; 2]) -> Option<f64> {
        let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
        for axis in 0..2 {
            let to = |side: f64| (side - from[axis]) / way[axis];
            let (a, b) = (to(self.low[axis]), to(self.high[axis]));
            (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
        }
        let hit = if enter > 0.0 { enter } else { leave };
        (enter <= leave && hit > 0.0).then_some(hit)
    }
}

/// A range sensor with a fan of beams, from right to left.
#[derive(Clone, Copy, Debug)]
pub struct Fan {
    /// Number of beams.
    pub beams: usize,
    /// Angle from the first to the last beam in radians.
    pub angle: f64,
}

impl Fan {
    fn first(self) -> f64 {
        -self.angle / 2.0
    }

    fn step(self) -> f64 {
        self.angle / (self.beams - 1) as f64
    }

    /// The robot's model of this sensor.
    pub fn model(self) -> SensorModel {
        SensorModel::Radial { first: self.first() as f32, step: self.step() as f32 }
    }
}

/// Distance in metres beyond which whole laps are skipped, for speed.
const LONG_WALK: f64 = 1_000.0;

/// A closed path between a few places, so that ground is left and revisited.
#[derive(Clone, Debug)]
pub struct Walk {
    places: Vec<[f64; 2]>,
    metres_per_second: f64,
}

impl Walk {
    /// A path between two to five places, at 0.3 to 3 m/s.
    pub fn random(world: &Boxes, rng: &mut ChaCha8Rng) -> Self {
        let count = rng.random_range(2..6);
        let places = (0..count).map(|_| world.point(rng)).collect();
        Self { places, metres_per_second: rng.random_range(0.3..3.0) }
    }

    /// The pose after the given time.
    pub fn pose(&self, elapsed: Instant) -> Pose {
        let mut left = elapsed.micros() as f64 / 1e6 * self.metres_per_second;
        if left > LONG_WALK {
            left %= self.lap();
        }
        let mut place = 0;
        loop {
            let (a, [dx, dy]) = self.leg(place);
            let length = dx.hypot(dy).max(0.01);
            if left < length {
                let part = left / length;
                return Pose::from_metres(a[0] + dx * part, a[1] + dy * part, dy.atan2(dx));
            }
            left -= length;
            place = (place + 1) % self.places.len();
        }
    }

    /// Where the leg from a place begins, and the way to the next place.
    fn leg(&self, place: usize) -> ([f64; 2], [f64; 2]) {
        let [a, b] = [self.places[place], self.places[(place + 1) % self.places.len()]];
        (a, [b[0] - a[0], b[1] - a[1]])
    }

    /// The length of the path in metres.
    fn lap(&self) -> f64 {
        let legs = (0..self.places.len()).map(|place| self.leg(place).1);
        legs.map(|[dx, dy]| dx.hypot(dy).max(0.01)).sum()
    }
}
