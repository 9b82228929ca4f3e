//! Memory and disk of a server are bounded over all robots together: an attacker who sends valid
//! tiles under ever new robot numbers can use no more than the limits, and does not disturb other
//! robots.

use std::{fs, path::Path};

use ubimap_protocol::{
    frame::MAX_FRAME,
    link::Terms,
    message::{Interest, TileUpdateHead},
    tile::{Epoch, Layer, Stamp, Tile, TileEncoder, TileId, Version},
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    server::{Event, MAX_ROBOTS, RobotEvent, Server},
    store::Store,
};
use ubimap_tests::raw_robot::RawRobot;

const RESOLUTION: Millimetres = Millimetres(50);
/// The robot that the cameras and the test follow; its port is 0, that of the others 1.
const NEIGHBOUR: RobotId = RobotId(1);
const HOME: TileId = TileId { x: -5, y: -5 };
/// Length of the attack in virtual time.
const SECONDS: u64 = 180;
/// Bytes in 50 ms at the maximum rate of a port.
const FULL_SPEED: usize = 2_000;
/// The common memory of all layers, and 64 KiB for each robot.
const MEMORY: usize = (64 << 20) + MAX_ROBOTS * (64 << 10);

fn at(millis: u64) -> Instant {
    Instant(millis * 1_000)
}

fn floor(rows: usize) -> Tile {
    let mut tile = Tile::UNKNOWN;
    tile.low[..rows].fill(u32::MAX);
    tile
}

/// Sends valid tiles at full speed; each robot number is used for the tiles of a few frames.
#[derive(Default)]
struct Attacker {
    robot: Option<RawRobot>,
    frames: usize,
    numbers: u64,
    tiles: u32,
    refused: usize,
}

impl Attacker {
    fn turn(&mut self, server: &mut Server, now: Instant) {
        let mut bytes = 0;
        while bytes < FULL_SPEED {
            if self.frames.is_multiple_of(8) {
                let id = RobotId(1_000 + (self.numbers % 60_000) as u16);
                self.numbers += 1;
                self.robot = RawRobot::try_connect(server, 1, id, now);
                self.refused += usize::from(self.robot.is_none());
                bytes += 30;
            }
            let Some(robot) = &mut self.robot else { continue };
            self.frames += 1;
            let frame = robot.frame(now, |writer| {
                let head = TileUpdateHead { layer: Layer::Robot, seconds: 0 };
                writer.push_with(&head, |coded| {
                    let mut encoder = TileEncoder::new(coded);
                    for tile in self.tiles..self.tiles + 25 {
                        let id = TileId { x: (tile % 300) as i16, y: (tile / 300 % 300) as i16 };
                        let stamp = Stamp { epoch: Epoch(1), version: Version(1) };
                        encoder.push(id, stamp, None, 0, &Tile::UNKNOWN, &floor(32))?;
                    }
                    encoder.finish()
                })
            });
            self.tiles += 25;
            bytes += frame.len();
            server.receive(1, &frame, now).unwrap();
        }
    }
}

/// What was sent to the neighbour, and the server's events.
#[derive(Debug, Default)]
struct Outcome {
    /// Bytes to the neighbour in each step of 50 ms.
    sent: Vec<usize>,
    events: Vec<RobotEvent>,
    /// Estimated memory of all layers.
    memory: usize,
    rows: usize,
    file: u64,
}

/// The memory of this process in bytes.
fn resident() -> usize {
    let pages = fs::read_to_string("/proc/self/statm").ok().and_then(|statm| {
        statm.split_whitespace().nth(1).and_then(|resident| resident.parse::<usize>().ok())
    });
    pages.unwrap_or(0) * 4_096
}

