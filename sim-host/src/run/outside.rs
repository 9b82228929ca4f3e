//! A robot outside of the simulation, such as a board or an emulator: its three serial ports lead to
//! the server and to simulated devices in the simulated room, in real time.

use std::{path::PathBuf, str::FromStr, time};

use ubimap_agent::drive::DriveCommand;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::stage::Stage;
use crate::{
    channel::{serial::SerialPort, wire::WireError},
    deployment::{Deployment, Policy, PortId},
    devices::{SimA010, SimCreate2},
};

/// Speed of all three ports in bits per second.
const BAUD: u32 = 115_200;

/// Bytes read at once.
const CHUNK: usize = 512;

/// Maximum time for which a turn waits for bytes from the robot.
const MAX_WAIT: time::Duration = time::Duration::from_micros(500);

/// The serial ports of a robot outside, as `SERVER,SENSOR,WHEELS`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutsidePorts {
    /// The robot's port to the server.
    pub server: PathBuf,
    /// Its port to an A010.
    pub sensor: PathBuf,
    /// Its port to a Create 2.
    pub wheels: PathBuf,
}

/// The text does not name three ports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("must be three ports, SERVER,SENSOR,WHEELS")]
pub struct NotThreePorts;

impl FromStr for OutsidePorts {
    type Err = NotThreePorts;

    fn from_str(text: &str) -> Result<Self, NotThreePorts> {
        let parts: Vec<&str> = text.split(',').map(str::trim).collect();
        let [server, sensor, wheels] = parts[..] else { return Err(NotThreePorts) };
        let [server, sensor, wheels] = [server, sensor, wheels].map(PathBuf::from);
        Ok(Self { server, sensor, wheels })
    }
}

/// A robot outside, with its devices inside.
pub struct Outside {
    robot: RobotId,
    port: PortId,
    server: SerialPort,
    sensor: SerialPort,
    wheels: SerialPort,
    camera: SimA010,
    base: SimCreate2,
    /// The speed and the turn rate last passed to the stage.
    driven: [f64; 2],
    /// When the run began.
    began: time::Instant,
    /// How far the simulation was behind real time at most.
    late: Duration,
    /// The robot's reported poses.
    path: Vec<(Instant, Pose)>,
}

impl Outside {
    /// Opens the ports.
    ///
    /// # Errors
    /// [`WireError::Open`].
    pub fn open(
        robot: RobotId,
        ports: &OutsidePorts,
        deployment: &mut Deployment,
    ) -> Result<Self, WireError> {
        Ok(Self {
            robot,
            server: SerialPort::open(&ports.server, BAUD)?,
            sensor: SerialPort::open(&ports.sensor, BAUD)?,
            wheels: SerialPort::open(&ports.wheels, BAUD)?,
            port: deployment.open_port(Policy::Open),
            camera: SimA010::new(BAUD),
            base: SimCreate2::new(),
            driven: [0.0; 2],
            began: time::Instant::now(),
            late: Duration::default(),
            path: Vec::new(),
        })
    }

    /// The robot's number.
    pub fn id(&self) -> RobotId {
        self.robot
    }

    /// Its port at the deployment.
    pub fn port(&self) -> PortId {
        self.port
    }

    /// The poses that it has reported.
    pub fn path(&self) -> &[(Instant, Pose)] {
        &self.path
    }

    /// How far the simulation was behind real time at most.
    pub fn late(&self) -> Duration {
        self.late
    }

    /// The time since the run began.
    pub(super) fn now(&self) -> Instant {
        Instant(self.began.elapsed().as_micros() as u64)
    }

    /// Moves bytes between the robot, the server and its devices until `until` at the latest.
    /// Returns the time.
    ///
    /// # Errors
    /// A port has hung up.
    pub(super) fn exchange(
        &mut self,
        deployment: &mut Deployment,
        stage: &mut dyn Stage,
        until: Instant,
    ) -> Result<Instant, WireError> {
        let mut bytes = [0; CHUNK];
        self.late = self.late.max(self.now().since(until));
        let left = time::Duration::from_micros(until.since(self.now()).micros());
        let count = self.wheels.read_within(&mut bytes, left.min(MAX_WAIT))?;
        // The simulation may be late; its events are then caught up with one after the other.
        let now = self.now().min(until);
        self.base.receive(&bytes[..count], now);
        let count = self.sensor.read(&mut bytes)?;
        self.camera.receive(&bytes[..count], now);
        let count = self.server.read(&mut bytes)?;
        if count > 0 {
            let is_open = deployment.receive(self.port, &bytes[..count], now);
            debug_assert!(is_open.is_ok());
        }
        let commanded = self.base.commanded();
        if commanded != self.driven {
            self.driven = commanded;
            let [speed, turn] = commanded.map(|it| (it * 1_000.0).round() as i16);
            stage.drive(now, 0, DriveCommand { speed, turn });
        }
        if self.base.next_frame().is_some_and(|next| next <= now)
            && let Some((rolled, is_touching)) = stage.wheels(now, 0)
        {
            self.base.measure(rolled, is_touching, now);
        }
        send(&mut self.sensor, &self.camera.poll_transmit(now))?;
        send(&mut self.wheels, &self.base.poll_transmit(now))?;
        if let Some(state) = deployment.server().state(self.robot)
            && let Some((pose, at)) = state.pose.zip(state.time)
            && self.path.last().is_none_or(|(last, _)| *last < at)
        {
            self.path.push((deployment.since_began(at), pose));
        }
        Ok(now)
    }

    /// Sends a frame of the server to the robot.
    ///
    /// # Errors
    /// The port has hung up.
    pub(super) fn transmit(&mut self, frame: &[u8]) -> Result<(), WireError> {
        send(&mut self.server, frame)
    }

    /// Passes a scan to its camera.
    pub(super) fn scan(&mut self, readings: &[u16], taken: Instant) {
        self.camera.expose(readings, taken);
    }
}

/// Writes bytes to a port. A robot that accepts none loses them, as on a line without flow control.
fn send(port: &mut SerialPort, bytes: &[u8]) -> Result<(), WireError> {
    if bytes.is_empty() {
        return Ok(());
    }
    match port.write(bytes) {
        Err(WireError::Stalled { .. }) => Ok(()),
        other => other,
    }
}
