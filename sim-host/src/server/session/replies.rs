//! Replies to one robot: the time, stored tiles, and requests for missing tiles.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::{MAX_REQUESTS, MAX_STORED, Request, Stored, TimeReply, ToRobot, Writer},
    tile::{Layer, Stamp, TileId},
    time::Instant,
};

/// Maximum number of waiting time replies, and of waiting requests; a working robot causes far
/// fewer.
const MAX_WAITING: usize = 256;
/// Maximum number of waiting notices of stored tiles: several times the pool of a robot.
const MAX_STORED_WAITING: usize = 1_024;

/// Replies waiting to be sent.
#[derive(Debug, Default)]
pub(super) struct Replies {
    /// Nonces of time requests, with their time of reception.
    times: Vec<(u16, Instant)>,
    /// States of the robot's tiles that are on disk, which the robot has not been told yet.
    stored: Vec<(TileId, Stamp)>,
    /// The newest state of each tile ever added to `stored`.
    newest_stored: BTreeMap<TileId, Stamp>,
    /// Tiles of the robot's layer to request.
    missing: Vec<TileId>,
}

impl Replies {
    /// Queues the answer to a time request. Excess requests are dropped; the robot repeats them.
    pub(super) fn time(&mut self, nonce: u16, received: Instant) {
        if self.times.len() < MAX_WAITING {
            self.times.push((nonce, received));
        }
    }

    /// Queues the notice that a tile's state is on disk, once per session and state. It replaces a
    /// waiting notice about an earlier version of the same epoch. Excess notices are dropped; the
    /// robot's digests cause them again.
    pub(super) fn stored(&mut self, id: TileId, stamp: Stamp) {
        if self.newest_stored.get(&id) == Some(&stamp) {
            return;
        }
        let is_same =
            |(other, queued): &&mut (TileId, Stamp)| *other == id && queued.epoch == stamp.epoch;
        if let Some((_, queued)) = self.stored.iter_mut().find(is_same) {
            *queued = stamp;
        } else if self.stored.len() < MAX_STORED_WAITING {
            self.stored.push((id, stamp));
        } else {
            return;
        }
        self.newest_stored.insert(id, stamp);
    }

    /// Queues a request for a robot's tile that is missing or differs. Returns false if too many
    /// requests are waiting; the robot's digests cause dropped ones again.
    pub(super) fn missing(&mut self, id: TileId) -> bool {
        if self.missing.contains(&id) {
            return true;
        }
        let has_room = self.missing.len() < MAX_WAITING;
        if has_room {
            self.missing.push(id);
        }
        has_room
    }

    /// Adds the answers to time requests to a frame.
    pub(super) fn write_times(&mut self, now: Instant, writer: &mut Writer<'_, ToRobot>) {
        while let Some(&(nonce, received)) = self.times.first() {
            let held_micros = now.since(received).micros() as u32;
            let reply = TimeReply { nonce, received, held_micros };
            if !writer.push(&reply) {
                break;
            }
            self.times.remove(0);
        }
    }

    /// Adds either notices of stored tiles or requests for missing tiles to a reliable frame.
    /// Returns whether it added any.
    pub(super) fn write_reliable(&mut self, writer: &mut Writer<'_, ToRobot>) -> bool {
        let stored = writer.push_longest(1..=self.stored.len().min(MAX_STORED), |count| Stored {
            tiles: self.stored[..count].iter().copied().collect(),
        });
        if let Some(count) = stored {
            self.stored.drain(..count);
            return true;
        }
        let missing = writer.push_longest(1..=self.missing.len().min(MAX_REQUESTS), |count| {
            let tiles = self.missing[..count].iter().copied().collect();
            Request { layer: Layer::Robot, tiles }
        });
        missing.map(|count| self.missing.drain(..count)).is_some()
    }

    /// Whether a time request waits for its answer.
    pub(super) fn has_times(&self) -> bool {
        !self.times.is_empty()
    }

    /// Whether [`Replies::write_reliable`] would add anything.
    pub(super) fn has_reliable(&self) -> bool {
        !self.stored.is_empty() || !self.missing.is_empty()
    }

    /// Number of replies waiting to be sent.
    pub(super) fn waiting(&self) -> usize {
        self.times.len() + self.stored.len() + self.missing.len()
    }
}
