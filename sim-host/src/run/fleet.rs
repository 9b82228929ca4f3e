//! Robots and a deployment, joined by channels under virtual time.
//!
//! Nothing here waits: the clock jumps from event to event, each robot and the deployment come back
//! when they asked to, and the same seed gives the same bytes.

use ubimap_agent::{
    Config, ConfigError, Memory,
    drive::{DriveCommand, Driving},
};
use ubimap_protocol::{
    frame::{Direction, MAX_FRAME},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::{
    heap::Heap,
    keeper::Keeper,
    member::{Journal, Member},
};
use crate::{
    camera::{Frame, Observation},
    channel::fault::Faults,
    deployment::{self, Deployment},
    server::Server,
    store::StoreError,
};

/// Something that happens at a moment of a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A robot, by its place in the fleet, takes a scan.
    Scan {
        /// Which robot.
        robot: usize,
        /// Readings in millimetres, 0 where nothing came back.
        readings: Vec<u16>,
    },
    /// A robot reads its odometry.
    Odometry {
        /// Which robot.
        robot: usize,
        /// `base_link` in `odom`.
        pose: Pose,
    },
    /// A frame of a camera has arrived.
    Frame(Frame),
    /// A frame of a camera has been looked at.
    Observation(Observation),
}

/// Where the events come from: a log, or a simulated room.
pub trait Stage {
    /// When the next event happens; `None` if there will be no more.
    fn next_event(&self) -> Option<Instant>;

    /// An event that has happened by `now`, oldest first.
    fn poll(&mut self, now: Instant) -> Option<Event>;

    /// A robot's wheels shall do this from `moment` on.
    fn drive(&mut self, _moment: Instant, _robot: usize, _command: DriveCommand) {}
}

/// Hears every frame that a robot or the server sends, before its channel does anything to it:
/// the robot, the direction, and the bytes.
pub type Tap<'t> = Box<dyn FnMut(RobotId, Direction, &[u8]) + 't>;

/// Hears every event of the deployment.
pub type Listener<'l> = Box<dyn FnMut(&deployment::Event) + 'l>;

/// A deployment and its robots, on one virtual clock.
pub struct Fleet<'b> {
    deployment: Deployment,
    robots: Vec<Member<'b>>,
    keeper: Option<Keeper>,
    /// Since the run began.
    now: Instant,
    frame: Vec<u8>,
    tap: Option<Tap<'b>>,
    listener: Option<Listener<'b>>,
}

/// How long a run goes on after the last event, unless all hold the same map before.
const PATIENCE: Duration = Duration::from_secs(120);

