//! Bandwidth of robots and of the server.

use std::{collections::VecDeque, path::Path};

use ubimap_agent::{Bounds, Config, Memory, locate::PoseSource, sense::SensorModel};
use ubimap_protocol::{
    message::ObstacleClass,
    tile::{Cell, Layer, TILE_SIDE, Tile},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    channel::fault::Faults,
    run::{
        fleet::{Event, Fleet, Stage},
        heap::BOUNDS,
        room_stage::RoomStage,
        simulate::{RESOLUTION, config},
    },
    world::{Scenario, World},
};
use ubimap_tests::deployments::bare;

/// Readings per scan.
const BEAMS: usize = 30;
/// After one scan the server holds exactly what the robot published, so the sizes of the other
/// formats are computed for the same cells.
#[test]
fn other_formats_are_compared_for_the_published_cells() {
    let model = SensorModel::Radial { first: -1.5, step: 0.02 };
    let pose_source = PoseSource::Odometry(Pose::from_metres(0.4, -0.3, 0.7));
    let bounds = Bounds { readings: 150, ..BOUNDS };
    let config = Config { pose_source, ..Config::new(RobotId(1), model, bounds) }.with_drive(None);
    let mut memory = [Memory::new(&bounds)];
    let faults = Faults::default();
    let mut fleet = Fleet::new(&[config], &mut memory, faults, 1, bare(Millimetres(50))).unwrap();
    assert!(fleet.run(&mut OneScan::default(), |_| {}).unwrap());

    let mut columns = Vec::new();
    let mut rows = Vec::new();
    let layer = fleet.server().layer(RobotId(1)).unwrap();
    for (id, seen) in layer.tiles() {
        let cells = (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (x, y)));
        for (x, y) in cells.filter(|&(x, y)| seen.tile.cell(x, y) != Cell::Unknown) {
            columns.push(id.first_cell().0 + x as i32);
            rows.push(id.first_cell().1 + y as i32);
        }
    }
    let span =
        |cells: &[i32]| (cells.iter().max().unwrap() - cells.iter().min().unwrap() + 1) as u64;
    let tiles = layer.tiles().count() as u64;
    let compared = fleet.robots()[0].comparison();
    assert_eq!(compared.updates, 1);
    assert_eq!(compared.occupancy_grid_update_bytes, 40 + span(&columns) * span(&rows));
    assert_eq!(compared.obstacle_distance_bytes, 3 * 179, "of 150 beams");
    assert!((20..260 * tiles).contains(&compared.zlib_tiles_bytes), "{compared:?}, {tiles} tiles");
}

/// A robot that takes one scan.
#[derive(Default)]
struct OneScan(u32);

impl Stage for OneScan {
    fn next_event(&self) -> Option<Instant> {
        (self.0 < 2).then_some(Instant(5_000_000))
    }

    fn poll(&mut self, _: Instant) -> Option<Event> {
        self.0 += 1;
        match self.0 {
            1 => Some(Event::Odometry { robot: 0, pose: Pose::default() }),
            2 => Some(Event::Scan { robot: 0, readings: vec![2_500; 150] }),
            _ => None,
        }
    }
}

/// A robot that does nothing until this time.
struct Idle(Option<Instant>);

impl Stage for Idle {
    fn next_event(&self) -> Option<Instant> {
        self.0
    }

    fn poll(&mut self, _: Instant) -> Option<Event> {
        self.0 = None;
        None
    }
}

/// A robot that stands still and scans a wall five times per second until some time.
struct Standing {
    next: Instant,
    end: Instant,
    odometry_read: bool,
}

impl Stage for Standing {
    fn next_event(&self) -> Option<Instant> {
        (self.next <= self.end).then_some(self.next)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        self.next_event().filter(|next| *next <= now)?;
        self.odometry_read = !self.odometry_read;
        if self.odometry_read {
            return Some(Event::Odometry { robot: 0, pose: Pose::default() });
        }
        self.next = self.next + Duration::from_millis(200);
        Some(Event::Scan { robot: 0, readings: vec![1_000; BEAMS] })
    }
}

/// Bytes sent by a robot during a stage, and the number of distance vectors received.
fn sent(mut stage: impl Stage, faults: Faults) -> (u64, u32) {
    let model = SensorModel::Radial { first: -1.5, step: 0.1 };
    let pose_source = PoseSource::Odometry(Pose::default());
    let bounds = Bounds { readings: BEAMS, ..BOUNDS };
    let config = Config { pose_source, ..Config::new(RobotId(1), model, bounds) }.with_drive(None);
    let mut memory = [Memory::new(&bounds)];
    let mut fleet = Fleet::new(&[config], &mut memory, faults, 1, bare(Millimetres(50))).unwrap();
    fleet.run(&mut stage, |_| {}).unwrap();
    let vectors = fleet.server().distance_vectors(RobotId(1));
    (fleet.robots()[0].robot().statistics().bytes_sent, vectors)
}

#[test]
fn an_idle_robot_sends_twenty_bytes_a_second_at_most() {
    let bad =
        Faults { loss: 0.3, duplicate: 0.05, reorder: 0.1, corrupt: 0.02, ..Faults::default() };
    for faults in [Faults::default(), bad] {
        let idle = |end| sent(Idle(Some(end)), faults);
        let standing = |end| sent(Standing { next: Instant(0), end, odometry_read: false }, faults);
        for (name, run) in [("idle", &idle as &dyn Fn(Instant) -> _), ("standing", &standing)] {
            // The first minute is excluded, because the clocks are synchronised then.
            let [(start, _), (end, vectors)] =
                [60, 660].map(|seconds| run(Instant(0) + Duration::from_secs(seconds)));
            let rate = (end - start) as f64 / 600.0;
            println!(
                "a robot, {name}: {rate:.1} bytes/s up, {vectors} distance vectors, loss {}",
                faults.loss
            );
            assert!(rate <= 20.0, "{name}: {rate} bytes/s");
            // A robot without scans sends no distance vectors; one at standstill sends one per
            // minute.
            let expected = if name == "idle" { 0..=0 } else { 5..=12 };
            assert!(expected.contains(&vectors), "{name}: {vectors}");
        }
    }
}

