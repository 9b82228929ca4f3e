//! A robot outside, with its devices inside.

use ubimap_agent::drive::DriveCommand;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::{
    in_step::InStep,
    link::{BAUD, Link},
    serial_ports::{self, SerialPorts},
};
use crate::{
    channel::wire::WireError,
    deployment::{Deployment, Policy, PortId},
    devices::{SimA010, SimCreate2},
    run::stage::Stage,
};

/// A robot outside, with its devices inside.
pub struct Outside {
    robot: RobotId,
    port: PortId,
    link: Box<dyn Link>,
    camera: SimA010,
    base: SimCreate2,
    /// The speed and the turn rate last passed to the stage.
    driven: [f64; 2],
    /// The robot's reported poses.
    path: Vec<(Instant, Pose)>,
}

/// Where a robot outside is.
#[derive(Clone, Debug)]
pub enum Place {
    /// At serial ports.
    Ports(serial_ports::Paths),
    /// In a process of this command.
    Command(String),
}

impl Outside {
    /// Connects a robot. `seed` sets the drift of its clock if it is a command.
    ///
    /// # Errors
    /// [`WireError::Open`].
    pub fn open(
        robot: RobotId,
        place: &Place,
        seed: u64,
        deployment: &mut Deployment,
    ) -> Result<Self, WireError> {
        Ok(Self {
            robot,
            link: match place {
                Place::Ports(paths) => Box::new(SerialPorts::open(paths)?),
                Place::Command(command) => Box::new(InStep::start(command, robot, seed)?),
            },
            port: deployment.open_port(Policy::Open),
            camera: SimA010::new(BAUD),
            base: SimCreate2::new(),
            driven: [0.0; 2],
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

    /// How far the simulation was behind real time at most, if the robot's time is real.
    pub fn late(&self) -> Option<Duration> {
        self.link.late()
    }

    /// Moves bytes between the robot, the server and its devices until `until` at the latest.
    /// Returns the time.
    ///
    /// # Errors
    /// The robot has hung up.
    pub(in crate::run) fn exchange(
        &mut self,
        deployment: &mut Deployment,
        stage: &mut dyn Stage,
        until: Instant,
    ) -> Result<Instant, WireError> {
        let (now, [server, sensor, wheels]) = self.link.receive(until)?;
        self.base.receive(&wheels, now);
        self.camera.receive(&sensor, now);
        if !server.is_empty() {
            let is_open = deployment.receive(self.port, &server, now);
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
        self.link.send([self.camera.poll_transmit(now), self.base.poll_transmit(now)])?;
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
    /// The robot has hung up.
    pub(in crate::run) fn transmit(&mut self, frame: &[u8], now: Instant) -> Result<(), WireError> {
        self.link.transmit(frame, now)
    }

    /// Passes a scan to its camera.
    pub(in crate::run) fn scan(&mut self, readings: &[u16], taken: Instant) {
        self.camera.expose(readings, taken);
    }
}
