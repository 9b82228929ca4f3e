//! Turns changes of the robot's own layer into tile updates.

use heapless::Vec;
use ubimap_protocol::{
    message::{Digests, TileDigest, TileUpdateHead, ToServer, Writer},
    tile::{Epoch, Layer, Row, Stamp, TILE_SIDE, Tile, TileEncoder, TileId, Version, tile_hash},
    time::{Duration, Instant},
};

use super::receive::FusedMap;
use crate::{
    map::{OwnTile, Pool},
    timing::DIGEST_INTERVAL,
};

/// Maximum number of tile digests sent at once.
const DIGESTS: usize = 2;

/// Decides when updates and digests of the robot's tiles are sent. Each [`OwnTile`] records what
/// the server holds of it.
#[derive(Debug)]
pub struct Publisher {
    /// How long changes are collected before they are sent.
    hold: Duration,
    /// When the oldest pending change happened.
    waiting_since: Option<Instant>,
    /// Changes that happen before this time are sent without delay.
    hurries_until: Instant,
    /// When the newest mapped scan was taken, in seconds of the server's clock.
    newest_scan: u32,
    frame: u16,
    /// The tile whose digest was sent last.
    digested: Option<TileId>,
    next_digest: Instant,
}

impl Publisher {
    /// Creates a publisher with nothing to send. Changes are collected for `hold` before they are
    /// sent.
    pub fn new(hold: Duration) -> Self {
        Self {
            hold,
            waiting_since: None,
            hurries_until: Instant(0),
            newest_scan: 0,
            frame: 0,
            digested: None,
            next_digest: Instant(0),
        }
    }

    /// Sets how long changes are collected before they are sent.
    pub(crate) fn set_hold(&mut self, hold: Duration) {
        self.hold = hold;
    }

    /// Sends changes that happen before `until` without delay.
    pub(crate) fn hurry(&mut self, until: Instant) {
        self.hurries_until = until;
    }

    /// Adds the digests of the next few tiles whose current state the server has acknowledged, if
    /// digests are due. If none fits, they stay due for the next frame; but if this frame is
    /// otherwise empty (`alone`), they are put off by the usual interval.
    pub fn push_digests(
        &mut self,
        pool: &Pool<'_>,
        writer: &mut Writer<'_, ToServer>,
        alone: bool,
        now: Instant,
    ) {
        if now < self.next_digest {
            return;
        }
        let mut tiles = Vec::<_, DIGESTS>::new();
        let mut last = self.digested;
        for _ in 0..DIGESTS {
            let level = |tile: &OwnTile| !tile.dirty && tile.publication.is_acknowledged();
            let tile = place_after(pool, last, level).and_then(|place| pool.tiles().nth(place));
            last = tile.and_then(|tile| tile.id);
            let Some((tile, id)) = tile.and_then(|tile| Some((tile, tile.id?))) else { break };
            let stamp = Stamp { epoch: tile.epoch, version: tile.publication.version() };
            let hash = tile_hash(tile.publication.sent());
            let _ = tiles.push(TileDigest { id, stamp, hash });
        }
        let told = writer.push_longest(1..=tiles.len(), |count| {
            let tiles = tiles.get(..count).unwrap_or_default();
            Digests { layer: Layer::Robot, tiles: Vec::from_slice(tiles).unwrap_or_default() }
        });
        if told.is_some() || tiles.is_empty() || alone {
            self.digested = match told {
                Some(count) if count < tiles.len() => tiles.get(count - 1).map(|digest| digest.id),
                Some(_) => last,
                None => None,
            };
            self.next_digest = now + DIGEST_INTERVAL;
        }
    }

    /// When the next digests are due.
    pub fn digest_timeout(&self) -> Instant {
        self.next_digest
    }

    /// Records a change of the map. `newest_scan` is in seconds of the server's clock, if known.
    pub fn changed(&mut self, now: Instant, newest_scan: Option<u32>) {
        self.waiting_since = self.waiting_since.or(Some(now));
        self.newest_scan = newest_scan.unwrap_or(self.newest_scan);
    }

