//! Schedules the frames of ideal cameras, and holds the observations in flight.

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;
use ubimap_protocol::{tile::Cell, time::Instant};

use super::{
    cadence::{Cadence, FrameSchedule},
    ideal_camera::{IdealCamera, IdealFrame, VisibleRobot},
    people::Person,
    robots::SimRobot,
    room::{CellGrid, Room},
    route::Body,
    scenario::Scenario,
};
use crate::{
    camera::{Observation, Thing},
    grid::clusters,
};

/// All ideal cameras of a scenario.
pub(super) struct IdealCameras {
    cameras: Vec<Scheduled>,
    /// Ordered by arrival, then capture, then camera.
    in_flight: BTreeMap<(Instant, Instant, usize), Observation>,
}

/// A camera with its frame times, and the cadence of frames that report cells.
struct Scheduled {
    camera: IdealCamera,
    frames: FrameSchedule,
    cells: Cadence,
}

impl IdealCameras {
    /// The cameras of a scenario; `dice` gives the random numbers of each.
    pub(super) fn new(
        scenario: &Scenario,
        room: &Room,
        cells: CellGrid,
        dice: impl Fn(usize) -> ChaCha8Rng,
    ) -> Self {
        let robot_height = scenario.robot_height_m();
        let camera = |(index, config)| Scheduled {
            camera: IdealCamera::new(config, room, cells, robot_height, dice(index)),
            frames: FrameSchedule::new(config),
            cells: Cadence::new(config.cells_rate_hz),
        };
        let cameras = scenario.cameras.iter().enumerate().map(camera).collect();
        Self { cameras, in_flight: BTreeMap::new() }
    }

    /// Recomputes the visible cells after the room has changed.
    pub(super) fn look_again(&mut self, room: &Room) {
        self.cameras.iter_mut().for_each(|scheduled| scheduled.camera.look_again(room));
    }

    /// The cells that a camera sees without people and robots.
    pub(super) fn visible(&self, camera: usize) -> impl Iterator<Item = (i32, i32)> {
        let cells = self.cameras.get(camera).map_or(&[][..], |it| it.camera.visible());
        cells.iter().map(|it| it.cell)
    }

    /// Takes the frames that are due.
    pub(super) fn take(
        &mut self,
        now: Instant,
        room: &Room,
        robots: &[SimRobot],
        people: &[Person],
    ) {
        for (index, scheduled) in self.cameras.iter_mut().enumerate() {
            if !scheduled.frames.is_due(now) {
                continue;
            }
            let with_cells = scheduled.cells.is_due(now);
            let robots: Vec<VisibleRobot> = robots.iter().map(VisibleRobot::of).collect();
            let people: Vec<Body> = people.iter().map(Person::body).collect();
            // A failed camera still draws its random numbers.
            let frame = scheduled.camera.frame(room, &robots, &people, with_cells);
            if !scheduled.frames.has_failed(now) {
                let arrival = now + scheduled.frames.latency();
                self.in_flight.insert((arrival, now, index), observation(index, now, frame));
            }
        }
    }

    /// The next observation that has arrived by `now`.
    pub(super) fn poll(&mut self, now: Instant) -> Option<Observation> {
        let first = self.in_flight.first_entry()?;
        (first.key().0 <= now).then(|| first.remove())
    }

    /// The earliest arrival of the next observation.
    pub(super) fn next_arrival(&self) -> Option<Instant> {
        let in_flight = self.in_flight.keys().map(|&(arrival, ..)| arrival).next();
        let coming = self.cameras.iter().filter_map(|it| it.frames.next_arrival());
        in_flight.into_iter().chain(coming).min()
    }

    #[cfg(test)]
    pub(super) fn cameras(&mut self) -> impl Iterator<Item = &mut IdealCamera> {
        self.cameras.iter_mut().map(|it| &mut it.camera)
    }
}

/// Makes an observation of a frame: each cluster of movable cells is a thing of unknown height.
fn observation(camera: usize, captured: Instant, frame: IdealFrame) -> Observation {
    let IdealFrame { robots, cells } = frame;
    let movable = cells.iter().filter(|(_, code)| *code == Cell::Movable);
    let clusters = clusters(movable.map(|&(cell, _)| cell).collect());
    let things = clusters.into_iter().map(|cells| Thing { cells, ..Thing::default() }).collect();
    Observation { camera, captured, robots, cells, things }
}
