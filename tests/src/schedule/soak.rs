//! A soak: the schedules' faults one after another for hours, and a calm every few minutes in which
//! all maps must converge.

use std::{fmt, fs, path::Path};

use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Bounds, Config, Memory};
use ubimap_protocol::{
    frame::Direction,
    time::{Duration, Instant},
};

use super::{Happening, Life, STEP, Schedule, weather};
use crate::{
    boxes::Fan,
    star::{Finds, Member, Star},
};

/// Number of robots.
const ROBOTS: usize = 4;
/// Time from the end of a calm to the next one.
const STORM: Duration = Duration::from_secs(240);
/// Time between two faults; the links' faults change apart from this.
const BETWEEN: Duration = Duration::from_secs(16);
/// A robot is cured in every storm whose number is a multiple of this.
const CURE: usize = 5;
/// Range of the sensors in millimetres, and tiles of a robot's pool: a few more than one scan
/// touches, so that a robot on its way gives up tiles all the time.
const RANGE: u16 = 1_200;
const OWN_TILES: usize = 10;
/// Number of rows of the report.
const ROWS: u64 = 16;

/// The state in a calm.
#[derive(Clone, Copy, Debug, Default)]
pub struct Row {
    /// The simulated time.
    pub at: Instant,
    /// The server's estimate of the memory of all robots' layers, in bytes.
    pub memory: usize,
    /// Bytes of the store's files.
    pub disk: u64,
    /// Number of tiles in the layers of all robots.
    pub tiles: usize,
    /// Number of epochs held of these tiles.
    pub epochs: usize,
    /// Maximum number of messages that waited for one robot, and of tiles being written, since the
    /// last row.
    pub queues: [usize; 2],
    /// Resident memory of the process in bytes; 0 if the system does not tell.
    pub resident: u64,
    /// Number of calms so far; in each all maps have converged.
    pub calms: u32,
    /// Number of epochs that the robots have begun since the start.
    pub begun: u32,
}

impl Row {
    /// The head of a table of rows.
    pub const HEAD: &str = "\
        | time | calms | tiles | epochs begun | epochs held | estimated memory, KiB | disk, KiB | messages waiting | tiles being written | resident, MiB |
|---|---|---|---|---|---|---|---|---|---|";
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let minutes = self.at.micros() / 60_000_000;
        let (hours, minutes) = (minutes / 60, minutes % 60);
        let Self { calms, tiles, begun, epochs, queues: [messages, writes], .. } = self;
        let (memory, disk) = (self.memory / 1024, self.disk / 1024);
        let resident = self.resident as f64 / (1024.0 * 1024.0);
        write!(
            f,
            "| {hours}:{minutes:02} | {calms} | {tiles} | {begun} | {epochs} | {memory} | {disk} | {messages} | {writes} | {resident:.1} |"
        )
    }
}

/// Robots that draw the same room for hours.
#[derive(Debug)]
pub struct Soak {
    schedule: Schedule,
    rng: ChaCha8Rng,
    length: Duration,
}