    /// When the pending changes are due to be sent; `None` if there are none.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let since = self.waiting_since?;
        Some(if since < self.hurries_until { since } else { since + self.hold })
    }

    /// Adds an update with as many tiles as fit, if one is due. Returns the number to pass to
    /// [`Self::acknowledged`] when the frame is acknowledged, or `None` if no update was added.
    pub fn fill(
        &mut self,
        pool: &mut Pool<'_>,
        merged: &FusedMap<'_>,
        writer: &mut Writer<'_, ToServer>,
        now: Instant,
    ) -> Option<u16> {
        if self.poll_timeout()? > now {
            return None;
        }
        let frame = self.frame.wrapping_add(1);
        let head = TileUpdateHead { layer: Layer::Robot, seconds: self.newest_scan };
        let mut blocked = false;
        let written = writer.push_with(&head, |coded| {
            let mut encoder = TileEncoder::new(coded);
            // The tiles are written in order of their ids, so that each id takes only a few bits.
            let mut done = None;
            while let Some(tile) = next_tile(pool, done) {
                let Some(id) = tile.id else { break };
                done = Some(id);
                tile.look(now);
                let mut cells = news(tile, merged.tile(id));
                if !tile.publication.differs(&cells) {
                    tile.dirty = false;
                    continue;
                }
                let version = Version(tile.publication.version().0.wrapping_add(1));
                let epoch: Epoch = tile.epoch;
                // The tile stays dirty: the part in flight may be lost, or there may be further
                // parts.
                blocked |=
                    !tile.publication.push(&mut encoder, id, epoch, version, &mut cells, frame);
            }
            encoder.finish()
        });
        if written {
            self.frame = frame;
            return Some(frame);
        }
        // If every tile fitted, nothing is left to send except what is in flight, and its
        // acknowledgement sets `waiting_since` again. Otherwise the next frame tries again.
        if !blocked {
            self.waiting_since = None;
        }
        None
    }

    /// Processes the acknowledgement of the frame for which [`Self::fill`] returned `frame`.
    pub fn acknowledged(
        &mut self,
        pool: &mut Pool<'_>,
        merged: &FusedMap<'_>,
        frame: u16,
        now: Instant,
    ) {
        for tile in pool.tiles_mut() {
            if !tile.publication.acknowledge(frame) {
                continue;
            }
            // A tile with nothing else to send is no longer dirty, so its place may be reused.
            let merged = tile.id.and_then(|id| merged.tile(id));
            tile.dirty = tile.dirty && tile.publication.differs(&news(tile, merged));
            if tile.dirty {
                // Further parts are sent without delay.
                let since = if tile.publication.has_parts_left() { now - self.hold } else { now };
                self.waiting_since = self.waiting_since.map(|old| old.min(since)).or(Some(since));
            }
        }
    }

    /// Handles the server's request for the tile `id`, or for all tiles if `None`. The tile is sent
    /// whole, and so are all tiles whose last update was in the same frame, because the server may
    /// not have decoded those either.
    pub fn requested(&mut self, pool: &mut Pool<'_>, id: Option<TileId>, now: Instant) {
        let one = id.and_then(|id| Some(pool.find(id)?.publication.clone()));
        for tile in pool.tiles_mut() {
            let meant = match &one {
                // The id is compared too: a tile that agreed with the server's map was never sent.
                Some(one) => tile.id == id || tile.publication.travelled_with(one),
                None => id.is_none(),
            };
            if meant {
                tile.publication.forget();
                tile.dirty = true;
                self.waiting_since = self.waiting_since.or(Some(now));
            }
        }
    }

    /// Starts a session. If `same_server`, only the updates that were not acknowledged are sent
    /// again. Otherwise all tiles are, because the acknowledgements so far came from another
    /// server.
    pub fn begin_session(&mut self, pool: &mut Pool<'_>, same_server: bool, now: Instant) {
        if !same_server {
            // `newest_scan` is by the other server's clock. With 0, tiles that are sent again count
            // as older than all new ones.
            self.newest_scan = 0;
        }
        for tile in pool.tiles_mut() {
            if same_server {
                tile.publication.interrupt();
            } else {
                tile.publication.forget();
            }
            if !tile.publication.is_acknowledged() {
                tile.dirty = true;
                self.waiting_since = self.waiting_since.or(Some(now));
            }
        }
    }
}

/// The cells of `tile` to be sent: those that were sent before, and those that differ from
/// `merged`, the server's map. Without `merged`, all cells.
fn news(tile: &OwnTile, merged: Option<&Tile>) -> Tile {
    let mut cells = tile.cells();
    let Some(merged) = merged else { return cells };
    let sent = tile.publication.sent();
    for y in 0..TILE_SIDE {
        let (own, known) = (cells.row(y), merged.row(y));
        // A cell that is occupied for the robot and movable in the map does not contradict the map.
        let same = !(own.high ^ known.high | own.low & !known.low);
        let told = sent.row(y).known();
        let tell = told | !same;
        cells.set_row(y, Row { low: own.low & tell, high: own.high & tell });
    }
    cells
}

/// The dirty tile with the lowest id above `done` that has no update in flight.
fn next_tile<'p>(pool: &'p mut Pool<'_>, done: Option<TileId>) -> Option<&'p mut OwnTile> {
    let place = place_after(pool, done, |tile| tile.dirty && tile.publication.is_ready())?;
    pool.tiles_mut().nth(place)
}

/// The index in `pool` of the tile with the lowest id above `done` that satisfies `is_wanted`.
fn place_after(
    pool: &Pool<'_>,
    done: Option<TileId>,
    is_wanted: fn(&OwnTile) -> bool,
) -> Option<usize> {
    let mut first: Option<(usize, TileId)> = None;
    for (place, tile) in pool.tiles().enumerate() {
        if let Some(id) = tile.id
            && Some(id) > done
            && first.is_none_or(|(_, first)| id < first)
            && is_wanted(tile)
        {
            first = Some((place, id));
        }
    }
    first.map(|(place, _)| place)
}

#[cfg(test)]
mod tests;
