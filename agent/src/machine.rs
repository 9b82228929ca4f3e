//! A robot with its depth sensor and its wheels, behind three ports.

use heapless::Vec;
use ubimap_protocol::{
    message::{EventCode, MAX_PARAMETERS, ParameterValue},
    time::{Duration, Instant},
};

use crate::{
    Config, ConfigError, Memory, Robot, Slices, Storage,
    device::{
        DepthSensor, WheelReport, Wheels,
        pwm_motors::{PoweredMotor, PwmMotors},
    },
    drive::{Drive, DriveCommand, NoDrive, StopReason},
};

/// Time for which a robot stands after its bumper has touched something.
const AFTER_BUMP: Duration = Duration::from_secs(2);

/// Time for which a robot stands after another stop by the base, which is repeated while its cause
/// lasts.
const AFTER_STOP: Duration = Duration::from_millis(500);

/// Time after which wheels that are told to stand do so: they are slowed down by 0.8 m/s^2.
const STANDSTILL: Duration = Duration::from_secs(1);

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

impl Port {
    /// All ports of a machine.
    pub const ALL: [Self; 3] = [Self::Server, Self::Sensor, Self::Wheels];
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
///     Bounds, Config, Machine, Memory, Port,
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
/// let mut buffer = [0; SLICE.buffer_len(SIDE)];
/// let slicer = Slicer::new(SLICE, camera, SIDE, Validity::default(), &mut buffer)?;
/// let sensor = A010::new(SENSOR, slicer)?;
/// let config = config.with_drive(Driving::default());
/// let mut machine = Machine::new(config, &mut memory, sensor, Create2::new())?;
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
    /// When the wheels were last told to turn.
    turned: Option<Instant>,
}

impl<'b, S: DepthSensor, W: Wheels, D: Drive> Machine<'b, S, W, D> {
    /// A freshly booted robot with its devices, none of which has been heard yet. It is built in
    /// place, as [`Robot::new`].
    ///
    /// # Errors
    /// [`ConfigError`]: the configuration is invalid, or the memory is too small for it.
    #[inline(never)]
    pub fn new(
        config: Config<D>,
        memory: &'b mut Memory<impl Storage, D>,
        sensor: S,
        wheels: W,
    ) -> Result<Self, ConfigError> {
        let slices = Robot::check(&config, memory)?;
        Ok(Self::assembled(config, slices, sensor, wheels))
    }

    // Not inlined, so that the result is written in place.
    #[inline(never)]
    fn assembled(config: Config<D>, slices: Slices<'b, D>, sensor: S, wheels: W) -> Self {
        Self {
            robot: Robot::assembled(config, slices),
            sensor,
            wheels,
            is_touching: false,
            turned: None,
        }
    }

    /// Processes bytes that had arrived at a port by `now`, in pieces of any size.
    // Neither this nor `timeout` is inlined, so that their stacks do not add up.
    #[inline(never)]
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
    #[inline(never)]
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

    /// The parameters that the board is to store now, and then to say whether it has ([`Machine::stored`]): while
    /// the server waits for that, and the wheels stand. If they turn, the server learns that nothing is stored.
    pub fn poll_store(&mut self, now: Instant) -> Option<Vec<ParameterValue, MAX_PARAMETERS>> {
        let parameters = self.robot.poll_store()?;
        if self.turned.is_some_and(|turned| now.since(turned) < STANDSTILL) {
            self.robot.stored(false);
            return None;
        }
        Some(parameters)
    }

    /// Answers the server that waits for the parameters to be stored, as [`Robot::stored`].
    pub fn stored(&mut self, is_stored: bool) {
        self.robot.stored(is_stored);
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
        let command = self.command();
        if command != DriveCommand::STAND {
            self.turned = Some(now);
        }
        self.wheels.drive(command, now);
    }
}

