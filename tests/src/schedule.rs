//! Schedules: random events for a server and its robots, determined by a seed. After every
//! schedule, once the links are restored and nothing new is mapped, all maps must converge within a
//! time limit.

use std::fmt;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Bounds, Config, Memory, locate::PoseSource};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, Direction},
    link::Terms,
    message::Stop,
    tile::Layer,
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    channel::fault::Faults,
    run::heap::{BOUNDS, Heap},
    server::Command,
};

use crate::{
    boxes::{Boxes, Fan, Walk},
    star::{Member, Star},
};

/// Interval of the robots' motion.
const STEP: Duration = Duration::from_millis(100);
/// Time limit for convergence after the links are restored and the last scan is taken. It covers a
/// handshake retry after a long cut (3.2 s), a session opened by an old Hello, the tiles of a
/// window at the downlink's bandwidth, and a slightly faulty link.
pub const PATIENCE: Duration = Duration::from_secs(30);
/// Time resolution for a newcomer.
const TICK: Duration = Duration::from_millis(1);
/// Time limit until all tiles have been compared by their digests: in the smallest frames one of at
/// most 36 tiles every ten seconds. As one digest in ten is lost, five rounds are allowed. So long a
/// robot may take to learn that its last tile is stored, and robots and a server with the epoch of an
/// earlier life to agree.
const UNTIL_COMPARED: Duration = Duration::from_secs(5 * 36 * 10);
/// Duration of silence required after convergence.
const QUIET: Duration = Duration::from_secs(3);

/// An event at some time.
#[derive(Clone, Copy, Debug)]
enum Happening {
    /// A robot boots, for the first time or again.
    Boot { robot: usize },
    /// Its link is cut, in one direction or in both.
    Cut { robot: usize, only: Option<Direction>, length: Duration },
    /// Its clock jumps forward, and runs fast or slow from then on.
    Clock { robot: usize, drift_ppm: i64, jump: Duration },
    /// The server commands it to stop or to drive on.
    Stop { robot: usize, number: u32 },
    /// The faults of its link change.
    Weather { robot: usize, up: Faults, down: Faults },
    /// It moves to another port.
    Move { robot: usize, port: usize },
    /// The server is killed and restarted: from its disk if it has one, otherwise empty, and with
    /// frames of another size. The robots keep their state.
    Restart { frame: u16 },
    /// Random bytes.
    Garbage { robot: usize, direction: Direction },
    /// An earlier frame, perhaps of an earlier session; or an earlier Hello, Welcome or Reset.
    Replay { robot: usize, direction: Direction, handshakes_only: bool },
}

/// A robot and its path.
#[derive(Clone, Debug)]
struct Plan {
    config: Config,
    walk: Walk,
    /// Number of steps from one scan to the next.
    scan_every: u64,
}

/// A schedule.
#[derive(Clone, Debug)]
pub struct Schedule {
    seed: u64,
    world: Boxes,
    sensor: Fan,
    plans: Vec<Plan>,
    ports: usize,
    frame: u16,
    /// Whether the server has a disk.
    stores: bool,
    /// Ordered by time.
    happenings: Vec<(Instant, Happening)>,
    /// When the last scan is taken and the links are restored.
    calm: Instant,
    calm_faults: Faults,
    drop_repeats: bool,
}

/// The result of a schedule.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ending {
    /// The time until convergence, or why it failed.
    pub level: Result<Duration, String>,
    /// Reliable frames retransmitted by the robots since their last boots.
    pub retransmissions: u32,
    /// Tiles evicted by the robots since their last boots.
    pub evicted: u32,
    /// Number of known cells in the final map.
    pub known: u32,
}

/// How a robot comes to hold none of the server's tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Newcomer {
    /// The robot is new.
    Joins,
    /// The robot has rebooted.
    Reboots,
}

/// How long a newcomer took to hold its window.
#[derive(Clone, Copy, Debug)]
pub struct Level {
    /// Time since its boot.
    pub took: Duration,
    /// Round-trip time of a frame.
    pub round_trip: Duration,
    /// Number of tiles in the robot's window.
    pub tiles: usize,
    /// Total bytes that the server sent to the robot meanwhile.
    pub bytes: u64,
}