impl Soak {
    /// The soak of a seed, of some length in simulated time.
    pub fn of(seed: u64, length: Duration) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut schedule = Schedule::quiet(seed, &mut rng, ROBOTS, Instant(0));
        (schedule.stores, schedule.repeats_epochs) = (true, false);
        // With a sensor that sees all around and scans often, robots soon see the whole room.
        schedule.sensor = Fan { beams: 72, angle: 6.2 };
        for plan in &mut schedule.plans {
            let Config { robot, pose_source, .. } = plan.config;
            let bounds = Bounds { max_range: RANGE, own_tiles: OWN_TILES, ..plan.config.bounds };
            let bounds = Bounds { readings: schedule.sensor.beams, ..bounds };
            let config = Config::new(robot, schedule.sensor.model(), bounds);
            plan.config = Config { pose_source, ..config };
            plan.scan_every = 2;
        }
        Self { schedule, rng, length }
    }

    /// Runs the soak, with the server's store in a new file. Passes each row to `tell` as soon as
    /// it is measured, and returns all rows.
    ///
    /// # Errors
    /// Why the maps have not converged in a calm.
    ///
    /// # Panics
    /// If an invariant is violated at any time.
    pub fn run(mut self, store: &Path, mut tell: impl FnMut(&Row)) -> Result<Vec<Row>, String> {
        // All memory of the robots is allocated now, so that what grows later is the server's.
        let rounds = (self.length.0.div_ceil(STORM.0) + ROWS) as usize;
        let lives = (0..ROBOTS + rounds).map(|life| &self.schedule.plans[life % ROBOTS]);
        let mut lives: Vec<Life> = lives.map(|plan| Memory::new(&plan.config.bounds)).collect();
        let mut lives = lives.iter_mut();
        let terms = self.schedule.terms();
        let mut star = Star::new(terms, self.schedule.ports, self.schedule.seed);
        let disk = star.disk_mut().expect("the server stores tiles");
        disk.copy_to(store, terms.resolution);
        let robots = self.schedule.plans.iter().enumerate();
        star.members = robots.map(|(port, plan)| Member::new(plan.config.robot, port)).collect();
        for (robot, plan) in self.schedule.plans.iter().enumerate() {
            let config = Config { boot_nonce: robot as u32, ..plan.config };
            star.boot(robot, config, lives.next().expect("there is one for each robot"));
        }

        let (mut rows, mut row) = (Vec::new(), Row::default());
        for round in 0.. {
            let storm = self.storm(&star, round);
            storm.storm(&mut star, &mut lives);
            let ending = storm.settle(&mut star);
            ending.level.map_err(|why| format!("round {round}, {:?}: {why}", star.now()))?;
            row.calms += 1;
            if star.now().micros() * ROWS < self.length.0 * (rows.len() as u64 + 1) {
                continue;
            }
            measure(&mut row, &mut star);
            tell(&row);
            rows.push(row);
            if rows.len() as u64 == ROWS {
                break;
            }
        }
        Ok(rows)
    }

    /// The next storm: every fault once, in any order.
    fn storm(&mut self, star: &Star<'_>, round: usize) -> Schedule {
        let rng = &mut self.rng;
        let robot = rng.random_range(0..ROBOTS);
        let other = rng.random_range(0..ROBOTS);
        let length = Duration(rng.random_range(1_000_000..20_000_000));
        let [up, down] = [Direction::ToServer, Direction::ToRobot];
        let direction = if rng.random() { up } else { down };
        let finds = if round.is_multiple_of(CURE) { Finds::Cure(robot) } else { Finds::Disk };
        let free = (0..self.schedule.ports)
            .filter(|port| star.members.iter().all(|member| member.port != *port));
        let mut faults = vec![
            Happening::Boot { robot: round % ROBOTS },
            Happening::Cut { robot, only: None, length },
            Happening::Cut { robot: other, only: Some(direction), length },
            Happening::Clock {
                robot,
                drift_ppm: rng.random_range(-500..=500),
                jump: Duration(rng.random_range(0..3_000_000)),
            },
            Happening::Command { robot, number: round as u32 },
            Happening::Restart { frame: rng.random_range(60..300), finds },
            Happening::Look { side: rng.random_range(0..4), length },
            Happening::StoreFails { length: Duration(2 * length.0) },
            Happening::Garbage { robot, direction: up },
            Happening::Garbage { robot: other, direction: down },
            Happening::Replay { robot, direction: up, handshakes_only: false },
            Happening::Replay { robot: other, direction: down, handshakes_only: false },
            Happening::Replay { robot, direction, handshakes_only: true },
        ];
        faults.extend(free.last().map(|port| Happening::Move { robot, port }));
        faults.shuffle(rng);
        let begins = star.now();
        let mut happenings: Vec<_> =
            (0..ROBOTS).map(|robot| (begins, weather(rng, robot))).collect();
        let moments = (1..).map(|fault| begins + Duration(fault * BETWEEN.0));
        happenings.extend(moments.zip(faults));
        let calm = (begins + STORM).micros().next_multiple_of(STEP.0);
        Schedule { happenings, calm: Instant(calm), ..self.schedule.clone() }
    }
}

/// Measures the server.
///
/// # Panics If messages wait although nothing happens.
fn measure(row: &mut Row, star: &mut Star<'_>) {
    let ids: Vec<_> = star.members.iter().map(|member| member.id).collect();
    let waiting: usize = ids.iter().map(|id| star.server().waiting(*id)).sum();
    assert_eq!(waiting, 0, "messages wait in a calm");
    let layers = || ids.iter().filter_map(|id| star.server().layer(*id));
    (row.at, row.resident) = (star.now(), resident());
    row.memory = layers().map(|layer| layer.memory()).sum();
    row.begun = layers().map(|layer| layer.next_epoch().0).sum();
    row.tiles = layers().map(|layer| layer.tiles().count()).sum();
    row.epochs = layers().map(|layer| layer.epochs()).sum();
    row.queues = star.take_longest_queues();
    row.disk = star.disk_mut().map_or(0, |disk| disk.bytes());
}

/// Resident memory of this process in bytes.
fn resident() -> u64 {
    let statm = fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages = statm.split_whitespace().nth(1).and_then(|pages| pages.parse::<u64>().ok());
    pages.unwrap_or(0) * 4_096
}
