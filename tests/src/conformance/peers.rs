//! The agent and the server as peers of the runner.

use std::fmt;

use ubimap_agent::{Bounds, Config, Memory, Robot, Seal, memory, sense::SensorModel};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, Key, MAX_FRAME},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::deployment::{self, Deployment, Kept, Life, Policy, PortId};

use super::virtual_bench::Peer;
use crate::deployments::bare;

const BOUNDS: Bounds = Bounds { readings: 64, fused_tiles: 16, ..Bounds::REFERENCE };
/// Intervals of odometry and scans.
const ODOMETRY: Duration = Duration::from_millis(50);
const SCANS: Duration = Duration::from_millis(200);
/// The door beside the robot opens and shuts this often, so that its map changes.
const DOOR: u64 = 5_000_000;

/// An agent that stands in a room with a door.
pub struct RobotPeer {
    robot: Robot<'static>,
    next_odometry: Instant,
    next_scan: Instant,
}

impl fmt::Debug for RobotPeer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("RobotPeer")
    }
}

/// The robot of the peers, and its key.
pub const KEY: (RobotId, Key) = (RobotId(7), Key::new([0x5A; 16]));

impl Default for RobotPeer {
    fn default() -> Self {
        Self::new(None)
    }
}

impl RobotPeer {
    /// A robot that seals its link.
    pub fn sealed() -> Self {
        Self::new(Some(Seal { key: KEY.1, boot: 3 }))
    }

    fn new(seal: Option<Seal>) -> Self {
        let memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
        let sensor = SensorModel::Radial { first: -1.6, step: 0.05 };
        let config = Config::new(KEY.0, sensor, BOUNDS);
        let config = Config { boot_nonce: 0x00B0_0700, seal, keeps_parameters: true, ..config };
        // It lives as long as the test.
        let robot = Robot::new(config, Box::leak(memory)).expect("the memory fits its bounds");
        Self { robot, next_odometry: Instant(0), next_scan: Instant(0) }
    }
}

impl Peer for RobotPeer {
    fn receive(&mut self, bytes: &[u8], now: Instant) {
        self.robot.receive(bytes, now);
    }

    fn poll_transmit(&mut self, now: Instant) -> Option<Vec<u8>> {
        let mut out = [0; DEFAULT_FRAME];
        let len = self.robot.poll_transmit(now, &mut out)?;
        Some(out[..len].to_vec())
    }

    fn poll_timeout(&self, _: Instant) -> Option<Instant> {
        Some(self.robot.poll_timeout().min(self.next_odometry).min(self.next_scan))
    }

    fn timeout(&mut self, now: Instant) {
        if self.next_odometry <= now {
            self.next_odometry = now + ODOMETRY;
            self.robot.odometry(now, Pose::default(), now);
        }
        if self.next_scan <= now {
            self.next_scan = now + SCANS;
            let is_open = now.micros() / DOOR % 2 == 1;
            let range = |beam: usize| if is_open && beam < 20 { 1_500 } else { 1_100 };
            let readings: [u16; BOUNDS.readings] = core::array::from_fn(range);
            // The robot counts a refused scan.
            let _ = self.robot.scan(now, &readings, now);
        }
        self.robot.timeout(now);
    }
}

/// A deployment without cameras, with one port.
#[derive(Debug)]
pub struct ServerPeer {
    deployment: Deployment,
    port: PortId,
}

impl Default for ServerPeer {
    fn default() -> Self {
        Self::new(Policy::Open, bare(Millimetres(50)))
    }
}

impl ServerPeer {
    /// A server with a keyed port.
    pub fn sealed() -> Self {
        Self::new(Policy::Keyed, bare(Millimetres(50)))
    }

    /// A server whose records are on disk at once.
    ///
    /// # Panics
    /// Never: there are no markers to confuse.
    pub fn storing() -> Self {
        let life = Life { kept: Some(Kept::default()), ..Life::default() };
        let deployment = Deployment::new(deployment::Config::new(Millimetres(50)), life);
        Self::new(Policy::Open, deployment.expect("there are no markers to confuse"))
    }

    fn new(policy: Policy, mut deployment: Deployment) -> Self {
        deployment.set_key(KEY.0, KEY.1);
        let port = deployment.open_port(policy);
        Self { deployment, port }
    }
}

impl Peer for ServerPeer {
    /// # Panics
    /// Never: the port is open.
    fn receive(&mut self, bytes: &[u8], now: Instant) {
        self.deployment.receive(self.port, bytes, now).expect("the port is open");
    }

    fn poll_transmit(&mut self, now: Instant) -> Option<Vec<u8>> {
        while let Some(batch) = self.deployment.poll_store(now) {
            self.deployment.stored(batch);
        }
        let mut out = [0; MAX_FRAME];
        let (_, len) = self.deployment.poll_transmit(now, &mut out)?;
        Some(out[..len].to_vec())
    }

    fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        self.deployment.poll_timeout(now)
    }

    fn timeout(&mut self, now: Instant) {
        self.deployment.timeout(now);
        while self.deployment.poll_event().is_some() {}
    }
}
