//! A simulated room on which a fleet acts.

use std::collections::VecDeque;

use ubimap_agent::drive::DriveCommand;
use ubimap_protocol::{time::Instant, units::Pose};

use super::{
    driving,
    fleet::{Event, Stage},
    scoring::TRACK_INTERVAL,
};
use crate::{
    camera::{FrameSource, Source},
    world::World,
};

/// A simulated room as a source of events.
pub struct RoomStage {
    world: World,
    end: Instant,
    next_odometry: Instant,
    waiting: VecDeque<Event>,
    /// Whether the cameras give frames, or observations of ideal cameras.
    is_filmed: bool,
    /// Whether robots that have a route drive themselves.
    is_driven: bool,
    /// Where each robot really was, every [`TRACK_INTERVAL`].
    tracks: Vec<Vec<Pose>>,
}

impl RoomStage {
    /// The events of a world up to a moment, with ideal cameras: no frames are rendered, and what is
    /// in view is known.
    pub fn new(world: World, end: Instant) -> Self {
        let tracks = vec![Vec::new(); world.robots().len()];
        let (next_odometry, waiting) = (Instant(0), VecDeque::new());
        Self { world, end, next_odometry, waiting, is_filmed: false, is_driven: false, tracks }
    }

    /// The same with the frames of RGB-D cameras.
    pub fn filmed(world: World, end: Instant) -> Self {
        Self { is_filmed: true, ..Self::new(world, end) }
    }

    /// Where each robot really was, every twentieth of a second from the first moment on.
    pub fn tracks(&self) -> &[Vec<Pose>] {
        &self.tracks
    }

    /// Lets the robots that have a route drive themselves from now on.
    pub fn hand_over(&mut self) {
        self.is_driven = true;
        for robot in 0..self.world.robots().len() {
            if self.world.robots()[robot].drives() {
                self.world.tell_wheels(robot, 0.0, 0.0);
            }
        }
    }

    /// The world as it is.
    pub fn world(&self) -> &World {
        &self.world
    }

    fn read_wheels(&mut self) {
        for (index, robot) in self.world.robots().iter().enumerate() {
            self.tracks[index].push(robot.truth());
            self.waiting.push_back(Event::Odometry { robot: index, pose: robot.odometry() });
            if self.is_driven && robot.drives() {
                self.waiting.push_back(Event::Drive { robot: index });
            }
        }
    }
}

impl Stage for RoomStage {
    fn next_event(&self) -> Option<Instant> {
        if !self.waiting.is_empty() {
            return Some(self.world.now());
        }
        let arrival = if self.is_filmed {
            FrameSource::next_arrival(&self.world)
        } else {
            Source::next_arrival(&self.world)
        };
        let events = [Some(self.next_odometry), self.world.next_scan(), arrival];
        events.into_iter().flatten().min().filter(|&next| next <= self.end)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        if let Some(event) = self.waiting.pop_front() {
            return Some(event);
        }
        self.world.advance(now);
        if self.next_odometry <= now {
            self.next_odometry = self.next_odometry + TRACK_INTERVAL;
            self.read_wheels();
        }
        while let Some(scan) = self.world.poll_scan(now) {
            // The wheels are read with each scan as well.
            let robot = scan.robot;
            self.waiting.push_back(Event::Odometry { robot, pose: scan.odometry });
            self.waiting.push_back(Event::Scan { robot, readings: scan.readings_mm });
        }
        if self.is_filmed {
            while let Some(frame) = FrameSource::poll(&mut self.world, now) {
                self.waiting.push_back(Event::Frame(frame));
            }
        }
        while let Some(observation) = Source::poll(&mut self.world, now) {
            if !self.is_filmed {
                self.waiting.push_back(Event::Observation(observation));
            }
        }
        self.waiting.pop_front()
    }

    fn drive(&mut self, robot: usize, command: DriveCommand) {
        let (speed_m_s, turn_rad_s) = driving::wheels(command);
        self.world.tell_wheels(robot, speed_m_s, turn_rad_s);
    }
}
