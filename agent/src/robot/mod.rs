//! The robot: readings of the sensor and the wheels and bytes from the link go in, frames and wheel
//! commands come out.
//!
//! [`Robot`] is the interface. `scans` turns scans into the map; `link` holds the session with the
//! server, `inbox` handles the server's messages, and `writing` writes the messages that wait in
//! the `outbox`; `surroundings` collects the inputs of the drive. All of them work on the state in
//! `mapper`.

mod bounds;
mod config;
mod inbox;
mod link;
mod mapper;
mod memory;
mod outbox;
mod parameter_storage;
mod parameters;
mod scans;
mod settings;
mod statistics;
mod surroundings;
mod writing;

use heapless::Vec;
use ubimap_protocol::{
    frame::SessionId,
    link::Counters,
    message::{EventCode, MAX_PARAMETERS, ParameterValue, RefusalReason},
    tile::Epoch,
    time::Instant,
    units::{Angle, Pose},
};

pub use bounds::Bounds;
pub use config::{Config, ConfigError, Part, Seal};
pub use link::LINK_STATE;
pub use memory::{Arrays, Memory, Slices, Storage};
pub use parameters::Parameter;
pub use settings::Settings;
pub use statistics::Statistics;

use crate::{
    drive::{Drive, DriveCommand, Drives, Halt, NoDrive, Seen, StopReason},
    map::Pool,
    sense::{Beam, ScanError, WaitingScans},
    share::{Commands, FusedMap},
};
use link::Link;
use mapper::Mapper;

/// A robot that maps, shares its map with the server, and optionally drives.
///
/// It owns no clock and no port: time is an argument, and all input and output passes through these
/// methods. All times are by the robot's own clock, which may start at any value.
///
/// **The driving law**: after every input ([`receive`](Self::receive),
/// [`odometry`](Self::odometry), [`scan`](Self::scan), [`timeout`](Self::timeout)) drain
/// [`poll_transmit`](Self::poll_transmit) until it returns `None`, apply the
/// [`command`](Self::command) to the wheels, and call `timeout` no later than
/// [`poll_timeout`](Self::poll_timeout).
///
/// The complete main loop; `examples/main_loop.rs` runs one in a simulated room:
///
/// ```
/// use ubimap_agent::{
///     Bounds, Config, ConfigError, Memory, Robot,
///     drive::{DriveCommand, Driving},
///     memory,
///     sense::SensorModel,
/// };
/// use ubimap_protocol::{
///     frame::DEFAULT_FRAME,
///     time::Instant,
///     units::{Pose, RobotId},
/// };
///
/// /// A depth sensor with rows of 100 pixels.
/// const BOUNDS: Bounds = Bounds::REFERENCE;
///
/// /// The board's functions that the loop uses.
/// trait Board {
///     /// Microseconds since boot.
///     fn now(&self) -> Instant;
///     /// Sleeps until an input arrives, at most until `until`.
///     fn wait(&mut self, until: Instant);
///     /// Reads the bytes that have arrived from the server, up to the buffer's length.
///     fn read(&mut self, bytes: &mut [u8]) -> usize;
///     /// Sends bytes to the server.
///     fn write(&mut self, bytes: &[u8]);
///     /// New odometry, if any: its time, and `base_link` in `odom`.
///     fn odometry(&mut self) -> Option<(Instant, Pose)>;
///     /// A new scan, if any: its time, and its readings in millimetres.
///     fn scan(&mut self) -> Option<(Instant, [u16; BOUNDS.readings])>;
///     /// Sets the speed of the wheels.
///     fn turn_wheels(&mut self, command: DriveCommand);
/// #   fn is_on(&self) -> bool;
/// }
///
/// fn run(
///     board: &mut impl Board,
///     memory: &mut memory!(BOUNDS, Driving),
/// ) -> Result<(), ConfigError> {
///     let sensor = SensorModel::Pinhole { focal: 61.7, centre: 49.5 };
///     let config = Config::new(RobotId(1), sensor, BOUNDS).with_drive(Driving::default());
///     let mut robot = Robot::new(config, memory)?;
///     let mut bytes = [0; DEFAULT_FRAME];
///     loop {
///         board.wait(robot.poll_timeout());
///         let count = board.read(&mut bytes);
///         robot.receive(&bytes[..count], board.now());
///         if let Some((moment, pose)) = board.odometry() {
///             robot.odometry(moment, pose, board.now());
///         }
///         if let Some((taken, readings)) = board.scan() {
///             // The robot counts a refused scan and reports it to the server.
///             let _ = robot.scan(taken, &readings, board.now());
///         }
///         robot.timeout(board.now());
///         while let Some(count) = robot.poll_transmit(board.now(), &mut bytes) {
///             board.write(&bytes[..count]);
///         }
///         board.turn_wheels(robot.command());
/// #       if !board.is_on() {
/// #           let count = robot.statistics();
/// #           assert_eq!(count.scans + count.overflowed, 100, "without a fix the queue overflows");
/// #           return Ok(());
/// #       }
///     }
/// }
/// #
/// # /// An empty room for ten seconds, without a server.
/// # #[derive(Default)]
/// # struct Bench {
/// #     now: Instant,
/// #     scans: u64,
/// #     frames: usize,
/// # }
/// #
/// # impl Board for Bench {
/// #     fn now(&self) -> Instant {
/// #         self.now
/// #     }
/// #     fn wait(&mut self, until: Instant) {
/// #         self.now = self.now.max(until.min(Instant(self.scans * 100_000)));
/// #     }
/// #     fn read(&mut self, _: &mut [u8]) -> usize {
/// #         0
/// #     }
/// #     fn write(&mut self, _: &[u8]) {
/// #         self.frames += 1;
/// #     }
/// #     fn odometry(&mut self) -> Option<(Instant, Pose)> {
/// #         Some((self.now, Pose::default()))
/// #     }
/// #     fn scan(&mut self) -> Option<(Instant, [u16; BOUNDS.readings])> {
/// #         let is_due = self.now.0 >= self.scans * 100_000;
/// #         self.scans += u64::from(is_due);
/// #         is_due.then_some((self.now, [1_500; BOUNDS.readings]))
/// #     }
/// #     fn turn_wheels(&mut self, command: DriveCommand) {
/// #         assert!(command == DriveCommand::STAND, "no task");
/// #     }
/// #     fn is_on(&self) -> bool {
/// #         self.scans < 100
/// #     }
/// # }
/// #
/// # let mut board = Bench::default();
/// # let mut memory: Box<memory!(BOUNDS, Driving)> = Box::new(Memory::EMPTY);
/// # run(&mut board, &mut memory).unwrap();
/// # assert!(board.frames > 1, "it repeats its Hello");
/// ```
#[derive(Debug)]
pub struct Robot<'b, D: Drive = NoDrive> {
    mapper: Mapper<'b>,
    scans: WaitingScans<'b>,
    link: Link,
    drive: D::State<'b>,
    halt: Option<Halt>,
}

