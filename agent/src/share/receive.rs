//! The server's tiles on the robot: a window of the merged map around it, and the camera coverage
//! of the same ground.

use heapless::Vec;
use ubimap_protocol::{
    message::{Digests, Freshness, Interest, MAX_REQUESTS, Request, ToServer, Writer},
    tile::{
        BaseMissing, Epoch, Layer, Replica, Stamp, TILE_SIDE, Tile, TileDecoder, TileError, TileId,
        Version, tile_hash,
    },
    time::Instant,
    units::{Millimetres, Pose},
};

use crate::{map::Surround, timing::COVERAGE_STALE};

/// Memory for one tile of the window: its cells in the fused layer and in the coverage layer. Its
/// versions are those of the server's epoch.
#[derive(Clone, Debug)]
pub struct FusedTile {
    cells: Tile,
    /// The cells covered by cameras: one word per row, one bit per cell.
    covered: [u32; TILE_SIDE],
    fused_version: Version,
    coverage_version: Version,
    fused_next: u16,
    coverage_next: u16,
    /// When the coverage was last confirmed to be current, in [`ticks`]; 0 if never.
    confirmed: u32,
}

const _: () = assert!(size_of::<FusedTile>() <= 400);

impl FusedTile {
    /// A free place.
    pub const FREE: Self = Self {
        cells: Tile::UNKNOWN,
        covered: [0; TILE_SIDE],
        fused_version: Version(0),
        coverage_version: Version(0),
        fused_next: 0,
        coverage_next: 0,
        confirmed: 0,
    };

    /// The cells in the merged map, if all of them have been received.
    fn complete(&self) -> Option<&Tile> {
        (self.fused_version.0 != 0 && self.fused_next == 0).then_some(&self.cells)
    }

    /// The tile's state in one layer; `epoch` is the server's.
    fn replica(&self, layer: Layer, epoch: Epoch) -> Replica {
        match layer {
            Layer::Coverage => {
                let tile = Tile { low: self.covered, ..Tile::UNKNOWN };
                let stamp = Stamp { epoch, version: self.coverage_version };
                Replica::restored(tile, stamp, self.coverage_next)
            }
            _ => {
                let stamp = Stamp { epoch, version: self.fused_version };
                Replica::restored(self.cells, stamp, self.fused_next)
            }
        }
    }

    /// Discards the tile's cells in one layer.
    fn give_up(&mut self, layer: Layer) {
        if layer == Layer::Coverage {
            self.covered = [0; TILE_SIDE];
            (self.coverage_version, self.coverage_next) = (Version(0), 0);
            self.confirmed = 0;
        } else {
            self.cells = Tile::UNKNOWN;
            (self.fused_version, self.fused_next) = (Version(0), 0);
        }
    }

    fn clear(&mut self) {
        self.give_up(Layer::Fused);
        self.give_up(Layer::Coverage);
    }

    fn keep(&mut self, layer: Layer, replica: &Replica) {
        let (tile, version, next) = (replica.tile(), replica.stamp().version, replica.next());
        if layer == Layer::Coverage {
            (self.covered, self.coverage_version, self.coverage_next) = (tile.low, version, next);
        } else {
            (self.cells, self.fused_version, self.fused_next) = (*tile, version, next);
        }
    }
}

/// Converts a time to units of 1.024 ms, never 0. The result wraps after 51 days: coverage that was
/// last confirmed exactly 51 days ago counts as fresh for a second.
fn ticks(moment: Instant) -> u32 {
    ((moment.micros() >> 10) as u32).max(1)
}

/// How long coverage is fresh, in [`ticks`].
const FRESH: u32 = (COVERAGE_STALE.0 >> 10) as u32;

/// The robot's copy of the server's tiles, in the caller's memory.
#[derive(Debug)]
pub struct FusedMap<'b> {
    /// Tile (x, y) of the window is stored at (x, y) modulo `side`, row by row.
    places: &'b mut [FusedTile],
    /// The side of the window, in tiles.
    side: u8,
    epoch: Epoch,
    interest: Option<Interest>,
    /// The number of the last window (interest) that was sent to the server.
    told: u32,
    missing: [Missing; 2],
}

