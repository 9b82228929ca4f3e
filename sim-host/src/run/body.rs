//! A simulated robot's software: a robot that gets scans or pictures and odometry, or a machine that
//! gets the bytes of simulated devices.

use ubimap_agent::{
    Config, ConfigError, Machine, Memory, Port, Robot,
    device::{
        a010::{A010, A010Config},
        create2::Create2,
    },
    drive::{DriveCommand, Driving},
    journal::Entry,
    sense::{Camera, Pick, SensorModel, Slice, Slicer, Validity},
};
use ubimap_protocol::{frame::DEFAULT_FRAME, time::Instant, units::Pose};

use super::{
    grey_robot::{GreyRobot, Sight},
    heap::Heap,
};
use crate::devices::{SimA010, SimCreate2};

/// The speed of a robot's ports in bits per second.
const BAUD: u32 = 115_200;

/// The configuration of the depth camera of all machines.
pub(super) const CAMERA: A010Config = match A010Config::for_port(BAUD) {
    Some(config) => config,
    None => panic!("the port carries the coarsest images"),
};

/// The rows of an image that are mapped: the middle ones.
const SLICE: Slice =
    Slice::Band { first: (CAMERA.binning.side() / 2 - 1) as u16, rows: 3, pick: Pick::Nearest };

/// Size of a machine's buffer for its depth camera, in readings.
pub(super) const BUFFER: usize = SLICE.buffer_len(CAMERA.binning.side());

/// A robot's software.
pub(super) enum Body<'b> {
    Robot(Box<Robot<'b, Option<Driving>>>),
    Grey(Box<GreyRobot<'b>>),
    Machine(Box<Wired<'b>>),
}

/// A machine with its simulated devices. Times are by the clock given in each call: the machine's for
/// its inputs, the run's for those of the devices.
pub(super) struct Wired<'b> {
    machine: Machine<'b, A010<'b>, Create2, Option<Driving>>,
    camera: SimA010,
    base: SimCreate2,
    journal: Option<Journal<'b>>,
}

/// Called with every input and output of a machine, and its time by the robot's clock.
pub(super) type Journal<'j> = Box<dyn FnMut(Instant, Entry<'_>) + 'j>;

impl<'b> Body<'b> {
    /// A robot that has just booted; with a buffer of [`BUFFER`] readings, a machine; with a sight, a
    /// robot that gets pictures.
    pub(super) fn new(
        config: Config<Option<Driving>>,
        memory: &'b mut Memory<Heap, Option<Driving>>,
        buffer: Option<&'b mut [u16]>,
        sight: Option<Sight>,
    ) -> Result<Self, ConfigError> {
        if let Some(sight) = sight {
            return Ok(Self::Grey(Box::new(GreyRobot::new(config, memory, sight)?)));
        }
        let camera = buffer.and_then(|buffer| camera(config.sensor, buffer));
        Ok(match camera {
            None => Self::Robot(Box::new(Robot::new(config, memory)?)),
            Some(camera) => Self::Machine(Box::new(Wired {
                machine: Machine::new(config, memory, camera, Create2::new())?,
                camera: SimA010::new(BAUD),
                base: SimCreate2::new(),
                journal: None,
            })),
        })
    }