impl<'b, D: Drive> Robot<'b, D> {
    /// Creates a freshly booted robot. It is built in place, so this call needs no more stack than
    /// later ones.
    ///
    /// # Errors
    /// [`ConfigError`]: the configuration is invalid, or the memory is too small for it.
    // Not inlined, and neither are its callees: each writes its result in place, so their stack
    // frames do not add up.
    #[inline(never)]
    pub fn new(
        config: Config<D>,
        memory: &'b mut Memory<impl Storage, D>,
    ) -> Result<Self, ConfigError> {
        let slices = Self::check(&config, memory)?;
        Ok(Self::assembled(config, slices))
    }

    /// The parts of the memory that a configuration needs.
    pub(crate) fn check(
        config: &Config<D>,
        memory: &'b mut Memory<impl Storage, D>,
    ) -> Result<Slices<'b, D>, ConfigError> {
        config.check()?;
        memory.slices().cut_to(&config.bounds)
    }

    #[inline(never)]
    pub(crate) fn assembled(config: Config<D>, memory: Slices<'b, D>) -> Self {
        let Slices { beams, waiting, scratch, own, fused, drive } = memory;
        Self {
            mapper: Mapper::new(&config, beams, scratch, own, fused),
            scans: WaitingScans::new(waiting, config.bounds.readings),
            link: Link::new(config.boot_nonce, config.seal),
            drive: config.drive.begin(config.bounds.resolution, drive),
            halt: None,
        }
    }

    /// Processes bytes from the server; frames may be split anywhere between calls.
    pub fn receive(&mut self, mut bytes: &[u8], now: Instant) {
        let Self { mapper, scans, link, .. } = self;
        while link.receive_frame(mapper, &mut bytes, now) {
            link.settle(mapper, now);
        }
        mapper.map_waiting(scans, link, now);
    }

    /// Processes an odometry reading: `base_link` in `odom` at `moment`.
    pub fn odometry(&mut self, moment: Instant, pose: Pose, now: Instant) {
        let Self { mapper, scans, link, .. } = self;
        mapper.odometry(moment, pose);
        mapper.map_waiting(scans, link, now);
    }

    /// Processes a scan taken at `taken`: readings as in a
    /// [`Scan`](crate::device::Scan). The drive uses
    /// it at once; it is mapped as soon as its pose is known.
    ///
    /// # Errors
    /// [`ScanError`]: the scan is not mapped. If the queue was full ([`ScanError::Full`]), the
    /// drive still uses the scan.
    pub fn scan(
        &mut self,
        taken: Instant,
        readings: &[u16],
        now: Instant,
    ) -> Result<(), ScanError> {
        let Self { mapper, scans, link, drive, .. } = self;
        let outcome = if drive.wants_scan(taken, mapper.locator.newest_fix()) {
            mapper.scan(scans, link, taken, readings, now)
        } else {
            scans.check(taken, readings)
        };
        if let Err(error) = outcome {
            mapper.refuse_scan(error, now);
        }
        if matches!(outcome, Ok(()) | Err(ScanError::Full)) {
            let (validity, mounting) = (mapper.settings.validity, mapper.settings.mounting);
            drive.see(&Seen { taken, readings, beams: mapper.beams, validity, mounting });
        }
        outcome
    }

    /// Processes a gyroscope reading: the turn rate about the vertical axis, as the magnitude of
    /// the angle turned in one second. Optional.
    pub fn gyro(&mut self, moment: Instant, turn: Angle) {
        self.mapper.steadiness.gyro(moment, turn);
    }

    /// Reports a jolt at `moment`, detected by an accelerometer or a bumper. Scans taken around
    /// that time are not mapped.
    pub fn jolt(&mut self, moment: Instant) {
        self.mapper.steadiness.jolt(moment);
    }

    /// Stops the wheels at once, whatever the server says: for bumpers, edges and buttons. The stop
    /// ends at `until`, if given, and otherwise only with [`Robot::resume`]. Of several stops, the
    /// one that ends last counts. Each new reason is reported to the server, and a bumper stop also
    /// counts as a [`jolt`](Self::jolt).
    pub fn stop(&mut self, reason: StopReason, until: Option<Instant>, now: Instant) {
        if reason == StopReason::Bumper {
            self.jolt(now);
        }
        if self.halt.is_none_or(|halt| halt.reason != reason)
            && let Some(code) = reason.event_code()
        {
            self.mapper.outbox.raise(code, now);
        }
        self.halt = Some(Halt { reason, until }.after(self.halt));
    }

    /// Reports an event of the board to the server, such as a low battery.
    pub fn report(&mut self, code: EventCode, now: Instant) {
        self.mapper.outbox.raise(code, now);
    }

    /// Ends all stops by [`Robot::stop`].
    pub fn resume(&mut self) {
        self.halt = None;
    }

    /// Why the robot is stopped by [`Robot::stop`]; `None` if it is not.
    pub fn stopped(&self) -> Option<StopReason> {
        self.halt.map(|halt| halt.reason)
    }

    /// The parameters to be stored, while a command of the server to store them waits. The board then
    /// calls [`Robot::stored`]. Only with [`Config::keeps_parameters`].
    pub fn poll_store(&self) -> Option<Vec<ParameterValue, MAX_PARAMETERS>> {
        parameters::to_store(&self.mapper.settings)
    }

    /// Answers the command that waits for the board: whether the parameters of [`Robot::poll_store`] are
    /// stored, so that they apply after the next boot.
    pub fn stored(&mut self, is_stored: bool) {
        let Mapper { settings, outbox, .. } = &mut self.mapper;
        if let Some(answer) = parameters::finish(settings, is_stored) {
            outbox.answer = Some(answer);
        }
    }

    /// Does the work that is due at `now`: drops expired scans, ages the map's evidence, and steps
    /// the drive.
    pub fn timeout(&mut self, now: Instant) {
        self.halt = self.halt.filter(|halt| !halt.is_over(now));
        let Self { mapper, scans, link, drive, halt } = self;
        mapper.age(now);
        mapper.map_waiting(scans, link, now);
        if drive.poll_timeout().is_some_and(|due| due <= now) {
            let step = drive.step(&mapper.surroundings(link, halt.is_some(), now));
            if let Some(code) = step {
                mapper.outbox.raise(code, now);
            }
        }
    }

    /// The latest time for the next calls of [`Robot::timeout`] and then [`Robot::poll_transmit`].
    pub fn poll_timeout(&self) -> Instant {
        let due = self.link.poll_timeout(&self.mapper);
        let due = due.min(self.mapper.map.poll_timeout());
        let halted = self.halt.and_then(|halt| halt.until);
        let rest = [self.mapper.scan_timeout(&self.scans), self.drive.poll_timeout(), halted];
        rest.into_iter().flatten().fold(due, Instant::min)
    }

    /// Writes the next frame due into `out`, which should hold 250 bytes. Returns its length.
    #[must_use]
    pub fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        self.link.poll_transmit(&mut self.mapper, now, out)
    }

    /// The current command for the wheels. Only [`Robot::timeout`] changes it, except that a
    /// [`stop`](Self::stop) counts at once.
    pub fn command(&self) -> DriveCommand {
        if self.halt.is_some() { DriveCommand::STAND } else { self.drive.command() }
    }

    /// The state of the drive.
    pub fn drive(&self) -> &D::State<'b> {
        &self.drive
    }

    /// The robot's counters.
    pub fn statistics(&self) -> Statistics {
        self.mapper.statistics
    }

    /// The link's counters.
    pub fn link_counters(&self) -> Counters {
        self.link.counters()
    }

    /// The robot's own tiles.
    pub fn own_tiles(&self) -> &Pool<'b> {
        &self.mapper.map.pool
    }

    /// The robot's copy of the server's tiles.
    pub fn fused_tiles(&self) -> &FusedMap<'b> {
        &self.mapper.fused
    }

    /// The newest known pose and its time: by the server's clock, or by the robot's until the clocks are
    /// synchronised.
    pub fn pose(&self) -> Option<(Instant, Pose)> {
        let to_server = |moment| self.mapper.clock.to_server(moment).unwrap_or(moment);
        self.mapper.latest_pose.map(|(moment, pose)| (to_server(moment), pose))
    }

    /// `base_link` in `map` at `moment` (robot's clock), by what is known now, and the standard
    /// deviation of the position in millimetres. Extrapolates up to a third of a second beyond the
    /// newest odometry. At most 13,000 instructions.
    pub fn pose_at(&self, moment: Instant) -> Option<(Pose, f32)> {
        self.mapper.pose_at(moment)
    }

    /// When the newest fix that arrived was taken, by the robot's clock.
    pub fn newest_fix(&self) -> Option<Instant> {
        self.mapper.locator.newest_fix()
    }

    /// The direction of each reading of a scan.
    pub fn beams(&self) -> &[Beam] {
        self.mapper.beams
    }

    /// The settings in force: the configuration, with the changes that the server has made.
    pub fn settings(&self) -> &Settings {
        &self.mapper.settings
    }

    /// The server's time at `now`, once the clocks are synchronised.
    pub fn server_time(&mut self, now: Instant) -> Option<Instant> {
        self.mapper.clock.server_now(now)
    }

    /// The server's newest commands, and its reports on other robots and obstacles.
    pub fn commands(&self) -> &Commands {
        &self.mapper.commands
    }

    /// Why the server refuses a session; `None` if it does not.
    pub fn refusal(&self) -> Option<RefusalReason> {
        self.link.refusal()
    }

    /// The epoch of the server in the last session; `None` before the first session.
    pub fn server_epoch(&self) -> Option<Epoch> {
        self.link.server_epoch()
    }

    /// The session with the server, if one is open.
    pub fn session(&self) -> Option<SessionId> {
        self.link.session()
    }

    /// Whether a session with the server is open.
    pub fn is_connected(&self) -> bool {
        self.link.is_connected()
    }

    /// Whether the server has acknowledged everything mapped so far and has been sent the window of
    /// tiles that the robot wants, and no scan is waiting.
    pub fn is_idle(&self) -> bool {
        self.scans.oldest().is_none() && self.mapper.is_idle()
    }
}
