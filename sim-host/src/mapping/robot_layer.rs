//! One robot's layer on the server: all epochs of each tile, joined.
//!
//! The newest two epochs of a tile are open: each has a state of its own. All older ones are
//! closed: only their joined cells are kept, and they no longer change.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::tile::{
    Applied, EPOCHS_AHEAD, Epoch, Replica, Stamp, TILE_CELLS, TILE_SIDE, Tile, TileDecoder,
    TileError, TileHeader, TileId, Version,
};

use super::epochs::{Epochs, Held, MAX_HELD};

/// Maximum number of tiles of a robot: 21,000 square metres with 5 cm cells.
const MAX_TILES: usize = 8_192;
/// Maximum number of epochs of all tiles of a robot: some 16 MB.
const MAX_EPOCHS: usize = MAX_TILES * MAX_HELD;
/// Estimated memory of a tile in bytes: its cells' times (4 kB), and its share of the fused layer.
const TILE_MEMORY: usize = 6 << 10;
/// Estimated memory of one epoch of a tile in bytes.
const EPOCH_MEMORY: usize = 640;

/// The cells of a tile, and for each cell the second of the server's clock in which a robot last
/// reported a change of it, or cameras last saw it; row by row from the south-west.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SeenTile {
    /// The cells.
    pub tile: Tile,
    /// One value per cell.
    pub seconds: [u32; TILE_CELLS as usize],
}

impl SeenTile {
    /// A tile without observations.
    pub const NOTHING: Self = Self { tile: Tile::UNKNOWN, seconds: [0; TILE_CELLS as usize] };

    /// Only those cells whose last reported change was at `second` or before; all others are unknown.
    pub fn by(&self, second: u32) -> Tile {
        let mut drawn = Tile::UNKNOWN;
        for (cell, _) in self.seconds.iter().enumerate().filter(|(_, seen)| **seen <= second) {
            let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
            drawn.set(x, y, self.tile.cell(x, y));
        }
        drawn
    }
}

/// A record on disk: a complete state of one epoch of a tile, or the joined cells of the tile's
/// closed epochs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TileRecord {
    /// The tile's id.
    pub id: TileId,
    /// Epoch and version of the state. Version 0, which no state has, means that the record joins
    /// all epochs up to this one and replaces their records.
    pub stamp: Stamp,
    /// The cells of this state.
    pub cells: Tile,
    /// All cells that the epoch has ever known.
    pub known: Tile,
    /// When the robot last reported a change of each cell, in any epoch: seconds of the server's
    /// clock, as in [`SeenTile`].
    pub seconds: [u32; TILE_CELLS as usize],
}

impl TileRecord {
    /// Whether the record joins all epochs of the tile up to that of its stamp.
    pub fn is_closed(&self) -> bool {
        self.stamp.version == Version(0)
    }
}

/// The layer of one robot. Each cell has the code of the newest epoch that knows it, so the layer
/// does not depend on the order in which states of tiles arrive.
#[derive(Clone, Debug, Default)]
pub struct RobotLayer {
    tiles: BTreeMap<TileId, Epochs>,
    /// The joined epochs of each tile.
    seen: BTreeMap<TileId, Box<SeenTile>>,
    /// Epochs below this one are void.
    first_epoch: Epoch,
    /// The highest epoch accepted so far.
    newest: Epoch,
    /// Epochs from this one on are not joined with older ones, which are about to become void.
    barrier: Option<Epoch>,
    /// Number of epochs held, summed over all tiles.
    epochs: usize,
    /// Maximum memory in bytes. If `None`, only [`MAX_TILES`] and [`MAX_EPOCHS`] apply.
    limit: Option<usize>,
}

/// A limit that an update can exceed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Limit {
    /// Maximum number of tiles or of epochs of one robot.
    Robot,
    /// Maximum memory of the layers of all robots.
    AllRobots,
}

