//! What moves about, followed from frame to frame.

use std::collections::BTreeSet;

use ubimap_protocol::{
    time::{Duration, Instant},
    units::Millimetres,
};

/// What has not been seen for so long is gone.
const MEMORY: Duration = Duration::from_secs(1);
/// A cluster this far from where a track should be is something else, in metres.
const GATE_M: f64 = 0.8;
/// Between the two positions that a velocity comes from, at least.
const BASELINE: Duration = Duration::from_millis(400);
/// Whatever has been this fast walks: metres a second.
const WALKING_M_S: f64 = 0.3;

/// One thing.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// The same thing keeps its number.
    pub number: u16,
    /// The middle of the cells that it takes up, in metres in `map`.
    pub position_m: [f64; 2],
    /// In metres a second.
    pub velocity_m_s: [f64; 2],
    /// A circle of this radius about the middle holds all of it, in metres.
    pub radius_m: f64,
    /// Whether it has walked since it is followed.
    pub has_walked: bool,
    seen: Instant,
    /// Where it was a while ago.
    before: (Instant, [f64; 2]),
}

/// All that moves about.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    tracks: Vec<Track>,
    number: u16,
    moment: Instant,
}

impl Tracks {
    /// Takes the cells, of this side, in which a frame shows something that moves, and the moment
    /// when it was captured. Another camera's frames may come in between.
    pub fn observe(&mut self, moment: Instant, cells: BTreeSet<(i32, i32)>, side: Millimetres) {
        if !(cells.is_empty() && self.tracks.is_empty()) {
            self.moment = self.moment.max(moment);
        }
        let mut clusters = clusters(cells, side);
        // The nearest pairs first.
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (track, it) in self.tracks.iter().enumerate() {
            let expected = it.position_at(moment);
            for (cluster, (position, _)) in clusters.iter().enumerate() {
                let distance = distance(expected, *position);
                pairs.extend((distance <= GATE_M).then_some((distance, track, cluster)));
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut followed, mut taken) = (BTreeSet::new(), BTreeSet::new());
        for (_, track, cluster) in pairs {
            if !followed.contains(&track) && taken.insert(cluster) {
                followed.insert(track);
                let (position, radius) = clusters[cluster];
                self.tracks[track].follow(moment, position, radius);
            }
        }
        self.tracks.retain(|track| self.moment.since(track.seen) <= MEMORY);
        for cluster in taken.into_iter().rev() {
            clusters.remove(cluster);
        }
        for (position_m, radius_m) in clusters {
            self.number = self.number.wrapping_add(1);
            self.tracks.push(Track {
                number: self.number,
                position_m,
                velocity_m_s: [0.0; 2],
                radius_m,
                has_walked: false,
                seen: moment,
                before: (moment, position_m),
            });
        }
    }

    /// The newest moment.
    pub fn moment(&self) -> Instant {
        self.moment
    }

    /// What was seen at that moment or shortly before, where it should be then.
    pub fn now(&self) -> impl Iterator<Item = Track> {
        let moment = self.moment;
        self.tracks.iter().map(move |track| {
            let position_m = track.position_at(moment);
            Track { position_m, ..track.clone() }
        })
    }
}

impl Track {
    fn position_at(&self, moment: Instant) -> [f64; 2] {
        let seconds = moment.since(self.seen).micros() as f64 / 1e6;
        let ([x, y], [vx, vy]) = (self.position_m, self.velocity_m_s);
        [x + vx * seconds, y + vy * seconds]
    }

