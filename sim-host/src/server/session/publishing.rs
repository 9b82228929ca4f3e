//! Publishing of one of the server's layers to one robot: which tiles it holds, and which are due.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::{
        Digests, Freshness, Interest, MAX_DIGESTS, MAX_FRESH_BYTES, Request, TileDigest,
        TileUpdateHead, ToRobot, Writer,
    },
    tile::{Layer, Publication, Stamp, Tile, TileEncoder, TileId, Version, tile_hash},
    time::{Duration, Instant},
};

use crate::server::snapshot::Snapshot;

/// Interval between messages with digests of a few tiles.
const DIGEST_INTERVAL: Duration = Duration::from_secs(10);
/// Period in which all coverage tiles are confirmed once.
const CONFIRM_INTERVAL: Duration = Duration::from_millis(250);
/// A tile is confirmed if the robot's state of it was the newest at most this time ago: a newer
/// update may be in flight.
const CONFIRM_DELAY: Duration = Duration::from_millis(500);

/// The tiles of one layer that a robot holds.
#[derive(Debug)]
pub(super) struct Publishing {
    layer: Layer,
    /// Minimum interval between updates of a tile, in which changes are gathered.
    hold: Duration,
    tiles: BTreeMap<TileId, Published>,
    /// The tile whose digest was sent last, and when the next digests are due.
    digested: Option<TileId>,
    next_digests: Instant,
    /// Index within the window of the next tile to confirm, and when it is due.
    confirmed: u16,
    next_confirmation: Instant,
}

/// The state of one tile on the robot.
#[derive(Debug, Default)]
struct Published {
    publication: Publication,
    /// When the tile was last sent.
    sent: Option<Instant>,
    /// The last time at which the state that the robot has acknowledged was the newest one.
    newest: Option<Instant>,
}

impl Publishing {
    /// Starts with a robot that holds no tiles.
    pub(super) fn new(layer: Layer, hold: Duration, now: Instant) -> Self {
        Self {
            layer,
            hold,
            tiles: BTreeMap::new(),
            digested: None,
            next_digests: now + DIGEST_INTERVAL,
            confirmed: 0,
            next_confirmation: now,
        }
    }

    /// Forgets the tiles that the robot has dropped: those for which `kept` is false.
    pub(super) fn retain(&mut self, kept: impl Fn(TileId) -> bool) {
        self.tiles.retain(|&id, _| kept(id));
    }

    /// Handles a request for tiles that the robot could not decode: they, and all tiles sent in the
    /// same frames, will be sent again as a whole.
    pub(super) fn requested(&mut self, request: &Request) {
        for id in &request.tiles {
            let Some(one) = self.tiles.get(id).map(|tile| tile.publication.clone()) else {
                continue;
            };
            let tiles = self.tiles.values_mut();
            tiles.filter(|it| it.publication.travelled_with(&one)).for_each(Published::forget);
        }
        if request.tiles.is_empty() {
            self.tiles.values_mut().for_each(Published::forget);
        }
    }

    pub(super) fn acknowledged(&mut self, frame: u16) {
        for tile in self.tiles.values_mut() {
            if tile.publication.acknowledge(frame) && tile.publication.is_acknowledged() {
                tile.newest = tile.newest.max(tile.sent);
            }
        }
    }

    /// Adds tile updates, one tile per message: a robot that has dropped a tile can't decode the
    /// rest of its message. Least recently sent tiles go first. `empty` is the length of the frame
    /// before the first tile. Returns whether all due tiles fit.
    pub(super) fn fill(
        &mut self,
        snapshot: &Snapshot<'_>,
        interest: &Interest,
        now: Instant,
        frame: u16,
        writer: &mut Writer<'_, ToRobot>,
        empty: usize,
    ) -> bool {
        let due = snapshot.layer(self.layer).within(interest).filter(|&(id, version, tile)| {
            self.due(id, version, tile).is_some_and(|due| due <= now)
        });
        let mut due: Vec<_> = due.collect();
        due.sort_by_key(|(id, ..)| self.tiles.get(id).and_then(|tile| tile.sent));
        let layer = self.layer;
        let seconds = (now.micros() / 1_000_000) as u32;
        for (id, version, tile) in due {
            let published = self.tiles.entry(id).or_default();
            let first = writer.len() == empty;
            let written = writer.push_with(&TileUpdateHead { layer, seconds }, |coded| {
                let mut encoder = TileEncoder::new(coded);
                let mut new = *tile;
                let mut trial = published.publication.clone();
                trial
                    .push(&mut encoder, id, snapshot.epoch, version, &mut new, frame)
                    .then_some(())?;
                if trial.has_parts_left() && !first {
                    // A tile is split only if it has a frame to itself.
                    return None;
                }
                published.publication = trial;
                encoder.finish()
            });
            if !written {
                return false;
            }
            published.sent = Some(now);
            if published.publication.has_parts_left() {
                return false;
            }
        }
        true
    }

    /// When the next tile is due.
    pub(super) fn next_tile(
        &self,
        snapshot: &Snapshot<'_>,
        interest: &Interest,
    ) -> Option<Instant> {
        snapshot
            .layer(self.layer)
            .within(interest)
            .filter_map(|(id, version, tile)| self.due(id, version, tile))
            .min()
    }

