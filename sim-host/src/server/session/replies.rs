//! What one robot is answered: the time, what is stored of its tiles, and which of them are missing.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::{MAX_REQUESTS, MAX_STORED, Request, Stored, TimeReply, ToRobot, Writer},
    tile::{Layer, Stamp, TileId},
    time::Instant,
};

/// Replies of one kind that wait for one robot, at the most. An agent causes far fewer.
const MOST_WAITING: usize = 256;

/// Replies that wait to be sent.
#[derive(Debug, Default)]
pub(super) struct Replies {
    /// Nonces of time requests, and when each was received.
    times: Vec<(u16, Instant)>,
    /// States of the robot's tiles that are on disk and that it has not been told of.
    stored: Vec<(TileId, Stamp)>,
    /// The newest state of each tile that was put there.
    newest_stored: BTreeMap<TileId, Stamp>,
    /// Tiles of the robot's layer to ask for.
    missing: Vec<TileId>,
}

impl Replies {
    /// The robot asked for the time. Beyond a bound requests are dropped: it asks again.
    pub(super) fn time(&mut self, nonce: u16, received: Instant) {
        if self.times.len() < MOST_WAITING {
            self.times.push((nonce, received));
        }
    }

    /// A state of a tile is on disk. The robot is told once in a session.
    pub(super) fn stored(&mut self, id: TileId, stamp: Stamp) {
        if self.newest_stored.insert(id, stamp) != Some(stamp) {
            self.stored.push((id, stamp));
        }
    }

    /// A tile of the robot is missing, or not as the robot says. Beyond a bound tiles are dropped:
    /// the robot's digests bring them up again.
    pub(super) fn missing(&mut self, id: TileId) {
        if self.missing.len() < MOST_WAITING && !self.missing.contains(&id) {
            self.missing.push(id);
        }
    }

    /// Adds the replies to time requests to a frame.
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

    /// Adds to a reliable frame which tiles are stored, or which are missing. Returns whether it
    /// did.
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

    /// Whether the time is to be told.
    pub(super) fn has_times(&self) -> bool {
        !self.times.is_empty()
    }

    /// Whether [`Replies::write_reliable`] has something.
    pub(super) fn has_reliable(&self) -> bool {
        !self.stored.is_empty() || !self.missing.is_empty()
    }

    /// Replies that wait to be sent.
    pub(super) fn waiting(&self) -> usize {
        self.times.len() + self.stored.len() + self.missing.len()
    }
}
