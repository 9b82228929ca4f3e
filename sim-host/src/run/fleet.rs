//! Robots and a deployment, connected by channels, under virtual time.
//!
//! Nothing here waits: the clock jumps from event to event, each robot and the deployment is called
//! at its `poll_timeout`, and the same seed gives the same bytes.

use log::Level;
use ubimap_agent::{Config, ConfigError, Memory, drive::Driving};
use ubimap_protocol::{
    frame::{Direction, MAX_FRAME},
    time::{Duration, Instant},
    units::RobotId,
};

pub use super::stage::{Event, Stage};
use super::{
    RunError,
    body::{BUFFER, Journal},
    grey_robot::Sight,
    heap::Heap,
    interruption,
    keeper::Keeper,
    member::Member,
    outside::robot::{Outside, Place},
    terminal,
};
use crate::{
    channel::fault::Faults,
    deployment::{self, Deployment, Policy},
    server::Server,
};

/// Called with every frame that a robot or the server sends, before its channel can alter it: the
/// robot, the direction and the bytes.
pub type Tap<'t> = Box<dyn FnMut(RobotId, Direction, &[u8]) + 't>;

/// Called with every event of the deployment.
pub type Listener<'l> = Box<dyn FnMut(&deployment::Event) + 'l>;

/// What the robots of a fleet are.
pub enum Bodies<'b> {
    /// Robots that get scans.
    Robots,
    /// Machines, which get the bytes of simulated devices; a buffer for each.
    Machines(&'b mut [[u16; BUFFER]]),
    /// Robots that get pictures of grey cameras.
    Grey(Sight),
}

/// A deployment and its robots, on one virtual clock.
pub struct Fleet<'b> {
    deployment: Deployment,
    robots: Vec<Member<'b>>,
    outside: Option<Outside>,
    keeper: Option<Keeper>,
    /// Time since the run began.
    now: Instant,
    frame: Vec<u8>,
    tap: Option<Tap<'b>>,
    listener: Option<Listener<'b>>,
    /// Whether the stage has ended. From then on no frames arrive, so robots get no fixes.
    has_ended: bool,
}

/// Maximum time after the last event for all maps to converge.
const PATIENCE: Duration = Duration::from_secs(120);