    fn follow(&mut self, moment: Instant, position: [f64; 2], radius: f64) {
        if moment < self.seen {
            return;
        }
        (self.seen, self.position_m, self.radius_m) = (moment, position, radius);
        let (then, from) = self.before;
        let elapsed = moment.since(then);
        if elapsed >= BASELINE {
            let rate = 1e6 / elapsed.micros() as f64;
            self.velocity_m_s = [(position[0] - from[0]) * rate, (position[1] - from[1]) * rate];
            self.has_walked |= distance([0.0; 2], self.velocity_m_s) >= WALKING_M_S;
            self.before = (moment, position);
        }
    }
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Cells that touch each other, also by a corner: the middle and the radius of each cluster, in
/// metres.
fn clusters(mut rest: BTreeSet<(i32, i32)>, side: Millimetres) -> Vec<([f64; 2], f64)> {
    let side = side.metres();
    let mut found = Vec::new();
    while let Some(first) = rest.pop_first() {
        let mut cluster = vec![first];
        let mut next = 0;
        while let Some(&(x, y)) = cluster.get(next) {
            next += 1;
            let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
            cluster.extend(around.filter(|cell| rest.remove(cell)));
        }
        let centres: Vec<[f64; 2]> = cluster
            .iter()
            .map(|&(x, y)| [(f64::from(x) + 0.5) * side, (f64::from(y) + 0.5) * side])
            .collect();
        let mean = |axis: usize| {
            centres.iter().map(|centre| centre[axis]).sum::<f64>() / centres.len() as f64
        };
        let middle = [mean(0), mean(1)];
        let farthest = centres.iter().map(|&centre| distance(middle, centre)).fold(0.0, f64::max);
        // To the corner of the farthest cell.
        found.push((middle, farthest + side * core::f64::consts::FRAC_1_SQRT_2));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: Millimetres = Millimetres(50);

    /// The cells within 25 cm of a point.
    fn disc(x: f64, y: f64) -> impl Iterator<Item = (i32, i32)> {
        let cell = |metres: f64| (metres / 0.05).floor() as i32;
        let cells = (cell(x) - 6..cell(x) + 7)
            .flat_map(move |cx| (cell(y) - 6..cell(y) + 7).map(move |cy| (cx, cy)));
        cells.filter(move |&(cx, cy)| {
            let centre = [(f64::from(cx) + 0.5) * 0.05, (f64::from(cy) + 0.5) * 0.05];
            distance(centre, [x, y]) <= 0.25
        })
    }

    fn at(millis: u64) -> Instant {
        Instant(millis * 1_000)
    }

    #[test]
    fn two_who_pass_each_other_keep_their_numbers_and_one_who_sits_has_not_walked() {
        let mut tracks = Tracks::default();
        for millis in (0..=6_000).step_by(250) {
            let way = millis as f64 / 1000.0;
            // Two cameras in turns, of which one does not see who sits.
            let sits = disc(3.0, 3.0).filter(|_| millis % 500 == 0);
            let cells = disc(way, 0.0).chain(disc(6.0 - way, 0.7)).chain(sits);
            tracks.observe(at(millis), cells.collect(), SIDE);
        }
        let found: Vec<Track> = tracks.now().collect();
        assert_eq!(found.len(), 3);
        let expected =
            [([6.0, 0.0], [1.0, 0.0]), ([3.0, 3.0], [0.0, 0.0]), ([0.0, 0.7], [-1.0, 0.0])];
        for (position, velocity) in expected {
            let near = |it: &&Track| distance(it.position_m, position) < 0.05;
            let track = found.iter().find(near).unwrap();
            assert!(distance(track.velocity_m_s, velocity) < 0.1, "{track:?}");
            assert!((0.2..0.32).contains(&track.radius_m), "{track:?}");
            assert_eq!(track.has_walked, velocity[0] != 0.0);
            assert!(track.number <= 3, "{track:?}");
        }
    }

    #[test]
    fn who_is_not_seen_for_a_second_is_gone_and_who_comes_later_is_another() {
        let mut tracks = Tracks::default();
        let mut observe = |millis: u64, cells: BTreeSet<(i32, i32)>| {
            tracks.observe(at(millis), cells, SIDE);
            tracks.now().map(|track| track.number).collect::<Vec<_>>()
        };
        let person = || disc(1.0, 1.0).collect::<BTreeSet<_>>();
        assert!(observe(0, BTreeSet::new()).is_empty());
        assert_eq!(observe(500, person()), [1]);
        assert_eq!(observe(1_500, BTreeSet::new()), [1], "hidden for a while");
        assert_eq!(observe(1_400, person()), [1], "late");
        assert_eq!(observe(2_300, BTreeSet::new()), [1]);
        assert!(observe(2_500, BTreeSet::new()).is_empty());
        assert_eq!(observe(3_000, person()), [2]);
    }
}
