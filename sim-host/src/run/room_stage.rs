//! A simulated room on which a fleet acts.

use std::collections::VecDeque;

use ubimap_agent::drive::DriveCommand;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::Pose,
};

use super::{
    RunError, driving,
    fleet::{Event, Stage},
    scan_log::ScanLog,
    scoring::TRACK_INTERVAL,
};
use crate::{
    camera::{FrameSource, Source},
    world::{STEP, World},
};

/// A robot reads its wheels at 20 Hz.
const ODOMETRY_INTERVAL: Duration = Duration::from_millis(50);

/// When a robot reads its wheels first: on a real robot they are read when the scans are not, and
/// when the drive makes no step.
fn first_odometry(robot: usize) -> Instant {
    let phases = ODOMETRY_INTERVAL.0 / STEP.0 - 1;
    Instant((1 + robot as u64 * 3 % phases) * STEP.0)
}

/// A simulated room as a source of events.
pub struct RoomStage {
    world: World,
    end: Instant,
    /// When each robot reads its wheels next.
    next_odometry: Vec<Instant>,
    next_track: Instant,
    waiting: VecDeque<Event>,
    /// Whether the cameras give frames, or observations of ideal cameras.
    is_filmed: bool,
    /// What wheels have been told and do not do yet, by time: when, and which robot's.
    commands: VecDeque<(Instant, usize, DriveCommand)>,
    /// Where each robot really was, every [`TRACK_INTERVAL`].
    tracks: Vec<Vec<Pose>>,
    log: Option<ScanLog>,
}

impl RoomStage {
    /// The events of a world up to a moment, with ideal cameras: no frames are rendered, and what is
    /// in view is known.
    pub fn new(world: World, end: Instant) -> Self {
        let robots = world.robots().len();
        Self {
            world,
            end,
            next_odometry: (0..robots).map(first_odometry).collect(),
            next_track: Instant(0),
            waiting: VecDeque::new(),
            is_filmed: false,
            commands: VecDeque::new(),
            tracks: vec![Vec::new(); robots],
            log: None,
        }
    }

    /// The same with the frames of RGB-D cameras.
    pub fn filmed(world: World, end: Instant) -> Self {
        Self { is_filmed: true, ..Self::new(world, end) }
    }

    /// Where each robot really was, every twentieth of a second from the first moment on.
    pub fn tracks(&self) -> &[Vec<Pose>] {
        &self.tracks
    }

    /// Has every scan written to a log from now on.
    pub fn keep_log(&mut self, log: ScanLog) {
        self.log = Some(log);
    }

    /// Writes the log, if one is kept.
    ///
    /// # Errors
    /// [`RunError::Log`].
    pub fn finish_log(&mut self) -> Result<(), RunError> {
        self.log.take().map_or(Ok(()), ScanLog::finish)
    }

    /// Lets the robots that have a route drive themselves from now on.
    pub fn hand_over(&mut self) {
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

    /// Moves the world on. Wheels obey from the first step of the world that begins after they were
    /// told.
    fn advance(&mut self, now: Instant) {
        let begins = |told: Instant| Instant(told.0.next_multiple_of(STEP.0));
        while let Some(&(told, robot, command)) = self.commands.front()
            && begins(told) <= now
        {
            self.world.advance(begins(told));
            let (speed_m_s, turn_rad_s) = driving::wheels(command);
            self.world.tell_wheels(robot, speed_m_s, turn_rad_s);
            self.commands.pop_front();
        }
        self.world.advance(now);
    }

    fn follow_tracks(&mut self, now: Instant) {
        if self.next_track <= now {
            self.next_track = self.next_track + TRACK_INTERVAL;
            let robots = self.tracks.iter_mut().zip(self.world.robots());
            robots.for_each(|(track, robot)| track.push(robot.truth()));
        }
    }

    fn read_wheels(&mut self, now: Instant) {
        let robots = self.next_odometry.iter_mut().zip(self.world.robots()).enumerate();
        for (robot, (next, simulated)) in robots {
            if *next <= now {
                *next = *next + ODOMETRY_INTERVAL;
                self.waiting.push_back(Event::Odometry { robot, pose: simulated.odometry() });
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
        let events = [Some(self.next_track), self.world.next_scan(), arrival];
        let odometry = self.next_odometry.iter().copied();
        events.into_iter().flatten().chain(odometry).min().filter(|&next| next <= self.end)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        if let Some(event) = self.waiting.pop_front() {
            return Some(event);
        }
        self.advance(now);
        self.follow_tracks(now);
        self.read_wheels(now);
        while let Some(scan) = self.world.poll_scan(now) {
            if let Some(log) = &mut self.log {
                log.add(&scan);
            }
            self.waiting.push_back(Event::Scan { robot: scan.robot, readings: scan.readings_mm });
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

    fn drive(&mut self, moment: Instant, robot: usize, command: DriveCommand) {
        self.commands.push_back((moment, robot, command));
    }
}