impl<S: DepthSensor, L: PoweredMotor, R: PoweredMotor, D: Drive>
    Machine<'_, S, PwmMotors<L, R>, D>
{
    /// Processes the counts of the left and the right wheel's encoder since the last call, and sets
    /// the motors' powers. Call it at 50 to 100 Hz.
    pub fn counts(&mut self, counts: [i32; 2], now: Instant) {
        let report = self.wheels.count(counts, now);
        self.robot.odometry(report.moment, report.pose, now);
        self.heed(&report, now);
        self.drive(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Bounds, Config, Memory,
        device::{Scan, SensorCounters, create2::Create2},
        drive::{Drives, Seen, Surroundings},
        memory,
        sense::SensorModel,
    };
    use std::{boxed::Box, vec, vec::Vec};
    use ubimap_protocol::{
        frame::{MAX_FRAME, SessionId},
        link::{Answer, Endpoint, Fill, Received, Terms, answer},
        message::{
            Hello, ParameterAction, ParameterCommand, ParameterOutcome, ParameterReport, ToRobot,
        },
        units::{Millimetres, RobotId},
    };

    const BOUNDS: Bounds = Bounds::SMALL;

    /// A drive that always drives ahead and turns.
    #[derive(Debug)]
    struct Ahead;

    const AHEAD: DriveCommand = DriveCommand { speed: 200, turn: 300 };

    impl Drive for Ahead {
        type Memory = ();
        const EMPTY: () = ();
        type State<'b> = Self;

        fn begin(self, _: Millimetres, (): &mut ()) -> Self {
            self
        }
    }

    impl Drives for Ahead {
        fn wants_scan(&mut self, _: Instant, _: Option<Instant>) -> bool {
            true
        }

        fn see(&mut self, _: &Seen<'_>) {}

        fn poll_timeout(&self) -> Option<Instant> {
            None
        }

        fn step(&mut self, _: &Surroundings<'_, '_>) -> Option<EventCode> {
            None
        }

        fn command(&self) -> DriveCommand {
            AHEAD
        }
    }

    /// A sensor that never reports.
    struct Blind;

    impl DepthSensor for Blind {
        fn receive(&mut self, bytes: &mut &[u8], _: Instant) -> Option<Scan<'_>> {
            *bytes = &[];
            None
        }

        fn poll_transmit(&mut self, _: Instant, _: &mut [u8]) -> Option<usize> {
            None
        }

        fn poll_timeout(&self) -> Instant {
            Instant(u64::MAX)
        }

        fn counters(&self) -> SensorCounters {
            SensorCounters::default()
        }
    }

    /// A machine and the time since it was switched on, in milliseconds.
    struct Bench<'b> {
        machine: Machine<'b, Blind, Create2, Ahead>,
        millis: u64,
    }

    impl Bench<'_> {
        fn now(&self) -> Instant {
            Instant(self.millis * 1_000)
        }

        /// The base reports these contacts once; `None`: it is silent. Returns what the machine then
        /// sends to it, after 15 ms.
        fn report(&mut self, contact: Option<u8>) -> Vec<Vec<u8>> {
            self.millis += 15;
            let now = self.now();
            if let Some(contact) = contact {
                let mut frame = vec![19, 10, 7, contact, 35, 2, 43, 0, 0, 44, 0, 0];
                let sum = frame.iter().fold(0, |sum: u8, &byte| sum.wrapping_add(byte));
                frame.push(sum.wrapping_neg());
                self.machine.receive(Port::Wheels, &frame, now);
            }
            self.machine.timeout(now);
            let (mut out, mut sent) = ([0; 16], Vec::new());
            while let Some(count) = self.machine.poll_transmit(Port::Wheels, now, &mut out) {
                sent.push(out[..count].to_vec());
            }
            sent
        }
    }

    /// Calls `test` with a machine that has driven for a second.
    fn driving(test: impl FnOnce(Bench<'_>)) {
        let model = SensorModel::Radial { first: 0.0, step: 0.1 };
        let config = Config { keeps_parameters: true, ..Config::new(RobotId(1), model, BOUNDS) };
        let config = config.with_drive(Ahead);
        let mut memory: Box<memory!(BOUNDS, Ahead)> = Box::new(Memory::EMPTY);
        let machine = Machine::new(config, &mut memory, Blind, Create2::new()).unwrap();
        let mut bench = Bench { machine, millis: 0 };
        (0..70).for_each(|_| drop(bench.report(Some(0))));
        assert_eq!((bench.machine.command(), bench.machine.robot().stopped()), (AHEAD, None));
        test(bench);
    }

    const STANDING: [u8; 5] = [145, 0, 0, 0, 0];

    #[test]
    fn a_bumper_stops_the_wheels_in_the_same_step_and_then_allows_turns() {
        driving(|mut bench| {
            assert_eq!(bench.report(Some(1)), [STANDING]);
            assert_eq!(bench.machine.robot().stopped(), Some(StopReason::Bumper));
            // While it stays pressed, the robot stands for two seconds, then turns away.
            for _ in 0..132 {
                bench.report(Some(1));
                assert_eq!(bench.machine.command(), DriveCommand::STAND);
            }
            (0..3).for_each(|_| drop(bench.report(Some(1))));
            let turn = DriveCommand { speed: 0, ..AHEAD };
            assert_eq!((bench.machine.command(), bench.machine.robot().stopped()), (turn, None));
            // Free again, it drives on, and a new contact stops it again.
            bench.report(Some(0));
            assert_eq!(bench.machine.command(), AHEAD);
            assert_eq!(bench.report(Some(2)), [STANDING]);
        });
    }

    #[test]
    fn a_wheel_drop_stops_the_wheels_until_it_is_over() {
        driving(|mut bench| {
            assert_eq!(bench.report(Some(4)), [STANDING]);
            for _ in 0..200 {
                bench.report(Some(12));
                assert_eq!(bench.machine.robot().stopped(), Some(StopReason::WheelDrop));
            }
            (0..32).for_each(|_| drop(bench.report(Some(0))));
            assert_eq!(bench.machine.command(), DriveCommand::STAND);
            (0..3).for_each(|_| drop(bench.report(Some(0))));
            assert_eq!(bench.machine.command(), AHEAD);
        });
    }

    #[test]
    fn a_silent_base_stands_within_600_ms_and_is_started_again() {
        driving(|mut bench| {
            let began = bench.millis;
            let mut sent = Vec::new();
            while bench.millis < began + 600 {
                sent.extend(bench.report(None));
            }
            assert_eq!(bench.machine.command(), DriveCommand::STAND);
            assert_eq!(bench.machine.robot().stopped(), Some(StopReason::WheelsSilent));
            assert!(sent.contains(&vec![128]), "{sent:?}");
            // It is back: after half a second the robot drives on.
            (0..40).for_each(|_| drop(bench.report(Some(0))));
            assert_eq!((bench.machine.command(), bench.machine.robot().stopped()), (AHEAD, None));
        });
    }

    /// A server's messages for the machine, and the reports of its answers.
    struct Server(Endpoint<ToRobot, (), 1, MAX_FRAME>);

    impl Server {
        /// Begins a session with a machine that says Hello.
        fn begin(bench: &mut Bench<'_>) -> Self {
            let (mut server, mut out) = (Endpoint::new(), [0; MAX_FRAME]);
            let count = bench.machine.poll_transmit(Port::Server, bench.now(), &mut out).unwrap();
            let Some(Received::Handshake(hello)) = server.receive(&mut &out[..count], bench.now())
            else {
                panic!("no Hello")
            };
            let hello: Hello = hello.decode().unwrap();
            let resolution = hello.resolution;
            let terms = Terms { resolution, frame: 250, server_epoch: 1, stores: false };
            let Answer::Welcome(welcome) = answer(&hello, &terms, SessionId(5), 1) else {
                panic!("refused")
            };
            let count = server.handshake(&welcome, &mut out).unwrap();
            bench.machine.receive(Port::Server, &out[..count], bench.now());
            server.begin(SessionId(5), MAX_FRAME);
            Self(server)
        }

        /// Sends a command to set a parameter. Returns what is to be stored.
        fn set(
            &mut self,
            bench: &mut Bench<'_>,
            (parameter, value): (u16, i32),
        ) -> Option<Vec<ParameterValue>> {
            let action = ParameterAction::Set(ParameterValue { parameter, value });
            let (mut out, now) = ([0; MAX_FRAME], bench.now());
            let sent = self.0.poll_transmit(now, &mut out, true, |writer, _| {
                assert!(writer.push(&ParameterCommand { number: 3, action }));
                Fill::Datagram
            });
            bench.machine.receive(Port::Server, &out[..sent.unwrap().len], now);
            let changed = |it: &&ParameterValue| it.parameter == 6;
            bench.machine.poll_store(now).map(|it| it.iter().filter(changed).copied().collect())
        }

        /// The outcome that the machine reports.
        fn outcome(&mut self, bench: &mut Bench<'_>) -> Option<ParameterOutcome> {
            let (mut out, mut outcome, now) = ([0; MAX_FRAME], None, bench.now());
            while let Some(count) = bench.machine.poll_transmit(Port::Server, now, &mut out) {
                let received = self.0.receive(&mut &out[..count], now);
                let Some(Received::Session(messages)) = received else { continue };
                for message in messages.flatten() {
                    let report = message.decode::<ParameterReport>().ok();
                    outcome = report.map(|it| it.outcome).or(outcome);
                }
                // It acknowledges, so that the next report can be sent.
                let sent = self.0.poll_transmit(now, &mut out, true, |_, _| Fill::Nothing);
                let frame = sent.map(|sent| out[..sent.len].to_vec()).unwrap_or_default();
                bench.machine.receive(Port::Server, &frame, now);
            }
            outcome
        }
    }

    #[test]
    fn parameters_are_stored_while_the_wheels_stand() {
        driving(|mut bench| {
            let server = &mut Server::begin(&mut bench);
            assert_eq!(server.set(&mut bench, (6, 300)), None);
            assert_eq!(server.outcome(&mut bench), Some(ParameterOutcome::Done));
            let value = ParameterValue { parameter: 6, value: 300 };
            // The wheels turn, are told to stand, and then stand.
            let now = bench.now();
            for (millis, stored) in [(0, None), (900, None), (150, Some(vec![value]))] {
                (0..millis / 15).for_each(|_| drop(bench.report(Some(0))));
                assert_eq!(server.set(&mut bench, (13, 1)), stored, "{millis}");
                if stored.is_none() {
                    let refused = Some(ParameterOutcome::OutOfRange);
                    assert_eq!(server.outcome(&mut bench), refused);
                }
                bench.machine.stop(StopReason::Button, None, now);
            }
            assert_eq!(server.outcome(&mut bench), None, "it waits for the board");
            bench.machine.stored(true);
            assert_eq!(server.outcome(&mut bench), Some(ParameterOutcome::Done));
        });
    }

    #[test]
    fn a_button_stops_until_the_robot_is_told_to_go_on() {
        driving(|mut bench| {
            let now = bench.now();
            bench.machine.stop(StopReason::Button, None, now);
            (0..1_000).for_each(|_| drop(bench.report(Some(0))));
            // A bump meanwhile does not shorten the stop.
            bench.report(Some(1));
            (0..1_000).for_each(|_| drop(bench.report(Some(0))));
            assert_eq!(bench.machine.command(), DriveCommand::STAND);
            bench.machine.resume();
            bench.report(Some(0));
            assert_eq!(bench.machine.command(), AHEAD);
        });
    }
}
