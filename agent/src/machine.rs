//! A robot with its depth sensor and its wheels, behind three ports.

use ubimap_protocol::{
    message::EventCode,
    time::{Duration, Instant},
};

use crate::{
    Robot,
    device::{DepthSensor, WheelReport, Wheels},
    drive::{Drive, DriveCommand, NoDrive, StopReason},
};

/// Time for which a robot stands after its bumper has touched something.
const AFTER_BUMP: Duration = Duration::from_secs(2);

/// Time for which a robot stands after another stop by the base, which is repeated while its cause
/// lasts.
const AFTER_STOP: Duration = Duration::from_millis(500);

/// A port of a [`Machine`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Port {
    /// The link to the server.
    Server,
    /// The depth sensor.
    Sensor,
    /// The controller of the wheels.
    Wheels,
}

/// A robot with the drivers of its sensor and its wheels. All input and output are bytes at three
/// ports, so the same code runs in a firmware, in the simulator and in tests.
///
/// **The driving law**: after every input ([`receive`](Self::receive), [`timeout`](Self::timeout))
/// drain [`poll_transmit`](Self::poll_transmit) for each port that has room, and call `timeout` no
/// later than [`poll_timeout`](Self::poll_timeout):
///
/// ```
/// use ubimap_agent::{
///     Bounds, Config, Machine, Memory, Port, Robot,
///     device::{
///         a010::{A010, A010Config},
///         create2::Create2,
///     },
///     drive::Driving,
///     memory,
///     sense::{Camera, Pick, Slice, Slicer, Validity},
/// };
/// use ubimap_protocol::{time::Instant, units::RobotId};
///
/// const SENSOR: A010Config = A010Config::for_port(115_200).unwrap();
/// const SIDE: usize = SENSOR.binning.side();
/// const SLICE: Slice = Slice::Band { first: 11, rows: 3, pick: Pick::Nearest };
/// const BOUNDS: Bounds = Bounds { readings: SIDE, ..Bounds::REFERENCE };
///
/// let camera = Camera::new((15.4, 15.4), (12.0, 12.0));
/// let config = Config::new(RobotId(1), SLICE.sensor(camera), BOUNDS);
/// let mut memory: Box<memory!(BOUNDS, Driving)> = Box::new(Memory::EMPTY);
/// let robot = Robot::new(config.with_drive(Driving::default()), &mut memory)?;
/// let mut buffer = [0; SLICE.buffer_len(SIDE)];
/// let slicer = Slicer::new(SLICE, camera, SIDE, Validity::default(), &mut buffer)?;
/// let mut machine = Machine::new(robot, A010::new(SENSOR, slicer)?, Create2::new());
///
/// let (now, mut out) = (Instant(0), [0; 250]);
/// for port in [Port::Server, Port::Sensor, Port::Wheels] {
///     machine.receive(port, b"", now);
/// }
/// machine.timeout(now);
/// assert_eq!(machine.poll_transmit(Port::Sensor, now, &mut out), Some(10));
/// assert_eq!(&out[..10], b"AT+DISP=0\r");
/// # Ok::<(), Box<dyn core::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Machine<'b, S, W, D: Drive = NoDrive> {
    robot: Robot<'b, D>,
    sensor: S,
    wheels: W,
    /// Whether a bumper touches something.
    is_touching: bool,
}

impl<'b, S: DepthSensor, W: Wheels, D: Drive> Machine<'b, S, W, D> {
    /// A robot with its devices, none of which has been heard yet.
    pub fn new(robot: Robot<'b, D>, sensor: S, wheels: W) -> Self {
        Self { robot, sensor, wheels, is_touching: false }
    }

    /// Processes bytes that had arrived at a port by `now`, in pieces of any size.
    pub fn receive(&mut self, port: Port, mut bytes: &[u8], now: Instant) {
        match port {
            Port::Server => self.robot.receive(bytes, now),
            Port::Sensor => {
                while let Some(scan) = self.sensor.receive(&mut bytes, now) {
                    // The robot counts a refused scan and reports it to the server.
                    let _ = self.robot.scan(scan.taken, scan.readings, now);
                }
            }
            Port::Wheels => {
                while let Some(report) = self.wheels.receive(&mut bytes, now) {
                    self.robot.odometry(report.moment, report.pose, now);
                    self.heed(&report, now);
                }
                self.drive(now);
            }
        }
    }

    /// Does the work that is due at `now`.
    pub fn timeout(&mut self, now: Instant) {
        if self.wheels.is_silent(now) {
            self.robot.stop(StopReason::WheelsSilent, Some(now + AFTER_STOP), now);
        }
        self.robot.timeout(now);
        self.drive(now);
    }

    /// Writes the next bytes for a port into `out`, which should hold 250 bytes. Returns their
    /// number.
    #[must_use]
    pub fn poll_transmit(&mut self, port: Port, now: Instant, out: &mut [u8]) -> Option<usize> {
        match port {
            Port::Server => self.robot.poll_transmit(now, out),
            Port::Sensor => self.sensor.poll_transmit(now, out),
            Port::Wheels => self.wheels.poll_transmit(now, out),
        }
    }

    /// The latest time for the next calls of [`Machine::timeout`] and then
    /// [`Machine::poll_transmit`].
    pub fn poll_timeout(&self) -> Instant {
        let devices = self.sensor.poll_timeout().min(self.wheels.poll_timeout());
        self.robot.poll_timeout().min(devices)
    }

    /// The command that the wheels follow. Against something that the bumper touches the robot does
    /// not drive forward.
    pub fn command(&self) -> DriveCommand {
        let command = self.robot.command();
        if self.is_touching {
            DriveCommand { speed: command.speed.min(0), ..command }
        } else {
            command
        }
    }

    /// Stops the wheels at once, as [`Robot::stop`].
    pub fn stop(&mut self, reason: StopReason, until: Option<Instant>, now: Instant) {
        self.robot.stop(reason, until, now);
        self.drive(now);
    }

    /// Ends all stops, as [`Robot::resume`].
    pub fn resume(&mut self) {
        self.robot.resume();
    }

    /// Reports to the server that the watchdog has reset the robot.
    pub fn report_watchdog(&mut self, now: Instant) {
        self.robot.report(EventCode::Watchdog, now);
    }

    /// The robot.
    pub fn robot(&self) -> &Robot<'b, D> {
        &self.robot
    }

    /// The sensor's driver.
    pub fn sensor(&self) -> &S {
        &self.sensor
    }

    /// The wheels' driver.
    pub fn wheels(&self) -> &W {
        &self.wheels
    }

    /// Stops for what the base reports.
    fn heed(&mut self, report: &WheelReport, now: Instant) {
        let touched = report.stop == Some(StopReason::Bumper);
        match report.stop {
            // While the bumper stays pressed, the robot may turn away after a while.
            Some(StopReason::Bumper) if self.is_touching => {}
            Some(StopReason::Bumper) => {
                self.robot.stop(StopReason::Bumper, Some(now + AFTER_BUMP), now);
            }
            Some(reason) => self.robot.stop(reason, Some(now + AFTER_STOP), now),
            None => {}
        }
        self.is_touching = touched;
    }

    /// Passes the command to the wheels.
    fn drive(&mut self, now: Instant) {
        self.wheels.drive(self.command(), now);
    }
}