/// The tiles of one layer that must be requested from the server.
#[derive(Debug)]
struct Missing {
    layer: Layer,
    tiles: Vec<TileId, MAX_REQUESTS>,
    /// Whether there are too many tiles to list, so that all tiles are requested.
    all: bool,
}

impl Missing {
    const fn of(layer: Layer) -> Self {
        Self { layer, tiles: Vec::new(), all: false }
    }

    fn add(&mut self, id: TileId) {
        if !self.tiles.contains(&id) && self.tiles.push(id).is_err() {
            // `all` is set now, because no later update may come that would request the tile.
            self.tiles.clear();
            self.all = true;
        }
    }

    /// Writes a request for as many tiles as fit, and removes them from the list. Returns whether a
    /// request was written.
    fn push(&mut self, writer: &mut Writer<'_, ToServer>) -> bool {
        if self.all {
            let request = Request { layer: self.layer, tiles: Vec::new() };
            self.all = !writer.push(&request);
            return !self.all;
        }
        let asked = writer.push_longest(1..=self.tiles.len(), |count| {
            let tiles = self.tiles.get(..count).unwrap_or_default();
            Request { layer: self.layer, tiles: Vec::from_slice(tiles).unwrap_or_default() }
        });
        if let Some(count) = asked {
            let rest = self.tiles.get(count..).unwrap_or_default();
            self.tiles = Vec::from_slice(rest).unwrap_or_default();
        }
        asked.is_some()
    }
}

impl<'b> FusedMap<'b> {
    /// An empty map. Its window is the largest square of at most `places.len()` tiles.
    pub fn new(places: &'b mut [FusedTile]) -> Self {
        places.iter_mut().for_each(FusedTile::clear);
        let side = (1..=u8::MAX).take_while(|&it| usize::from(it).pow(2) <= places.len()).last();
        Self {
            places,
            side: side.unwrap_or(0),
            epoch: Epoch(0),
            interest: None,
            told: 0,
            missing: [Missing::of(Layer::Fused), Missing::of(Layer::Coverage)],
        }
    }

    /// Number of places, each for one tile.
    pub fn capacity(&self) -> usize {
        self.places.len()
    }

    /// The tiles held in one of the server's layers, complete or partial.
    pub fn tiles(&self, layer: Layer) -> impl Iterator<Item = (TileId, Replica)> {
        self.interest.into_iter().flat_map(|interest| interest.ids()).filter_map(move |id| {
            let replica = self.place(id)?.replica(layer, self.epoch);
            (replica.stamp().version.0 != 0).then_some((id, replica))
        })
    }

    /// The cells of a fused tile; `None` if the tile is not held or is incomplete.
    pub fn tile(&self, id: TileId) -> Option<&Tile> {
        self.place(id).and_then(FusedTile::complete)
    }