fn run(name: &str, mut attacker: Option<&mut Attacker>) -> (Server, RawRobot, Outcome) {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    for suffix in ["", "-wal", "-shm"] {
        let _ = fs::remove_file(format!("{}{suffix}", path.display()));
    }
    let mut store = Store::open(&path, RESOLUTION).unwrap();
    let terms = Terms { resolution: RESOLUTION, frame: 250, server_epoch: 1, stores: true };
    let mut server = Server::new(terms, 2);
    let mut neighbour = RawRobot::connect(&mut server, 0, NEIGHBOUR, at(0));
    neighbour.draw(&mut server, at(0), HOME, &floor(3));
    let interest = Interest { number: 1, from: HOME, to: HOME };
    let mut outcome = Outcome::default();
    let mut out = [0; MAX_FRAME];
    for step in 1..=SECONDS * 20 {
        let now = at(step * 50);
        let seen = Sighting::usual(NEIGHBOUR, Pose::from_metres(step as f64 / 1e4, 0.0, 0.0));
        server.observe(&Observation { captured: now, robots: vec![seen], ..Default::default() });
        neighbour.say(&mut server, now, &interest);
        if let Some(attacker) = &mut attacker {
            attacker.turn(&mut server, now);
        }
        server.timeout(now);
        let frames = std::iter::from_fn(|| server.poll_transmit(0, now, &mut out));
        outcome.sent.push(frames.sum());
        while server.poll_transmit(1, now, &mut out).is_some() {}
        while let Some((_, event)) = server.poll_event() {
            outcome.events.extend(match event {
                Event::Robot(event) => Some(event),
                _ => None,
            });
        }
        if step % 5 == 0 {
            let batch: Vec<_> = std::iter::from_fn(|| server.poll_store()).take(256).collect();
            store.keep(&batch, now).unwrap();
            batch.iter().for_each(|(robot, record)| server.stored(*robot, record));
        }
    }
    let layers = (0..=u16::MAX).filter_map(|robot| server.layer(RobotId(robot)));
    outcome.memory = layers.map(|layer| layer.memory()).sum();
    outcome.rows = store.records().unwrap().len();
    outcome.file = path.metadata().unwrap().len();
    (server, neighbour, outcome)
}

#[test]
#[ignore = "long: cargo thorough"]
fn ever_new_numbers_fill_no_memory_and_disturb_nobody() {
    let (.., alone) = run("alone.db", None);
    assert_eq!(alone.events, []);
    let before = resident();
    let mut attacker = Attacker::default();
    let (mut server, mut neighbour, outcome) = run("attacked.db", Some(&mut attacker));
    let grown = resident().saturating_sub(before);
    let Outcome { memory, rows, file, events, sent } = outcome;
    println!(
        "{} tiles under {} numbers, {} refused: {memory} bytes estimated, {grown} measured, {rows} rows, \
         {file} bytes on disk, {} events",
        attacker.tiles,
        attacker.numbers,
        attacker.refused,
        events.len()
    );
    // The neighbour gets the same fixes, tiles and digests at the same times.
    assert!(sent == alone.sent);
    assert!(attacker.tiles > 500_000 && attacker.refused > 1_000);
    assert!((60 << 20..=MEMORY).contains(&memory), "{memory}");
    // The estimate is what the process takes: also the fused layer, and what fusing needs.
    assert!(grown < MEMORY + (64 << 20), "{grown}");
    assert!((8_000..20_000).contains(&rows) && file < 128 << 20, "{rows}, {file}");
    // Both limits are named, at a limited rate: 20 in ten seconds.
    assert!(events.iter().any(|event| matches!(event, RobotEvent::NoRoom(_))));
    assert!(events.iter().any(|event| matches!(event, RobotEvent::TooMany(_))));
    assert!(events.len() as u64 <= SECONDS * 2 + 20, "{}", events.len());

    // A robot that is known keeps its tiles, and still has room for a few more.
    let now = at(SECONDS * 1_000 + 50);
    neighbour.draw(&mut server, now, HOME, &floor(9));
    let more = TileId { x: -6, y: -5 };
    neighbour.draw(&mut server, now, more, &floor(2));
    let layer = server.layer(NEIGHBOUR).unwrap();
    assert_eq!(layer.seen(HOME).unwrap().tile, floor(9));
    assert_eq!(layer.seen(more).unwrap().tile, floor(2));
    // A refused tile is neither in the map nor handed out for storage.
    let drawn = |server: &Server| server.fused().tiles().count();
    assert!(drawn(&server) < 20_000);
    while server.poll_store().is_some() {}
    let last = TileId { x: 299, y: 299 };
    let known = RobotId(1_000);
    let mut known = RawRobot::connect(&mut server, 1, known, now);
    known.draw(&mut server, now, last, &floor(1));
    assert_eq!(server.layer(known.id).unwrap().seen(last), None);
    assert!(server.poll_store().is_none());
    // The server requests the tile, so the robot does not evict it.
    assert_eq!(server.waiting(known.id), 1);
}
