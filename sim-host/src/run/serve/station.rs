//! A deployment with its wires, driven by the wall clock.

use std::{thread, time};

use ubimap_protocol::{
    frame::MAX_FRAME,
    time::{Duration, Instant},
    units::Millimetres,
};

use super::{attached::Attached, bench_camera::BenchCamera};
use crate::{
    deployment::{Config, Deployment, Life, Policy, PortId},
    report::ServeReport,
    run::{RunError, keeper::Keeper},
};

/// Maximum wait for a byte, shared by all ports. Bytes that arrive at another port meanwhile get a
/// time that is late by up to this.
const LONGEST_WAIT: Duration = Duration::from_millis(4);
/// Minimum wait, so that the processor can idle.
const SHORTEST_WAIT: Duration = Duration::from_millis(1);
/// Time for the last messages to the robots: enough for one retransmission.
const FAREWELL: Duration = Duration::from_millis(500);

/// A deployment with its wires, driven by the wall clock.
pub struct Station {
    deployment: Deployment,
    /// Each wire with its port; a wire that was opened again has a new port.
    ports: Vec<(PortId, Attached)>,
    keeper: Option<Keeper>,
    camera: BenchCamera,
    started: time::Instant,
    buffer: Vec<u8>,
}

impl Station {
    /// Starts a deployment. Its records go to the keeper, if there is one.
    ///
    /// # Errors
    /// [`RunError::Registry`], which a deployment without markers does not return.
    pub fn new(
        resolution: Millimetres,
        life: Life,
        wires: Vec<Attached>,
        keeper: Option<Keeper>,
    ) -> Result<Self, RunError> {
        let mut deployment = Deployment::new(Config::new(resolution), life)?;
        let ports =
            wires.into_iter().map(|wire| (deployment.open_port(Policy::Open), wire)).collect();
        Ok(Self {
            deployment,
            ports,
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

    /// Whether any wire is open.
    pub fn is_attached(&self) -> bool {
        self.open() > 0
    }

    /// Number of open wires.
    fn open(&self) -> u64 {
        self.ports.iter().filter(|(_, wire)| wire.is_open()).count() as u64
    }

    /// Does the work that is due and processes input that arrives within a few milliseconds.
    pub fn turn(&mut self) {
        let now = self.now();
        let stands = self.ports.iter().filter_map(|(port, wire)| {
            Some((self.deployment.port(*port).ok()?.robot?, wire.stands()?))
        });
        if let Some(observation) = self.camera.poll(now, stands) {
            self.deployment.observe(observation);
        }
        self.drain();
        let wait = self.wait();
        if !self.is_attached() {
            thread::sleep(wait);
        }
        for index in 0..self.ports.len() {
            self.receive(index, wait);
            self.drain();
        }
        self.follow_hang_ups();
        self.deployment.timeout(self.now());
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

    /// Closes the ports of wires that have hung up, and opens a port for each that has come back.
    fn follow_hang_ups(&mut self) {
        let now = self.now();
        for (port, wire) in &mut self.ports {
            if wire.is_open() {
                continue;
            }
            if let Ok(status) = self.deployment.port(*port) {
                wire.end_link(&status);
                // The port is open: it has a status.
                let _ = self.deployment.close_port(*port);
            }
            if wire.reopen(now) {
                *port = self.deployment.open_port(Policy::Open);
            }
        }
    }

    /// The time to wait at each port.
    fn wait(&self) -> time::Duration {
        let now = self.now();
        let due = self.deployment.poll_timeout(now).into_iter().chain([self.camera.next()]).min();
        let until_due = due.map_or(LONGEST_WAIT, |due| due.since(now)).min(LONGEST_WAIT);
        let wait = Duration(until_due.micros() / self.open().max(1)).max(SHORTEST_WAIT);
        time::Duration::from_micros(wait.micros())
    }

    fn receive(&mut self, index: usize, wait: time::Duration) {
        let Some((port, wire)) = self.ports.get_mut(index) else { return };
        let count = wire.read_within(&mut self.buffer, wait);
        if count == 0 {
            return;
        }
        let now = Instant(self.started.elapsed().as_micros() as u64);
        // The port is open: the wire has not hung up.
        let _ = self.deployment.receive(*port, &self.buffer[..count], now);
        if let Ok(status) = self.deployment.port(*port) {
            wire.note(&status, self.deployment.server_time(now));
        }
    }

    /// Drains the outputs.
    fn drain(&mut self) {
        let now = self.now();
        if let Some(keeper) = &mut self.keeper {
            keeper.keep_trying(&mut self.deployment, now);
        }
        while let Some((port, len)) = self.deployment.poll_transmit(now, &mut self.buffer) {
            if let Some((_, wire)) = self.ports.iter_mut().find(|(id, _)| *id == port) {
                wire.write(&self.buffer[..len]);
            }
        }
        while let Some((_, event)) = self.deployment.poll_event() {
            log::log!(event.level(), "{event}");
        }
    }

    /// The report on the robots at this time.
    pub fn report(&self) -> ServeReport {
        let summary = |(port, wire): &(PortId, Attached)| {
            wire.summary(self.deployment.port(*port).ok().as_ref(), self.deployment.server())
        };
        ServeReport {
            schema: ServeReport::SCHEMA,
            version: ServeReport::VERSION,
            ports: self.ports.iter().map(summary).collect(),
            elapsed_s: self.started.elapsed().as_secs_f64(),
        }
    }
}