    /// When an update of a tile is due; `None` if it has not changed. A tile that has changed and
    /// changed back counts as changed, because its version is new.
    fn due(&self, id: TileId, version: Version, tile: &Tile) -> Option<Instant> {
        let Some(Published { publication, sent, .. }) = self.tiles.get(&id) else {
            return Some(Instant(0));
        };
        let newer = publication.version() != version;
        let more = publication.is_ready() && (newer || publication.differs(tile));
        let waits = sent.filter(|_| !publication.has_parts_left());
        more.then(|| waits.map_or(Instant(0), |sent| sent + self.hold))
    }

    /// Whether the robot has acknowledged the newest state of every tile in its window.
    pub(super) fn is_level(&self, snapshot: &Snapshot<'_>, interest: &Interest) -> bool {
        snapshot
            .layer(self.layer)
            .within(interest)
            .all(|(id, version, tile)| self.has(id, version, tile))
    }

    /// Whether the robot has acknowledged this state of a tile.
    fn has(&self, id: TileId, version: Version, tile: &Tile) -> bool {
        self.tiles.get(&id).is_some_and(|published| published.has(version, tile))
    }

    pub(super) fn next_digests(&self) -> Instant {
        self.next_digests
    }

    /// Adds the digests of the next few tiles of the window, if due: of tiles that the robot should
    /// hold, and of tiles that the server does not have, in case the robot holds them from an
    /// earlier run of the server with the same epoch.
    pub(super) fn fill_digests(
        &mut self,
        snapshot: &Snapshot<'_>,
        interest: &Interest,
        now: Instant,
        writer: &mut Writer<'_, ToRobot>,
    ) {
        if self.next_digests > now {
            return;
        }
        self.next_digests = now + DIGEST_INTERVAL;
        let layer = snapshot.layer(self.layer);
        let mut ids: Vec<TileId> = interest.ids().filter(|&id| Some(id) > self.digested).collect();
        ids.sort_unstable();
        let next = ids.into_iter().filter_map(|id| {
            let (version, tile) = layer.get(id).unwrap_or((Version(0), &Tile::UNKNOWN));
            let is_level = version == Version(0) || self.has(id, version, tile);
            let stamp = Stamp { epoch: snapshot.epoch, version };
            is_level.then(|| TileDigest { id, stamp, hash: tile_hash(tile) })
        });
        let tiles: Vec<TileDigest> = next.take(MAX_DIGESTS).collect();
        // Sends as many digests as fit.
        let told = writer.push_longest(1..=tiles.len(), |count| {
            let tiles = tiles[..count].iter().copied().collect();
            Digests { layer: self.layer, tiles }
        });
        // If none fits beside other messages, the same digests are tried next time.
        if told.is_some() || tiles.is_empty() {
            self.digested = told.map(|count| tiles[count - 1].id);
        }
    }

    /// When the next confirmation is due; `None` if there are no tiles.
    pub(super) fn next_confirmation(
        &self,
        snapshot: &Snapshot<'_>,
        interest: &Interest,
    ) -> Option<Instant> {
        snapshot.layer(self.layer).within(interest).next().map(|_| self.next_confirmation)
    }

    /// Adds the confirmation of tiles whose state on the robot was the newest within
    /// [`CONFIRM_DELAY`]. A window too large for one message is confirmed in parts.
    pub(super) fn fill_confirmation(
        &mut self,
        snapshot: &Snapshot<'_>,
        interest: &Interest,
        now: Instant,
        writer: &mut Writer<'_, ToRobot>,
    ) {
        if self.next_confirmation(snapshot, interest).is_none_or(|next| next > now) {
            return;
        }
        for (id, version, tile) in snapshot.layer(self.layer).within(interest) {
            let published = self.tiles.get_mut(&id);
            if let Some(published) = published.filter(|it| it.has(version, tile)) {
                published.newest = Some(now);
            }
        }
        let time = now - CONFIRM_DELAY;
        let first = self.confirmed;
        let mut tiles = heapless::Vec::<u8, MAX_FRESH_BYTES>::new();
        let most = (8 * MAX_FRESH_BYTES).min(8 * writer.room().saturating_sub(12).max(1));
        for (index, id) in interest.ids().skip(first.into()).take(most).enumerate() {
            if self.tiles.get(&id).is_some_and(|tile| tile.newest >= Some(time)) {
                // The capacity is sufficient for `most` bits.
                let _ = tiles.resize(index / 8 + 1, 0);
                tiles[index / 8] |= 1 << (index % 8);
            }
        }
        let freshness = Freshness { time, interest: interest.number, first, tiles };
        let all = interest.tiles();
        self.confirmed = u16::try_from(u32::from(first) + most as u32)
            .ok()
            .filter(|next| u32::from(*next) < all)
            .unwrap_or(0);
        let rounds = u64::from(all).div_ceil(most as u64).max(1);
        self.next_confirmation = now + Duration(CONFIRM_INTERVAL.micros() / rounds);
        if !freshness.tiles.is_empty() {
            // If it does not fit, a later message confirms these tiles.
            let _ = writer.push(&freshness);
        }
    }
}

impl Published {
    fn has(&self, version: Version, tile: &Tile) -> bool {
        let publication = &self.publication;
        publication.is_acknowledged()
            && publication.version() == version
            && publication.sent() == tile
    }

    fn forget(&mut self) {
        self.publication.forget();
        self.newest = None;
    }
}
