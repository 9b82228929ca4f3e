//! The robots' keys while a server runs: their folder is read again whenever something in it has changed.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    time::SystemTime,
};

use ubimap_protocol::{
    frame::Key,
    time::{Duration, Instant},
    units::RobotId,
};

use crate::run::keys::{self, KeysError};

/// Interval between two looks at the folder.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// The keys in a folder.
#[derive(Debug)]
pub struct LiveKeys {
    folder: PathBuf,
    keys: BTreeMap<RobotId, Key>,
    /// What the folder looked like when it was last read.
    stamp: Stamp,
    next_check: Instant,
}

/// The names of files, their sizes, and when they were changed.
type Stamp = BTreeMap<PathBuf, (u64, Option<SystemTime>)>;

/// A change of a robot's key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum KeyChange {
    /// It has a key that is new.
    Given(RobotId, Key),
    /// It has none any more.
    Retired(RobotId),
}

impl LiveKeys {
    /// Reads the keys in a folder.
    ///
    /// # Errors
    /// [`KeysError`].
    pub fn open(folder: &Path) -> Result<Self, KeysError> {
        // First the stamp: what changes meanwhile is read again.
        let stamp = stamp(folder);
        let keys = keys::load(folder)?.into_iter().collect();
        Ok(Self { folder: folder.to_owned(), keys, stamp, next_check: Instant(0) + CHECK_INTERVAL })
    }

    /// All keys.
    pub(super) fn all(&self) -> impl Iterator<Item = (RobotId, Key)> {
        self.keys.iter().map(|(&robot, &key)| (robot, key))
    }

    /// The changes since the last look, if one is due. Keys that can't be used change nothing; the reason is
    /// logged once.
    pub(super) fn poll(&mut self, now: Instant) -> Vec<KeyChange> {
        if now < self.next_check {
            return Vec::new();
        }
        self.next_check = now + CHECK_INTERVAL;
        let stamp = stamp(&self.folder);
        if stamp == self.stamp {
            return Vec::new();
        }
        self.stamp = stamp;
        let keys: BTreeMap<RobotId, Key> = match keys::load(&self.folder) {
            Ok(keys) => keys.into_iter().collect(),
            Err(error) => {
                log::error!("{error}; the keys stay as they were");
                return Vec::new();
            }
        };
        let given = keys.iter().filter(|(robot, key)| self.keys.get(robot) != Some(key));
        let given = given.map(|(&robot, &key)| KeyChange::Given(robot, key));
        let retired = self.keys.keys().filter(|robot| !keys.contains_key(robot));
        let changes = given.chain(retired.map(|&robot| KeyChange::Retired(robot))).collect();
        self.keys = keys;
        changes
    }
}

/// What a folder looks like; empty if it can't be read.
fn stamp(folder: &Path) -> Stamp {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let stamped = entries.filter_map(|entry| {
        let metadata = entry.metadata().ok()?;
        Some((entry.path(), (metadata.len(), metadata.modified().ok())))
    });
    stamped.collect()
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;
    use crate::{
        run::options::{KeysAction, KeysOptions},
        testing::Folder,
    };

    #[test]
    fn keys_that_are_made_replaced_or_retired_are_noticed_and_bad_ones_change_nothing() {
        let outer = Folder::new("live-keys");
        let folder = outer.path().join("keys");
        let act = |action| keys::run(&KeysOptions { action, dir: folder.clone() }).unwrap();
        act(KeysAction::Make { robot: 7 });
        let mut live = LiveKeys::open(&folder).unwrap();
        let mut now = Instant(0);
        let mut poll = |live: &mut LiveKeys| {
            now = now + CHECK_INTERVAL;
            live.poll(now)
        };
        assert_eq!((live.all().count(), poll(&mut live)), (1, Vec::new()));
        act(KeysAction::Make { robot: 8 });
        assert_eq!(live.poll(Instant(0)), [], "it is not due");
        let [KeyChange::Given(robot, eight)] = poll(&mut live)[..] else { panic!("no key") };
        assert_eq!(robot, RobotId(8));
        // Half a key, as a copy may leave it for a moment.
        let path = folder.join("7.key");
        let seven = fs::read_to_string(&path).unwrap();
        fs::write(&path, &seven[..seven.len() - 9]).unwrap();
        assert_eq!((poll(&mut live), live.all().count()), (Vec::new(), 2));
        fs::write(&path, &seven).unwrap();
        assert_eq!(poll(&mut live), []);
        act(KeysAction::Retire { robot: 7 });
        act(KeysAction::Retire { robot: 8 });
        act(KeysAction::Make { robot: 8 });
        let changes = poll(&mut live);
        let [KeyChange::Given(RobotId(8), other), KeyChange::Retired(RobotId(7))] = changes[..]
        else {
            panic!("{changes:?}")
        };
        assert_ne!(other, eight);
        // A folder that is away for a moment, such as on a stick, takes nobody's key.
        fs::rename(&folder, outer.path().join("away")).unwrap();
        assert_eq!((poll(&mut live), live.all().count()), (Vec::new(), 1));
    }
}
