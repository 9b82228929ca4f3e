//! Localises the robots from the frames of all cameras.

mod events;
mod identifier_track;
mod search;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use ubimap_protocol::{
    message::Certainty,
    time::Instant,
    units::{Pose, RobotId},
};

pub use events::SightingEvent;

use self::{
    identifier_track::{IdentifierTrack, Trouble},
    search::{Expected, Search},
};
use super::{
    markers::{Identifier, Marker, Mount, Placement, locate},
    steadiness::Witness,
};
use crate::{
    camera::{Calibration, Frame, Lens, Sighting},
    timing::{STRANGER_AWAY, STRANGER_CONFIRMED},
};

/// Number of consecutive views in which a marker fits no pose of its robot before it is reported as
/// not level. A blurred or partly hidden marker soon fits again.
const NOT_LEVEL: u32 = 4;

/// Why the markers of a deployment are refused.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum RegistryError {
    /// Two robots carry the same identifier.
    #[error("robots {} and {} carry the same identifier", .0.0, .1.0)]
    Twice(RobotId, RobotId),
    /// Head and tail have the same colour.
    #[error("the colour marker of robot {} has a head and a tail of one colour", .0.0)]
    OneColour(RobotId),
    /// The marker's size is not positive, or its position is not finite.
    #[error("the marker of robot {} needs a positive size and a finite position", .0.0)]
    Mount(RobotId),
}

/// Localises the robots: finds their markers, computes their poses and tracks them over all cameras.
/// Overlapping views (zone 2 of the paper) are the general case.
#[derive(Debug)]
pub struct Localiser {
    lenses: Vec<Option<Lens>>,
    mounts: BTreeMap<Identifier, Mount>,
    search: Search,
    tracks: BTreeMap<Identifier, IdentifierTrack>,
    /// For each marker that currently fits no pose of its robot, the number of consecutive such
    /// views.
    not_there: BTreeMap<Identifier, u32>,
    /// For each unregistered identifier, the time of its last sighting and whether it was reported.
    strangers: BTreeMap<Identifier, (Instant, bool)>,
    /// Cameras whose pose is not known.
    out: BTreeSet<usize>,
    /// Cameras whose last frame had a capture time in the future.
    ahead: BTreeSet<usize>,
    /// The markers in the last frame whose robots other cameras have just seen.
    witnesses: Vec<Witness>,
    events: VecDeque<(Instant, SightingEvent)>,
}

impl Localiser {
    /// A localiser for these cameras and the markers of all robots.
    ///
    /// # Errors
    /// Every [`RegistryError`].
    pub fn new(
        cameras: &[Calibration],
        markers: impl IntoIterator<Item = (Identifier, Mount)>,
    ) -> Result<Self, RegistryError> {
        let mut mounts: BTreeMap<Identifier, Mount> = BTreeMap::new();
        for (identifier, mount) in markers {
            let Mount { robot, side_m, height_m, offset_m: [x, y], turn_rad } = mount;
            if !(side_m > 0.0 && [side_m, height_m, x, y, turn_rad].iter().all(|it| it.is_finite()))
            {
                return Err(RegistryError::Mount(robot));
            }
            let mut same = vec![identifier];
            if let Identifier::Colours { head, tail } = identifier {
                if head == tail {
                    return Err(RegistryError::OneColour(robot));
                }
                // Head and tail can't be told apart, so the swapped pair must be unique, too.
                same.push(Identifier::Colours { head: tail, tail: head });
            }
            if let Some(other) = same.iter().find_map(|it| mounts.get(it)) {
                return Err(RegistryError::Twice(other.robot, robot));
            }
            mounts.insert(identifier, mount);
        }
        let is_colours = |it: &Identifier| matches!(it, Identifier::Colours { .. });
        let search = Search::new(cameras.len(), mounts.keys().any(is_colours));
        Ok(Self {
            lenses: cameras.iter().map(|camera| camera.picture).collect(),
            mounts,
            search,
            tracks: BTreeMap::new(),
            not_there: BTreeMap::new(),
            strangers: BTreeMap::new(),
            out: BTreeSet::new(),
            ahead: BTreeSet::new(),
            witnesses: Vec::new(),
            events: VecDeque::new(),
        })
    }

