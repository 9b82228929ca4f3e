mod backup;
mod damage;

use std::collections::BTreeMap;

use ubimap_protocol::units::{Angle, Pose};

use super::schema::END_OF_EPOCHS;
use super::*;
use crate::{mapping::Correction, testing::Folder};

const CELLS: Millimetres = Millimetres(50);

pub(super) fn record(x: i16, epoch: u32, version: u32) -> TileRecord {
    let word = |row: usize| (row as u32 + version).wrapping_mul(0x9E37_79B9) ^ epoch;
    let cells =
        Tile { low: core::array::from_fn(word), high: core::array::from_fn(|row| !word(row)) };
    TileRecord {
        id: TileId { x, y: -7 },
        stamp: Stamp { epoch: Epoch(epoch), version: Version(version) },
        cells,
        known: Tile { low: cells.high, high: cells.low },
        seconds: core::array::from_fn(|cell| cell as u32 * version),
    }
}

/// By how much a robot was off in two seconds, and what it saw.
fn placement(robot: u16, x: i32) -> (RobotId, Placement) {
    let by = Pose { x: Millimetres(x), y: Millimetres(-4), heading: Angle(65_000) };
    let later = Correction { since: 70_000, by: Pose::default() };
    let ground = BTreeMap::from([(TileId { x: -3, y: 7 }, [0xF000_0001; TILE_SIDE])]);
    let corrections = vec![Correction { since: 3, by }, later];
    (RobotId(robot), Placement { corrections, ground })
}

fn cure(taken_out: f64) -> CureRecord {
    let cured = Cured { taken_out, added: -2.5 };
    CureRecord { robot: RobotId(7), cured, first_epoch: Epoch(5), is_over: true }
}

/// The text of the error with which opening fails.
fn refused(path: &Path, resolution: Millimetres) -> String {
    let error = Store::open(path, resolution).unwrap_err();
    assert_eq!(error.path, path);
    error.to_string()
}

#[test]
fn stored_tiles_are_read_in_the_next_life() {
    let folder = Folder::new("store");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    assert_eq!(store.begin_life(Epoch(0)).unwrap(), Epoch(1));
    assert_eq!((store.clock(), store.records().unwrap()), (Instant(0), Vec::new()));
    let [west, east] = [RobotId(1), RobotId(u16::MAX)];
    let edge = i16::MIN;
    store
        .keep(&[(east, record(edge, END_OF_EPOCHS - 1, 1)), (west, record(4, 2, 8))], Instant(5))
        .unwrap();
    // A newer version replaces the older one of its epoch; another epoch gets its own row, and the
    // newest times apply to the tile.
    store.keep(&[(west, record(4, 2, 9)), (west, record(4, 1, 3))], Instant(3)).unwrap();
    drop(store);

    let mut store = Store::open(&path, CELLS).unwrap();
    assert_eq!(store.clock(), Instant(5), "the clock is monotonic");
    let seconds = record(4, 1, 3).seconds;
    let newer = TileRecord { seconds, ..record(4, 2, 9) };
    let all = [(west, record(4, 1, 3)), (west, newer), (east, record(edge, END_OF_EPOCHS - 1, 1))];
    assert_eq!(store.records().unwrap(), all);
    // No life repeats the epoch of the last one; the order of epochs has no meaning.
    assert_eq!(store.begin_life(Epoch(1)).unwrap(), Epoch(2));
    for (drawn, begun) in [(u32::MAX, u32::MAX), (u32::MAX, 1), (70, 70), (9, 9)] {
        assert_eq!(store.begin_life(Epoch(drawn)).unwrap(), Epoch(begun));
    }
}

/// Earlier versions of the server accepted any epoch of a robot except the highest number.
#[test]
fn tiles_of_impossible_epochs_are_deleted() {
    let folder = Folder::new("store-epochs");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    let robot = RobotId(3);
    let usual = (robot, record(4, 2, 8));
    let all = [usual.clone(), (robot, record(4, u32::MAX - 1, 1))];
    store.keep(&all, Instant(5)).unwrap();
    drop(store);
    let kept = Store::open(&path, CELLS).unwrap().records().unwrap();
    assert_eq!(kept.len(), 1);
    assert_eq!(kept[0].1.stamp, usual.1.stamp);
}

fn seen(x: i16, seed: u32) -> CameraTile {
    let TileRecord { id, cells, seconds, .. } = record(x, seed, seed);
    CameraTile { id, seen: SeenTile { tile: cells, seconds }, cameras: seconds.map(|it| it % 7) }
}