/// The result of an update.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Updated {
    /// The changed tiles.
    pub tiles: BTreeSet<TileId>,
    /// The tiles and epochs with a complete state in this update, whether new or already held.
    pub complete: BTreeSet<(TileId, Epoch)>,
    /// Tiles in which epochs were closed, each with its newest closed epoch. The
    /// [record](RobotLayer::record) of that epoch must be stored.
    pub folded: BTreeSet<(TileId, Epoch)>,
    /// The tile that was not applied, because its base is missing or a limit is exceeded; the rest
    /// of the update was skipped. Requesting this tile makes the robot send all of that again, or
    /// at least keeps it from evicting the tile.
    pub missing: Option<TileId>,
    /// Number of tile states in the update that were old: a newer one, or one of a closed epoch,
    /// had arrived before.
    pub late: u32,
    /// The limit that `missing` would exceed; `None` if its base is missing.
    pub refused: Option<Limit>,
}

impl RobotLayer {
    /// Applies the coded tiles of an update whose newest scan was taken at `seconds` of the
    /// server's clock. Returns the effects, also of the tiles before an error.
    ///
    /// # Errors
    /// A [`TileError`]; the rest of the update is not decoded.
    pub fn update(&mut self, coded: &[u8], seconds: u32) -> (Updated, Result<(), TileError>) {
        let mut updated = Updated { missing: self.wrong_base(coded), ..Updated::default() };
        if updated.missing.is_some() {
            return (updated, Ok(()));
        }
        let mut decoder = TileDecoder::new(coded);
        loop {
            let header = match decoder.header() {
                Ok(Some(header)) => header,
                Ok(None) => return (updated, Ok(())),
                Err(error) => return (updated, Err(error)),
            };
            let epoch = header.stamp.epoch;
            if epoch.0 > self.next_epoch().0.saturating_add(EPOCHS_AHEAD) || epoch.0 == u32::MAX {
                // The server never granted this epoch. Accepting it could use up the epoch numbers
                // that the robot needs for its reboots.
                return (updated, Err(TileError::Malformed));
            }
            if epoch < self.first_epoch {
                // The robot itself has discarded all tiles in this update.
                return (updated, Ok(()));
            }
            if self.is_closed(header.id, epoch) {
                // The update is a late copy, which the robot no longer tries to deliver. So nothing
                // is requested if its remaining tiles can't be decoded.
                updated.late += 1;
                match Replica::default().apply(&header, &mut decoder) {
                    Ok(_) => continue,
                    Err(_) => return (updated, Ok(())),
                }
            }
            updated.refused = self.refuses(header.id, epoch);
            // The frame is acknowledged, so a request must tell the robot that the tile is not
            // held.
            if updated.refused.is_some() || !self.apply(&header, &mut decoder, &mut updated) {
                updated.missing = Some(header.id);
                return (updated, Ok(()));
            }
            self.newest = self.newest.max(epoch);
            updated.complete.extend((header.end == TILE_CELLS).then_some((header.id, epoch)));
            if self.join(header.id, |_| seconds) {
                updated.tiles.insert(header.id);
            }
        }
    }

    /// Applies one tile of an update, and closes older epochs of the tile. Returns false, without
    /// any change, if the base that the update names is not held.
    fn apply(
        &mut self,
        header: &TileHeader,
        decoder: &mut TileDecoder<'_>,
        updated: &mut Updated,
    ) -> bool {
        let is_new = !self.tiles.contains_key(&header.id);
        let epochs = self.tiles.entry(header.id).or_default();
        let before = epochs.len();
        match epochs.apply(header, decoder) {
            Ok(applied) => updated.late += u32::from(applied == Applied::Old),
            Err(_) => {
                if is_new {
                    self.tiles.remove(&header.id);
                }
                return false;
            }
        }
        updated.folded.extend(epochs.fold(self.barrier).map(|closed| (header.id, closed)));
        self.epochs = self.epochs + epochs.len() - before;
        true
    }

    /// The limit that an update of this tile and epoch would exceed; `None` if it may be applied.
    fn refuses(&self, id: TileId, epoch: Epoch) -> Option<Limit> {
        let epochs = self.tiles.get(&id);
        let growth = epochs.map_or(1, |epochs| epochs.growth(epoch, self.barrier));
        let is_beyond_own = epochs.is_none() && self.tiles.len() >= MAX_TILES
            || growth > 0 && self.epochs >= MAX_EPOCHS;
        let more = usize::from(epochs.is_none()) * TILE_MEMORY + growth * EPOCH_MEMORY;
        let is_beyond = more > 0 && self.limit.is_some_and(|limit| self.memory() + more > limit);
        if is_beyond_own { Some(Limit::Robot) } else { is_beyond.then_some(Limit::AllRobots) }
    }