impl Level {
    /// Time limit: two round trips (Hello and Welcome, Interest and tiles), plus the time to send
    /// all bytes at 2 kB/s except one second's worth and one frame, as the rate limiter counts
    /// whole frames. The server's delay of changes (up to 1 s) does not matter, as nothing changes.
    pub fn bound(&self) -> Duration {
        let paced = self.bytes.saturating_sub(2_000) * 1_000_000 / 2_000;
        let frame = DEFAULT_FRAME as u64 * 1_000_000 / 2_000;
        Duration(2 * self.round_trip.0 + TICK.0 + paced + if paced > 0 { frame } else { 0 })
    }
}

impl fmt::Display for Ending {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}, {} known", self.level, self.known)
    }
}

impl Schedule {
    /// The schedule for a seed.
    pub fn of(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let rng = &mut rng;
        let robots = rng.random_range(1..=5);
        let calm = Instant(rng.random_range(5_000_000..25_000_000));
        let mut schedule = Self::quiet(seed, rng, robots, calm);
        schedule.stores = rng.random_bool(0.6);
        for robot in 0..robots {
            let joins = if rng.random_bool(0.7) { 0 } else { rng.random_range(0..calm.0) };
            schedule.happenings.push((Instant(joins), Happening::Boot { robot }));
            let weather = weather(rng, robot);
            schedule.happenings.push((Instant(0), weather));
            let drift_ppm = rng.random_range(-500..=500);
            let clock = Happening::Clock { robot, drift_ppm, jump: Duration(0) };
            schedule.happenings.push((Instant(0), clock));
        }
        let mut ports: Vec<usize> = (0..robots).collect();
        let mut moments: Vec<u64> =
            (0..rng.random_range(0..16)).map(|_| rng.random_range(0..calm.0)).collect();
        moments.sort_unstable();
        for moment in moments {
            let robot = rng.random_range(0..robots);
            let direction = if rng.random() { Direction::ToServer } else { Direction::ToRobot };
            let happening = match rng.random_range(0..24) {
                0..3 => Happening::Boot { robot },
                3..6 => {
                    let only = rng.random_bool(0.4).then_some(direction);
                    let length = Duration(rng.random_range(100_000..6_000_000));
                    Happening::Cut { robot, only, length }
                }
                20 => Happening::Clock {
                    robot,
                    drift_ppm: rng.random_range(-2_000..=2_000),
                    jump: Duration(rng.random_range(0..3_000_000)),
                },
                21 => Happening::Stop { robot, number: moment as u32 },
                6..9 => weather(rng, robot),
                9..11 => {
                    let port = rng.random_range(0..schedule.ports);
                    if ports.contains(&port) {
                        continue;
                    }
                    ports[robot] = port;
                    Happening::Move { robot, port }
                }
                11..13 => Happening::Restart { frame: rng.random_range(32..300) },
                13..15 => Happening::Garbage { robot, direction },
                _ => Happening::Replay { robot, direction, handshakes_only: rng.random_bool(0.4) },
            };
            schedule.happenings.push((Instant(moment), happening));
        }
        // All robots boot at once, as after a power failure.
        if rng.random_bool(0.1) {
            let moment = Instant(rng.random_range(0..calm.0));
            schedule.happenings.push((moment, Happening::Restart { frame: schedule.frame }));
            let boots = (0..robots).map(|robot| (moment, Happening::Boot { robot }));
            schedule.happenings.extend(boots);
        }
        schedule.happenings.sort_by_key(|(moment, _)| *moment);
        schedule
    }

    /// A schedule whose only faults are lost frames, with this probability. Some robots map, and
    /// finish.
    pub fn lossy(seed: u64, loss: f64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut schedule = Self::quiet(seed, &mut rng, 2, Instant(10_000_000));
        let latency = Duration::from_millis(20);
        let faults = Faults { loss, latency, ..Faults::default() };
        schedule.calm_faults = faults;
        schedule.happenings = (0..2)
            .flat_map(|robot| {
                [Happening::Boot { robot }, Happening::Weather { robot, up: faults, down: faults }]
            })
            .map(|happening| (Instant(0), happening))
            .collect();
        schedule
    }

