//! A deployment with its wires, driven by the wall clock.

use std::time;

use ubimap_protocol::{
    frame::{Key, MAX_FRAME},
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::{
    attached::Attached,
    bench_camera::BenchCamera,
    links::{Door, Links},
};
use crate::{
    deployment::{Config, Deployment, Life, Policy},
    report::ServeReport,
    run::{RunError, keeper::Keeper},
};

/// Maximum wait for an arrival, so that hang-ups and signals are noticed.
const LONGEST_WAIT: Duration = Duration::from_millis(20);
/// Maximum number of arrivals that are handled before other work that is due.
const ARRIVALS: usize = 64;
/// Minimum wait, so that the processor can idle.
const SHORTEST_WAIT: Duration = Duration::from_millis(1);
/// Time for the last messages to the robots: enough for one retransmission.
const FAREWELL: Duration = Duration::from_millis(500);

/// A deployment with its wires, driven by the wall clock.
pub struct Station {
    deployment: Deployment,
    links: Links,
    keeper: Option<Keeper>,
    camera: BenchCamera,
    started: time::Instant,
    buffer: Vec<u8>,
}

impl Station {
    /// Starts a deployment. With `keys` all of its ports are keyed. Its records go to the keeper, if there is one.
    ///
    /// # Errors
    /// [`RunError::Port`] if no thread can be started; [`RunError::Registry`], which a deployment
    /// without markers does not return.
    pub fn new(
        resolution: Millimetres,
        life: Life,
        (wires, doors): (Vec<Attached>, Vec<Door>),
        keys: Option<Vec<(RobotId, Key)>>,
        keeper: Option<Keeper>,
    ) -> Result<Self, RunError> {
        let mut deployment = Deployment::new(Config::new(resolution), life)?;
        let policy = if keys.is_some() { Policy::Keyed } else { Policy::Open };
        for (robot, key) in keys.into_iter().flatten() {
            deployment.set_key(robot, key);
        }
        let links = Links::open(wires, doors, policy, &mut deployment)?;
        Ok(Self {
            deployment,
            links,
            keeper,
            camera: BenchCamera::default(),
            started: time::Instant::now(),
            buffer: vec![0; 4 * MAX_FRAME],
        })
    }

    /// The deployment.
    pub fn deployment(&self) -> &Deployment {
        &self.deployment
    }

    /// The time since the station started.
    pub fn now(&self) -> Instant {
        Instant(self.started.elapsed().as_micros() as u64)
    }

    /// Whether any wire or socket is open.
    pub fn is_attached(&self) -> bool {
        self.links.is_open()
    }

    /// Does the work that is due and processes input that arrives within a few milliseconds.
    pub fn turn(&mut self) {
        let now = self.now();
        let stands = self.links.iter().filter_map(|(port, link)| {
            Some((self.deployment.port(port).ok()?.robot?, link.stands()?))
        });
        if let Some(observation) = self.camera.poll(now, stands) {
            self.deployment.observe(observation);
        }
        self.drain();
        let mut wait = self.wait();
        for _ in 0..ARRIVALS {
            let Some(arrival) = self.links.next_within(wait) else { break };
            let at = Instant(arrival.at.duration_since(self.started).as_micros() as u64);
            self.links.take(arrival, &mut self.deployment, at);
            self.drain();
            wait = time::Duration::ZERO;
        }
        let now = self.now();
        self.links.follow_hang_ups(&mut self.deployment, now);
        self.deployment.timeout(now);
        self.drain();
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
        let due = self.deployment.poll_timeout(now).into_iter().chain([self.camera.next()]).min();
        let until_due = due.map_or(LONGEST_WAIT, |due| due.since(now)).min(LONGEST_WAIT);
        time::Duration::from_micros(until_due.max(SHORTEST_WAIT).micros())
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
            log::log!(event.level(), "{event}");
        }
    }

    /// The report on the robots at this time.
    pub fn report(&self) -> ServeReport {
        let summary = |(port, link): (_, &Attached)| {
            link.summary(self.deployment.port(port).ok().as_ref(), self.deployment.server())
        };
        ServeReport {
            schema: ServeReport::SCHEMA,
            version: ServeReport::VERSION,
            ports: self.links.iter().map(summary).collect(),
            elapsed_s: self.started.elapsed().as_secs_f64(),
        }
    }
}