    /// What the server knows about a tile: its cells in the merged map, and the cells covered by
    /// cameras (one word per row) if that was confirmed less than a second before `now`.
    pub fn around(&self, id: TileId, now: Instant) -> Surround<'_> {
        let fresh = |place: &&FusedTile| {
            let confirmed = place.confirmed != 0 && place.coverage_next == 0;
            confirmed && ticks(now).wrapping_sub(place.confirmed) < FRESH
        };
        let place = self.place(id);
        Surround {
            merged: place.and_then(FusedTile::complete),
            covered: place.filter(fresh).map(|place| &place.covered),
            masked: None,
        }
    }

    /// Centres the window on the robot when the robot has left the window's middle third, and drops
    /// the tiles outside. `resolution` is the side of a cell.
    pub fn follow(&mut self, pose: Pose, resolution: Millimetres) {
        let side = i32::from(self.side);
        if side == 0 {
            return;
        }
        let tile_size = resolution.0.saturating_mul(TILE_SIDE as i32).max(1);
        // The south-western tile of a window centred on the robot.
        let first = |coordinate: Millimetres| {
            let half = side * tile_size / 2;
            let first = (coordinate.0.saturating_sub(half)).div_euclid(tile_size);
            // Rounded to the nearest tile: the robot is within half a tile of the window's centre.
            let rest = coordinate.0.saturating_sub(half).rem_euclid(tile_size);
            first + i32::from(2 * i64::from(rest) >= i64::from(tile_size))
        };
        let clamp = |tile: i32| tile.clamp(i32::from(i16::MIN), i32::from(i16::MAX)) as i16;
        let from = TileId { x: clamp(first(pose.x)), y: clamp(first(pose.y)) };
        let to = TileId {
            x: clamp(i32::from(from.x) + side - 1),
            y: clamp(i32::from(from.y) + side - 1),
        };
        let slack = (side / 6).max(1);
        let far = |a: i16, b: i16| (i32::from(a) - i32::from(b)).abs() > slack;
        let moved =
            self.interest.is_none_or(|now| far(now.from.x, from.x) || far(now.from.y, from.y));
        if !moved {
            return;
        }
        let number = self.interest.map_or(0, |now| now.number) + 1;
        let interest = Interest { number, from, to };
        for id in self.interest.into_iter().flat_map(|before| before.ids()) {
            if !interest.contains(id)
                && let Some(place) = self.place_mut(id)
            {
                place.clear();
            }
        }
        self.interest = Some(interest);
    }

    /// The window of tiles that the robot wants from the server; `None` before the first pose.
    pub fn interest(&self) -> Option<Interest> {
        self.interest
    }

    /// The window, if it has not been sent to the server in this session.
    pub fn untold(&self) -> Option<Interest> {
        self.interest.filter(|interest| interest.number > self.told)
    }

    /// Records that the window with this number was sent to the server.
    pub fn told(&mut self, number: u32) {
        self.told = self.told.max(number);
    }

    /// Writes a request for as many missing tiles of one layer as fit; each tile is requested once.
    /// Returns whether a request was written.
    pub fn push_request(&mut self, writer: &mut Writer<'_, ToServer>) -> bool {
        self.missing.iter_mut().any(|missing| missing.push(writer))
    }

    /// Starts a session with a server of this epoch. The server does not know the window yet, and
    /// tiles of any other epoch are discarded.
    pub fn begin_session(&mut self, epoch: Epoch) {
        self.told = 0;
        self.missing = [Missing::of(Layer::Fused), Missing::of(Layer::Coverage)];
        if self.epoch != epoch {
            self.epoch = epoch;
            self.places.iter_mut().for_each(FusedTile::clear);
        }
    }

    /// Processes the coded tiles of an update of one of the server's layers. Calls `dropped` with
    /// each tile that is discarded because its cells were wrong, or with `None` if the whole layer
    /// is discarded because any of its cells may be wrong.
    ///
    /// # Errors
    /// [`TileError`]: the rest of the update is ignored; the tiles before the error are kept.
    // Not inlined, like `compare` and `confirm`: decoding would enlarge the stack frame in which
    // every other message is processed.
    #[inline(never)]
    pub fn update(
        &mut self,
        layer: Layer,
        coded: &[u8],
        mut dropped: impl FnMut(Option<TileId>),
    ) -> Result<(), TileError> {
        let mut decoder = TileDecoder::new(coded);
        let epoch = self.epoch;
        // Whether a tile builds upon cells that the end of the update has yet to confirm.
        let mut is_unconfirmed = false;
        loop {
            let header = match decoder.header() {
                Ok(Some(header)) => header,
                Ok(None) => return Ok(()),
                Err(_) if is_unconfirmed => break,
                Err(error) => return Err(error),
            };
            // A tile outside the window was sent before the window moved. A whole tile is skipped.
            // After any other update of such a tile, the rest of the message can't be decoded and
            // is lost; the server sends it again when the tile is requested.
            let place = self.place(header.id).filter(|_| header.stamp.epoch == epoch);
            let mut replica = place.map_or(Replica::NOTHING, |place| place.replica(layer, epoch));
            let is_held = place.is_some();
            if replica.apply(&header, &mut decoder) == Err(BaseMissing) {
                if is_unconfirmed {
                    break;
                }
                if header.base.is_none()
                    && header.stamp < replica.stamp()
                    && let Some(place) = self.place_mut(header.id)
                {
                    // The tile held is from an earlier run of the server with the same epoch. The
                    // first part of the new tile was skipped as stale, and would be skipped again.
                    place.give_up(layer);
                    dropped(Some(header.id));
                }
                self.request(layer, header.id);
                return Ok(());
            }
            is_unconfirmed |= header.names_base();
            if let Some(place) = self.place_mut(header.id).filter(|_| is_held) {
                place.keep(layer, &replica);
            }
        }
        // The update was coded against other cells than those held here, so any tile of this layer
        // may be wrong now.
        self.places.iter_mut().for_each(|place| place.give_up(layer));
        self.missing.iter_mut().filter(|it| it.layer == layer).for_each(|it| it.all = true);
        dropped(None);
        Ok(())
    }

    /// Compares the digests of some of the server's tiles. A tile held in any other state, even a
    /// newer one, is dropped and, if the server has the tile, requested: the server is the only
    /// writer, so that state is wrong. Calls `dropped` with each of these tiles.
    #[inline(never)]
    pub fn compare(&mut self, digests: &Digests, mut dropped: impl FnMut(TileId)) {
        let (layer, epoch) = (digests.layer, self.epoch);
        for digest in &digests.tiles {
            let Some(place) = self.place_mut(digest.id) else { continue };
            let replica = place.replica(layer, epoch);
            if replica.stamp() != digest.stamp || tile_hash(replica.tile()) != digest.hash {
                // The tile is dropped so that the server's reply is accepted: a reply with the
                // same version as the tile held here, or an older one, would be ignored as stale.
                place.give_up(layer);
                if digest.stamp.version != Version(0) {
                    self.request(layer, digest.id);
                }
                dropped(digest.id);
            }
        }
    }

    /// Records that the coverage tiles listed in `freshness` were current at `moment` (robot's
    /// clock).
    #[inline(never)]
    pub fn confirm(&mut self, freshness: &Freshness, moment: Instant) {
        let Some(interest) = self.interest.filter(|it| it.number == freshness.interest) else {
            return;
        };
        let now = ticks(moment);
        let bits = freshness.tiles.iter().flat_map(|byte| (0..8).map(move |bit| byte >> bit & 1));
        let tiles = interest.ids().skip(usize::from(freshness.first));
        for (id, _) in tiles.zip(bits).filter(|&(_, bit)| bit != 0) {
            let Some(place) = self.place_mut(id) else { continue };
            let later = now.wrapping_sub(place.confirmed) < u32::MAX / 2;
            if place.coverage_version.0 != 0 && (place.confirmed == 0 || later) {
                place.confirmed = now;
            }
        }
    }

    fn place(&self, id: TileId) -> Option<&FusedTile> {
        self.places.get(self.index(id)?)
    }

    fn place_mut(&mut self, id: TileId) -> Option<&mut FusedTile> {
        self.places.get_mut(self.index(id)?)
    }

    /// The index of a tile in `places`; `None` if the tile is outside the window.
    fn index(&self, id: TileId) -> Option<usize> {
        let side = i32::from(self.side);
        let along = |tile: i16| i32::from(tile).checked_rem_euclid(side);
        self.interest.filter(|interest| interest.contains(id))?;
        usize::try_from(along(id.y)? * side + along(id.x)?).ok()
    }

    fn request(&mut self, layer: Layer, id: TileId) {
        if let Some(missing) = self.missing.iter_mut().find(|missing| missing.layer == layer) {
            missing.add(id);
        }
    }
}

#[cfg(test)]
mod tests;
