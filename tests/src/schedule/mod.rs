//! Schedules: random events for a server and its robots, determined by a seed. After every
//! schedule, once the links are restored and nothing new is mapped, all maps must converge within a
//! time limit.

use std::{collections::BTreeSet, fmt};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Bounds, Config, Memory, locate::PoseSource};
use ubimap_protocol::{
    frame::{Direction, MIN_FRAME, MIN_SEALED_FRAME},
    link::Terms,
    message::{ParameterAction, ParameterCommand, Stop},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    channel::fault::Faults,
    run::heap::{BOUNDS, Heap},
    server::Command,
};

mod newcomer;
mod soak;

pub use newcomer::{Level, Newcomer};
pub use soak::{Row, Soak};

use crate::{
    boxes::{Boxes, Fan, Walk},
    star::{Finds, Member, Star},
};

/// Interval of the robots' motion.
const STEP: Duration = Duration::from_millis(100);
/// Time limit for convergence after the links are restored and the last scan is taken. It covers a
/// handshake retry after a long cut (3.2 s), a session opened by an old Hello, the tiles of a
/// window at the downlink's bandwidth, and a slightly faulty link.
pub const PATIENCE: Duration = Duration::from_secs(30);
/// Time limit for convergence after a cure (the correction of a robot's constant error): the tiles
/// that it has made void are requested from all robots and sent to all of them again, in frames
/// that may have room for only 10 bytes of a tile.
const UNTIL_CURED: Duration = Duration::from_secs(120);
/// Time limit until all tiles have been compared by their digests. A robot has at most 36 tiles, and
/// the smallest frames hold one digest, sent every ten seconds; as one digest in ten is lost, five
/// rounds are allowed. A robot may need this long to learn that its last tile is stored. So may
/// robots and a server that has the epoch of an earlier life, until their maps agree.
const UNTIL_COMPARED: Duration = Duration::from_secs(5 * 36 * 10);
/// Duration of silence required after convergence.
const QUIET: Duration = Duration::from_secs(3);

/// The memory that a robot uses from one boot to the next.
type Life = Memory<Heap>;

