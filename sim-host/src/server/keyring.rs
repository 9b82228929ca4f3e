//! The keys of robots on keyed ports, and which attempts to open a session are new.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    frame::{Attempt, Key},
    units::RobotId,
};

/// Keys, salts, and the newest attempt of each robot.
#[derive(Debug)]
pub(super) struct Keyring {
    keys: BTreeMap<RobotId, Held>,
    next_salt: u64,
    /// Robots about whose missing key or old attempts the operator was told.
    told: BTreeSet<RobotId>,
}

#[derive(Debug)]
struct Held {
    key: Key,
    newest: Option<Attempt>,
    /// Whether the newest attempt has become a session. Its Hello is then of no further use.
    is_spent: bool,
}

/// What is known of an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Age {
    /// Later than all before.
    New,
    /// The newest one again; it has not become a session yet.
    Repeated,
    /// An earlier one, or one that has become a session.
    Old,
}

impl Keyring {
    /// No keys. Answers get the salts from `next_salt` on.
    pub(super) fn new(next_salt: u64) -> Self {
        Self { keys: BTreeMap::new(), next_salt, told: BTreeSet::new() }
    }

    /// Sets the salt of the next answer.
    pub(super) fn salt_from(&mut self, next: u64) {
        self.next_salt = next;
    }

    /// Sets the key of a robot.
    pub(super) fn set(&mut self, robot: RobotId, key: Key) {
        self.told.remove(&robot);
        if self.key(robot) != Some(key) {
            self.keys.insert(robot, Held { key, newest: None, is_spent: false });
        }
    }

    /// Removes the key of a robot. Returns whether there was one.
    pub(super) fn retire(&mut self, robot: RobotId) -> bool {
        self.keys.remove(&robot).is_some()
    }

    pub(super) fn key(&self, robot: RobotId) -> Option<Key> {
        self.keys.get(&robot).map(|held| held.key)
    }

    /// A salt that was not used before.
    pub(super) fn salt(&mut self) -> u64 {
        let salt = self.next_salt;
        self.next_salt = salt.wrapping_add(1);
        salt
    }

    /// Judges an attempt, and remembers it if it is new.
    pub(super) fn judge(&mut self, robot: RobotId, attempt: Attempt) -> Age {
        let Some(held) = self.keys.get_mut(&robot) else { return Age::Old };
        match held.newest {
            Some(newest) if attempt < newest || attempt == newest && held.is_spent => Age::Old,
            Some(newest) if attempt == newest => Age::Repeated,
            _ => {
                (held.newest, held.is_spent) = (Some(attempt), false);
                Age::New
            }
        }
    }

    /// Records that an attempt has become a session.
    pub(super) fn spend(&mut self, robot: RobotId, attempt: Attempt) {
        self.told.remove(&robot);
        if let Some(held) = self.keys.get_mut(&robot) {
            held.is_spent |= held.newest == Some(attempt);
        }
    }

    /// Whether the operator must be told about a robot: once until it has a key and a session.
    pub(super) fn tell(&mut self, robot: RobotId) -> bool {
        self.told.insert(robot)
    }
}
