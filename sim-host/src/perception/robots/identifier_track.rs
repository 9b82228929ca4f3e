//! Tracks one identifier over all cameras.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{Matrix3, Vector3};
use ubimap_protocol::time::{Duration, Instant};

use crate::{
    perception::markers::Placement,
    timing::{MARKER_PLACE_LOST, SIGHTINGS_JOIN},
};

/// Maximum speed of a robot, in m/s.
const SPEED_LIMIT_M_S: f64 = 3.0;
/// Maximum rate of turn of a robot, in rad/s.
const TURN_LIMIT_RAD_S: f64 = 10.0;
/// Maximum difference between simultaneous sightings of one robot, in metres.
const TOLERANCE_M: f64 = 0.15;
/// Maximum difference between the headings of simultaneous sightings, in radians.
const TOLERANCE_RAD: f64 = 0.35;
/// Time span over which the velocity is estimated.
const BASELINE: Duration = Duration::from_millis(250);
/// Minimum time for an estimate of the velocity: one frame.
const MIN_BASELINE: Duration = Duration::from_millis(50);
/// Standard deviation of the velocity: x and y in m/s, heading in rad/s.
const VELOCITY_DOUBT: [f64; 3] = [0.1, 0.1, 0.3];

/// Why an identifier has no pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Trouble {
    /// The identifier moved faster than a robot can drive.
    Jump,
    /// The identifier is in two places at once.
    Twice,
}

/// The places where an identifier has been seen: more than one only if something is wrong.
#[derive(Debug, Default)]
pub(super) struct IdentifierTrack {
    /// Oldest first.
    places: Vec<Place>,
    trouble: Option<Trouble>,
    is_told: bool,
}

/// Consecutive sightings between which a robot can have driven.
#[derive(Debug)]
struct Place {
    /// The newest sighting of each camera.
    sightings: BTreeMap<usize, (Instant, Placement)>,
    /// Recent placements, newest last.
    path: VecDeque<(Instant, Placement)>,
    /// Time of the first sighting here.
    first: Instant,
    /// Time of the last sighting here.
    last: Instant,
    /// Number of sightings here.
    times: u32,
    /// Whether it was also seen elsewhere at the same time.
    is_twin: bool,
}

impl IdentifierTrack {
    /// Takes the placements of the identifier in one frame and returns the robot's pose, if it has one.
    pub(super) fn observe(
        &mut self,
        camera: usize,
        captured: Instant,
        placements: &[Placement],
    ) -> Option<Placement> {
        let newest = self.places.iter().map(|place| place.last).max().unwrap_or(captured);
        if captured + MARKER_PLACE_LOST < newest {
            return None;
        }
        let mut joined = None;
        for placement in placements {
            let reachable = self.places.iter().enumerate();
            let reachable = reachable.filter(|(_, place)| place.reaches(captured, placement));
            let nearest = reachable.min_by(|(_, a), (_, b)| {
                a.newest().distance_m(placement).total_cmp(&b.newest().distance_m(placement))
            });
            if let Some((index, _)) = nearest {
                self.meet_twins(index, captured);
                let place = &mut self.places[index];
                joined = place.join(camera, captured, *placement).map(|it| (index, it)).or(joined);
            } else {
                let at_once = |place: &Place| {
                    place.sightings.iter().any(|(&other, &(then, _))| {
                        (other == camera && then == captured)
                            || (other != camera && apart(then, captured) <= SIGHTINGS_JOIN)
                    })
                };
                let is_twin = self.places.iter().any(at_once);
                self.places.push(Place::new(camera, captured, *placement, is_twin));
                if self.places.len() == 1 {
                    joined = Some((0, *placement));
                }
            }
        }
        let newest = newest.max(captured);
        let before = self.places.len();
        self.places.retain(|place| newest.since(place.last) <= MARKER_PLACE_LOST || before == 1);
        self.judge();
        let (index, placement) = joined?;
        // A single sighting elsewhere that is not repeated is taken for a false detection.
        let others = || self.places.iter().skip(1);
        let is_sure = self.trouble != Some(Trouble::Twice)
            && (self.places.len() == 1 || index == 0 && others().all(|place| place.times == 1));
        is_sure.then_some(placement)
    }

    /// Where the robot is at a moment by cameras other than this one; `None` if it is in trouble, or none has
    /// just seen it.
    pub(super) fn by_others(&self, camera: usize, moment: Instant) -> Option<Placement> {
        let [place] = &self.places[..] else { return None };
        let velocity = place.velocity();
        let others = place.sightings.iter().filter(|&(&other, &(then, _))| {
            other != camera && apart(then, moment) <= SIGHTINGS_JOIN
        });
        let nearest = others.min_by_key(|&(_, &(then, _))| apart(then, moment));
        nearest.map(|(_, (then, seen))| {
            if *then <= moment {
                moved(seen, velocity, moment.since(*then))
            } else {
                moved(seen, -velocity, then.since(moment))
            }
        })
    }

    /// The current trouble, reported once.
    pub(super) fn poll_trouble(&mut self) -> Option<Trouble> {
        let trouble = self.trouble.filter(|_| !self.is_told);
        self.is_told = true;
        trouble
    }

    /// The expected placements at a moment, and the time since each was last seen.
    pub(super) fn expected(&self, moment: Instant) -> impl Iterator<Item = (Placement, Duration)> {
        self.places.iter().map(move |place| {
            let unseen = moment.since(place.last);
            (moved(place.newest(), place.velocity(), unseen), unseen)
        })
    }

