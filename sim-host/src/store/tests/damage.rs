//! A disk that changes written data: each change must be noticed or harmless.

use std::collections::BTreeMap;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// All contents of a store that matter.
#[derive(Debug, PartialEq)]
struct Content {
    tiles: BTreeMap<(RobotId, TileId, Stamp), TileRecord>,
    camera_tiles: Vec<CameraTile>,
    cures: Vec<CureRecord>,
    clock: Instant,
}

impl Content {
    fn of(store: &Store) -> Self {
        let tiles = store.records().unwrap().into_iter();
        Self {
            tiles: tiles.map(|(robot, it)| ((robot, it.id, it.stamp), it)).collect(),
            camera_tiles: store.camera_tiles().unwrap(),
            cures: store.cured().unwrap(),
            clock: store.clock(),
        }
    }
}

/// A store with rows in every table, and its file.
fn full(path: &Path) -> (Content, Vec<u8>) {
    let mut store = Store::open(path, CELLS).unwrap();
    let tiles = (0..24).map(|at| (RobotId(at % 2), record(at as i16 / 6, 1 + at as u32 % 3, 9)));
    store.keep(&tiles.collect::<Vec<_>>(), Instant(77)).unwrap();
    store.keep_camera_tiles(&(0..6).map(|x| seen(x, 1)).collect::<Vec<_>>(), Instant(78)).unwrap();
    for robot in 7..10 {
        let record = CureRecord { robot: RobotId(robot), ..cure(f64::from(robot)) };
        store.cure(&record).unwrap();
    }
    let content = Content::of(&store);
    drop(store);
    let file = std::fs::read(path).unwrap();
    (content, file)
}

/// Opens a damaged file. Returns whether the damage was noticed; if not, it must be harmless.
fn is_noticed(path: &Path, before: &Content) -> bool {
    let mut store = match Store::open(path, CELLS) {
        Err(error) => {
            let told = error.to_string();
            let known = ["damaged", "another version", "not writable"];
            assert!(known.iter().any(|it| told.contains(it)), "{told}");
            return true;
        }
        Ok(store) => store,
    };
    let mut after = Content::of(&store);
    let damage = store.damage().to_vec();
    for (key, record) in &mut after.tiles {
        let original = before.tiles.get(key).expect("no tile is invented");
        // The cells of a tile must be right even if its times are lost.
        if record.seconds == [0; TILE_CELLS as usize] && !damage.is_empty() {
            record.seconds = original.seconds;
        }
        assert!(record == original, "{key:?}: {damage:?}");
    }
    assert!(after.camera_tiles.iter().all(|tile| before.camera_tiles.contains(tile)));
    assert!(after.cures.iter().all(|cure| before.cures.contains(cure)));
    assert_eq!(after.clock, before.clock);
    let count = |it: &Content| it.tiles.len() + it.camera_tiles.len() + it.cures.len();
    assert!(count(before) - count(&after) <= damage.len(), "{damage:?}");

    // The remaining rows can be used, and the damage is no longer reported.
    store.keep(&[(RobotId(5), record(0, 1, 1))], Instant(80)).unwrap();
    drop(store);
    let store = Store::open(path, CELLS).unwrap();
    assert_eq!(store.damage(), []);
    assert_eq!(store.records().unwrap().len(), after.tiles.len() + 1);
    !damage.is_empty()
}

/// Damages a file `times` times with `spoil`. Returns how often that was noticed.
fn count_noticed(name: &str, times: u64, mut spoil: impl FnMut(&mut [u8], &mut ChaCha8Rng)) -> u64 {
    let folder = Folder::new(name);
    let path = folder.path().join("map.db");
    let (content, file) = full(&path);
    let mut noticed = 0;
    for seed in 0..times {
        let mut damaged = file.clone();
        spoil(&mut damaged, &mut ChaCha8Rng::seed_from_u64(seed));
        std::fs::write(&path, damaged).unwrap();
        noticed += u64::from(is_noticed(&path, &content));
        for extension in ["db-wal", "db-shm"] {
            let _ = std::fs::remove_file(path.with_extension(extension));
        }
    }
    noticed
}

