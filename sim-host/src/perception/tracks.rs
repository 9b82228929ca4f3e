//! Tracks objects from frame to frame over all cameras.

use std::collections::{BTreeSet, VecDeque};

use ubimap_protocol::{
    message::{ObstacleClass, Posture},
    time::{Duration, Instant},
    units::Millimetres,
};

use super::motion::Motion;
use crate::{
    camera::{LAYERS, Thing},
    timing::THING_LOST,
};

/// Maximum distance between an object and the predicted position of its track, in metres.
const GATE_M: f64 = 0.8;
/// Minimum speed of an object that counts as walking, in m/s.
const WALKING_M_S: f64 = 0.3;
/// Minimum distance from its first position of an object that counts as walking, in metres: two
/// cameras that see different sides of an object do not make it walk.
const WALKED_M: f64 = 0.4;
/// Minimum height of a walking object that is classified as a person, in millimetres.
const PERSON_MM: u16 = 1_000;
/// An object that has not walked for this duration is part of the room.
const FIXED_AFTER: Duration = Duration::from_secs(10);
/// Minimum height of a standing person, in millimetres.
const STANDING_MM: u16 = 1_350;
/// Minimum height of a sitting person, in millimetres; below it, the person lies.
const SITTING_MM: u16 = 550;
/// Minimum duration of lying before it is reported, so that stooping is not.
const LYING_FOR: Duration = Duration::from_secs(1);
/// Duration for which a height is kept: a camera that sees only the legs does not shrink a person.
const HEIGHT_FOR: Duration = Duration::from_secs(1);

/// A tracked object.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// The number of the track, constant while the object is followed.
    pub number: u16,
    /// The centre in `map`, in metres.
    pub position_m: [f64; 2],
    /// The velocity in m/s.
    pub velocity_m_s: [f64; 2],
    /// Radius of a circle around the centre that contains the object, in metres.
    pub radius_m: f64,
    /// The height in millimetres; zero if unknown.
    pub top_mm: u16,
    /// Number of its pixels in each 128 mm layer, in the newest frame.
    pub layers: [u32; LAYERS],
    /// The last label from a detector.
    pub label: Option<String>,
    /// Whether the object has walked since it has been tracked.
    pub has_walked: bool,
    motion: Motion,
    seen: Instant,
    /// Time and position of the first observation.
    first: (Instant, [f64; 2]),
    /// The time when `top_mm` was last confirmed, and the maximum height ever.
    height: (Instant, u16),
    /// The time since which the person has been lying, and whether that was reported.
    lies: Option<(Instant, bool)>,
}

/// A report that a person is lying on the floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lying {
    /// The number of the track.
    pub number: u16,
    /// When it was observed.
    pub moment: Instant,
    /// The position in `map`, in metres.
    pub position_m: [f64; 2],
}

/// The tracks of all objects.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    tracks: Vec<Track>,
    number: u16,
    moment: Instant,
    lying: VecDeque<Lying>,
}

impl Tracks {
    /// Updates the tracks with the objects in a frame captured at `moment`; `side` is the side of a
    /// cell. Frames of several cameras may be mixed.
    pub fn observe(&mut self, moment: Instant, things: &[Thing], side: Millimetres) {
        if !(things.is_empty() && self.tracks.is_empty()) {
            self.moment = self.moment.max(moment);
        }
        let extents: Vec<_> = things.iter().map(|thing| extent(thing, side)).collect();
        // Assign the nearest pairs first.
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (track, it) in self.tracks.iter().enumerate() {
            let expected = it.motion.position_at(moment.since(it.seen));
            for (thing, (position, _)) in extents.iter().enumerate() {
                let distance = distance(expected, *position);
                pairs.extend((distance <= GATE_M).then_some((distance, track, thing)));
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut followed, mut taken) = (BTreeSet::new(), BTreeSet::new());
        for (_, track, thing) in pairs {
            if !followed.contains(&track) && taken.insert(thing) {
                followed.insert(track);
                let track = &mut self.tracks[track];
                track.follow(moment, &things[thing], extents[thing]);
                self.lying.extend(track.falls());
            }
        }
        self.tracks.retain(|track| self.moment.since(track.seen) <= THING_LOST);
        for (index, thing) in things.iter().enumerate().filter(|(index, _)| !taken.contains(index))
        {
            self.number = self.number.wrapping_add(1);
            self.tracks.push(Track::new(self.number, moment, thing, extents[index]));
        }
    }

    /// The capture time of the newest frame.
    pub fn moment(&self) -> Instant {
        self.moment
    }

    /// The tracks with their positions predicted for [`Tracks::moment`].
    pub fn now(&self) -> impl Iterator<Item = Track> {
        let moment = self.moment;
        self.tracks.iter().map(move |track| {
            let position_m = track.motion.position_at(moment.since(track.seen));
            Track { position_m, ..track.clone() }
        })
    }

    /// The next person found lying; each case is reported once.
    pub fn poll_lying(&mut self) -> Option<Lying> {
        self.lying.pop_front()
    }
}

impl Track {
    fn new(number: u16, moment: Instant, thing: &Thing, extent: ([f64; 2], f64)) -> Self {
        let (position_m, radius_m) = extent;
        Self {
            number,
            position_m,
            velocity_m_s: [0.0; 2],
            radius_m,
            top_mm: thing.top_mm,
            layers: thing.layers,
            label: thing.label.clone(),
            has_walked: false,
            motion: Motion::at(position_m),
            seen: moment,
            first: (moment, position_m),
            height: (moment, thing.top_mm),
            lies: None,
        }
    }

