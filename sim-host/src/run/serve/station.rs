//! A deployment with its links and cameras, driven by the wall clock.

use std::{collections::BTreeSet, sync::Arc, time};

use log::Level;
use ubimap_protocol::{
    frame::MAX_FRAME,
    message::Stop,
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::{
    attached::Attached,
    bench_camera::BenchCamera,
    cameras::Cameras,
    clock::Clock,
    links::{Door, Links},
    live_keys::{KeyChange, LiveKeys},
    message::{Message, Move, Perceived},
    perceiving,
    results::{self, Delays, Snapshot},
    robots, sources,
    standing::Standings,
};
use crate::{
    channel::{
        intake::{Arrival, Feed},
        socket_file::SocketFile,
    },
    deployment::{Config, Deployment, Event, Life, Policy},
    grid::OccupancyGrid,
    perception::{Observer, robots::RegistryError},
    report::{ServeReport, ServedRobot, json_pretty},
    run::{
        RunError,
        control::Request,
        deployment_file::{DeployedCamera, Playback},
        figures,
        keeper::Keeper,
        markers,
    },
    server::{self, Command},
};

/// Maximum wait for an arrival, so that hang-ups and signals are noticed.
const LONGEST_WAIT: Duration = Duration::from_millis(20);
/// Maximum number of arrivals that are handled before other work that is due.
const ARRIVALS: usize = 64;
/// Minimum wait, so that the processor can idle.
const SHORTEST_WAIT: Duration = Duration::from_millis(1);
/// Time for the last messages to the robots: enough for one retransmission.
const FAREWELL: Duration = Duration::from_millis(500);

/// A deployment with its links and cameras, driven by the wall clock.
pub struct Station {
    deployment: Deployment,
    links: Links,
    keeper: Option<Keeper>,
    /// `None` if the ports are open.
    keys: Option<LiveKeys>,
    eyes: Eyes,
    clock: Clock,
    buffer: Vec<u8>,
    /// The number of the last stop command.
    stops: u32,
    /// The robots that a user has stopped.
    stopped: BTreeSet<RobotId>,
    registered: Vec<RobotId>,
}

/// Links and sockets, and the robots' keys, if they are sealed.
pub(super) type Connections = ((Vec<Attached>, Vec<Door>), Option<LiveKeys>);

/// Who sees the robots.
enum Eyes {
    /// The bench's stand-in for cameras.
    Bench(BenchCamera),
    /// Cameras, and perception in a thread.
    Cameras(Watch),
}

struct Watch {
    cameras: Arc<Cameras>,
    deployed: Vec<DeployedCamera>,
    standings: Standings,
    plan: Option<Arc<OccupancyGrid>>,
    delays: Delays,
    /// Removed with the station.
    _sockets: Vec<SocketFile>,
}

impl Station {
    /// Starts a deployment on a bench, without cameras. With `keys` all of its ports are keyed. Its
    /// records go to the keeper, if there is one.
    ///
    /// # Errors
    /// [`RunError::Port`] if no thread can be started; [`RunError::Registry`], which a deployment
    /// without markers does not return.
    pub fn new(
        resolution: Millimetres,
        life: Life,
        links: (Vec<Attached>, Vec<Door>),
        keys: Option<LiveKeys>,
        keeper: Option<Keeper>,
    ) -> Result<Self, RunError> {
        let config = Config::new(resolution);
        let eyes = Eyes::Bench(BenchCamera::default());
        Self::with(config, life, (links, keys), keeper, (eyes, Clock::new(1.0)))
    }

    /// Starts a deployment with cameras, and a floor plan to compare the map with. The cameras of `config` are
    /// not used: perception runs in a thread. With keys all ports are keyed.
    ///
    /// # Errors
    /// [`RunError::Port`] if a socket can't be opened or a thread not started; [`RunError::Registry`].
    pub(super) fn live(
        config: Config,
        life: Life,
        links: Connections,
        keeper: Option<Keeper>,
        (deployed, plan): (Vec<DeployedCamera>, Option<OccupancyGrid>),
        playback: Playback,
    ) -> Result<Self, RunError> {
        let observer = observer(&config, &deployed);
        let (sources, sockets) = sources::open(&deployed, playback.every_frame)?;
        let cameras = Arc::new(Cameras::new(deployed.len()));
        let mut number = 0..;
        let numbers = deployed.iter().map(|it| it.is_placed.then(|| number.next()).flatten());
        let numbers = numbers.collect();
        let watch = Watch {
            cameras: Arc::clone(&cameras),
            standings: Standings::new(&deployed),
            plan: plan.map(Arc::new),
            deployed,
            delays: Delays::default(),
            _sockets: sockets,
        };
        let clock = Clock::new(playback.speed);
        let mut station = Self::with(config, life, links, keeper, (Eyes::Cameras(watch), clock))?;
        perceiving::start(Arc::clone(&cameras), observer, numbers, station.feed())?;
        // From zero, so that recorded frames have the times that they have for `watch`.
        station.clock = Clock::new(playback.speed);
        cameras.start(sources, station.clock)?;
        Ok(station)
    }

    fn with(
        config: Config,
        life: Life,
        ((wires, doors), keys): Connections,
        keeper: Option<Keeper>,
        (eyes, clock): (Eyes, Clock),
    ) -> Result<Self, RunError> {
        let registered = config.registry.footprints().map(|(robot, _)| robot).collect();
        let mut deployment = Deployment::new(config, life)?;
        let level = match eyes {
            Eyes::Bench(_) => Level::Info,
            Eyes::Cameras(_) => Level::Debug,
        };
        let policy = if keys.is_some() { Policy::Keyed } else { Policy::Open };
        for (robot, key) in keys.iter().flat_map(LiveKeys::all) {
            deployment.set_key(robot, key);
        }
        let links = Links::open(wires, doors, policy, &mut deployment, level)?;
        let buffer = vec![0; 4 * MAX_FRAME];
        let stopped = BTreeSet::new();
        Ok(Self {
            deployment,
            links,
            keeper,
            keys,
            eyes,
            clock,
            buffer,
            stops: 0,
            stopped,
            registered,
        })
    }

    /// The deployment.
    pub fn deployment(&self) -> &Deployment {
        &self.deployment
    }

    /// What other threads send messages with.
    pub(super) fn feed(&self) -> Feed<Message> {
        self.links.feed()
    }

    /// The time since the station started.
    pub fn now(&self) -> Instant {
        self.clock.now()
    }

    /// Whether any wire or socket is open.
    pub fn is_attached(&self) -> bool {
        self.links.is_open()
    }

    /// Lets all registered robots explore.
    pub(super) fn explore(&mut self, robots: impl IntoIterator<Item = RobotId>) {
        robots.into_iter().for_each(|robot| self.deployment.explore(robot, true));
    }

    /// Does the work that is due and processes input that arrives within a few milliseconds.
    pub fn turn(&mut self) {
        self.look();
        self.drain();
        let mut wait = self.wait();
        for _ in 0..ARRIVALS {
            let Some(arrival) = self.links.next_within(wait) else { break };
            match arrival {
                Arrival::Port { source, at, what } => {
                    let at = self.clock.at(at);
                    self.links.take(source, what, &mut self.deployment, at);
                    self.drain();
                }
                Arrival::Message(message) => self.hear(message),
            }
            wait = time::Duration::ZERO;
        }
        let now = self.now();
        self.follow_keys(now);
        self.links.follow_hang_ups(&mut self.deployment, now);
        self.deployment.timeout(now);
        self.drain();
    }

    /// Takes over keys that were made, replaced or retired.
    fn follow_keys(&mut self, now: Instant) {
        for change in self.keys.iter_mut().flat_map(|keys| keys.poll(now)) {
            match change {
                KeyChange::Given(robot, key) => {
                    self.deployment.set_key(robot, key);
                    log::info!("robot {} has a new key", robot.0);
                }
                KeyChange::Retired(robot) => {
                    self.deployment.retire_key(robot);
                    log::info!("robot {} has no key any more: it is shut out", robot.0);
                }
            }
        }
    }

    /// Lets the bench's camera look.
    fn look(&mut self) {
        let now = self.now();
        let Eyes::Bench(camera) = &mut self.eyes else { return };
        let stands = self.links.iter().filter_map(|(port, link)| {
            Some((self.deployment.port(port).ok()?.robot?, link.stands()?))
        });
        if let Some(observation) = camera.poll(now, stands) {
            self.deployment.observe(observation);
        }
    }

    fn hear(&mut self, message: Message) {
        match message {
            Message::Idle => {}
            Message::Whereabouts(captured, answer) => {
                let moment = self.deployment.server_time(captured);
                // Perception may be gone.
                let _ = answer.send(self.deployment.server().whereabouts(moment).collect());
            }
            Message::Perceived(perceived) => self.perceived(*perceived),
            Message::Request(request, answer) => {
                let answered = self.obey(request);
                self.drain();
                // Whoever has asked may be gone.
                let _ = answer.send(answered);
            }
        }
    }

    /// Takes what was seen in a frame, in the order of [`Deployment::frame`].
    fn perceived(&mut self, perceived: Perceived) {
        let Perceived { observation, events, moves, fault, arrived } = perceived;
        if let Some(fault) = fault {
            self.deployment.frame_error(fault, arrived);
        }
        for Move { camera, captured, change, before } in moves {
            if let Eyes::Cameras(watch) = &mut self.eyes {
                watch.standings.follow(camera, &change);
            }
            self.deployment.camera_moved(captured, camera, change, before.as_ref());
        }
        for (captured, event) in events {
            self.deployment.sighting_event(captured, event);
        }
        self.deployment.observe(observation);
        self.drain();
        let delay = self.now().since(arrived);
        if let Eyes::Cameras(watch) = &mut self.eyes {
            watch.delays.add(delay);
        }
    }

    /// Does what a command asks for. Returns the answer.
    fn obey(&mut self, request: Request) -> Result<String, String> {
        let now = self.now();
        match request {
            Request::Status | Request::Report => {
                let snapshot = self.snapshot().map_err(|error| error.to_string())?;
                Ok(match request {
                    Request::Report => json_pretty(&snapshot.report),
                    _ => snapshot.report.to_string(),
                })
            }
            Request::Go(robot, place) => {
                robots::commandable(&self.robots(), robot)?;
                self.deployment.goal(robot, place, now).map_err(|error| error.to_string())?;
                self.stop(robot, false)?;
                Ok(format!("robot {} goes to {} m, {} m\n", robot.0, place[0], place[1]))
            }
            Request::Stop(robot) => self.each(robot, true),
            Request::Explore(robot) => self.each(robot, false),
        }
    }

    /// Stops a robot, or all with a session, or lets them drive and explore.
    fn each(&mut self, robot: Option<RobotId>, stop: bool) -> Result<String, String> {
        let ports = self.deployment.status().ports;
        let robots: Vec<RobotId> = match robot {
            Some(robot) => {
                robots::commandable(&self.robots(), robot)?;
                vec![robot]
            }
            None => ports.iter().filter_map(|port| port.robot).collect(),
        };
        for &robot in &robots {
            self.deployment.explore(robot, !stop);
            self.stop(robot, stop)?;
        }
        let names: Vec<String> = robots.iter().map(|robot| robot.0.to_string()).collect();
        let what = if stop { "stopped" } else { "exploring" };
        Ok(format!(
            "{what}: {}\n",
            if names.is_empty() { "no robot: none is connected".into() } else { names.join(", ") }
        ))
    }

    fn stop(&mut self, robot: RobotId, stop: bool) -> Result<(), String> {
        self.stops += 1;
        let command = Command::Stop(Stop { number: self.stops, stop });
        self.deployment.command(robot, command).map_err(|error| error.to_string())?;
        match stop {
            true => self.stopped.insert(robot),
            false => self.stopped.remove(&robot),
        };
        Ok(())
    }

    /// Ends the service in order: tells all robots to stop, and writes what is not on disk yet.
    pub fn finish(&mut self) {
        self.deployment.stop_robots();
        let end = self.now() + FAREWELL;
        while self.is_attached() && self.now() < end {
            self.turn();
        }
        self.deployment.hasten_store(self.now());
        self.drain();
    }

    /// The time to wait for an arrival.
    fn wait(&self) -> time::Duration {
        let now = self.now();
        let bench = match &self.eyes {
            Eyes::Bench(camera) => Some(camera.next()),
            Eyes::Cameras(_) => None,
        };
        let due = self.deployment.poll_timeout(now).into_iter().chain(bench).min();
        let until_due = due.map_or(LONGEST_WAIT, |due| due.since(now)).min(LONGEST_WAIT);
        self.clock.until(now + until_due.max(SHORTEST_WAIT))
    }

    /// Drains the outputs.
    fn drain(&mut self) {
        let now = self.now();
        if let Some(keeper) = &mut self.keeper {
            keeper.keep_trying(&mut self.deployment, now);
        }
        while let Some((port, len)) = self.deployment.poll_transmit(now, &mut self.buffer) {
            self.links.write(port, &self.buffer[..len]);
        }
        while let Some((_, event)) = self.deployment.poll_event() {
            log::log!(self.level(&event), "{event}");
        }
    }

    /// With cameras, what is usual is summed up every minute instead, but for a robot that comes.
    fn level(&self, event: &Event) -> Level {
        match (event.level(), &self.eyes) {
            _ if matches!(event, Event::Server(server::Event::Joined(..))) => event.level(),
            (Level::Info, Eyes::Cameras(_)) => Level::Debug,
            (level, _) => level,
        }
    }

    /// The state of the robots at this time.
    fn robots(&self) -> Vec<ServedRobot> {
        let Self { deployment, links, registered, stopped, .. } = self;
        robots::robots(deployment, links, registered, stopped, self.now())
    }

    /// The report on the robots and cameras at this time.
    pub fn report(&self) -> ServeReport {
        let summary = |(port, link): (_, &Attached)| {
            link.summary(self.deployment.port(port).ok().as_ref(), self.deployment.server())
        };
        let now = self.now();
        let cameras = match &self.eyes {
            Eyes::Bench(_) => Vec::new(),
            Eyes::Cameras(Watch { cameras, deployed, standings, .. }) => {
                results::cameras(deployed, &cameras.states(), standings, &self.deployment, now)
            }
        };
        ServeReport {
            schema: ServeReport::SCHEMA,
            version: ServeReport::VERSION,
            robots: self.robots(),
            people: markers::tracked_people(&self.deployment, now),
            ports: self.links.iter().map(summary).collect(),
            cameras,
            delays: match &self.eyes {
                Eyes::Bench(_) => None,
                Eyes::Cameras(watch) => watch.delays.summary(),
            },
            camera_moves: figures::camera_moves(&self.deployment),
            map: None,
            unexplored: figures::unexplored(&self.deployment),
            plan: None,
            elapsed_s: self.now().micros() as f64 / 1e6,
            time_s: self.deployment.server_time(self.now()).micros() as f64 / 1e6,
            unix_s: time::UNIX_EPOCH.elapsed().unwrap_or_default().as_secs_f64(),
        }
    }

    /// The results at this time.
    ///
    /// # Errors
    /// [`RunError::Grid`].
    pub(super) fn snapshot(&self) -> Result<Snapshot, RunError> {
        let (report, now) = (self.report(), self.now());
        let Eyes::Cameras(watch) = &self.eyes else {
            return Snapshot::new(report, &self.deployment, [], None, now);
        };
        let is_out: Vec<bool> =
            report.cameras.iter().map(|camera| camera.away || camera.knocked).collect();
        let placed = watch.standings.placed().map(|(index, camera)| (camera, !is_out[index]));
        Snapshot::new(report, &self.deployment, placed, watch.plan.clone(), now)
    }

    /// One line about the results.
    pub(super) fn summary(&self, snapshot: &Snapshot) -> String {
        results::summary(&snapshot.report, snapshot.known_m2())
    }
}

/// Makes perception of the cameras with a pose.
fn observer(
    config: &Config,
    deployed: &[DeployedCamera],
) -> impl FnOnce() -> Result<Observer, RegistryError> + Send + 'static {
    let placed = deployed.iter().filter(|camera| camera.is_placed);
    let calibrations: Vec<_> = placed.map(|camera| camera.calibration).collect();
    let registry = config.registry.clone();
    let survey = registry.survey(config.resolution, config.obstacle_heights);
    move || registry.observer(&calibrations, survey)
}
