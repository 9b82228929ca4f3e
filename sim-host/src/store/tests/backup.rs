use super::*;

/// The robots' tiles in a file.
fn tiles(path: &Path) -> Vec<(RobotId, TileRecord)> {
    Store::open(path, CELLS).unwrap().records().unwrap()
}

#[test]
fn a_store_in_use_is_copied_with_everything_stored() {
    let folder = Folder::new("backup");
    let (path, copy) = (folder.path().join("map.db"), folder.path().join("copy.db"));
    let mut store = Store::open(&path, CELLS).unwrap();
    store.keep(&[(RobotId(1), record(0, 1, 1))], Instant(7)).unwrap();
    assert_eq!(backup(&path, &copy).unwrap(), 1);
    // The writer continues, and the earlier backup is replaced.
    store.keep(&[(RobotId(1), record(1, 1, 1))], Instant(8)).unwrap();
    assert_eq!(backup(&path, &copy).unwrap(), 2);
    store.keep(&[(RobotId(1), record(2, 1, 1))], Instant(9)).unwrap();
    let names = || -> Vec<_> {
        let all = std::fs::read_dir(folder.path()).unwrap();
        all.map(|it| it.unwrap().file_name().into_string().unwrap())
            .filter(|name| name.starts_with("copy"))
            .collect()
    };
    assert_eq!(names(), ["copy.db"]);
    let both = [0, 1].map(|x| (RobotId(1), record(x, 1, 1)));
    let opened = Store::open(&copy, CELLS).unwrap();
    assert_eq!((opened.records().unwrap(), opened.clock()), (both.to_vec(), Instant(8)));
    drop((opened, store));
    assert_eq!(tiles(&path).len(), 3);
}

/// Writes batches of tiles, each batch with one version, while backups are made. Each copy must
/// contain a complete batch, and everything that was stored before the copy began.
#[test]
fn a_copy_is_consistent_while_the_writer_is_busy() {
    use std::sync::atomic::{AtomicU32, Ordering};
    let folder = Folder::new("backup-busy");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    let write = |store: &mut Store, version: u32| {
        let batch: Vec<_> = (0..20).map(|x| (RobotId(1), record(x, 1, version))).collect();
        store.keep(&batch, Instant(version.into())).unwrap();
    };
    write(&mut store, 1);
    let (stored, wanted) = (AtomicU32::new(1), AtomicU32::new(u32::MAX));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            for version in 2..u32::MAX {
                if wanted.load(Ordering::SeqCst) == 0 {
                    break;
                }
                write(&mut store, version);
                stored.store(version, Ordering::SeqCst);
            }
        });
        for copy in 0..10 {
            let copy = folder.path().join(format!("copy-{copy}.db"));
            let before = stored.load(Ordering::SeqCst);
            let count = backup(&path, &copy);
            let after = stored.load(Ordering::SeqCst);
            let versions: Vec<u32> =
                tiles(&copy).iter().map(|(_, it)| it.stamp.version.0).collect();
            assert_eq!((count.unwrap(), versions.len()), (20, 20));
            assert!(versions.iter().all(|it| *it == versions[0]), "{versions:?}");
            assert!((before..=after + 1).contains(&versions[0]));
        }
        wanted.store(0, Ordering::SeqCst);
    });
    assert!(stored.into_inner() > 2, "it has written meanwhile");
}

#[test]
fn only_an_earlier_backup_is_replaced() {
    let folder = Folder::new("backup-targets");
    let path = folder.path().join("map.db");
    let mut store = Store::open(&path, CELLS).unwrap();
    store.keep(&[(RobotId(1), record(0, 1, 1))], Instant(7)).unwrap();
    let refused = |from: &Path, to: &Path| backup(from, to).unwrap_err().to_string();
    let notes = folder.file("notes.txt", b"not a store");
    assert!(refused(&path, &notes).contains("is not a backup"));
    assert_eq!(std::fs::read(&notes).unwrap(), b"not a store");
    assert!(refused(&path, folder.path()).contains("is not a backup"));
    assert!(refused(&path, &path).contains("is not a backup"));
    assert!(refused(&notes, &folder.path().join("copy.db")).contains("not a ubimap store"));
    let other = folder.path().join("other.db");
    let in_use = Store::open(&other, CELLS).unwrap();
    assert!(refused(&path, &other).contains("in use"));
    drop(in_use);
    let none = folder.path().join("none.db");
    assert!(refused(&none, &folder.path().join("copy.db")).contains("can't be opened"));
    assert!(!none.exists());
}

/// An earlier backup may hold the rows that are damaged now.
#[test]
fn a_damaged_store_does_not_replace_its_backup() {
    let folder = Folder::new("backup-damaged");
    let (path, copy) = (folder.path().join("map.db"), folder.path().join("copy.db"));
    let mut store = Store::open(&path, CELLS).unwrap();
    store.keep(&[(RobotId(1), record(0, 1, 1))], Instant(7)).unwrap();
    backup(&path, &copy).unwrap();
    let good = std::fs::read(&copy).unwrap();
    store.connection.execute_batch("UPDATE tile SET version = 2").unwrap();
    let told = backup(&path, &copy).unwrap_err().to_string();
    assert!(told.contains("map.db: 1 of its rows are damaged"), "{told}");
    assert_eq!(std::fs::read(&copy).unwrap(), good);
    drop(store);
    // Opening the store deletes the damaged row.
    drop(Store::open(&path, CELLS).unwrap());
    assert_eq!(backup(&path, &copy).unwrap(), 0);
}