#[test]
fn camera_tiles_and_cures_are_read_in_the_next_life() {
    let folder = Folder::new("store-cameras");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    let robot = RobotId(7);
    let begun = CureRecord { first_epoch: Epoch(3), is_over: false, ..cure(1.25) };
    store.keep(&[(robot, record(0, 4, 1)), (robot, record(0, 5, 1))], Instant(0)).unwrap();
    store.cure(&begun).unwrap();
    assert_eq!(store.cured().unwrap(), [begun]);
    store.keep_placements(&[placement(1, 5), placement(2, 6)], Instant(9)).unwrap();
    store.keep_placements(&[placement(1, 7)], Instant(9)).unwrap();
    store.cure(&cure(3.0)).unwrap();
    store.keep_camera_tiles(&[seen(2, 1), seen(-1, 2)], Instant(8)).unwrap();
    store.keep_camera_tiles(&[seen(2, 3)], Instant(9)).unwrap();
    drop(store);

    let store = Store::open(&path, CELLS).unwrap();
    assert_eq!(store.clock(), Instant(9));
    assert_eq!(store.camera_tiles().unwrap(), [seen(-1, 2), seen(2, 3)]);
    assert_eq!(store.cured().unwrap(), [cure(3.0)]);
    assert_eq!(store.placements().unwrap(), [placement(1, 7), placement(2, 6)]);
    assert_eq!(store.records().unwrap(), [(robot, record(0, 5, 1))]);
}

/// Removes the checksums: the tables of schema 3.
const WITHOUT_SUMS: &str = "
    ALTER TABLE server DROP COLUMN crc; ALTER TABLE tile DROP COLUMN crc;
    ALTER TABLE seen DROP COLUMN crc; ALTER TABLE camera DROP COLUMN crc;
    ALTER TABLE cured DROP COLUMN crc; DROP TABLE placement; PRAGMA user_version = 3;";

#[test]
fn files_of_earlier_schemas_are_upgraded() {
    let folder = Folder::new("store-first");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    store.keep(&[(RobotId(1), record(0, 1, 1))], Instant(3)).unwrap();
    let first = "DROP TABLE camera; DROP TABLE cured; PRAGMA user_version = 1";
    store.connection.execute_batch(WITHOUT_SUMS).unwrap();
    store.connection.execute_batch(first).unwrap();
    drop(store);
    let mut store = Store::open(&path, CELLS).unwrap();
    assert_eq!(store.records().unwrap(), [(RobotId(1), record(0, 1, 1))]);
    store.keep_camera_tiles(&[seen(2, 1)], Instant(8)).unwrap();
    let second = "ALTER TABLE cured DROP COLUMN is_over; PRAGMA user_version = 2;
                  INSERT INTO cured VALUES (7, 5, 3.0, -2.5)";
    store.connection.execute_batch(WITHOUT_SUMS).unwrap();
    store.connection.execute_batch(second).unwrap();
    drop(store);
    let store = Store::open(&path, CELLS).unwrap();
    assert_eq!(store.camera_tiles().unwrap(), [seen(2, 1)]);
    assert_eq!(store.cured().unwrap(), [cure(3.0)]);
    store.connection.execute_batch(WITHOUT_SUMS).unwrap();
    drop(store);
    for _ in 0..2 {
        let store = Store::open(&path, CELLS).unwrap();
        assert_eq!(store.damage(), []);
        assert_eq!(store.records().unwrap(), [(RobotId(1), record(0, 1, 1))]);
        assert_eq!((store.clock(), store.cured().unwrap()), (Instant(8), vec![cure(3.0)]));
    }
}

#[test]
fn a_file_is_open_in_one_process_at_a_time() {
    let folder = Folder::new("store-owner");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    store.begin_life(Epoch(0)).unwrap();
    assert!(refused(&path, CELLS).contains("in use by another process"));
}

#[test]
fn files_of_other_programs_and_maps_are_refused_unchanged() {
    let folder = Folder::new("store-foreign");
    let text =
        folder.file("notes.txt", "not a database, but long enough for one. ".repeat(40).as_bytes());
    assert!(refused(&text, CELLS).contains("not a ubimap store"));

    let foreign = folder.path().join("foreign.db");
    let connection = Connection::open(&foreign).unwrap();
    connection.execute_batch("CREATE TABLE t (a)").unwrap();
    drop(connection);
    let before = std::fs::read(&foreign).unwrap();
    assert!(refused(&foreign, CELLS).contains("not a ubimap store"));
    assert_eq!(std::fs::read(&foreign).unwrap(), before);

    let path = folder.path().join("map.db");
    drop(Store::open(&path, CELLS).unwrap());
    let cells = refused(&path, Millimetres(100));
    assert!(cells.contains("cells of 0.05 m, but this run uses 0.1 m"), "{cells}");
    Connection::open(&path).unwrap().pragma_update(None, "user_version", 6).unwrap();
    assert!(refused(&path, CELLS).contains("schema 6, this one has 5"));

    assert!(refused(folder.path(), CELLS).contains("can't be opened"));
    assert!(refused(&folder.path().join("no/map.db"), CELLS).contains("folder"));
}

