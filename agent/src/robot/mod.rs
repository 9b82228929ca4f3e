//! The robot: what its sensor, its wheels and its link say goes in, frames and wheel commands come
//! out.
//!
//! [`Robot`] is the surface. `scans` is the way of a scan into the map; `link` the session with the
//! server, whose messages `inbox` takes, and to which `writing` writes what waits in the `outbox`;
//! `surroundings` are what drives the robot goes by. All of them work on the `mapper`.

mod bounds;
mod config;
mod inbox;
mod link;
mod mapper;
mod memory;
mod outbox;
mod parameters;
mod scans;
mod settings;
mod statistics;
mod surroundings;
mod writing;

use ubimap_protocol::{
    link::Counters,
    message::RefusalReason,
    tile::Epoch,
    time::Instant,
    units::{Angle, Pose},
};

pub use bounds::Bounds;
pub use config::{Config, ConfigError, Part};
pub use link::LINK_STATE;
pub use memory::{Arrays, Memory, Slices, Storage};
pub use parameters::Parameter;
pub use settings::Settings;
pub use statistics::Statistics;

use crate::{
    drive::{Drive, DriveCommand, Drives, NoDrive, Seen},
    map::Pool,
    sense::{Beam, ScanError, WaitingScans},
    share::{Commands, FusedMap},
};
use link::Link;
use mapper::Mapper;

/// A robot that maps, shares what it maps, and drives if it has something that drives it.
///
/// It owns no clock and no port: time is an argument, and whatever a board reads or writes goes
/// through these methods. All times are of the robot's own clock, which counts from any moment on.
///
/// **The law**: after every input ([`receive`](Self::receive), [`odometry`](Self::odometry),
/// [`scan`](Self::scan), [`timeout`](Self::timeout)) drain [`poll_transmit`](Self::poll_transmit)
/// until it has nothing more, give the wheels the [`command`](Self::command), and call `timeout` at
/// [`poll_timeout`](Self::poll_timeout) at the latest.
///
/// The whole main loop; `examples/main_loop.rs` has one with a simulated room:
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
/// /// A depth sensor that gives rows of 100 pixels.
/// const BOUNDS: Bounds = Bounds::REFERENCE;
///
/// /// What the loop needs of a board.
/// trait Board {
///     /// Microseconds since boot.
///     fn now(&self) -> Instant;
///     /// Sleeps until a device has something, or until this moment.
///     fn wait(&mut self, until: Instant);
///     /// Bytes from the server, as many as there are and find room.
///     fn read(&mut self, bytes: &mut [u8]) -> usize;
///     /// Bytes to the server.
///     fn write(&mut self, bytes: &[u8]);
///     /// A reading of the wheels, if there is a new one: when, and `base_link` in `odom`.
///     fn odometry(&mut self) -> Option<(Instant, Pose)>;
///     /// A row of the sensor, if there is a new one: when it was taken, and millimetres.
///     fn scan(&mut self) -> Option<(Instant, [u16; BOUNDS.readings])>;
///     /// What the wheels shall do from now on.
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
///             // The robot counts a scan that it cannot take, and tells the server.
///             let _ = robot.scan(taken, &readings, board.now());
///         }
///         robot.timeout(board.now());
///         while let Some(count) = robot.poll_transmit(board.now(), &mut bytes) {
///             board.write(&bytes[..count]);
///         }
///         board.turn_wheels(robot.command());
/// #       if !board.is_on() {
/// #           let count = robot.statistics();
/// #           assert_eq!(count.scans + count.overflowed, 100, "without a fix few can wait");
/// #           return Ok(());
/// #       }
///     }
/// }
/// #
/// # /// A room without anything, ten seconds long; nobody answers.
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
/// #         assert!(command.is_stand(), "it has no task");
/// #     }
/// #     fn is_on(&self) -> bool {
/// #         self.scans < 100
/// #     }
/// # }
/// #
/// # let mut board = Bench::default();
/// # let mut memory: Box<memory!(BOUNDS, Driving)> = Box::new(Memory::EMPTY);
/// # run(&mut board, &mut memory).unwrap();
/// # assert!(board.frames > 1, "it says hello again and again");
/// ```
#[derive(Debug)]
pub struct Robot<'b, D: Drive = NoDrive> {
    mapper: Mapper<'b>,
    scans: WaitingScans<'b>,
    link: Link,
    drive: D::State<'b>,
}

impl<'b, D: Drive> Robot<'b, D> {
    /// A robot that has just booted. It is built in place: what it takes of the stack beside the
    /// robot itself is less than its work takes later.
    ///
    /// # Errors
    /// [`ConfigError`], of the configuration or of memory that is too small for it.
    // This and what it calls are not inlined: each then writes its result where it shall stay, and
    // what it needs of the stack beside does not lie under all others.
    #[inline(never)]
    pub fn new(
        config: Config<D>,
        memory: &'b mut Memory<impl Storage, D>,
    ) -> Result<Self, ConfigError> {
        config.check()?;
        let memory = memory.slices().cut_to(&config.bounds)?;
        Ok(Self::assembled(config, memory))
    }

    #[inline(never)]
    fn assembled(config: Config<D>, memory: Slices<'b, D>) -> Self {
        let Slices { beams, waiting, scratch, own, fused, drive } = memory;
        Self {
            mapper: Mapper::new(&config, beams, scratch, own, fused),
            scans: WaitingScans::new(waiting, config.bounds.readings),
            link: Link::new(config.boot_nonce),
            drive: config.drive.begin(config.bounds.resolution, drive),
        }
    }