    /// The robot itself.
    pub(super) fn robot(&self) -> &Robot<'b, Option<Driving>> {
        match self {
            Self::Robot(robot) => robot,
            Self::Grey(grey) => &grey.robot,
            Self::Machine(wired) => wired.machine.robot(),
        }
    }

    /// Calls `journal` with every input and output of a machine from now on.
    pub(super) fn keep_journal(&mut self, journal: Journal<'b>) {
        if let Self::Machine(wired) = self {
            wired.journal = Some(journal);
        }
    }

    /// Passes bytes from the server.
    pub(super) fn receive(&mut self, bytes: &[u8], local: Instant) {
        match self {
            Self::Robot(robot) => robot.receive(bytes, local),
            Self::Grey(grey) => grey.robot.receive(bytes, local),
            Self::Machine(wired) => wired.receive(Port::Server, bytes, local),
        }
    }

    /// Passes a scan to the robot, or to the camera of the machine.
    pub(super) fn scan(&mut self, readings: &[u16], local: Instant, now: Instant) {
        match self {
            Self::Robot(robot) => {
                if let Err(error) = robot.scan(local, readings, local) {
                    // The robot's statistics count dropped scans.
                    log::debug!("robot {}: scan dropped: {error}", robot.settings().robot.0);
                }
            }
            // It has no range sensor.
            Self::Grey(_) => {}
            Self::Machine(wired) => wired.camera.expose(readings, now),
        }
    }

    /// Passes a picture to a robot with a grey camera.
    pub(super) fn look(&mut self, picture: &[u8], local: Instant) {
        if let Self::Grey(grey) = self {
            grey.look(picture, local);
        }
    }

    /// Passes odometry to a robot; a machine has wheels instead.
    pub(super) fn odometry(&mut self, pose: Pose, local: Instant) {
        match self {
            Self::Robot(robot) => robot.odometry(local, pose, local),
            Self::Grey(grey) => grey.odometry(pose, local),
            Self::Machine(_) => {}
        }
    }

    /// Does the work that is due.
    pub(super) fn timeout(&mut self, local: Instant, now: Instant) {
        match self {
            Self::Robot(robot) => robot.timeout(local),
            Self::Grey(grey) => grey.timeout(local),
            Self::Machine(wired) => wired.exchange(local, now),
        }
    }

    /// Writes the next frame to the server. Returns its length.
    pub(super) fn poll_transmit(&mut self, local: Instant, out: &mut [u8]) -> Option<usize> {
        match self {
            Self::Robot(robot) => robot.poll_transmit(local, out),
            Self::Grey(grey) => grey.robot.poll_transmit(local, out),
            Self::Machine(wired) => wired.poll_transmit(Port::Server, local, out),
        }
    }

    /// The command that the wheels follow.
    pub(super) fn command(&self) -> DriveCommand {
        match self {
            Self::Robot(robot) => robot.command(),
            Self::Grey(grey) => grey.command(),
            Self::Machine(wired) => {
                let [speed, turn] = wired.base.commanded().map(|it| (it * 1_000.0).round() as i16);
                DriveCommand { speed, turn }
            }
        }
    }

    /// The deadline for the next call of [`Body::timeout`] by the robot's clock, and by the run's.
    pub(super) fn poll_timeout(&self) -> (Instant, Option<Instant>) {
        match self {
            Self::Robot(robot) => (robot.poll_timeout(), None),
            Self::Grey(grey) => (grey.robot.poll_timeout(), None),
            Self::Machine(wired) => {
                let devices = [wired.camera.poll_timeout(), wired.base.poll_timeout()];
                (wired.machine.poll_timeout(), devices.into_iter().flatten().min())
            }
        }
    }

    /// When the wheels of a machine measure next, by the run's clock.
    pub(super) fn next_measurement(&self) -> Option<Instant> {
        match self {
            Self::Robot(_) | Self::Grey(_) => None,
            Self::Machine(wired) => wired.base.next_frame(),
        }
    }

    /// Passes what the wheels have measured to the base of a machine.
    pub(super) fn measure(&mut self, rolled: [f64; 2], is_touching: bool, now: Instant) {
        if let Self::Machine(wired) = self {
            wired.base.measure(rolled, is_touching, now);
        }
    }
}

impl Wired<'_> {
    /// Moves bytes between the machine and its devices until there are none.
    fn exchange(&mut self, local: Instant, now: Instant) {
        let (pixels, frames) = (self.camera.poll_transmit(now), self.base.poll_transmit(now));
        self.receive(Port::Sensor, &pixels, local);
        self.receive(Port::Wheels, &frames, local);
        self.note(local, Entry::Timeout);
        self.machine.timeout(local);
        let mut bytes = [0; 64];
        while let Some(count) = self.poll_transmit(Port::Sensor, local, &mut bytes) {
            self.camera.receive(&bytes[..count], now);
        }
        while let Some(count) = self.poll_transmit(Port::Wheels, local, &mut bytes) {
            self.base.receive(&bytes[..count], now);
        }
    }

    /// Passes bytes to the machine, as many at once as a firmware reads.
    fn receive(&mut self, port: Port, bytes: &[u8], local: Instant) {
        for bytes in bytes.chunks(DEFAULT_FRAME) {
            self.note(local, Entry::Received(port, bytes));
            self.machine.receive(port, bytes, local);
        }
    }

    fn poll_transmit(&mut self, port: Port, local: Instant, out: &mut [u8]) -> Option<usize> {
        let count = self.machine.poll_transmit(port, local, out);
        let bytes = count.and_then(|count| out.get(..count)).unwrap_or_default();
        self.note(local, Entry::Transmitted(port, bytes));
        count
    }

    fn note(&mut self, local: Instant, entry: Entry<'_>) {
        if let Some(journal) = &mut self.journal {
            journal(local, entry);
        }
    }
}

/// The driver of a depth camera with this model; `None` if it is not the camera of machines.
pub(super) fn camera(sensor: SensorModel, buffer: &mut [u16]) -> Option<A010<'_>> {
    let camera = match sensor {
        SensorModel::Pinhole { focal, centre } => Camera::new((focal, focal), (centre, centre)),
        SensorModel::Row { camera, .. } => camera,
        SensorModel::Radial { .. } => return None,
    };
    let side = CAMERA.binning.side();
    let slicer = Slicer::new(SLICE, camera, side, Validity::default(), buffer).ok()?;
    A010::new(CAMERA, slicer).ok()
}