    /// Estimated memory in bytes, including the layer's share of the fused layer.
    pub fn memory(&self) -> usize {
        self.tiles.len() * TILE_MEMORY + self.epochs * EPOCH_MEMORY
    }

    /// Number of epochs held, summed over all tiles; the closed epochs of a tile count as one.
    pub fn epochs(&self) -> usize {
        self.epochs
    }

    /// Keeps epochs from `barrier` on apart from older ones, which are about to become void. The
    /// barrier is set from when the robot is asked to restart at epoch `barrier` until
    /// [`retire`](Self::retire) is called.
    pub fn set_barrier(&mut self, barrier: Option<Epoch>) {
        self.barrier = barrier;
    }

    /// Sets the maximum memory in bytes. Existing epochs of tiles are kept and can be updated;
    /// updates that need more memory are refused.
    pub fn set_limit(&mut self, bytes: usize) {
        self.limit = Some(bytes);
    }

    /// The tile to request if the update was coded relative to cells other than those held here:
    /// the first tile that names a base, if the update can't be decoded up to its end. The update
    /// is decoded into copies, since an error may only show at the end.
    fn wrong_base(&self, coded: &[u8]) -> Option<TileId> {
        let mut copies = BTreeMap::<(TileId, Epoch), Replica>::new();
        let mut decoder = TileDecoder::new(coded);
        let mut unconfirmed = None;
        loop {
            let header = match decoder.header() {
                Ok(Some(header)) => header,
                Ok(None) => return None,
                Err(_) => return unconfirmed,
            };
            let (id, epoch) = (header.id, header.stamp.epoch);
            let held = || self.tiles.get(&id)?.held(epoch).map(|held| held.replica().clone());
            let copy = copies.entry((id, epoch)).or_insert_with(|| held().unwrap_or_default());
            if copy.apply(&header, &mut decoder).is_err() {
                return unconfirmed;
            }
            if header.names_base() {
                unconfirmed = unconfirmed.or(Some(id));
            }
        }
    }

    /// Joins the epochs of a tile again; each cell that changes gets the time that `seconds`
    /// returns for its index. Returns whether any cell has changed.
    fn join(&mut self, id: TileId, seconds: impl Fn(usize) -> u32) -> bool {
        let joined = self.tiles.get(&id).map_or(Tile::UNKNOWN, Epochs::joined);
        let seen = self.seen.entry(id).or_insert_with(|| Box::new(SeenTile::NOTHING));
        for (cell, time) in seen.seconds.iter_mut().enumerate() {
            let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
            if seen.tile.cell(x, y) != joined.cell(x, y) {
                *time = seconds(cell);
            }
        }
        core::mem::replace(&mut seen.tile, joined) != joined
    }

    /// Voids the epochs below `first`: the robot drew them from wrong poses and has discarded them.
    /// Returns the changed tiles and the epochs that were closed.
    pub fn retire(&mut self, first: Epoch) -> Updated {
        self.first_epoch = self.first_epoch.max(first);
        self.barrier.take_if(|barrier| *barrier <= first);
        let ids: Vec<TileId> = self.tiles.keys().copied().collect();
        let mut updated = Updated::default();
        for id in ids {
            if let Some(epochs) = self.tiles.get_mut(&id) {
                let before = epochs.len();
                epochs.retire(self.first_epoch);
                updated.folded.extend(epochs.fold(self.barrier).map(|closed| (id, closed)));
                self.epochs = self.epochs + epochs.len() - before;
            }
            updated.tiles.extend(self.join(id, |_| 0).then_some(id));
        }
        updated
    }

    /// Epochs below this one are void.
    pub fn first_epoch(&self) -> Epoch {
        self.first_epoch
    }

    /// The robot's observations of a tile.
    pub fn seen(&self, id: TileId) -> Option<&SeenTile> {
        self.seen.get(&id).map(Box::as_ref)
    }

