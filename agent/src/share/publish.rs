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

/// When to send changes of the map, and the state of those sent.
#[derive(Debug)]
pub struct Publisher {
    /// How long changes are collected before they are sent.
    hold: Duration,
    /// When the oldest pending change happened.
    waiting_since: Option<Instant>,
    /// Changes before this time are sent without delay.
    hurries_until: Instant,
    /// When the newest mapped scan was taken, in seconds of the server's clock.
    newest_scan: u32,
    frame: u16,
    /// The tile whose digest was sent last.
    digested: Option<TileId>,
    next_digest: Instant,
}

impl Publisher {
    /// Nothing to send.
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

    /// Changes before `until` are sent without delay.
    pub(crate) fn hurry(&mut self, until: Instant) {
        self.hurries_until = until;
    }

    /// Adds the digests of the next few tiles that the server should hold, if they are due. Digests
    /// that do not fit are left to the next frame, unless this frame is otherwise empty.
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

    /// When there is something to send.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let since = self.waiting_since?;
        Some(if since < self.hurries_until { since } else { since + self.hold })
    }

    /// Adds an update with as many tiles as fit, if it is due. Returns the number of the frame,
    /// which is needed when the frame is acknowledged.
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
            // In order of their ids, so that each id takes only a few bits.
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
        // Nothing is left to send except what is in flight; its acknowledgement sets this time
        // again. Tiles that did not fit beside other messages are tried again in the next frame.
        if !blocked {
            self.waiting_since = None;
        }
        None
    }

    /// Processes the acknowledgement of a frame with tiles.
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
            // If the tile has nothing else to send, its place may be reused at once.
            let merged = tile.id.and_then(|id| merged.tile(id));
            tile.dirty = tile.dirty && tile.publication.differs(&news(tile, merged));
            if tile.dirty {
                // Further parts are sent without delay.
                let since = if tile.publication.has_parts_left() { now - self.hold } else { now };
                self.waiting_since = self.waiting_since.map(|old| old.min(since)).or(Some(since));
            }
        }
    }

    /// Handles the server's request for a tile that it could not decode (for all tiles, if `None`):
    /// it is sent whole, and so are all tiles that were in the same frame.
    pub fn requested(&mut self, pool: &mut Pool<'_>, id: Option<TileId>, now: Instant) {
        let one = id.and_then(|id| Some(pool.find(id)?.publication.clone()));
        for tile in pool.tiles_mut() {
            let meant = match &one {
                // It may never have been sent, because it agreed with the server's map.
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

    /// Starts a session. `same_server`: the acknowledgements so far came from this server.
    pub fn begin_session(&mut self, pool: &mut Pool<'_>, same_server: bool, now: Instant) {
        if !same_server {
            // That time is by another clock. With 0, tiles that are sent again count as older than
            // all new ones.
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

/// The cells of a tile to be sent: those sent in this epoch before, and those that differ from the
/// server's map.
fn news(tile: &OwnTile, merged: Option<&Tile>) -> Tile {
    let mut cells = tile.cells();
    let Some(merged) = merged else { return cells };
    let sent = tile.publication.sent();
    for y in 0..TILE_SIDE {
        let (own, known) = (cells.row(y), merged.row(y));
        // If the robot has not observed an object to be movable, that does not contradict the map.
        let same = !(own.high ^ known.high | own.low & !known.low);
        let told = sent.row(y).known();
        let tell = told | !same;
        cells.set_row(y, Row { low: own.low & tell, high: own.high & tell });
    }
    cells
}

/// The first tile after `done`, in order of ids, that is dirty and has no update in flight.
fn next_tile<'p>(pool: &'p mut Pool<'_>, done: Option<TileId>) -> Option<&'p mut OwnTile> {
    let place = place_after(pool, done, |tile| tile.dirty && tile.publication.is_ready())?;
    pool.tiles_mut().nth(place)
}

/// The index of the first tile after `done`, in order of ids, that satisfies the predicate.
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
mod tests {
    use super::*;
    use crate::{
        map::{LocalMap, MappingConfig, Policy, RowSighting},
        sense::Validity,
        share::FusedTile,
    };
    use ubimap_protocol::{
        message::Messages,
        tile::{Applied, Replica, TileDecoder},
        units::{Millimetres, Pose},
    };

    /// Sends version 1 of an empty tile in a frame, and acknowledges it.
    fn acknowledge(pool: &mut Pool<'_>, id: TileId, frame: u16) {
        let tile = pool.find_or_begin(id, 1).unwrap();
        let mut buffer = [0; 64];
        let mut encoder = TileEncoder::new(&mut buffer);
        let mut cells = Tile::UNKNOWN;
        let version = Version(1);
        assert!(tile.publication.push(&mut encoder, id, Epoch(1), version, &mut cells, frame));
        assert!(tile.publication.acknowledge(frame));
    }

    /// A pool of tiles that the server has acknowledged.
    fn acknowledged(places: &mut [OwnTile]) -> Pool<'_> {
        let mut pool = Pool::new(places);
        [1, 2, 3].into_iter().for_each(|x| acknowledge(&mut pool, TileId { x, y: 0 }, 7));
        pool
    }

    #[test]
    fn the_digests_of_all_tiles_take_turns_in_small_frames() {
        let mut places = [OwnTile::FREE; 3];
        let pool = acknowledged(&mut places);
        let mut publisher = Publisher::new(Duration(0));
        let mut tell = |room: usize, alone: bool, now: Instant| {
            let mut buffer = [0u8; 60];
            let mut writer = Writer::new(&mut buffer[..room]);
            publisher.push_digests(&pool, &mut writer, alone, now);
            let len = writer.len();
            let message = Messages::<ToServer>::new(&buffer[..len]).next()?.unwrap();
            let digests = message.decode::<Digests>().unwrap();
            Some(digests.tiles.iter().map(|it| it.id.x).collect::<std::vec::Vec<_>>())
        };
        let mut now = Instant(0);
        assert_eq!(tell(60, true, now), Some(std::vec![1, 2]));
        assert_eq!(tell(60, true, now), None);
        for x in [3, 1, 2, 3] {
            now = now + DIGEST_INTERVAL;
            assert_eq!(tell(8, false, now), None, "there is no room beside others");
            assert_eq!(tell(16, true, now), Some(std::vec![x]));
        }
    }

    #[test]
    fn a_request_for_one_tile_sends_all_tiles_of_its_frame_again() {
        let mut places = [OwnTile::FREE; 5];
        let mut pool = acknowledged(&mut places);
        acknowledge(&mut pool, TileId { x: 4, y: 0 }, 8);
        // It is in the pool, but agreed with the server's map and was never sent.
        pool.find_or_begin(TileId { x: 5, y: 0 }, 1).unwrap();
        let mut publisher = Publisher::new(Duration(0));
        let mut requested = |id: Option<TileId>| {
            pool.tiles_mut().for_each(|tile| tile.dirty = false);
            publisher.waiting_since = None;
            publisher.requested(&mut pool, id, Instant(9));
            let again = pool.tiles().filter(|tile| tile.dirty);
            let again: std::vec::Vec<_> = again
                .inspect(|tile| assert!(tile.publication.differs(&Tile::UNKNOWN)))
                .map(|tile| tile.id.unwrap().x)
                .collect();
            assert_eq!(publisher.poll_timeout(), (!again.is_empty()).then_some(Instant(9)));
            again
        };
        let named = |x: i16| Some(TileId { x, y: 0 });
        assert_eq!(requested(named(2)), [1, 2, 3]);
        assert_eq!(requested(named(4)), [4]);
        assert_eq!(requested(named(5)), [5]);
        assert_eq!(requested(named(6)), [], "a tile that is not in the pool");
        assert_eq!(requested(None), [1, 2, 3, 4, 5]);
    }

    #[test]
    fn a_change_made_while_the_tile_is_in_flight_is_sent_after_the_acknowledgement() {
        const ID: TileId = TileId { x: 0, y: 0 };
        let mut places = [OwnTile::FREE; 1];
        let mut pool = Pool::new(&mut places);
        let merged = FusedMap::new(&mut []);
        let mut publisher = Publisher::new(Duration(100));
        let mut server = Replica::default();
        let see = |pool: &mut Pool<'_>, publisher: &mut Publisher, y: usize, now: Instant| {
            let tile = pool.find_or_begin(ID, 1).unwrap();
            tile.evidence.add(y, [RowSighting { free: 1 << y, hit: 0 }].into_iter());
            tile.dirty = true;
            publisher.changed(now, None);
        };
        let mut send = |pool: &mut Pool<'_>, publisher: &mut Publisher, now: Instant| {
            let mut buffer = [0u8; 100];
            let mut writer = Writer::new(&mut buffer);
            let frame = publisher.fill(pool, &merged, &mut writer, now)?;
            let len = writer.len();
            let message = Messages::<ToServer>::new(&buffer[..len]).next().unwrap().unwrap();
            let (_, coded) = message.split::<TileUpdateHead>().unwrap();
            let mut decoder = TileDecoder::new(coded);
            let header = decoder.header().unwrap().unwrap();
            assert_eq!(server.apply(&header, &mut decoder), Ok(Applied::Complete));
            assert_eq!(decoder.header(), Ok(None));
            Some((frame, *server.tile()))
        };
        see(&mut pool, &mut publisher, 0, Instant(0));
        assert_eq!(send(&mut pool, &mut publisher, Instant(99)), None, "changes are gathered");
        let (first, _) = send(&mut pool, &mut publisher, Instant(100)).unwrap();
        see(&mut pool, &mut publisher, 1, Instant(110));
        assert_eq!(send(&mut pool, &mut publisher, Instant(300)), None, "one update is in flight");
        publisher.acknowledged(&mut pool, &merged, first, Instant(400));
        assert_eq!(publisher.poll_timeout(), Some(Instant(500)));
        let (second, cells) = send(&mut pool, &mut publisher, Instant(500)).unwrap();
        assert_eq!(cells, pool.find(ID).unwrap().cells());
        publisher.acknowledged(&mut pool, &merged, second, Instant(600));
        assert!(!pool.find(ID).unwrap().dirty, "its place may be used for another tile");
        assert_eq!(send(&mut pool, &mut publisher, Instant(900)), None, "nothing is left");
        assert_eq!(publisher.poll_timeout(), None);
    }

    #[test]
    fn times_of_one_servers_clock_are_not_sent_to_another() {
        let mut places = [OwnTile::FREE; 1];
        let mut pool = Pool::new(&mut places);
        let merged = FusedMap::new(&mut []);
        let mut publisher = Publisher::new(Duration(0));
        let tile = pool.find_or_begin(TileId { x: 0, y: 0 }, 1).unwrap();
        tile.evidence.add(0, [RowSighting { free: 1, hit: 0 }].into_iter());
        tile.dirty = true;
        publisher.changed(Instant(0), Some(7_000));
        let told = |publisher: &mut Publisher, pool: &mut Pool<'_>| {
            let mut buffer = [0u8; 100];
            let mut writer = Writer::new(&mut buffer);
            publisher.fill(pool, &merged, &mut writer, Instant(9)).unwrap();
            let len = writer.len();
            let message = Messages::<ToServer>::new(&buffer[..len]).next().unwrap().unwrap();
            message.decode::<TileUpdateHead>().unwrap().seconds
        };
        assert_eq!(told(&mut publisher, &mut pool), 7_000);
        publisher.begin_session(&mut pool, true, Instant(9));
        assert_eq!(told(&mut publisher, &mut pool), 7_000);
        publisher.begin_session(&mut pool, false, Instant(9));
        assert_eq!(told(&mut publisher, &mut pool), 0);
    }

    #[test]
    fn only_hits_close_in_time_contradict_the_map() {
        let mut places = [FusedTile::FREE; 4];
        let mut merged = FusedMap::new(&mut places);
        merged.begin_session(Epoch(7));
        merged.follow(Pose::default(), Millimetres(50));
        let id = TileId { x: 0, y: 0 };
        let free = Tile { low: [u32::MAX; TILE_SIDE], ..Tile::UNKNOWN };
        let mut out = [0; 60];
        let mut encoder = TileEncoder::new(&mut out);
        let stamp = Stamp { epoch: Epoch(7), version: Version(1) };
        encoder.push(id, stamp, None, 0, &Tile::UNKNOWN, &free).unwrap();
        let len = encoder.finish().unwrap();
        assert_eq!(merged.update(Layer::Fused, &out[..len]), Ok(()));

        let mut places = [OwnTile::FREE; 1];
        let config = MappingConfig {
            resolution: Millimetres(50),
            max_range: 4_000,
            near: 700,
            mounting: Pose::default(),
            validity: Validity::default(),
            policy: Policy::default(),
        };
        let mut map = LocalMap::new(config, &[], &mut [], Pool::new(&mut places));
        // The number of cells to send after ten hits.
        let mut told = |apart: Duration| {
            map.pool.begin_anew(Epoch(0));
            for hit in 1..=10 {
                let tile = map.pool.find_or_begin(id, 1).unwrap();
                let sighting = RowSighting { free: 0, hit: 1 };
                tile.evidence.add_beside(3, [sighting].into_iter(), merged.tile(id).unwrap());
                map.timeout(Instant(hit * apart.micros()), |id| merged.tile(id));
            }
            news(map.pool.find(id).unwrap(), merged.tile(id)).row(3).high
        };
        assert_eq!(told(Duration::from_millis(100)), 1);
        assert_eq!(told(Duration::from_secs(60)), 0);
    }
}