/// A row that another program has changed is deleted, like one that the disk has changed.
#[test]
fn damage_is_reported() {
    let folder = Folder::new("store-damage");
    let path = folder.path().join("map.db");
    let spoilt = |statement: &str| {
        let _ = std::fs::remove_file(&path);
        let mut store = Store::open(&path, CELLS).unwrap();
        store.keep(&[(RobotId(1), record(0, 1, 1))], Instant(0)).unwrap();
        store.keep_camera_tiles(&[seen(0, 1)], Instant(0)).unwrap();
        store.cure(&cure(1.0)).unwrap();
        store.keep_placements(&[placement(9, 3)], Instant(0)).unwrap();
        store.connection.execute_batch(statement).unwrap();
        drop(store);
        match Store::open(&path, CELLS) {
            Ok(store) => format!("{:?}", store.damage()),
            Err(error) => error.to_string(),
        }
    };
    let (tile, robot) = (TileId { x: 0, y: -7 }, RobotId(1));
    for (statement, damage) in [
        ("UPDATE tile SET cells = x'00'", Damage::Tile(robot, tile, Epoch(1))),
        ("UPDATE tile SET version = 2", Damage::Tile(robot, tile, Epoch(1))),
        ("UPDATE tile SET epoch = 3", Damage::Tile(robot, tile, Epoch(3))),
        ("UPDATE tile SET robot = 65536", Damage::Unknown),
        ("UPDATE tile SET epoch = -1", Damage::Unknown),
        ("UPDATE seen SET seconds = zeroblob(4095)", Damage::Times(robot, tile)),
        ("UPDATE camera SET cells = zeroblob(257)", Damage::CameraTile(tile)),
        ("UPDATE camera SET cameras = x''", Damage::CameraTile(tile)),
        ("UPDATE camera SET x = 32768", Damage::Unknown),
        ("UPDATE cured SET first_epoch = -1", Damage::Cure(RobotId(7))),
        ("UPDATE cured SET identifier_deg = 1.5", Damage::Cure(RobotId(7))),
        ("UPDATE placement SET corrections = x'00'", Damage::Placement(RobotId(9))),
        ("UPDATE placement SET robot = 65536", Damage::Unknown),
    ] {
        assert_eq!(spoilt(statement), format!("{:?}", [damage]), "{statement}");
        let store = Store::open(&path, CELLS).unwrap();
        assert_eq!(store.damage(), [], "the row is deleted");
        let counts = [
            store.records().unwrap().len(),
            store.camera_tiles().unwrap().len(),
            store.cured().unwrap().len(),
            store.placements().unwrap().len(),
        ];
        let left = if statement.contains("seen") { 4 } else { 3 };
        assert_eq!(counts.iter().sum::<usize>(), left, "{statement}");
    }
    for statement in [
        "UPDATE server SET clock_us = -1",
        "UPDATE server SET resolution_mm = 51",
        "UPDATE server SET epoch = 4294967296",
        "DELETE FROM server",
    ] {
        let told = spoilt(statement);
        assert!(told.contains("damaged") && told.contains("map.db"), "{statement}: {told}");
    }
    let told = spoilt("DROP TABLE server");
    assert!(told.contains("no such table"), "{told}");

    // Overwrite the middle of the file.
    let mut store = Store::open(&folder.path().join("torn.db"), CELLS).unwrap();
    let many: Vec<_> = (0..40).map(|x| (RobotId(1), record(x, 1, 1))).collect();
    store.keep(&many, Instant(0)).unwrap();
    drop(store);
    let torn = folder.path().join("torn.db");
    let mut bytes = std::fs::read(&torn).unwrap();
    let end = bytes.len();
    bytes[4096..end].fill(0xA5);
    std::fs::write(&torn, bytes).unwrap();
    assert!(refused(&torn, CELLS).contains("damaged"));
}

/// SQLite reports a limit on the file's pages as a full disk.
#[test]
fn a_full_disk_loses_nothing_that_was_stored() {
    let folder = Folder::new("store-full");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    store.keep(&[(RobotId(1), record(0, 1, 1))], Instant(0)).unwrap();
    let kept = store.records().unwrap();
    let pages: u32 =
        store.connection.pragma_query_value(None, "page_count", |row| row.get(0)).unwrap();
    store
        .connection
        .pragma_update_and_check(None, "max_page_count", pages + 2, |_| Ok(()))
        .unwrap();
    let many: Vec<_> = (0..40).map(|x| (RobotId(2), record(x, 1, 1))).collect();
    let told = store.keep(&many, Instant(9)).unwrap_err().to_string();
    assert!(told.contains("the disk is full") && told.contains("map.db"), "{told}");
    assert_eq!(store.records().unwrap(), kept);
    drop(store);
    let store = Store::open(&path, CELLS).unwrap();
    assert_eq!((store.clock(), store.records().unwrap()), (Instant(0), kept));
}