    /// The tiles that the robot has observed.
    pub fn tiles(&self) -> impl Iterator<Item = (TileId, &SeenTile)> {
        self.seen.iter().map(|(&id, seen)| (id, seen.as_ref()))
    }

    /// The stamp and cells of an open epoch of a tile, if its state is complete.
    pub fn held(&self, id: TileId, epoch: Epoch) -> Option<(Stamp, &Tile)> {
        self.tiles.get(&id)?.held(epoch)?.complete()
    }

    /// Whether an epoch of a tile can no longer change, because newer ones are held. Its cells are
    /// only known as part of the joined tile.
    pub fn is_closed(&self, id: TileId, epoch: Epoch) -> bool {
        self.tiles.get(&id).is_some_and(|epochs| epochs.is_closed(epoch))
    }

    /// Discards the state of a tile with this stamp, if it is held, because its cells differ from
    /// the robot's. The robot then sends the same version again as a whole, which replaces it;
    /// until then its cells stay in the map.
    pub fn discard(&mut self, id: TileId, stamp: Stamp) {
        let held = self.tiles.get_mut(&id).and_then(|epochs| epochs.held_mut(stamp.epoch));
        if let Some(held) = held.filter(|held| held.replica().stamp() == stamp) {
            held.discard();
        }
    }

    /// The record to store for an epoch of a tile; `None` unless the epoch is open and its state is
    /// complete, or it is the newest closed epoch.
    pub fn record(&self, id: TileId, epoch: Epoch) -> Option<TileRecord> {
        let epochs = self.tiles.get(&id)?;
        let seconds = self.seen.get(&id)?.seconds;
        if let Some(&cells) = epochs.closed_at(epoch) {
            let stamp = Stamp { epoch, version: Version(0) };
            return Some(TileRecord { id, stamp, cells, known: cells, seconds });
        }
        let held = epochs.held(epoch)?;
        let (stamp, cells) = held.complete()?;
        Some(TileRecord { id, stamp, cells: *cells, known: held.known(), seconds })
    }

    /// Marks a record as stored on disk.
    pub fn kept(&mut self, record: &TileRecord) {
        let Stamp { epoch, version } = record.stamp;
        let held = self.tiles.get_mut(&record.id).and_then(|epochs| epochs.held_mut(epoch));
        // The state may have been discarded and replaced while the record was written.
        let is_same = |held: &&mut Held| {
            let replica = held.replica();
            replica.stamp() > record.stamp
                || replica.stamp() == record.stamp && *replica.tile() == record.cells
        };
        if let Some(held) = held.filter(is_same) {
            held.kept = held.kept.max(version);
        }
    }

    /// The stamp of an open epoch of a tile, if its state is complete and on disk.
    pub fn on_disk(&self, id: TileId, epoch: Epoch) -> Option<Stamp> {
        let held = self.tiles.get(&id)?.held(epoch)?;
        held.complete().map(|(stamp, _)| stamp).filter(|stamp| stamp.version <= held.kept)
    }

    /// Restores a record from disk; the cells that it changes get its times. The records of a tile
    /// must come in the order of their epochs. A state that is not newer than the current one is
    /// ignored. Returns the tile if it has changed, and the epoch that was closed.
    pub fn restore(&mut self, record: &TileRecord) -> Updated {
        let &TileRecord { id, stamp, cells, known, ref seconds } = record;
        self.newest = self.newest.max(stamp.epoch);
        let epochs = self.tiles.entry(id).or_default();
        let before = epochs.len();
        let is_news = if record.is_closed() {
            epochs.restore_closed(stamp.epoch, known)
        } else {
            epochs.restore(stamp, Held::restored(cells, known, stamp))
        };
        let mut updated = Updated::default();
        updated.folded.extend(epochs.fold(None).map(|closed| (id, closed)));
        self.epochs = self.epochs + epochs.len() - before;
        if is_news && self.join(id, |cell| seconds[cell]) {
            updated.tiles.insert(id);
        }
        updated
    }

    /// The lowest epoch that is not void and higher than all that the robot has used.
    pub fn next_epoch(&self) -> Epoch {
        Epoch(self.newest.0.saturating_add(1)).max(self.first_epoch)
    }
}

#[cfg(test)]
mod tests;