fn below(random: &mut ChaCha8Rng, limit: usize) -> usize {
    (random.next_u64() % limit as u64) as usize
}

/// The checksum covers every bit of a row.
#[test]
fn a_flipped_bit_in_a_row_is_noticed() {
    let folder = Folder::new("store-cells");
    let path = folder.path().join("map.db");
    let (_, file) = full(&path);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let blobs = ["tile.cells", "tile.known", "seen.seconds", "camera.cells", "camera.cameras"];
    for round in 0..100 {
        let (table, column) = blobs[round % blobs.len()].split_once('.').unwrap();
        let connection = Connection::open(&path).unwrap();
        let select = format!("SELECT {column} FROM {table} WHERE x = 2 LIMIT 1");
        let original: Vec<u8> = connection.query_row(&select, [], |row| row.get(0)).unwrap();
        let mut flipped = original.clone();
        flipped[below(&mut random, original.len())] ^= 1 << below(&mut random, 8);
        let update = format!("UPDATE {table} SET {column} = ? WHERE {column} = ?");
        connection.execute(&update, [flipped, original]).unwrap();
        drop(connection);
        assert!(!Store::open(&path, CELLS).unwrap().damage().is_empty(), "{table}.{column}");
        std::fs::write(&path, &file).unwrap();
    }
}

#[test]
fn a_flipped_bit_anywhere_is_noticed_or_harmless() {
    let noticed = count_noticed("store-bits", 200, |file, random| {
        let at = below(random, file.len());
        file[at] ^= 1 << below(random, 8);
    });
    assert!(noticed > 100, "{noticed}");
}

#[test]
#[ignore = "long: cargo thorough"]
fn garbage_anywhere_is_noticed_or_harmless() {
    let noticed = count_noticed("store-garbage", 200, |file, random| {
        let at = below(random, file.len() - 16);
        random.fill_bytes(&mut file[at..at + 16]);
    });
    assert!(noticed > 100, "{noticed}");
}

/// The first page has the header and the tables' definitions.
#[test]
#[ignore = "long: cargo thorough"]
fn damage_of_the_first_page_is_noticed_or_harmless() {
    let noticed = count_noticed("store-header", 1500, |file, random| {
        let at = below(random, 4_096);
        file[at] ^= 1 << below(random, 8);
    });
    assert!(noticed > 20, "{noticed}");
}

/// SQLite silently returns to the state before a damaged frame of its log.
#[test]
fn damage_of_the_log_is_noticed_or_costs_the_last_commit() {
    const COMMITS: usize = 20;
    let folder = Folder::new("store-log");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    for x in 0..COMMITS {
        store.keep(&[(RobotId(1), record(x as i16, 1, 1))], Instant(x as u64)).unwrap();
    }
    let [database, log] = ["map.db", "map.db-wal"].map(|it| folder.path().join(it));
    let [database, log] = [database, log].map(|it| std::fs::read(it).unwrap());
    // The files that a killed process leaves.
    let killed = folder.path().join("killed.db");
    let mut noticed = 0;
    let mut opened = |log: &[u8]| {
        std::fs::write(&killed, &database).unwrap();
        std::fs::write(killed.with_extension("db-wal"), log).unwrap();
        let store = Store::open(&killed, CELLS).unwrap();
        let records = store.records().unwrap();
        assert!((0..).zip(&records).all(|(x, it)| it.1 == record(x, 1, 1)), "a prefix");
        let is_told = store.damage() == [Damage::Log];
        noticed += usize::from(is_told);
        (records.len(), is_told)
    };
    assert_eq!(opened(&log), (COMMITS, false));
    // The process was killed in the middle of a write.
    for cut in [log.len() - 1, log.len() - 4_096, log.len() - 4_100, log.len() / 2] {
        assert!(!opened(&log[..cut]).1);
    }
    for seed in 0..100 {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut log = log.clone();
        // Damages any frame except the last one, which may be incomplete.
        let at = below(&mut random, log.len() - 4_120);
        log[at] ^= 1 << below(&mut random, 8);
        let (count, is_told) = opened(&log);
        assert!(is_told || count == COMMITS, "seed {seed}: {count} tiles");
    }
    assert!(noticed > 90, "{noticed}");
}