    /// A schedule on a clean link, for [`Self::level_after`]: two robots, the second of which is
    /// the newcomer.
    pub fn newcomer(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut schedule = Self::quiet(seed, &mut rng, 2, Instant(20_000_000));
        for plan in &mut schedule.plans {
            plan.config.pose_source = PoseSource::Odometry(Pose::default());
            let bounds = &mut plan.config.bounds;
            (bounds.own_tiles, bounds.fused_tiles, bounds.max_range) = (128, 100, 4_000);
            plan.scan_every = 3;
        }
        schedule.frame = DEFAULT_FRAME as u16;
        schedule.calm_faults =
            Faults { latency: schedule.calm_faults.latency, ..Faults::default() };
        schedule
    }

    /// The first robot maps. When everything has settled, the second one boots, knows its pose and
    /// sees nothing. Measures how long the second robot takes to hold its window.
    ///
    /// # Panics If it never holds its window.
    pub fn level_after(&self, who: Newcomer) -> Level {
        let plans = [&self.plans[0], &self.plans[1], &self.plans[1]];
        let mut lives = plans.map(|plan| Memory::new(&plan.config.bounds));
        let [first, second, third] = &mut lives;
        let terms = self.terms();
        let mut star = Star::new(terms, self.ports, self.seed);
        let ids = self.plans.iter().enumerate();
        star.members = ids.map(|(port, plan)| Member::new(plan.config.robot, port)).collect();
        let (up, down) = (self.calm_faults, self.calm_faults);
        for robot in 0..2 {
            self.happen(&mut star, Instant(0), Happening::Weather { robot, up, down });
        }
        star.boot(0, self.plans[0].config, first);
        if who == Newcomer::Reboots {
            star.boot(1, self.plans[1].config, second);
        }
        // Some of the worlds are full of rubble, so that the encoded tiles are long.
        let mut rubble = ChaCha8Rng::seed_from_u64(self.seed);
        let density = if self.seed.is_multiple_of(2) { 0.0 } else { 0.9 };
        let mut step = 0;
        while Instant(step * STEP.0) < self.calm {
            star.run_until(Instant(step * STEP.0));
            if rubble.random_bool(density) {
                let readings = (0..self.sensor.beams).map(|_| rubble.random_range(300..4_000));
                let pose = self.plans[0].walk.pose(star.now());
                star.scan(0, Some(pose), &readings.collect::<Vec<u16>>());
            } else {
                self.step(&mut star, step);
            }
            step += 1;
        }
        star.run_until(self.calm + Duration::from_secs(20));
        assert_eq!(star.behind(), None);

        let booted = star.now();
        let before = star.members[1].down.bytes();
        star.boot(1, Config { boot_nonce: 99, ..self.plans[1].config }, third);
        star.scan(1, Some(self.plans[1].walk.pose(booted)), &vec![0; self.sensor.beams]);
        while star.holds_its_window(1) != Some(true) {
            assert!(star.now() < booted + PATIENCE, "the newcomer never holds its window");
            star.run_until(star.now() + TICK);
        }
        let fused =
            star.members[1].robot().map(|robot| robot.fused_tiles().tiles(Layer::Fused).count());
        Level {
            took: star.now().since(booted),
            round_trip: Duration(2 * self.calm_faults.latency.0),
            tiles: fused.unwrap_or(0),
            bytes: star.members[1].down.bytes() - before,
        }
    }

    fn terms(&self) -> Terms {
        let Self { frame, stores, .. } = *self;
        Terms { resolution: Millimetres(50), frame, server_epoch: 1, stores }
    }

    /// The same schedule, in which the wire drops all retransmitted frames.
    pub fn without_retransmissions(self) -> Self {
        Self { drop_repeats: true, ..self }
    }

