//! Copies a store, even while another process uses it.

use std::{
    ffi::OsString,
    fs::{self, File},
    io::Read,
    path::{Path, PathBuf},
};

use rusqlite::{
    Connection, OpenFlags,
    backup::{Backup, StepResult},
};

use super::{
    StoreError, Trouble,
    lock::lock,
    rows,
    schema::{APPLICATION_ID, check_owner, check_pages, check_schema, connect},
};

/// Copies the store `from` to the file `to`, which is replaced as a whole if it is an earlier
/// backup. The copy contains everything that was stored when the copying began, is checked, and is
/// on disk when this returns. Returns the number of robots' tiles in it; each epoch of a tile
/// counts.
///
/// # Errors
/// [`StoreError`]; `to` is unchanged. A store with damaged rows is not copied, since an earlier
/// backup may still contain those rows.
pub fn backup(from: &Path, to: &Path) -> Result<u32, StoreError> {
    let partial = with_suffix(to, "-partial");
    check_target(from, to).map_err(|trouble| StoreError::new(to, trouble))?;
    let source = connect(from, OpenFlags::empty());
    let source = source.and_then(|source| {
        check_owner(&source).map_err(Trouble::in_tables)?;
        Ok(source)
    });
    let source = source.map_err(|trouble| StoreError::new(from, trouble))?;
    let copied = copy(&source, &partial).map_err(|trouble| StoreError::new(&partial, trouble));
    let checked = copied.and_then(|copy| {
        let tiles = check(&copy).map_err(|trouble| StoreError::new(from, trouble))?;
        drop(copy);
        replace(&partial, to).map_err(|trouble| StoreError::new(to, trouble))?;
        Ok(tiles)
    });
    if checked.is_err() {
        remove(&partial);
    }
    checked
}

/// Removes the files that a failed or killed backup has left, so that the next one starts afresh.
fn remove(partial: &Path) {
    for suffix in ["", "-wal", "-shm"] {
        // An error is ignored: usually there is no such file.
        let _ = fs::remove_file(with_suffix(partial, suffix));
    }
}

/// Refuses to replace anything except an earlier backup that is not in use.
fn check_target(from: &Path, to: &Path) -> Result<(), Trouble> {
    let Ok(metadata) = to.metadata() else { return Ok(()) };
    let is_same = fs::canonicalize(from).ok() == fs::canonicalize(to).ok();
    // SQLite would mistake a log beside the file for that of the new file.
    let is_in_use = with_suffix(to, "-wal").exists() || with_suffix(to, "-lock").exists();
    if !metadata.is_file() || is_same || !is_store(to) {
        return Err(Trouble::NotABackup);
    }
    if is_in_use {
        // Taking the lock only serves to choose the error; it is released at once.
        return Err(lock(to).err().unwrap_or(Trouble::NotABackup));
    }
    Ok(())
}

/// Whether a file begins like a store. It is not opened with SQLite, which could change it.
fn is_store(path: &Path) -> bool {
    let mut header = [0; 72];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut header));
    read.is_ok()
        && header.starts_with(b"SQLite format 3\0")
        && header.ends_with(&APPLICATION_ID.to_be_bytes())
}

/// Copies a database in one step, so that the copy is consistent even while another process writes.
fn copy(source: &Connection, partial: &Path) -> Result<Connection, Trouble> {
    remove(partial);
    let mut copy = connect(partial, OpenFlags::SQLITE_OPEN_CREATE)?;
    let backup = Backup::new(source, &mut copy)?;
    match backup.step(-1)? {
        StepResult::Done => {}
        _ => return Err(Trouble::InUse),
    }
    drop(backup);
    Ok(copy)
}

/// Checks a copy, and counts its tiles.
fn check(copy: &Connection) -> Result<u32, Trouble> {
    check_pages(copy)?;
    if check_schema(copy)? {
        let damaged = rows::ALL.iter().map(|table| Ok(table.damaged(copy)?.len()));
        let damaged: usize = damaged.sum::<Result<_, Trouble>>()?;
        if damaged > 0 {
            return Err(Trouble::DamagedRows(damaged));
        }
    }
    Ok(copy.query_row("SELECT count(*) FROM tile", [], |row| row.get(0))?)
}

/// Renames the complete copy to `to`, durably.
fn replace(partial: &Path, to: &Path) -> Result<(), Trouble> {
    let moved = File::open(partial).and_then(|file| {
        file.sync_all()?;
        fs::rename(partial, to)?;
        // Folders can be synchronised on Unix only.
        let folder = to.parent().filter(|it| !it.as_os_str().is_empty());
        if cfg!(unix) { File::open(folder.unwrap_or(Path::new(".")))?.sync_all() } else { Ok(()) }
    });
    moved.map_err(Trouble::Replace)
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(suffix);
    name.into()
}