    /// The class, derived from height, motion and label.
    pub fn class(&self) -> ObstacleClass {
        let is_high = self.height.1 >= PERSON_MM || self.height.1 == 0;
        if self.label.as_deref() == Some("person") || (self.has_walked && is_high) {
            ObstacleClass::Person
        } else if !self.has_walked && self.seen.since(self.first.0) >= FIXED_AFTER {
            ObstacleClass::Fixed
        } else {
            ObstacleClass::Movable
        }
    }

    /// The posture of a person, derived from the height; unknown for other objects.
    pub fn posture(&self) -> Posture {
        match self.top_mm {
            _ if self.class() != ObstacleClass::Person => Posture::Unknown,
            STANDING_MM.. => Posture::Standing,
            SITTING_MM.. => Posture::Sitting,
            1.. => Posture::Lying,
            0 => Posture::Unknown,
        }
    }

    /// The cells, with sides of `side`, of a square around the object.
    pub(super) fn cells(&self, side: Millimetres) -> impl Iterator<Item = (i32, i32)> {
        let ([x, y], radius, side) = (self.position_m, self.radius_m, side.metres());
        let range = move |middle: f64| {
            let cell = |metres: f64| (metres / side).floor() as i32;
            cell(middle - radius)..=cell(middle + radius)
        };
        range(y).flat_map(move |row| range(x).map(move |column| (column, row)))
    }

    fn follow(&mut self, moment: Instant, thing: &Thing, (position, radius): ([f64; 2], f64)) {
        if moment < self.seen {
            return;
        }
        self.motion.observe(moment.since(self.seen), position);
        self.seen = moment;
        self.position_m = self.motion.position_at(Duration::default());
        self.velocity_m_s = self.motion.velocity();
        self.radius_m = radius;
        self.layers = thing.layers;
        if thing.label.is_some() {
            self.label.clone_from(&thing.label);
        }
        let speed = distance([0.0; 2], self.velocity_m_s);
        let way = distance(self.first.1, self.position_m);
        self.has_walked |= speed >= WALKING_M_S && way >= WALKED_M.max(radius);
        if thing.top_mm >= self.top_mm || moment.since(self.height.0) > HEIGHT_FOR {
            self.top_mm = thing.top_mm;
            self.height = (moment, self.height.1.max(thing.top_mm));
        }
    }

    /// Returns a report, once, as soon as it is certain that a person is lying on the floor.
    fn falls(&mut self) -> Option<Lying> {
        if self.posture() != Posture::Lying {
            self.lies = None;
            return None;
        }
        let (since, told) = self.lies.get_or_insert((self.seen, false));
        if *told || self.seen.since(*since) < LYING_FOR {
            return None;
        }
        *told = true;
        Some(Lying { number: self.number, moment: self.seen, position_m: self.position_m })
    }
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The centre and the radius of an object, in metres.
fn extent(thing: &Thing, side: Millimetres) -> ([f64; 2], f64) {
    let side = side.metres();
    let centres = thing
        .cells
        .iter()
        .map(|&(x, y)| [(f64::from(x) + 0.5) * side, (f64::from(y) + 0.5) * side]);
    let count = thing.cells.len().max(1) as f64;
    let sum = centres.clone().fold([0.0, 0.0], |sum, it| [sum[0] + it[0], sum[1] + it[1]]);
    let middle = sum.map(|sum| sum / count);
    let farthest = centres.map(|centre| distance(middle, centre)).fold(0.0, f64::max);
    // The radius includes the corners of the farthest cell.
    (middle, farthest + side * core::f64::consts::FRAC_1_SQRT_2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grid::clusters;

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

    fn things(cells: impl Iterator<Item = (i32, i32)>) -> Vec<Thing> {
        let clusters = clusters(cells.collect()).into_iter();
        clusters.map(|cells| Thing { cells, ..Thing::default() }).collect()
    }

    fn at(millis: u64) -> Instant {
        Instant(millis * 1_000)
    }

    #[test]
    fn two_people_who_pass_keep_their_tracks_and_a_sitting_one_has_not_walked() {
        let mut tracks = Tracks::default();
        for millis in (0..=6_000).step_by(250) {
            let way = millis as f64 / 1000.0;
            // Two cameras alternate; one of them does not see the sitting person.
            let sits = disc(3.0, 3.0).filter(|_| millis % 500 == 0);
            let cells = disc(way, 0.0).chain(disc(6.0 - way, 0.7)).chain(sits);
            tracks.observe(at(millis), &things(cells), SIDE);
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
    fn a_track_ends_after_a_second_unseen_and_a_later_object_gets_a_new_one() {
        let mut tracks = Tracks::default();
        let mut observe = |millis: u64, things: Vec<Thing>| {
            tracks.observe(at(millis), &things, SIDE);
            tracks.now().map(|track| track.number).collect::<Vec<_>>()
        };
        let person = || things(disc(1.0, 1.0));
        assert!(observe(0, vec![]).is_empty());
        assert_eq!(observe(500, person()), [1]);
        assert_eq!(observe(1_500, vec![]), [1], "hidden for a while");
        assert_eq!(observe(1_400, person()), [1], "late");
        assert_eq!(observe(2_300, vec![]), [1]);
        assert!(observe(2_500, vec![]).is_empty());
        assert_eq!(observe(3_000, person()), [2]);
    }
}