impl<'b> Fleet<'b> {
    /// A robot for each configuration, at a port of its own; `memory` has one entry for each as
    /// well.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn new(
        configs: &[Config<Option<Driving>>],
        memory: &'b mut [Memory<Heap, Option<Driving>>],
        faults: Faults,
        seed: u64,
        mut deployment: Deployment,
    ) -> Result<Self, ConfigError> {
        let robots = configs.iter().zip(memory).map(|(config, memory)| {
            Member::new(*config, memory, deployment.open_port(), faults, seed)
        });
        let robots = robots.collect::<Result<_, ConfigError>>()?;
        Ok(Self {
            deployment,
            robots,
            keeper: None,
            now: Instant(0),
            frame: vec![0; MAX_FRAME],
            tap: None,
            listener: None,
        })
    }

    /// Has what the deployment hands out written to a file from now on.
    pub fn keep(&mut self, keeper: Keeper) {
        self.keeper = Some(keeper);
    }

    /// Has every frame of the links heard from now on.
    pub fn tap(&mut self, tap: Tap<'b>) {
        self.tap = Some(tap);
    }

    /// Has what a robot takes and gives heard from now on. The robot is named by its place.
    pub fn keep_journal(&mut self, robot: usize, journal: Journal<'b>) {
        if let Some(robot) = self.robots.get_mut(robot) {
            robot.keep_journal(journal);
        }
    }

    /// Has every event of the deployment heard from now on.
    pub fn listen(&mut self, listener: Listener<'b>) {
        self.listener = Some(listener);
    }

    /// The deployment.
    pub fn deployment(&self) -> &Deployment {
        &self.deployment
    }

    /// Its server.
    pub fn server(&self) -> &Server {
        self.deployment.server()
    }

    /// The robots.
    pub fn robots(&self) -> &[Member<'b>] {
        &self.robots
    }

    /// The time since the run began.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// How long the run has lasted.
    pub fn elapsed(&self) -> Duration {
        self.now.since(Instant(0))
    }

    /// Runs until the stage has ended and all hold the same map, or until patience ends. Returns
    /// whether they do. `watch` sees the fleet after every event.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn run(
        &mut self,
        stage: &mut dyn Stage,
        mut watch: impl FnMut(&Self),
    ) -> Result<bool, StoreError> {
        while let Some(next) = stage.next_event() {
            self.run_until(next, stage)?;
            while let Some(event) = stage.poll(self.now) {
                self.happen(event);
            }
            self.drain()?;
            watch(self);
        }
        let end = self.now + PATIENCE;
        while !self.has_converged() && self.now < end {
            self.run_until(self.now + Duration::from_millis(100), stage)?;
        }
        Ok(self.has_converged())
    }

    /// Lets all that is due before `until` happen; then it is `until`.
    fn run_until(&mut self, until: Instant, stage: &mut dyn Stage) -> Result<(), StoreError> {
        while let Some(next) = self.next_due().filter(|&next| next < until) {
            self.now = self.now.max(next);
            self.deliver();
            self.turn_wheels(stage);
            self.drain()?;
        }
        self.now = self.now.max(until);
        Ok(())
    }

    /// When a frame arrives, or a robot or the deployment wants to come back.
    fn next_due(&self) -> Option<Instant> {
        let robots = self.robots.iter().map(Member::poll_timeout);
        robots.chain([self.deployment.poll_timeout(self.now)]).flatten().min()
    }

    fn deliver(&mut self) {
        let now = self.now;
        for robot in &mut self.robots {
            while let Some(bytes) = robot.poll_up(now) {
                let is_open = self.deployment.receive(robot.port(), &bytes, now);
                debug_assert!(is_open.is_ok());
            }
            robot.deliver(now);
        }
        self.deployment.timeout(now);
    }

    /// Lets the wheels do what the robots say.
    fn turn_wheels(&mut self, stage: &mut dyn Stage) {
        for (index, robot) in self.robots.iter_mut().enumerate() {
            if let Some(command) = robot.poll_command(self.now) {
                stage.drive(self.now, index, command);
            }
        }
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Scan { robot, readings } => {
                let Some(robot) = self.robots.get_mut(robot) else { return };
                robot.scan(&readings, self.now);
                let pose = robot.robot().pose();
                robot.follow(pose.map(|(at, pose)| (self.deployment.since_began(at), pose)));
            }
            Event::Odometry { robot, pose } => {
                let Some(robot) = self.robots.get_mut(robot) else { return };
                robot.odometry(pose, self.now);
            }
            Event::Frame(frame) => self.deployment.frame(frame, self.now),
            Event::Observation(observation) => self.deployment.observe(observation),
        }
    }

    /// Drains the outputs of all, until none has any left.
    fn drain(&mut self) -> Result<(), StoreError> {
        let now = self.now;
        if let Some(keeper) = &mut self.keeper {
            keeper.keep(&mut self.deployment, now)?;
        }
        let mut hear = |robot, direction, frame: &[u8]| {
            if let Some(tap) = &mut self.tap {
                tap(robot, direction, frame);
            }
        };
        for robot in &mut self.robots {
            while let Some(len) = robot.poll_transmit(now, &mut self.frame) {
                hear(robot.id(), Direction::ToServer, &self.frame[..len]);
            }
        }
        while let Some((port, len)) = self.deployment.poll_transmit(now, &mut self.frame) {
            if let Some(robot) = self.robots.iter_mut().find(|robot| robot.port() == port) {
                hear(robot.id(), Direction::ToRobot, &self.frame[..len]);
                robot.send_down(now, &self.frame[..len]);
            }
        }
        while let Some((_, event)) = self.deployment.poll_event() {
            log::log!(event.level(), "{event}");
            if let Some(listener) = &mut self.listener {
                listener(&event);
            }
        }
        Ok(())
    }
}