const ROBOT: RobotId = RobotId(1);
/// By this time every robot holds the map.
const JOINED: Instant = Instant(5_000_000);
const END: Instant = Instant(90_000_000);

/// Measurements of one run.
#[derive(Debug, Default)]
struct Seen {
    /// The bytes sent to the robot in the last second with their times, and the maximum sum per
    /// second.
    second: VecDeque<(Instant, u64)>,
    busiest: u64,
    joined: u64,
    bytes: u64,
    /// Maximum number of queued messages.
    waiting: usize,
    /// Number of samples, and number of samples in which the cell ahead of the robot was covered by
    /// cameras.
    samples: u32,
    fresh: u32,
    /// Maximum numbers of peers and people known to the robot.
    peers: usize,
    people: usize,
}

impl Seen {
    fn look(&mut self, fleet: &Fleet<'_>) {
        let (now, server) = (fleet.now(), fleet.server());
        self.bytes = server.bytes_sent(0);
        self.waiting = self.waiting.max(server.waiting(ROBOT));
        self.second.push_back((now, self.bytes));
        while self.second.front().is_some_and(|&(at, _)| at + Duration::from_secs(1) < now) {
            self.second.pop_front();
        }
        if now < JOINED {
            (self.joined, self.second) = (self.bytes, VecDeque::new());
            return;
        }
        let before = self.second.front().map_or(self.bytes, |&(_, bytes)| bytes);
        self.busiest = self.busiest.max(self.bytes - before);
        let robot = fleet.robots()[0].robot();
        let Some((_, pose)) = robot.pose() else { return };
        // Half a metre ahead, where no wall is near.
        let ahead = |metres: f64, unit: f64| ((metres + unit / 2.0) / RESOLUTION.metres()) as i32;
        let (sine, cosine) = pose.heading.radians().sin_cos();
        let cell = (ahead(pose.x.metres(), cosine), ahead(pose.y.metres(), sine));
        self.samples += 1;
        self.fresh += u32::from(fleet.robots()[0].is_left_to_cameras(fleet.now(), cell));
        let commands = robot.commands();
        self.peers = self.peers.max(commands.peers().map_or(0, |it| it.peers.len()));
        let people = commands.obstacles().map_or(0, |it| {
            it.obstacles.iter().filter(|it| it.class == ObstacleClass::Person).count()
        });
        self.people = self.people.max(people);
    }
}

fn cross(faults: Faults) -> Seen {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../sim-host/scenarios/crossing.toml");
    let scenario = Scenario::read(&path).unwrap();
    assert!(scenario.cameras.len() == 4 && scenario.people.len() >= 4);
    let world = World::new(&scenario, None, RESOLUTION, 1).unwrap();
    let robots = world.robots().iter();
    let configs: Vec<_> = robots.map(|robot| config(robot, 1).with_drive(None)).collect();
    let mut memory: Vec<_> = configs.iter().map(|it| Memory::new(&it.bounds)).collect();
    let mut fleet = Fleet::new(&configs, &mut memory, faults, 1, bare(RESOLUTION)).unwrap();
    let mut seen = Seen::default();
    let level = fleet.run(&mut RoomStage::new(world, END), |fleet| seen.look(fleet)).unwrap();
    assert!(level, "the robots do not converge to one map");

    // The cameras stop: nothing is covered any more, and the robot knows it.
    fleet.run(&mut Idle(Some(fleet.now() + Duration::from_secs(10))), |_| {}).unwrap();
    let held: Vec<_> = fleet.robots()[0].robot().fused_tiles().tiles(Layer::Coverage).collect();
    // In a corner of the hall, about half of its window is outside.
    assert!(held.len() >= 20, "{}", held.len());
    for (id, replica) in held {
        let (version, tile) = fleet.server().coverage().get(id).unwrap();
        assert_eq!((replica.stamp().version, replica.tile()), (version, tile), "{id:?}");
        assert_eq!(tile, &Tile::UNKNOWN, "{id:?}");
    }
    seen
}

#[test]
#[ignore = "long: cargo thorough"]
fn a_robot_that_crosses_covered_ground_is_sent_two_kilobytes_a_second_at_most() {
    let bad =
        Faults { loss: 0.3, duplicate: 0.05, reorder: 0.1, corrupt: 0.02, ..Faults::default() };
    for faults in [Faults::default(), bad] {
        let seen = cross(faults);
        let seconds = END.since(JOINED).micros() as f64 / 1e6;
        let mean = (seen.bytes - seen.joined) as f64 / seconds;
        let fresh = f64::from(seen.fresh) / f64::from(seen.samples);
        println!(
            "crossing covered ground, loss {}: {mean:.0} bytes/s down, {} in the busiest second, \
             at most {} messages waiting, {:.0} % of the time the ground ahead is the cameras', \
             {} peers, {} people",
            faults.loss,
            seen.busiest,
            seen.waiting,
            100.0 * fresh,
            seen.peers,
            seen.people,
        );
        // Frames that are lost together are also retransmitted together.
        assert!(mean <= 2_000.0 && (seen.busiest <= 2_000 || faults.loss > 0.0), "{seen:?}");
        // At most a fix and a time reply are queued: nothing accumulates.
        assert!(seen.waiting <= 4, "{seen:?}");
        assert!(seen.peers == 2 && seen.people >= 3, "{seen:?}");
    }
}