    fn quiet(seed: u64, rng: &mut ChaCha8Rng, robots: usize, calm: Instant) -> Self {
        let world = Boxes::random(rng);
        let sensor = Fan { beams: rng.random_range(24..72), angle: rng.random_range(1.5..5.0) };
        let plans = (1..=robots as u16).map(|id| plan(rng, &world, sensor, RobotId(id))).collect();
        let mild = rng.random_bool(0.5);
        let calm_faults = Faults {
            loss: if mild { 0.1 } else { 0.0 },
            duplicate: if mild { 0.05 } else { 0.0 },
            reorder: if mild { 0.1 } else { 0.0 },
            latency: Duration(rng.random_range(0..100_000)),
            ..Faults::default()
        };
        Self {
            seed,
            world,
            sensor,
            plans,
            ports: robots + 2,
            frame: if rng.random() { 250 } else { rng.random_range(32..300) },
            stores: false,
            happenings: Vec::new(),
            calm,
            calm_faults,
            drop_repeats: false,
        }
    }

    /// Runs the schedule.
    ///
    /// # Panics
    /// If an invariant is violated at any time.
    pub fn run(&self) -> Ending {
        let terms = self.terms();
        let boots = self.happenings.iter().filter_map(|(_, happening)| match happening {
            Happening::Boot { robot } => Some(*robot),
            _ => None,
        });
        let mut lives: Vec<Memory<Heap>> =
            boots.map(|robot| Memory::new(&self.plans[robot].config.bounds)).collect();
        let mut lives = lives.iter_mut();
        let mut star = Star::new(terms, self.ports, self.seed);
        let robots = self.plans.iter().enumerate();
        star.members = robots.map(|(port, plan)| Member::new(plan.config.robot, port)).collect();
        if self.drop_repeats {
            star.members.iter_mut().for_each(|robot| robot.up.drop_repeats());
        }

        let mut happenings = self.happenings.iter().peekable();
        let mut step = 0;
        while Instant(step * STEP.0) < self.calm {
            let next = Instant(step * STEP.0);
            while let Some((moment, happening)) = happenings.next_if(|(moment, _)| *moment <= next)
            {
                star.run_until(*moment);
                match *happening {
                    Happening::Boot { robot } => {
                        let life = lives.next().expect("there is one for each boot");
                        let nonce = (moment.0 as u32).wrapping_mul(2_654_435_761) ^ robot as u32;
                        let config = Config { boot_nonce: nonce, ..self.plans[robot].config };
                        star.boot(robot, config, life);
                    }
                    happening => self.happen(&mut star, *moment, happening),
                }
            }
            star.run_until(next);
            self.step(&mut star, step);
            step += 1;
        }
        let (up, down) = (self.calm_faults, self.calm_faults);
        for robot in 0..self.plans.len() {
            self.happen(&mut star, self.calm, Happening::Weather { robot, up, down });
        }
        self.settle(&mut star, step)
    }

    fn happen(&self, star: &mut Star<'_>, moment: Instant, happening: Happening) {
        match happening {
            Happening::Boot { .. } => {}
            Happening::Cut { robot, only, length } => {
                let until = (moment + length).min(self.calm);
                let Member { up, down, .. } = &mut star.members[robot];
                if only != Some(Direction::ToRobot) {
                    up.cut(until);
                }
                if only != Some(Direction::ToServer) {
                    down.cut(until);
                }
            }
            Happening::Clock { robot, drift_ppm, jump } => star.set_clock(robot, drift_ppm, jump),
            Happening::Stop { robot, number } => {
                // Without a session there is nobody to stop.
                let _ = star.command(robot, Command::Stop(Stop { number, stop: number % 2 == 0 }));
            }
            Happening::Weather { robot, up, down } => {
                let seed = self.seed.wrapping_mul(0x1_0001) ^ moment.0 << 8 ^ (robot as u64) << 1;
                star.members[robot].up.weather(up, seed);
                star.members[robot].down.weather(down, seed ^ 1);
            }
            Happening::Move { robot, port } => star.move_to_port(robot, port),
            Happening::Restart { frame } => star.restart_server(frame),
            Happening::Garbage { robot, direction } => star.garbage(robot, direction),
            Happening::Replay { robot, direction, handshakes_only } => {
                star.replay(robot, direction, handshakes_only);
            }
        }
    }