    /// The poses of the robots when `frame` was captured, each fused with the sightings by other
    /// cameras at about that time. A frame that arrives after newer ones of other cameras
    /// contributes to the next pose. A frame that is too old, or captured after `now`, is ignored.
    pub fn observe(&mut self, frame: &Frame, now: Instant) -> Vec<Sighting> {
        self.witnesses.clear();
        let Some(&Some(lens)) = self.lenses.get(frame.camera) else { return Vec::new() };
        let Some(picture) = &frame.picture else { return Vec::new() };
        let (camera, captured) = (frame.camera, frame.captured);
        if captured > now {
            if self.ahead.insert(camera) {
                self.events.push_back((now, SightingEvent::ClockAhead { camera }));
            }
            return Vec::new();
        }
        self.ahead.remove(&camera);
        let expected: Vec<Expected> = self.expected(captured).collect();
        let markers = self.search.markers(camera, captured, picture, &lens, &expected);
        self.witnesses =
            markers.iter().filter_map(|it| self.witness(camera, captured, it)).collect();
        if self.out.contains(&camera) {
            return Vec::new();
        }
        let mut located: BTreeMap<Identifier, Vec<Placement>> = BTreeMap::new();
        for marker in &markers {
            if let Some(placement) = self.place(&lens, marker, captured) {
                located.entry(marker.identifier).or_default().push(placement);
            }
        }
        let mut sightings = Vec::new();
        for (identifier, placements) in located {
            let Some(mount) = self.mounts.get(&identifier) else { continue };
            let track = self.tracks.entry(identifier).or_default();
            let placement = track.observe(camera, captured, &placements);
            if let Some(trouble) = track.poll_trouble() {
                let event = match trouble {
                    Trouble::Jump => SightingEvent::Jumped(mount.robot),
                    Trouble::Twice => SightingEvent::SeenTwice(mount.robot),
                };
                self.events.push_back((captured, event));
            }
            sightings.extend(placement.map(|it| sighting(mount.robot, &it)));
        }
        sightings
    }

    /// The markers in the last frame whose robots other cameras have just seen.
    pub(super) fn witnesses(&self) -> &[Witness] {
        &self.witnesses
    }

    fn witness(&self, camera: usize, captured: Instant, marker: &Marker) -> Option<Witness> {
        let mount = self.mounts.get(&marker.identifier)?;
        let place = self.tracks.get(&marker.identifier)?.by_others(camera, captured)?;
        let (points, height_m) = (mount.points(marker.identifier), mount.height_m);
        Some(Witness { marker: marker.clone(), points, height_m, place })
    }

    /// Ignores a camera whose pose is not known, or no longer does.
    pub fn leave_out(&mut self, camera: usize, is_out: bool) {
        if is_out {
            self.out.insert(camera);
        } else {
            self.out.remove(&camera);
        }
    }

    /// Moves a camera's picture sensor.
    pub fn stand(&mut self, camera: usize, picture: Option<Lens>) {
        if let Some(lens) = self.lenses.get_mut(camera) {
            *lens = picture;
        }
    }

    /// The next problem, and the capture time of the frame that shows it. A problem is reported
    /// once, and again only after it has ended.
    pub fn poll_event(&mut self) -> Option<(Instant, SightingEvent)> {
        self.events.pop_front()
    }

    /// The pose of the robot that carries a marker.
    fn place(&mut self, lens: &Lens, marker: &Marker, captured: Instant) -> Option<Placement> {
        let identifier = marker.identifier;
        let is_tag = matches!(identifier, Identifier::Tag(_));
        let Some(mount) = self.mounts.get(&identifier) else {
            // Any two adjacent colours may look like a marker, so only tags are reported as
            // unregistered.
            if is_tag {
                self.meet_stranger(identifier, captured);
            }
            return None;
        };
        let located = locate(lens, marker, &mount.points(identifier), mount.height_m);
        if located.is_ok() {
            self.not_there.remove(&identifier);
        } else if is_tag {
            let views = self.not_there.entry(identifier).or_default();
            *views += 1;
            if *views == NOT_LEVEL {
                self.events.push_back((captured, SightingEvent::NotLevel(mount.robot)));
            }
        }
        located.ok()
    }

    fn meet_stranger(&mut self, identifier: Identifier, captured: Instant) {
        let known = self.strangers.get(&identifier).copied();
        let known = known.filter(|(last, _)| captured.since(*last) <= STRANGER_AWAY);
        let mut told = known.is_some_and(|(_, told)| told);
        if !told
            && known.is_some_and(|(last, _)| {
                last < captured && captured.since(last) <= STRANGER_CONFIRMED
            })
        {
            self.events.push_back((captured, SightingEvent::Unregistered(identifier)));
            told = true;
        }
        self.strangers.insert(identifier, (captured, told));
    }

    /// The expected placements of all markers at a moment.
    fn expected(&self, moment: Instant) -> impl Iterator<Item = Expected> {
        self.tracks.iter().flat_map(move |(identifier, track)| {
            let mount = self.mounts.get(identifier);
            mount.into_iter().flat_map(move |&mount| {
                let places = track.expected(moment);
                places.map(move |(placement, unseen)| Expected { mount, placement, unseen })
            })
        })
    }
}

fn sighting(robot: RobotId, placement: &Placement) -> Sighting {
    let [x, y] = placement.position_m;
    let deviation = |axis: usize| libm::sqrt(placement.covariance[(axis, axis)]);
    // The cast saturates.
    let millimetres = |axis: usize| (deviation(axis) * 1000.0).ceil() as u16;
    let turn = deviation(2) * f64::from(u16::MAX) / core::f64::consts::TAU;
    Sighting {
        robot,
        pose: Pose::from_metres(x, y, placement.heading_rad),
        certainty: Certainty { x: millimetres(0), y: millimetres(1), heading: turn.ceil() as u16 },
    }
}