    /// Marks a place as a twin if the identifier is seen there again although it has meanwhile been
    /// seen elsewhere more than once.
    fn meet_twins(&mut self, index: usize, captured: Instant) {
        let seen = self.places[index].first;
        let others = self.places.iter_mut().enumerate().filter(|(other, _)| *other != index);
        for (_, other) in others {
            other.is_twin |= other.times > 1 && seen <= other.first && other.first <= captured;
        }
    }

    fn judge(&mut self) {
        let trouble = match &self.places[..] {
            [] | [_] => None,
            several if several.iter().any(|place| place.is_twin) => Some(Trouble::Twice),
            _ => Some(Trouble::Jump),
        };
        if trouble.is_none()
            && let [place] = &mut self.places[..]
        {
            place.is_twin = false;
        }
        self.is_told &= trouble == self.trouble;
        self.trouble = trouble;
    }
}

impl Place {
    fn new(camera: usize, captured: Instant, placement: Placement, is_twin: bool) -> Self {
        Self {
            sightings: BTreeMap::from([(camera, (captured, placement))]),
            path: VecDeque::from([(captured, placement)]),
            first: captured,
            last: captured,
            times: 1,
            is_twin,
        }
    }

    /// The newest placement; a place always has one.
    fn newest(&self) -> &Placement {
        &self.path[self.path.len() - 1].1
    }

    /// Whether a robot can drive to a placement in the time since the last sighting.
    fn reaches(&self, captured: Instant, placement: &Placement) -> bool {
        let seconds = seconds(apart(self.last, captured));
        let turn = wrapped(placement.heading_rad - self.newest().heading_rad).abs();
        self.newest().distance_m(placement) <= SPEED_LIMIT_M_S * seconds + TOLERANCE_M
            && turn <= TURN_LIMIT_RAD_S * seconds + TOLERANCE_RAD
    }

    /// Adds a sighting. If it is the newest, returns the robot's pose: the average of the sightings
    /// by all cameras at about that time, weighted by information. A sighting is used in as many
    /// poses as there are cameras, so each pose carries only that fraction of its information: a
    /// filter that processes all poses counts nothing twice.
    fn join(
        &mut self,
        camera: usize,
        captured: Instant,
        placement: Placement,
    ) -> Option<Placement> {
        if self.sightings.get(&camera).is_some_and(|&(then, _)| captured <= then) {
            return None;
        }
        self.sightings.insert(camera, (captured, placement));
        self.times = self.times.saturating_add(1);
        if captured < self.last {
            return None;
        }
        let velocity = self.velocity();
        self.sightings.retain(|_, &mut (then, _)| captured.since(then) <= SIGHTINGS_JOIN);
        let (mut information, mut sum) = (Matrix3::zeros(), Vector3::zeros());
        for &(then, seen) in self.sightings.values() {
            let seen = moved(&seen, velocity, captured.since(then));
            let weight = seen.covariance.try_inverse()?;
            let [x, y] = [0, 1].map(|axis| seen.position_m[axis] - placement.position_m[axis]);
            let turn = wrapped(seen.heading_rad - placement.heading_rad);
            information += weight;
            sum += weight * Vector3::new(x, y, turn);
        }
        let covariance = information.try_inverse()?;
        let [x, y] = placement.position_m;
        let correction = covariance * sum;
        let joined = Placement {
            position_m: [x + correction.x, y + correction.y],
            heading_rad: placement.heading_rad + correction.z,
            covariance: covariance * self.sightings.len() as f64,
        };
        self.last = captured;
        self.path.push_back((captured, joined));
        while self.path.len() > 1 && captured.since(self.path[0].0) > BASELINE {
            self.path.pop_front();
        }
        Some(joined)
    }

    /// The velocity of x, y and heading, per second.
    fn velocity(&self) -> Vector3<f64> {
        let ((then, from), to) = (&self.path[0], self.newest());
        let elapsed = self.last.since(*then);
        if elapsed < MIN_BASELINE {
            return Vector3::zeros();
        }
        let [x, y] = [0, 1].map(|axis| to.position_m[axis] - from.position_m[axis]);
        let turn = wrapped(to.heading_rad - from.heading_rad);
        Vector3::new(x, y, turn) / seconds(elapsed)
    }
}

/// The placement after `elapsed` at a constant velocity.
fn moved(from: &Placement, velocity: Vector3<f64>, elapsed: Duration) -> Placement {
    let way = velocity * seconds(elapsed);
    let doubt = Vector3::from(VELOCITY_DOUBT) * seconds(elapsed);
    let [x, y] = from.position_m;
    Placement {
        position_m: [x + way.x, y + way.y],
        heading_rad: from.heading_rad + way.z,
        covariance: from.covariance + Matrix3::from_diagonal(&doubt.component_mul(&doubt)),
    }
}

fn apart(a: Instant, b: Instant) -> Duration {
    a.max(b).since(a.min(b))
}

fn seconds(duration: Duration) -> f64 {
    duration.micros() as f64 / 1e6
}

/// Wraps an angle to plus or minus half a turn.
fn wrapped(angle: f64) -> f64 {
    use core::f64::consts::{PI, TAU};
    (angle + PI).rem_euclid(TAU) - PI
}