    /// Moves the robots by one step; some of them scan.
    fn step(&self, star: &mut Star<'_>, step: u64) {
        let now = star.now();
        for (robot, plan) in self.plans.iter().enumerate() {
            let pose = plan.walk.pose(now);
            let seen_by_cameras = plan.config.pose_source == PoseSource::Fixes;
            if seen_by_cameras {
                star.fix(robot, pose);
            }
            if step.is_multiple_of(plan.scan_every) {
                let odometry = (!seen_by_cameras).then_some(pose);
                star.scan(robot, odometry, &self.world.scan(self.sensor, pose, now));
            }
        }
    }

    /// Maps nothing new, waits for convergence, and then for silence.
    fn settle(&self, star: &mut Star<'_>, mut step: u64) -> Ending {
        let mut behind = star.behind();
        let end = self.calm + if star.repeats_epoch() { UNTIL_COMPARED } else { PATIENCE };
        while behind.is_some() && star.now() < end {
            step += 1;
            star.run_until(Instant(step * STEP.0));
            behind = star.behind();
        }
        let took = star.now().since(self.calm);
        star.check_all();
        let mut level = behind.map_or(Ok(took), Err);
        if level.is_ok() {
            let effort = star.effort();
            star.run_until(star.now() + QUIET);
            if star.effort().iter().zip(&effort).any(|(now, then)| now.0 != then.0) {
                level = Err("tiles were sent after convergence".into());
            } else if let Some(why) = star.behind() {
                level = Err(format!("no longer converged: {why}"));
            }
            let end = star.now() + UNTIL_COMPARED;
            while level.is_ok()
                && let Some(why) = star.unstored()
            {
                if star.now() >= end {
                    level = Err(format!("never reported as stored: {why}"));
                }
                star.run_until(star.now() + STEP);
            }
        }
        let robots = || star.members.iter().filter_map(|member| member.robot());
        let known = star.server().fused().tiles().map(|(.., tile)| {
            let (free, occupied, movable) = tile.counts();
            free + occupied + movable
        });
        Ending {
            level,
            retransmissions: robots().map(|robot| robot.link_counters().retransmissions).sum(),
            evicted: robots().map(|robot| robot.own_tiles().evicted()).sum(),
            known: known.sum(),
        }
    }
}

fn plan(rng: &mut ChaCha8Rng, world: &Boxes, sensor: Fan, id: RobotId) -> Plan {
    let max_range = rng.random_range(900..2_500u16);
    // A scan touches at most the tiles in a square of twice its range; some pools are larger.
    let side = (2 * usize::from(max_range)).div_ceil(1_600) + 1;
    let own = side * side + if rng.random() { 0 } else { rng.random_range(0..12) };
    let pose_source =
        if rng.random() { PoseSource::Fixes } else { PoseSource::Odometry(Pose::default()) };
    let fused_tiles = rng.random_range(4..=16);
    let readings = sensor.beams;
    let bounds = Bounds { readings, own_tiles: own, fused_tiles, max_range, ..BOUNDS };
    Plan {
        config: Config { pose_source, ..Config::new(id, sensor.model(), bounds) },
        walk: Walk::random(world, rng),
        scan_every: rng.random_range(1..8),
    }
}

fn weather(rng: &mut ChaCha8Rng, robot: usize) -> Happening {
    let mut faults = || {
        let at_most = |most: f64, rng: &mut ChaCha8Rng| {
            if rng.random_bool(0.3) { 0.0 } else { rng.random_range(0.0..most) }
        };
        Faults {
            loss: at_most(0.6, rng),
            burst: rng.random_range(1.0..8.0),
            duplicate: at_most(0.3, rng),
            reorder: at_most(0.3, rng),
            corrupt: at_most(0.1, rng),
            latency: Duration(rng.random_range(0..200_000)),
            jitter: Duration(rng.random_range(0..100_000)),
            cut: None,
        }
    };
    Happening::Weather { robot, up: faults(), down: faults() }
}