impl<'b> Fleet<'b> {
    /// A robot for each configuration, each at its own port. `memory` has one entry per robot.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn new(
        configs: &[Config<Option<Driving>>],
        memory: &'b mut [Memory<Heap, Option<Driving>>],
        faults: Faults,
        seed: u64,
        deployment: Deployment,
    ) -> Result<Self, ConfigError> {
        Self::of_bodies(configs, memory, Bodies::Robots, faults, seed, deployment)
    }

    /// The same with other bodies.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn of_bodies(
        configs: &[Config<Option<Driving>>],
        memory: &'b mut [Memory<Heap, Option<Driving>>],
        bodies: Bodies<'b>,
        faults: Faults,
        seed: u64,
        mut deployment: Deployment,
    ) -> Result<Self, ConfigError> {
        let (buffers, sight) = match bodies {
            Bodies::Robots => (&mut [][..], None),
            Bodies::Machines(buffers) => (buffers, None),
            Bodies::Grey(sight) => (&mut [][..], Some(sight)),
        };
        let mut buffers = buffers.iter_mut().map(|buffer| &mut buffer[..]);
        let robots = configs.iter().zip(memory).map(|(config, memory)| {
            let memory = (memory, buffers.next());
            Member::new(*config, memory, sight, deployment.open_port(Policy::Open), faults, seed)
        });
        let robots = robots.collect::<Result<_, ConfigError>>()?;
        Ok(Self {
            deployment,
            robots,
            outside: None,
            keeper: None,
            now: Instant(0),
            frame: vec![0; MAX_FRAME],
            tap: None,
            listener: None,
            has_ended: false,
        })
    }

    /// Stores the deployment's records in a file from now on.
    pub fn keep(&mut self, keeper: Keeper) {
        self.keeper = Some(keeper);
    }

    /// Connects the stage's only robot, which is outside, to this fleet without robots. From now on
    /// its clock is the time that passes.
    ///
    /// # Errors
    /// [`RunError::Port`] if a port can't be opened or a command not started.
    pub fn connect(&mut self, robot: RobotId, place: &Place, seed: u64) -> Result<(), RunError> {
        self.outside = Some(Outside::open(robot, place, seed, &mut self.deployment)?);
        Ok(())
    }

    /// The robot outside.
    pub fn outside(&self) -> Option<&Outside> {
        self.outside.as_ref()
    }

    /// Calls `tap` with every frame from now on.
    pub fn tap(&mut self, tap: Tap<'b>) {
        self.tap = Some(tap);
    }

    /// Calls `journal` with every input and output of a machine from now on. `robot` is its index.
    pub fn keep_journal(&mut self, robot: usize, journal: Journal<'b>) {
        if let Some(robot) = self.robots.get_mut(robot) {
            robot.keep_journal(journal);
        }
    }

    /// Calls `listener` with every event of the deployment from now on.
    pub fn listen(&mut self, listener: Listener<'b>) {
        self.listener = Some(listener);
    }

    /// The deployment.
    pub fn deployment(&self) -> &Deployment {
        &self.deployment
    }

    /// The server of the deployment.
    pub fn server(&self) -> &Server {
        self.deployment.server()
    }

    /// The robots.
    pub fn robots(&self) -> &[Member<'b>] {
        &self.robots
    }

    /// The current time of the run, whose clock starts at zero.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The time since the run began.
    pub fn elapsed(&self) -> Duration {
        self.now.since(Instant(0))
    }

    /// [`play`](Self::play), then [`settle`](Self::settle). Returns whether all maps
    /// have converged.
    ///
    /// # Errors
    /// [`RunError::Store`], [`RunError::Port`].
    pub fn run(
        &mut self,
        stage: &mut dyn Stage,
        watch: impl FnMut(&Self),
    ) -> Result<bool, RunError> {
        self.play(stage, watch)?;
        self.settle(stage)
    }

    /// Runs until the stage has ended or a signal interrupts. `watch` is called after all events of
    /// a moment.
    ///
    /// # Errors
    /// [`RunError::Store`], [`RunError::Port`].
    pub fn play(
        &mut self,
        stage: &mut dyn Stage,
        mut watch: impl FnMut(&Self),
    ) -> Result<(), RunError> {
        while !interruption::is_requested()
            && let Some(next) = stage.next_event()
        {
            self.run_until(next, stage)?;
            while let Some(event) = stage.poll(self.now) {
                self.happen(event);
            }
            self.drain()?;
            watch(self);
        }
        Ok(())
    }

    /// Continues after the stage has ended until all maps have converged, for at most two minutes.
    /// Returns whether they have.
    ///
    /// # Errors
    /// [`RunError::Store`], [`RunError::Port`].
    pub fn settle(&mut self, stage: &mut dyn Stage) -> Result<bool, RunError> {
        self.has_ended = true;
        let end = self.now + PATIENCE;
        while !self.has_converged() && self.now < end {
            self.run_until(self.now + Duration::from_millis(100), stage)?;
        }
        Ok(self.has_converged())
    }

    /// Processes everything due before `until`, then sets the clock to `until`.
    fn run_until(&mut self, until: Instant, stage: &mut dyn Stage) -> Result<(), RunError> {
        while let Some(outside) = &mut self.outside
            && self.now < until
        {
            let now = outside.exchange(&mut self.deployment, stage, until)?;
            self.now = self.now.max(now);
            self.deployment.timeout(self.now);
            self.drain()?;
        }
        while let Some(next) = self.next_due().filter(|&next| next < until) {
            self.now = self.now.max(next);
            self.read_wheels(stage);
            self.deliver();
            self.turn_wheels(stage);
            self.drain()?;
        }
        self.now = self.now.max(until);
        Ok(())
    }

    /// Time of the next frame delivery or timeout.
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

    /// Passes what wheels have measured to the machines.
    fn read_wheels(&mut self, stage: &mut dyn Stage) {
        let now = self.now;
        for (index, robot) in self.robots.iter_mut().enumerate() {
            if robot.next_measurement().is_some_and(|next| next <= now)
                && let Some(measured) = stage.wheels(now, index)
            {
                robot.measure(measured, now);
            }
        }
    }

    /// Passes the robots' drive commands to the stage.
    fn turn_wheels(&mut self, stage: &mut dyn Stage) {
        for (index, robot) in self.robots.iter_mut().enumerate() {
            if let Some(command) = robot.poll_command() {
                stage.drive(self.now, index, command);
            }
        }
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Scan { readings, .. } if self.outside.is_some() => {
                self.outside.iter_mut().for_each(|outside| outside.scan(&readings, self.now));
            }
            Event::Scan { robot, readings } => {
                let Some(robot) = self.robots.get_mut(robot) else { return };
                robot.scan(&readings, self.now);
                let pose = robot.robot().pose();
                robot.follow(pose.map(|(at, pose)| (self.deployment.since_began(at), pose)));
            }
            Event::Look { robot, picture } => {
                let Some(robot) = self.robots.get_mut(robot) else { return };
                robot.look(&picture, self.now);
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

    /// Drains the outputs of the deployment and all robots.
    fn drain(&mut self) -> Result<(), RunError> {
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
            if let Some(outside) = self.outside.as_mut().filter(|it| it.port() == port) {
                hear(outside.id(), Direction::ToRobot, &self.frame[..len]);
                outside.transmit(&self.frame[..len], now)?;
            }
            if let Some(robot) = self.robots.iter_mut().find(|robot| robot.port() == port) {
                hear(robot.id(), Direction::ToRobot, &self.frame[..len]);
                robot.send_down(now, &self.frame[..len]);
            }
        }
        while let Some((moment, event)) = self.deployment.poll_event() {
            // After the end robots lose their poses, because no frames arrive.
            let level = if self.has_ended { Level::Debug } else { event.level() };
            log::log!(level, "{}: {event}", terminal::seconds(moment));
            if let Some(listener) = &mut self.listener {
                listener(&event);
            }
        }
        Ok(())
    }
}