    /// Takes bytes from the server, in pieces of any size.
    pub fn receive(&mut self, mut bytes: &[u8], now: Instant) {
        let Self { mapper, scans, link, .. } = self;
        while link.receive_frame(mapper, &mut bytes, now) {
            link.settle(mapper, now);
        }
        mapper.map_waiting(scans, link, now);
    }

    /// Takes a reading of the odometry: `base_link` in `odom` at `moment`.
    pub fn odometry(&mut self, moment: Instant, pose: Pose, now: Instant) {
        let Self { mapper, scans, link, .. } = self;
        mapper.odometry(moment, pose);
        mapper.map_waiting(scans, link, now);
    }

    /// Takes a scan that was taken at `taken`: readings in millimetres, 0 where nothing came back. It
    /// is mapped once its pose is known, and driven by at once.
    ///
    /// # Errors
    /// [`ScanError`]: the scan is not mapped. One that finds the queue full is still driven by.
    pub fn scan(
        &mut self,
        taken: Instant,
        readings: &[u16],
        now: Instant,
    ) -> Result<(), ScanError> {
        let Self { mapper, scans, link, drive } = self;
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

    /// Takes a reading of a gyroscope about the vertical, if the robot has one: how far it would
    /// turn in a second, either way.
    pub fn gyro(&mut self, moment: Instant, turn: Angle) {
        self.mapper.steadiness.gyro(moment, turn);
    }

    /// The robot was jolted at `moment`: an accelerometer or a bumper says so. Scans of that moment
    /// are not mapped.
    pub fn jolt(&mut self, moment: Instant) {
        self.mapper.steadiness.jolt(moment);
    }

    /// Does what is due at `now`: scans that have waited long enough, the map's evidence, a step of
    /// the drive.
    pub fn timeout(&mut self, now: Instant) {
        let Self { mapper, scans, link, drive } = self;
        mapper.age(now);
        mapper.map_waiting(scans, link, now);
        if drive.poll_timeout().is_some_and(|due| due <= now) {
            let step = drive.step(&mapper.surroundings(link, now));
            if let Some(code) = step {
                mapper.outbox.raise(code, now);
            }
        }
    }

    /// When to call [`Robot::timeout`] at the latest, and then [`Robot::poll_transmit`].
    pub fn poll_timeout(&self) -> Instant {
        let due = self.link.poll_timeout(&self.mapper);
        let due = due.min(self.mapper.map.poll_timeout());
        let rest = [self.mapper.scan_timeout(&self.scans), self.drive.poll_timeout()];
        rest.into_iter().flatten().fold(due, Instant::min)
    }

    /// Writes the next frame that is due into `out`, which should have 250 bytes. Returns its
    /// length.
    #[must_use]
    pub fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        self.link.poll_transmit(&mut self.mapper, now, out)
    }

    /// What the wheels shall do now. It changes with [`Robot::timeout`] only.
    pub fn command(&self) -> DriveCommand {
        self.drive.command()
    }

    /// What drives the robot.
    pub fn drive(&self) -> &D::State<'b> {
        &self.drive
    }

    /// What has been counted.
    pub fn statistics(&self) -> Statistics {
        self.mapper.statistics
    }

    /// What the link has counted.
    pub fn link_counters(&self) -> Counters {
        self.link.counters()
    }

    /// The robot's own tiles.
    pub fn own_tiles(&self) -> &Pool<'b> {
        &self.mapper.map.pool
    }

    /// The server's tiles that the robot holds.
    pub fn fused_tiles(&self) -> &FusedMap<'b> {
        &self.mapper.fused
    }

    /// The newest pose known, and its moment in the server's clock (in the robot's, if odometry
    /// told it before the clocks agreed).
    pub fn pose(&self) -> Option<(Instant, Pose)> {
        self.mapper.latest_pose
    }

    /// `base_link` in `map` at a moment of the robot's clock as far as is known now, and the
    /// standard deviation of the position in millimetres. It may lie after the newest odometry: for
    /// a third of a second the robot is taken to go on as it did. At most 13,000 instructions.
    pub fn pose_at(&self, moment: Instant) -> Option<(Pose, f32)> {
        self.mapper.pose_at(moment)
    }

    /// What each reading of a scan stands for.
    pub fn beams(&self) -> &[Beam] {
        self.mapper.beams
    }

    /// What counts of the configuration, as the server has changed it.
    pub fn settings(&self) -> &Settings {
        &self.mapper.settings
    }

    /// The server's time now, once the clocks agree.
    pub fn server_time(&mut self, now: Instant) -> Option<Instant> {
        self.mapper.clock.server_now(now)
    }

    /// What the server wants of the robot, and what it tells of its surroundings.
    pub fn commands(&self) -> &Commands {
        &self.mapper.commands
    }

    /// Why the server refuses a session, if it does.
    pub fn refusal(&self) -> Option<RefusalReason> {
        self.link.refusal()
    }

    /// The epoch of the server with which the last session was begun.
    pub fn server_epoch(&self) -> Option<Epoch> {
        self.link.server_epoch()
    }

    /// Whether there is a session.
    pub fn is_connected(&self) -> bool {
        self.link.is_connected()
    }

    /// Whether everything that the robot has mapped is on the server, as far as it knows, and no
    /// scan waits.
    pub fn is_idle(&self) -> bool {
        self.scans.oldest().is_none() && self.mapper.is_idle()
    }
}