/// The old rows are deleted in the same transaction that writes their joined cells, or not at all.
#[test]
fn a_record_of_closed_epochs_replaces_theirs() {
    let folder = Folder::new("store-closed");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    let (robot, other) = (RobotId(1), RobotId(2));
    let mut all: Vec<_> = (1..5).map(|epoch| (robot, record(0, epoch, 1))).collect();
    all.extend([(robot, record(1, 1, 1)), (other, record(0, 1, 1))]);
    store.keep(&all, Instant(0)).unwrap();
    let before = store.records().unwrap();
    let closed = (robot, record(0, 3, 0));
    let pages: u32 =
        store.connection.pragma_query_value(None, "page_count", |row| row.get(0)).unwrap();
    store.limit_pages(pages);
    let mut many: Vec<_> = (0..40).map(|x| (other, record(x, 2, 1))).collect();
    many.insert(0, closed.clone());
    assert!(matches!(store.keep(&many, Instant(0)).unwrap_err().trouble, Trouble::Full));
    assert_eq!(store.records().unwrap(), before);

    store.limit_pages(u32::MAX);
    store.keep(std::slice::from_ref(&closed), Instant(0)).unwrap();
    drop(store);
    let store = Store::open(&path, CELLS).unwrap();
    let seconds = closed.1.seconds;
    let left = [closed, (robot, TileRecord { seconds, ..record(0, 4, 1) })];
    assert_eq!(store.records().unwrap(), [&left, &all[4..]].concat());
}

#[test]
fn names_that_keep_nothing_on_disk_are_refused() {
    for name in ["", ":memory:", "file:map.db", "file::memory:?cache=shared", "/dev/null"] {
        let told = refused(Path::new(name), CELLS);
        assert!(told.contains("not a file on disk"), "{name}: {told}");
    }
}

/// Damages a store, given the paths of its database and its log.
#[cfg(unix)]
type Spoil = fn(&Path, &Path);

/// After each of these, writes would be lost, although SQLite reports success for most of them.
#[cfg(unix)]
#[test]
fn a_file_that_was_removed_replaced_or_truncated_takes_nothing_more() {
    let folder = Folder::new("store-gone");
    let spoil: [(&str, Spoil); 6] = [
        ("removed", |path, _| std::fs::remove_file(path).unwrap()),
        ("replaced", |path, _| {
            let copy = path.with_extension("copy");
            std::fs::copy(path, &copy).unwrap();
            std::fs::rename(copy, path).unwrap();
        }),
        ("truncated", |path, _| truncate(path, 4096)),
        ("emptied", |path, _| truncate(path, 0)),
        ("log removed", |_, log| std::fs::remove_file(log).unwrap()),
        ("log truncated", |_, log| truncate(log, 0)),
    ];
    for (what, spoil) in spoil {
        let path = folder.path().join(format!("{what}.db"));
        let mut store = Store::open(&path, CELLS).unwrap();
        store.begin_life(Epoch(0)).unwrap();
        // Enough commits for several checkpoints, so that the database and its log have both been
        // rewritten.
        for version in 1..=300 {
            let records: Vec<_> =
                (0..5).map(|x| (RobotId(1), record(x, version % 40, version))).collect();
            store.keep(&records, Instant(version.into())).unwrap();
        }
        spoil(&path, &folder.path().join(format!("{what}.db-wal")));
        for _ in 0..2 {
            let told = store.keep(&[(RobotId(1), record(9, 1, 1))], Instant(400)).unwrap_err();
            assert!(matches!(told.trouble, Trouble::Gone), "{what}: {told}");
        }
    }
}

#[cfg(unix)]
fn truncate(path: &Path, len: u64) {
    std::fs::OpenOptions::new().write(true).open(path).unwrap().set_len(len).unwrap();
}

#[test]
fn triggers_and_views_in_a_file_do_not_run() {
    let folder = Folder::new("store-schema");
    let path = folder.path().join("map.db");
    drop(Store::open(&path, CELLS).unwrap());
    let change = |statements: &str| {
        Connection::open(&path).unwrap().execute_batch(statements).unwrap();
    };
    change("CREATE TRIGGER t AFTER INSERT ON tile BEGIN DELETE FROM tile; END");
    let mut store = Store::open(&path, CELLS).unwrap();
    store.keep(&[(RobotId(1), record(0, 1, 1))], Instant(0)).unwrap();
    assert_eq!(store.records().unwrap(), [(RobotId(1), record(0, 1, 1))]);
    drop(store);
    change(
        "ALTER TABLE camera RENAME TO other;
         CREATE VIEW camera AS SELECT * FROM other",
    );
    let told = refused(&path, CELLS);
    assert!(told.contains("view"), "{told}");
}
