//! `ubimap serve --store` is killed repeatedly while robots work: the file must contain everything
//! that the server has confirmed as stored.

use std::{
    collections::BTreeMap,
    io::{Read, Write},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time,
};

use serialport::{SerialPort, TTYPort};
use ubimap_agent::{Bounds, Config, Memory, Robot, locate::PoseSource, sense::SensorModel};
use ubimap_protocol::{
    tile::{Epoch, Layer, TILE_SIDE, Tile, TileId, Version},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    mapping::{MapTime, RobotLayer, SeenTile, Sight, Weight, fuse, hollow},
    run::heap::{BOUNDS, Heap},
    store::Store,
};

const RESOLUTION: Millimetres = Millimetres(50);
const BEAMS: usize = 60;
const ROBOTS: u16 = 2;
/// Tiles in a robot's pool: about as many as one scan touches.
const OWN_TILES: usize = 9;
const PATIENCE: Duration = Duration::from_secs(60);

/// A server process, killed on drop.
struct Serving(Child);

impl Serving {
    /// A server with its robots behind new ports.
    fn start(store: &Path, robots: &mut [Member<'_>]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
        command.arg("serve").arg("--store").arg(store);
        for robot in robots {
            let (mut master, slave) = TTYPort::pair().unwrap();
            master.set_timeout(time::Duration::from_millis(1)).unwrap();
            command.arg(slave.name().unwrap());
            robot.port = Some(master);
        }
        Self(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        // SIGKILL: it can't clean up.
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

/// The confirmations to a robot: for each epoch of a tile the stored version and its cells.
type Promises = BTreeMap<(TileId, Epoch), (Version, Tile)>;

struct Member<'b> {
    id: RobotId,
    robot: Robot<'b>,
    port: Option<TTYPort>,
    next_scan: Instant,
    promises: Promises,
}

impl Member<'_> {
    /// Takes a scan if the robot drives and a scan is due, and exchanges frames with the server.
    fn turn(&mut self, now: Instant, drives: bool) {
        if drives && self.next_scan <= now {
            self.next_scan = now + Duration::from_millis(50);
            // The robot drives back and forth over 12 m at 6 m/s.
            let way = now.micros() as f64 / 1e6 * 6.0 % 24.0;
            let pose = Pose::from_metres(way.min(24.0 - way), f64::from(self.id.0) * 2.0, 0.3);
            let readings: Vec<u16> = (0..BEAMS)
                .map(|beam| 700 + ((beam as u64 * 97 + now.micros()) % 500) as u16)
                .collect();
            self.robot.odometry(now, pose, now);
            let _ = self.robot.scan(now, &readings, now);
        }
        let mut buffer = [0; 1_024];
        // As long as there is no server, the link loses all frames.
        if let Some(count) = self.port.as_mut().and_then(|port| port.read(&mut buffer).ok()) {
            self.robot.receive(&buffer[..count], now);
        }
        self.robot.timeout(now);
        while let Some(len) = self.robot.poll_transmit(now, &mut buffer) {
            if let Some(port) = &mut self.port {
                let _ = port.write_all(&buffer[..len]);
            }
        }
        for tile in self.robot.own_tiles().tiles().filter(|tile| is_stored(tile)) {
            let key = (tile.id().unwrap(), tile.epoch());
            self.promises.insert(key, (tile.stored(), *tile.publication().sent()));
        }
    }

    /// Whether all tiles of the robot are stored, and the robot holds the server's map of its
    /// surroundings.
    fn is_done(&self) -> bool {
        self.robot.is_idle() && self.robot.own_tiles().tiles().all(is_stored)
    }
}

fn is_stored(tile: &ubimap_agent::map::OwnTile) -> bool {
    tile.publication().is_acknowledged() && tile.stored() == tile.publication().version()
}

/// The layers in the file after the server was killed. Checks that all confirmed tiles are there.
fn layers(store: &Path, robots: &[Member<'_>]) -> BTreeMap<RobotId, RobotLayer> {
    let mut layers = BTreeMap::<RobotId, RobotLayer>::new();
    let file = Store::open(store, RESOLUTION).unwrap();
    assert_eq!(file.damage(), [], "a kill damages nothing");
    for (robot, record) in file.records().unwrap() {
        layers.entry(robot).or_default().restore(&record);
    }
    for robot in robots {
        for (&(id, epoch), (version, cells)) in &robot.promises {
            let Some(layer) = layers.get(&robot.id) else { panic!("robot {:?} is lost", robot.id) };
            if layer.is_closed(id, epoch) {
                let seen = layer.seen(id).unwrap();
                let kept = |y| cells.row(y).known() & !seen.tile.row(y).known() == 0;
                assert!((0..TILE_SIDE).all(kept), "cells of {id:?} {epoch:?} are lost");
                continue;
            }
            let held = layer.held(id, epoch);
            let Some((stamp, kept)) = held else { panic!("{id:?} {epoch:?} is not in the file") };
            assert!(stamp.version >= *version, "{id:?} {epoch:?}: {stamp:?}, not {version:?}");
            assert!(stamp.version > *version || kept == cells, "{id:?} {stamp:?} is another");
        }
    }
    layers
}

fn file() -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("killed");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    folder.join("map.db")
}

#[test]
#[ignore = "long: cargo thorough"]
fn a_killed_server_loses_no_confirmed_tile() {
    let store = file();
    let model = SensorModel::Radial { first: -3.0, step: 0.1 };
    let bounds = Bounds {
        readings: BEAMS,
        own_tiles: OWN_TILES,
        fused_tiles: 16,
        max_range: 1_400,
        ..BOUNDS
    };
    let configs = (1..=ROBOTS).map(|id| Config {
        hold: Duration::from_millis(100),
        pose_source: PoseSource::Odometry(Pose::default()),
        boot_nonce: id.into(),
        ..Config::new(RobotId(id), model, bounds)
    });
    let configs: Vec<Config> = configs.collect();
    let mut memories: Vec<Memory<Heap>> =
        configs.iter().map(|config| Memory::new(&config.bounds)).collect();
    let robots = configs.iter().zip(&mut memories).map(|(config, memory)| Member {
        id: config.robot,
        robot: Robot::new(*config, memory).unwrap(),
        port: None,
        next_scan: Instant(0),
        promises: Promises::new(),
    });
    let mut robots: Vec<Member<'_>> = robots.collect();
    let start = time::Instant::now();
    let now = || Instant(start.elapsed().as_micros() as u64);

    for life in 1..=3 {
        let serving = Serving::start(&store, &mut robots);
        let evicted = |robots: &[Member<'_>]| -> u32 {
            robots.iter().map(|member| member.robot.own_tiles().evicted()).sum()
        };
        // Work continues: stored tiles are evicted to make room for new ones.
        let (began, before) = (now(), evicted(&robots));
        while evicted(&robots) < before + 25 {
            robots.iter_mut().for_each(|robot| robot.turn(now(), true));
            let states =
                || robots.iter().map(|member| member.robot.statistics()).collect::<Vec<_>>();
            assert!(now().since(began) < PATIENCE, "life {life}: {:?}", states());
        }
        // A backup of the running server holds what it has confirmed.
        let copy = store.with_file_name(format!("copy-{life}.db"));
        let mut backup = Command::new(env!("CARGO_BIN_EXE_ubimap"));
        let done = backup.arg("backup").args([&store, &copy]).output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        drop(serving);
        layers(&copy, &robots);
        layers(&store, &robots);
    }

    let serving = Serving::start(&store, &mut robots);
    let began = now();
    let mut done_since = None;
    while done_since.is_none_or(|since| now().since(since) < Duration::from_secs(3)) {
        robots.iter_mut().for_each(|robot| robot.turn(now(), false));
        let done = robots.iter().all(|member| member.robot.is_connected() && member.is_done());
        done_since = done_since.filter(|_| done).or(done.then(now));
        assert!(now().since(began) < PATIENCE, "they never agree");
    }
    drop(serving);

    let layers = layers(&store, &robots);
    for robot in &robots {
        // For each cell the value from the newest epoch that knows it.
        let mut told = BTreeMap::<TileId, Tile>::new();
        for (&(id, _), (_, cells)) in robot.promises.iter().rev() {
            told.entry(id).or_default().fill_unknown_from(cells);
        }
        let kept: BTreeMap<TileId, Tile> =
            layers[&robot.id].tiles().map(|(id, seen)| (id, seen.tile)).collect();
        assert!(kept == told, "robot {}", robot.id.0);
        assert!(robot.promises.len() > kept.len() + 10, "evictions begin tiles anew");
        // The robot's copy of the server's map equals the fusion of the layers in the file.
        let held: Vec<_> = robot.robot.fused_tiles().tiles(Layer::Fused).collect();
        assert!(!held.is_empty());
        for (id, replica) in held {
            let whole = |id| {
                let seen = layers.values().filter_map(|layer| layer.seen(id));
                let seen: Vec<_> = seen.map(|seen| (Weight::FULL, seen)).collect();
                fuse(&SeenTile::NOTHING, &seen, None, MapTime::default())
            };
            let beside = |east, north| whole(TileId { x: id.x + east, y: id.y + north });
            let beside: [[Tile; 3]; 3] =
                [-1, 0, 1].map(|north| [-1, 0, 1].map(|east| beside(east, north)));
            let mut expected = whole(id);
            let unseen = Sight::default();
            let tile = |east, north| {
                let tile = beside.get((north + 1) as usize)?.get((east + 1) as usize)?;
                Some((tile, &unseen))
            };
            hollow(&mut expected, &unseen, tile);
            assert_eq!(*replica.tile(), expected, "{id:?}");
        }
    }
}
