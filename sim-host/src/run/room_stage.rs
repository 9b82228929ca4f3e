//! A simulated room as the stage of a fleet.

use std::collections::VecDeque;

use ubimap_agent::drive::DriveCommand;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::Pose,
};

use super::{
    RunError, driving,
    fleet::{Event, Stage},
    onboard::Onboard,
    pointset::Pointset,
    scan_log::ScanLog,
    scoring::TRACK_INTERVAL,
    vision::Vision,
};
use crate::{
    camera::{FrameSource, Source},
    recording::ExposureRule,
    world::{STEP, World},
};

/// Odometry is read at 20 Hz.
const ODOMETRY_INTERVAL: Duration = Duration::from_millis(50);

/// Time of a robot's first odometry reading. As on a real robot, readings coincide neither with
/// scans nor with the drive's steps.
fn first_odometry(robot: usize) -> Instant {
    let phases = ODOMETRY_INTERVAL.0 / STEP.0 - 1;
    Instant((1 + robot as u64 * 3 % phases) * STEP.0)
}

/// A simulated room as a source of events.
pub struct RoomStage {
    world: World,
    end: Instant,
    /// Time of each robot's next odometry reading.
    next_odometry: Vec<Instant>,
    next_track: Instant,
    waiting: VecDeque<Event>,
    /// Whether cameras deliver rendered frames, instead of the observations of ideal cameras.
    is_filmed: bool,
    /// Drive commands not yet applied, oldest first: time, robot and command.
    commands: VecDeque<(Instant, usize, DriveCommand)>,
    /// True poses of each robot, one per [`TRACK_INTERVAL`].
    tracks: Vec<Vec<Pose>>,
    log: Option<ScanLog>,
    vision: Option<Vision>,
    onboard: Option<Onboard>,
    points: Option<Pointset>,
    exposure: ExposureRule,
}

impl RoomStage {
    /// The events of a world until `end`, with ideal cameras, which observe without rendered
    /// frames.
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
            vision: None,
            onboard: None,
            points: None,
            exposure: ExposureRule::Any,
        }
    }

    /// The events of a world until `end`, with rendered frames of RGB-D cameras.
    pub fn filmed(world: World, end: Instant) -> Self {
        Self { is_filmed: true, ..Self::new(world, end) }
    }

    /// True poses of each robot, every 50 ms from time zero on.
    pub fn tracks(&self) -> &[Vec<Pose>] {
        &self.tracks
    }

    /// Writes every scan to a log from now on.
    pub fn keep_log(&mut self, log: ScanLog) {
        self.log = Some(log);
    }

    /// Leaves out badly exposed readings, and collects the points of all scans from now on.
    pub(super) fn keep_points(&mut self, points: Pointset, exposure: ExposureRule) {
        (self.points, self.exposure) = (Some(points), exposure);
    }

    /// The points of all scans.
    pub(super) fn points(&self) -> Option<&Pointset> {
        self.points.as_ref()
    }

    /// Lets the robots estimate their poses without the cameras, too, from now on.
    pub(super) fn keep_onboard(&mut self) {
        self.onboard = Some(Onboard::new(&self.world));
    }

    /// The robots without the cameras.
    pub(super) fn onboard(&self) -> Option<&Onboard> {
        self.onboard.as_ref()
    }

    /// Compares every picture of a grey camera with the truth from now on.
    pub(super) fn keep_vision(&mut self, vision: Vision) {
        self.vision = Some(vision);
    }

    /// What the grey cameras have measured.
    pub(super) fn vision(&self) -> Option<&Vision> {
        self.vision.as_ref()
    }

    /// Finishes the log, if there is one.
    ///
    /// # Errors
    /// [`RunError::Log`].
    pub fn finish_log(&mut self) -> Result<(), RunError> {
        self.log.take().map_or(Ok(()), ScanLog::finish)
    }

    /// Stops the scripted routes: robots that have one drive themselves from now on.
    pub fn hand_over(&mut self) {
        for robot in 0..self.world.robots().len() {
            if self.world.robots()[robot].drives() {
                self.world.tell_wheels(robot, 0.0, 0.0);
            }
        }
    }

    /// The simulated world.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Advances the world. A command takes effect at the first step that begins after it.
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
        while let Some(mut scan) = self.world.poll_scan(now) {
            // A robot masks its readings before it looks at them.
            let counts = self.exposure.apply(&mut scan.readings_mm, &scan.light);
            self.points.iter_mut().for_each(|points| points.masked(counts.masked));
            if let Some(onboard) = &mut self.onboard {
                onboard.note(&scan, &self.world);
            }
            if let Some(points) = &mut self.points {
                points.note(&scan, &self.world);
            }
            if let Some(log) = &mut self.log {
                log.add(&scan);
            }
            self.waiting.push_back(Event::Scan { robot: scan.robot, readings: scan.readings_mm });
        }
        while let Some(look) = self.world.poll_look(now) {
            if let Some(vision) = &mut self.vision {
                vision.note(&look);
            }
            let (robot, picture) = (look.robot, look.picture);
            self.waiting.push_back(Event::Look { robot, picture });
        }
        if self.is_filmed {
            while let Some(frame) = FrameSource::poll(&mut self.world, now) {
                self.waiting.push_back(Event::Frame(frame));
            }
        } else {
            self.world.skip_frames(now);
        }
        while let Some(observation) = Source::poll(&mut self.world, now) {
            if !self.is_filmed {
                self.waiting.push_back(Event::Observation(observation));
            }
        }
        self.waiting.pop_front()
    }

    fn wheels(&mut self, now: Instant, robot: usize) -> Option<([f64; 2], bool)> {
        self.advance(now);
        let robot = self.world.robots().get(robot)?;
        Some((robot.rolled(), robot.is_touching()))
    }

    fn drive(&mut self, moment: Instant, robot: usize, command: DriveCommand) {
        self.commands.push_back((moment, robot, command));
    }
}