/// An event at some time.
#[derive(Clone, Copy, Debug)]
enum Happening {
    /// A robot boots, for the first time or again.
    Boot { robot: usize },
    /// Its link is cut, in one direction or in both.
    Cut { robot: usize, only: Option<Direction>, length: Duration },
    /// Its clock jumps forward, and runs fast or slow from then on.
    Clock { robot: usize, drift_ppm: i64, jump: Duration },
    /// The server commands it to stop, to drive on, or to report its parameters.
    Command { robot: usize, number: u32 },
    /// The faults of its link change.
    Weather { robot: usize, up: Faults, down: Faults },
    /// It moves to another port.
    Move { robot: usize, port: usize },
    /// The server is killed and restarted: from its disk if it has one, otherwise empty, and with
    /// frames of another size. The robots keep their state.
    Restart { frame: u16, finds: Finds },
    /// The server's disk is copied.
    BackUp,
    /// For a while a camera sees free ground beyond a wall of the room.
    Look { side: usize, length: Duration },
    /// Another robot that has the number of the first one is switched on, at a port of its own, or
    /// off.
    Twin { is_on: bool },
    /// For a while every write to the server's disk fails.
    StoreFails { length: Duration },
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
    /// A robot that has the number of the first one; it is switched on and off.
    twin: Option<Plan>,
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
    /// Whether the ports are keyed. A robot that has another one's number has another key.
    is_sealed: bool,
    /// Whether the server may restart in an epoch of an earlier life.
    repeats_epochs: bool,
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
    /// Number of cells that robots have told, summed over the robots.
    pub known: u32,
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
        // Not drawn, so that the schedules are those of open links.
        schedule.is_sealed = seed % 3 == 2;
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
            let happening = match rng.random_range(0..30) {
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
                21 => Happening::Command { robot, number: moment as u32 },
                6..9 => weather(rng, robot),
                9..11 => {
                    let port = rng.random_range(0..schedule.ports);
                    if ports.contains(&port) {
                        continue;
                    }
                    ports[robot] = port;
                    Happening::Move { robot, port }
                }
                11..13 => {
                    let finds = match rng.random_range(0..10) {
                        0..2 => Finds::Backup,
                        2..4 => Finds::Cure(robot),
                        _ => Finds::Disk,
                    };
                    Happening::Restart { frame: rng.random_range(32..300), finds }
                }
                22 => Happening::BackUp,
                23..25 => {
                    let length = Duration(rng.random_range(100_000..6_000_000));
                    Happening::Look { side: rng.random_range(0..4), length }
                }
                25 if schedule.twin.is_none() => {
                    schedule.twin = Some(plan(
                        rng,
                        &schedule.world,
                        schedule.sensor,
                        RobotId(robot as u16 + 1),
                    ));
                    let off = Instant(rng.random_range(moment..calm.0));
                    schedule.happenings.push((off, Happening::Twin { is_on: false }));
                    Happening::Twin { is_on: true }
                }
                13..15 => Happening::Garbage { robot, direction },
                _ => Happening::Replay { robot, direction, handshakes_only: rng.random_bool(0.4) },
            };
            schedule.happenings.push((Instant(moment), happening));
        }
        // All robots boot at once, as after a power failure.
        if rng.random_bool(0.1) {
            let moment = Instant(rng.random_range(0..calm.0));
            schedule
                .happenings
                .push((moment, Happening::Restart { frame: schedule.frame, finds: Finds::Disk }));
            let boots = (0..robots).map(|robot| (moment, Happening::Boot { robot }));
            schedule.happenings.extend(boots);
        }
        schedule.happenings.sort_by_key(|(moment, _)| *moment);
        schedule
    }

    /// A schedule whose only faults are lost frames, with this probability. Some robots map for a
    /// while and then stop.
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

    fn terms(&self) -> Terms {
        let Self { stores, .. } = *self;
        let frame = self.agreeable(self.frame);
        Terms { resolution: Millimetres(50), frame, server_epoch: 1, stores }
    }

    /// A frame size that the server may name on these ports.
    fn agreeable(&self, frame: u16) -> u16 {
        let min = if self.is_sealed { MIN_SEALED_FRAME } else { MIN_FRAME };
        frame.max(min as u16)
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
            twin: None,
            ports: robots + 2,
            frame: if rng.random() { 250 } else { rng.random_range(32..300) },
            stores: false,
            happenings: Vec::new(),
            calm,
            calm_faults,
            drop_repeats: false,
            is_sealed: false,
            repeats_epochs: true,
        }
    }

    /// Runs the schedule.
    ///
    /// # Panics
    /// If an invariant is violated at any time.
    pub fn run(&self) -> Ending {
        let terms = self.terms();
        let boots = self.happenings.iter().filter_map(|(_, happening)| match happening {
            Happening::Boot { robot } => Some(&self.plans[*robot]),
            Happening::Twin { is_on: true } => self.twin.as_ref(),
            _ => None,
        });
        let mut lives: Vec<Life> = boots.map(|plan| Memory::new(&plan.config.bounds)).collect();
        let mut lives = lives.iter_mut();
        // The last port is the twin's.
        let mut star = Star::new(terms, self.ports + 1, self.seed);
        let robots =
            self.plans.iter().enumerate().chain(self.twin.iter().map(|it| (self.ports, it)));
        star.members = robots.map(|(port, plan)| Member::new(plan.config.robot, port)).collect();
        if self.is_sealed {
            star.seal();
        }
        if self.drop_repeats {
            star.members.iter_mut().for_each(|robot| robot.up.drop_repeats());
        }

        self.storm(&mut star, &mut lives);
        self.settle(&mut star)
    }

    /// Moves the robots from the present time to the beginning of the calm, and lets all events
    /// happen that are due meanwhile.
    fn storm<'l>(&self, star: &mut Star<'l>, lives: &mut impl Iterator<Item = &'l mut Life>) {
        let mut happenings = self.happenings.iter().peekable();
        let mut step = star.now().micros().div_ceil(STEP.0);
        while Instant(step * STEP.0) < self.calm {
            let next = Instant(step * STEP.0);
            while let Some((moment, happening)) = happenings.next_if(|(moment, _)| *moment <= next)
            {
                star.run_until(*moment);
                let booting = match *happening {
                    Happening::Boot { robot } => Some((robot, &self.plans[robot])),
                    Happening::Twin { is_on: true } => {
                        self.twin.as_ref().map(|twin| (self.plans.len(), twin))
                    }
                    _ => None,
                };
                match *happening {
                    _ if let Some((robot, plan)) = booting => {
                        let life = lives.next().expect("there is one for each boot");
                        let nonce = (moment.0 as u32).wrapping_mul(2_654_435_761) ^ robot as u32;
                        let config = Config { boot_nonce: nonce, ..plan.config };
                        star.boot(robot, config, life);
                    }
                    happening => self.happen(star, *moment, happening),
                }
            }
            star.run_until(next);
            self.step(star, step);
            step += 1;
        }
        if self.twin.is_some() {
            star.switch_off(self.plans.len());
        }
        let (up, down) = (self.calm_faults, self.calm_faults);
        for robot in 0..self.plans.len() {
            self.happen(star, self.calm, Happening::Weather { robot, up, down });
        }
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
            Happening::Command { robot, number } => {
                let command = match number % 3 {
                    0 => Command::Parameter(ParameterCommand {
                        number: number as u16 >> 2,
                        action: ParameterAction::List,
                    }),
                    kind => Command::Stop(Stop { number, stop: kind == 1 }),
                };
                // A robot without a session can't be commanded.
                let _ = star.command(robot, command);
            }
            Happening::Weather { robot, up, down } => {
                let seed = self.seed.wrapping_mul(0x1_0001) ^ moment.0 << 8 ^ (robot as u64) << 1;
                star.members[robot].up.weather(up, seed);
                star.members[robot].down.weather(down, seed ^ 1);
            }
            Happening::Move { robot, port } => star.move_to_port(robot, port),
            Happening::Restart { frame, finds } => {
                star.restart_server(self.agreeable(frame), finds, self.repeats_epochs)
            }
            Happening::BackUp => star.back_up(),
            // What cameras see is reported with each step.
            Happening::Look { .. } => {}
            Happening::Twin { .. } => star.switch_off(self.plans.len()),
            Happening::StoreFails { length } => star.fail_store(length),
            Happening::Garbage { robot, direction } => star.garbage(robot, direction),
            Happening::Replay { robot, direction, handshakes_only } => {
                star.replay(robot, direction, handshakes_only);
            }
        }
    }

    /// Moves the robots by one step; some of them scan.
    fn step(&self, star: &mut Star<'_>, step: u64) {
        let now = star.now();
        // A robot that is located by cameras interpolates its pose, so that scans taken in a turn may end
        // behind the walls.
        let plans = || self.plans.iter().chain(&self.twin);
        let located = plans().filter(|it| it.config.pose_source == PoseSource::Fixes);
        let reach = located.map(|it| it.config.bounds.max_range).max().unwrap_or(0);
        for &(begins, happening) in &self.happenings {
            if let Happening::Look { side, length } = happening
                && (begins..begins + length).contains(&now)
            {
                star.look(self.world.beyond(side, reach));
            }
        }
        for (robot, plan) in plans().enumerate() {
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

    /// Stops mapping, waits until all maps have converged, and then checks that nothing more is
    /// sent.
    fn settle(&self, star: &mut Star<'_>) -> Ending {
        let patience = match star.repeats_epoch() {
            true => UNTIL_COMPARED,
            false if star.has_cured() => UNTIL_CURED,
            false => PATIENCE,
        };
        let mut level = self.converge(star, self.calm + patience);
        star.check_all();
        if level.is_ok()
            && let Err(why) = self.stay_level(star)
        {
            level = Err(why);
        }
        let robots = || star.members.iter().filter_map(|member| member.robot());
        let ids: BTreeSet<RobotId> = star.members.iter().map(|member| member.id).collect();
        let layers = ids.into_iter().filter_map(|robot| star.server().layer(robot));
        let tiles = layers.flat_map(|layer| layer.tiles());
        let known = tiles.map(|(_, seen)| {
            let (free, occupied, movable) = seen.tile.counts();
            free + occupied + movable
        });
        Ending {
            level,
            retransmissions: robots().map(|robot| robot.link_counters().retransmissions).sum(),
            evicted: robots().map(|robot| robot.own_tiles().evicted()).sum(),
            known: known.sum(),
        }
    }

    /// Runs until all maps have converged; returns the time since the calm began.
    fn converge(&self, star: &mut Star<'_>, end: Instant) -> Result<Duration, String> {
        // The last step before the calm was taken.
        let mut step = star.now().micros().div_ceil(STEP.0);
        while let Some(why) = star.behind() {
            if star.now() >= end {
                return Err(why);
            }
            step += 1;
            star.run_until(Instant(step * STEP.0));
        }
        Ok(star.now().since(self.calm))
    }

    /// Checks that nothing more happens once all maps have converged, and waits until the robots know
    /// that all their tiles are stored.
    fn stay_level(&self, star: &mut Star<'_>) -> Result<(), String> {
        let (effort, time) = (star.effort(), star.server().map_time());
        star.run_until(star.now() + QUIET);
        let is_silent = star.effort().iter().zip(&effort).all(|(now, then)| now.0 == then.0);
        if !is_silent && !star.has_cured() {
            return Err("tiles were sent after convergence".into());
        }
        // The map itself may have changed since: when its time steps, movable cells expire, and robots are
        // weighed anew.
        let may_change = star.server().map_time() != time;
        let patience = match star.has_cured() {
            // Requested tiles may change the map once more.
            true => UNTIL_CURED,
            false if may_change => PATIENCE,
            false => Duration(0),
        };
        let end = star.now() + patience;
        self.converge(star, end).map_err(|why| format!("no longer converged: {why}"))?;
        let end = star.now() + UNTIL_COMPARED;
        while let Some(why) = star.unstored() {
            if star.now() >= end {
                return Err(format!("never reported as stored: {why}"));
            }
            star.run_until(star.now() + STEP);
        }
        Ok(())
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
