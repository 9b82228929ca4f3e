//! Rows of a store that were damaged on disk: the server requests their tiles again, and reports
//! those as lost that no robot holds any longer.

use ubimap_protocol::{
    frame::MAX_FRAME,
    link::Terms,
    message::Interest,
    tile::{Cell, Epoch, Stamp, Tile, TileId, Version},
    time::Instant,
    units::{Millimetres, RobotId},
};
use ubimap_sim_host::{
    mapping::TileRecord,
    run::keeper::Keeper,
    server::{RobotEvent, Server},
    store::{Damage, Store},
};
use ubimap_tests::raw_robot::RawRobot;

const RESOLUTION: Millimetres = Millimetres(50);
const ROBOT: RobotId = RobotId(7);
const HELD: TileId = TileId { x: 0, y: 0 };
const EVICTED: TileId = TileId { x: 1, y: 0 };
const INTACT: TileId = TileId { x: 2, y: 0 };

fn floor() -> Tile {
    Tile { low: [u32::MAX; 32], high: [0; 32] }
}

fn record(id: TileId, row: u32) -> TileRecord {
    // Each tile's rows differ, so that they are found in the file.
    let cells = Tile { low: [row; 32], high: [0; 32] };
    let stamp = Stamp { epoch: Epoch(1), version: Version(1) };
    TileRecord { id, stamp, cells, known: cells, seconds: [1; 1_024] }
}

/// The robot events of a server, polled at `now`.
fn events(server: &mut Server, now: Instant) -> Vec<RobotEvent> {
    server.timeout(now);
    let mut out = [0; MAX_FRAME];
    while server.poll_transmit(0, now, &mut out).is_some() {}
    server.robot_events().iter().map(|(event, ..)| event).collect()
}

#[test]
fn damaged_tiles_are_asked_for_again_or_reported_as_lost() {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("damaged-store");
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let path = folder.join("map.db");
    let rows = [(HELD, 0x1234_5678), (EVICTED, 0x2345_6789), (INTACT, 0x3456_789A)];
    let records = rows.map(|(id, row)| (ROBOT, record(id, row)));
    let mut store = Store::open(&path, RESOLUTION).unwrap();
    store.keep(&records, Instant(5_000_000)).unwrap();
    drop(store);
    let mut file = std::fs::read(&path).unwrap();
    for (_, row) in &rows[..2] {
        let bytes = row.to_le_bytes();
        let at = file.windows(4).rposition(|it| it == bytes).unwrap();
        file[at] ^= 4;
    }
    std::fs::write(&path, file).unwrap();

    let (_, life) = Keeper::open(&path, RESOLUTION, Epoch(1)).unwrap();
    let kept = life.kept.unwrap();
    assert_eq!(kept.tiles, [(ROBOT, record(INTACT, 0x3456_789A))]);
    assert_eq!(kept.damaged_tiles, [HELD, EVICTED].map(|id| (ROBOT, id, Epoch(1))));
    let line = Damage::Tile(ROBOT, EVICTED, Epoch(1)).to_string();
    assert!(line.contains("tile (1, 0) of robot 7, epoch 1, is damaged"), "{line}");

    let terms = Terms { resolution: RESOLUTION, frame: 250, server_epoch: 2, stores: true };
    let mut server = Server::new(terms, 1);
    kept.tiles.iter().for_each(|(robot, record)| server.restore(*robot, record));
    for (robot, id, epoch) in kept.damaged_tiles {
        server.restore_damaged(robot, id, epoch);
    }
    assert_eq!(server.fused().get(HELD), None, "blind again");
    let at = |seconds: u64| Instant(seconds * 1_000_000);
    let mut robot = RawRobot::connect(&mut server, 0, ROBOT, at(100));
    assert_eq!(server.waiting(ROBOT), 2, "two tiles to request");
    robot.draw(&mut server, at(101), HELD, &floor());
    assert!(server.fused().get(HELD).is_some_and(|(_, tile)| tile.cell(3, 3) == Cell::Free));
    let nothing = Interest { number: 1, from: HELD, to: HELD };
    robot.say(&mut server, at(159), &nothing);
    assert_eq!(events(&mut server, at(159)), []);
    // The loss is reported once, with the number of tiles.
    let lost = RobotEvent::LostTiles(ROBOT, 1);
    for second in [160, 161, 300] {
        robot.say(&mut server, at(second), &nothing);
        assert_eq!(events(&mut server, at(second)), [lost]);
        let counts: Vec<u64> = server.robot_events().iter().map(|(_, count, _)| count).collect();
        assert_eq!(counts, [1]);
    }
    assert!(lost.to_string().starts_with("robot 7 has not sent again 1 of its tiles"));
    assert_eq!(server.fused().get(EVICTED), None, "it stays blind");
}
