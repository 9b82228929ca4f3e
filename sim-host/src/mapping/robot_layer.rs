//! One robot's layer on the server: all epochs of each tile, joined.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::tile::{
    Applied, BaseMissing, EPOCHS_AHEAD, Epoch, Replica, Stamp, TILE_CELLS, TILE_SIDE, Tile,
    TileDecoder, TileError, TileId, Version,
};

/// Maximum number of tiles of a robot: 21,000 square metres with 5 cm cells.
const MAX_TILES: usize = 8_192;
/// Maximum number of epochs of all tiles of a robot: some 40 MB.
const MAX_EPOCHS: usize = 65_536;
/// Estimated memory of a tile in bytes: its cells' times (4 kB), and its share of the fused layer.
const TILE_MEMORY: usize = 6 << 10;
/// Estimated memory of one epoch of a tile in bytes.
const EPOCH_MEMORY: usize = 640;

/// One epoch of one tile.
#[derive(Clone, Debug, Default)]
struct Held {
    replica: Replica,
    /// The cells of the replica before it was restarted within its epoch. Cells that an epoch has
    /// known stay known.
    before: Option<Tile>,
    /// The version on disk.
    kept: Version,
}

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
}

/// A complete state of one epoch of a tile, as stored on disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TileRecord {
    /// The tile's id.
    pub id: TileId,
    /// Epoch and version of the state.
    pub stamp: Stamp,
    /// The cells of this state.
    pub cells: Tile,
    /// All cells that the epoch has ever known.
    pub known: Tile,
    /// When the robot last reported a change of each cell, in any epoch: seconds of the server's
    /// clock, as in [`SeenTile`].
    pub seconds: [u32; TILE_CELLS as usize],
}

/// The layer of one robot. Each cell has the code of the newest epoch that knows it, so the layer
/// does not depend on the order in which states of tiles arrive.
#[derive(Clone, Debug, Default)]
pub struct RobotLayer {
    // Boxed, because a map's node has room for eleven entries.
    tiles: BTreeMap<TileId, BTreeMap<Epoch, Box<Held>>>,
    /// The joined epochs of each tile.
    seen: BTreeMap<TileId, Box<SeenTile>>,
    /// Epochs below this one are void.
    first_epoch: Epoch,
    /// The highest epoch accepted so far.
    newest: Epoch,
    /// Number of epochs of all tiles.
    epochs: usize,
    /// Maximum memory in bytes; `None`: only this layer's own limits apply.
    limit: Option<usize>,
}

/// A limit on what is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Limit {
    /// Tiles and epochs of one robot.
    Robot,
    /// Memory of the layers of all robots.
    AllRobots,
}

/// The result of an update.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Updated {
    /// The changed tiles.
    pub tiles: BTreeSet<TileId>,
    /// The tiles and epochs with a complete state in this update, whether new or already held.
    pub complete: BTreeSet<(TileId, Epoch)>,
    /// The tile that was not taken, because its base is missing or the robot exceeds its limits.
    /// The rest of the update was skipped as well; requesting this tile restores all of it, or
    /// keeps the robot from evicting it.
    pub missing: Option<TileId>,
    /// The limit because of which a tile, and the rest of the update, was refused.
    pub refused: Option<Limit>,
}

impl RobotLayer {
    /// Applies the coded tiles of an update whose newest scan was taken at `seconds`. The first
    /// value describes what was applied.
    ///
    /// # Errors On a [`TileError`] the rest of the update is not decoded.
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
                // This epoch was never granted. Accepting it would leave no epochs for the robot's
                // reboots.
                return (updated, Err(TileError::Malformed));
            }
            if epoch < self.first_epoch {
                // The robot itself has discarded all tiles in this update.
                return (updated, Ok(()));
            }
            let known = self.tiles.get(&header.id);
            let is_new = !known.is_some_and(|epochs| epochs.contains_key(&epoch));
            updated.refused = self.refuses(known.is_none(), is_new);
            if updated.refused.is_some() {
                // The frame is acknowledged, but the robot must not take the tile for held.
                updated.missing = Some(header.id);
                return (updated, Ok(()));
            }
            self.epochs += usize::from(is_new);
            let epochs = self.tiles.entry(header.id).or_default();
            let held = epochs.entry(epoch).or_default();
            // Cells of a discarded state may be wrong.
            let is_discarded = held.replica.stamp() == Stamp::NOTHING;
            let mut before = if is_discarded { Tile::UNKNOWN } else { *held.replica.tile() };
            match held.replica.apply(&header, &mut decoder) {
                Ok(Applied::Old) => {}
                Ok(Applied::Complete | Applied::Partial) => {
                    if header.base.is_none() && header.start == 0 {
                        if let Some(earlier) = &held.before {
                            before.fill_unknown_from(earlier);
                        }
                        held.before = Some(before);
                    }
                }
                Err(BaseMissing) => {
                    if held.replica == Replica::default() {
                        epochs.remove(&epoch);
                        self.epochs -= 1;
                    }
                    updated.missing = Some(header.id);
                    return (updated, Ok(()));
                }
            }
            self.newest = self.newest.max(epoch);
            updated.complete.extend((header.end == TILE_CELLS).then_some((header.id, epoch)));
            if self.join(header.id, |_| seconds) {
                updated.tiles.insert(header.id);
            }
        }
    }

    /// The limit that a tile or epoch exceeds, if it is new.
    fn refuses(&self, is_new_tile: bool, is_new_epoch: bool) -> Option<Limit> {
        let is_beyond_own = is_new_tile && self.tiles.len() >= MAX_TILES
            || is_new_epoch && self.epochs >= MAX_EPOCHS;
        let more =
            usize::from(is_new_tile) * TILE_MEMORY + usize::from(is_new_epoch) * EPOCH_MEMORY;
        let is_beyond = more > 0 && self.limit.is_some_and(|limit| self.memory() + more > limit);
        if is_beyond_own { Some(Limit::Robot) } else { is_beyond.then_some(Limit::AllRobots) }
    }

    /// Estimated memory in bytes, with the layer's share of the fused layer.
    pub fn memory(&self) -> usize {
        self.tiles.len() * TILE_MEMORY + self.epochs * EPOCH_MEMORY
    }

    /// Sets the maximum memory in bytes. What is there is kept and can be updated; more is refused.
    pub fn set_limit(&mut self, bytes: usize) {
        self.limit = Some(bytes);
    }

    /// A tile of an update that builds upon other cells than those held here. Decodes the update on
    /// copies, since only its end tells.
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
            let held = || self.tiles.get(&id)?.get(&epoch).map(|held| held.replica.clone());
            let copy = copies.entry((id, epoch)).or_insert_with(|| held().unwrap_or_default());
            if copy.apply(&header, &mut decoder).is_err() {
                return unconfirmed;
            }
            if header.names_base() {
                unconfirmed = unconfirmed.or(Some(id));
            }
        }
    }

    /// Joins the epochs of a tile again; changed cells get the time `seconds`. Returns whether any
    /// has changed.
    fn join(&mut self, id: TileId, seconds: impl Fn(usize) -> u32) -> bool {
        let joined = self.joined(id);
        let seen = self.seen.entry(id).or_insert_with(|| Box::new(SeenTile::NOTHING));
        for (cell, time) in seen.seconds.iter_mut().enumerate() {
            let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
            if seen.tile.cell(x, y) != joined.cell(x, y) {
                *time = seconds(cell);
            }
        }
        core::mem::replace(&mut seen.tile, joined) != joined
    }

    fn joined(&self, id: TileId) -> Tile {
        let mut joined = Tile::UNKNOWN;
        for held in self.tiles.get(&id).into_iter().flat_map(|epochs| epochs.values().rev()) {
            joined.fill_unknown_from(held.replica.tile());
            if let Some(before) = &held.before {
                joined.fill_unknown_from(before);
            }
        }
        joined
    }

    /// Voids the epochs below `first`: the robot drew them from wrong poses and has discarded them.
    /// Returns the changed tiles.
    pub fn retire(&mut self, first: Epoch) -> BTreeSet<TileId> {
        self.first_epoch = self.first_epoch.max(first);
        let ids: Vec<TileId> = self.tiles.keys().copied().collect();
        let mut changed = BTreeSet::new();
        for id in ids {
            if let Some(epochs) = self.tiles.get_mut(&id) {
                let before = epochs.len();
                *epochs = epochs.split_off(&self.first_epoch);
                self.epochs -= before - epochs.len();
            }
            changed.extend(self.join(id, |_| 0).then_some(id));
        }
        changed
    }

    /// Epochs below this one are void.
    pub fn first_epoch(&self) -> Epoch {
        self.first_epoch
    }

    /// The cells of a tile whose last report is not after `second`.
    pub fn drawn_by(&self, id: TileId, second: u32) -> Tile {
        let mut drawn = Tile::UNKNOWN;
        if let Some(SeenTile { tile, seconds }) = self.seen(id) {
            for (cell, _) in seconds.iter().enumerate().filter(|(_, seen)| **seen <= second) {
                let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
                drawn.set(x, y, tile.cell(x, y));
            }
        }
        drawn
    }

    /// The robot's observations of a tile.
    pub fn seen(&self, id: TileId) -> Option<&SeenTile> {
        self.seen.get(&id).map(Box::as_ref)
    }

    /// The tiles that the robot has observed.
    pub fn tiles(&self) -> impl Iterator<Item = (TileId, &SeenTile)> {
        self.seen.iter().map(|(&id, seen)| (id, seen.as_ref()))
    }

    /// The newest complete state of an epoch of a tile, and its cells.
    pub fn held(&self, id: TileId, epoch: Epoch) -> Option<(Stamp, &Tile)> {
        let held = self.tiles.get(&id)?.get(&epoch)?;
        let stamp = held.replica.stamp();
        let is_complete = stamp != Stamp::NOTHING && !held.replica.is_partial();
        is_complete.then(|| (stamp, held.replica.tile()))
    }

    /// Discards this state of a tile, if it is held, because its cells differ from the robot's. The
    /// robot then sends the same version again as a whole, which replaces it; until then its cells
    /// stay in the map.
    pub fn discard(&mut self, id: TileId, stamp: Stamp) {
        let held = self.tiles.get_mut(&id).and_then(|epochs| epochs.get_mut(&stamp.epoch));
        if let Some(held) = held.filter(|held| held.replica.stamp() == stamp) {
            let mut cells = *held.replica.tile();
            if let Some(before) = &held.before {
                cells.fill_unknown_from(before);
            }
            let replica = Replica::restored(cells, Stamp::NOTHING, 0);
            **held = Held { replica, before: None, kept: Version(0) };
        }
    }

    /// The record to store for an epoch of a tile, if its state is complete.
    pub fn record(&self, id: TileId, epoch: Epoch) -> Option<TileRecord> {
        let held = self.tiles.get(&id)?.get(&epoch)?;
        let mut known = *held.replica.tile();
        if let Some(before) = &held.before {
            known.fill_unknown_from(before);
        }
        let (stamp, cells) = self.held(id, epoch)?;
        Some(TileRecord { id, stamp, cells: *cells, known, seconds: self.seen.get(&id)?.seconds })
    }

    /// Marks a record as stored on disk.
    pub fn kept(&mut self, record: &TileRecord) {
        let Stamp { epoch, version } = record.stamp;
        let held = self.tiles.get_mut(&record.id).and_then(|epochs| epochs.get_mut(&epoch));
        // The state may have been discarded and replaced while the record was written.
        let is_same = |held: &&mut Box<Held>| {
            held.replica.stamp() > record.stamp
                || held.replica.stamp() == record.stamp && *held.replica.tile() == record.cells
        };
        if let Some(held) = held.filter(is_same) {
            held.kept = held.kept.max(version);
        }
    }

    /// The newest complete state of an epoch of a tile, if it is on disk.
    pub fn on_disk(&self, id: TileId, epoch: Epoch) -> Option<Stamp> {
        let kept = self.tiles.get(&id)?.get(&epoch)?.kept;
        self.held(id, epoch).map(|(stamp, _)| stamp).filter(|stamp| stamp.version <= kept)
    }

    /// Restores a stored epoch of a tile, with the times of the newest record of the tile. A state
    /// that is not newer than the current one is ignored. Returns whether the tile has changed.
    pub fn restore(&mut self, record: &TileRecord) -> bool {
        let epochs = self.tiles.entry(record.id).or_default();
        self.epochs += usize::from(!epochs.contains_key(&record.stamp.epoch));
        self.newest = self.newest.max(record.stamp.epoch);
        let held = epochs.entry(record.stamp.epoch).or_default();
        if held.replica.stamp() >= record.stamp {
            return false;
        }
        held.replica = Replica::restored(record.cells, record.stamp, 0);
        held.before = Some(record.known);
        held.kept = record.stamp.version;
        self.join(record.id, |cell| record.seconds[cell])
    }

    /// The lowest epoch that the robot has not used.
    pub fn next_epoch(&self) -> Epoch {
        Epoch(self.newest.0.saturating_add(1)).max(self.first_epoch)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::{Cell, TileEncoder, Version};

    const ID: TileId = TileId { x: 1, y: 2 };

    fn update(epoch: u32, version: u32, base: Option<(u32, &Tile)>, new: &Tile) -> Vec<u8> {
        let mut out = [0u8; 1024];
        let mut encoder = TileEncoder::new(&mut out);
        let stamp = Stamp { epoch: Epoch(epoch), version: Version(version) };
        let old = base.map_or(&Tile::UNKNOWN, |(_, old)| old);
        let base = base.map(|(base, _)| Version(base));
        encoder.push(ID, stamp, base, 0, old, new).unwrap();
        let len = encoder.finish().unwrap();
        out[..len].to_vec()
    }

    fn tile(cells: &[(usize, Cell)]) -> Tile {
        let mut tile = Tile::UNKNOWN;
        cells.iter().for_each(|&(x, cell)| tile.set(x, 0, cell));
        tile
    }

    #[test]
    fn a_newer_epoch_adds_to_an_older_one_in_any_order() {
        let old = update(1, 4, None, &tile(&[(0, Cell::Occupied), (1, Cell::Free)]));
        let new = update(2, 1, None, &tile(&[(1, Cell::Occupied), (2, Cell::Free)]));
        let joined = tile(&[(0, Cell::Occupied), (1, Cell::Occupied), (2, Cell::Free)]);
        for order in [[&old, &new], [&new, &old]] {
            let mut layer = RobotLayer::default();
            for coded in order {
                assert_eq!(layer.update(coded, 5).1, Ok(()));
            }
            assert_eq!(layer.seen(ID).unwrap().tile, joined);
            assert_eq!(layer.next_epoch(), Epoch(3));
        }
    }

    #[test]
    fn stored_tiles_are_restored_and_extended() {
        let mut layer = RobotLayer::default();
        let early = tile(&[(2, Cell::Occupied)]);
        assert_eq!(layer.update(&update(2, 7, None, &early), 4).1, Ok(()));
        let first = tile(&[(0, Cell::Occupied), (1, Cell::Free)]);
        assert_eq!(layer.update(&update(3, 1, None, &first), 5).1, Ok(()));
        assert_eq!(layer.on_disk(ID, Epoch(3)), None);
        let record = layer.record(ID, Epoch(3)).unwrap();
        layer.kept(&record);
        assert_eq!(layer.on_disk(ID, Epoch(3)), Some(record.stamp));
        let mut restarted = RobotLayer::default();
        assert!(restarted.restore(&layer.record(ID, Epoch(2)).unwrap()));
        assert!(restarted.restore(&record));
        assert!(!restarted.restore(&record));
        assert_eq!(restarted.on_disk(ID, Epoch(3)), Some(record.stamp));
        // The time of each cell is restored, too.
        assert_eq!(restarted.seen(ID), layer.seen(ID));
        assert_eq!(restarted.next_epoch(), Epoch(4));
        let second = tile(&[(0, Cell::Occupied), (1, Cell::Occupied)]);
        let coded = update(3, 2, Some((1, &first)), &second);
        assert_eq!(restarted.update(&coded, 6).0.missing, None);
        let mut joined = second;
        joined.fill_unknown_from(&early);
        assert_eq!(restarted.seen(ID).unwrap().tile, joined);
    }

    #[test]
    fn beyond_the_maximum_only_existing_tiles_are_updated() {
        let cells = tile(&[(0, Cell::Free)]);
        let mut out = [0u8; 64];
        let mut coded = |x: usize, epoch: u32, version: u32, cells: &Tile| {
            let mut encoder = TileEncoder::new(&mut out);
            let id = TileId { x: x as i16, y: 0 };
            let stamp = Stamp { epoch: Epoch(epoch), version: Version(version) };
            encoder.push(id, stamp, None, 0, &Tile::UNKNOWN, cells).unwrap();
            let len = encoder.finish().unwrap();
            out[..len].to_vec()
        };
        let mut layer = RobotLayer::default();
        for x in 0..MAX_TILES {
            assert_eq!(layer.update(&coded(x, 1, 1, &cells), 5).0.refused, None);
        }
        let refused = layer.update(&coded(MAX_TILES, 1, 1, &cells), 5).0.refused;
        assert_eq!(refused, Some(Limit::Robot));
        assert_eq!(layer.tiles().count(), MAX_TILES);
        let more = tile(&[(0, Cell::Occupied)]);
        for (epoch, version) in [(1, 2), (2, 1)] {
            let (updated, _) = layer.update(&coded(3, epoch, version, &more), 6);
            assert!(updated.refused.is_none() && !updated.complete.is_empty());
        }
        // Voided epochs do not count.
        layer.retire(Epoch(2));
        assert_eq!(layer.epochs, 1);
    }

    #[test]
    fn a_tile_beyond_the_limit_is_requested() {
        let mut layer = RobotLayer::default();
        for index in 0..MAX_TILES {
            let id = TileId { x: 100 + (index % 100) as i16, y: (index / 100) as i16 };
            layer.tiles.insert(id, BTreeMap::new());
        }
        let (updated, result) = layer.update(&update(1, 1, None, &tile(&[(0, Cell::Free)])), 5);
        assert_eq!(result, Ok(()));
        assert!(updated.refused.is_some() && updated.complete.is_empty());
        assert_eq!(updated.missing, Some(ID));
    }

    /// One frame must not use up the epochs that the robot needs for its reboots.
    #[test]
    fn epochs_that_were_never_granted_are_refused() {
        let mut layer = RobotLayer::default();
        let cells = tile(&[(0, Cell::Free)]);
        let malformed = (Updated::default(), Err(TileError::Malformed));
        for epoch in [u32::MAX, u32::MAX - 1, 1 << 31, EPOCHS_AHEAD + 2] {
            assert_eq!(layer.update(&update(epoch, 1, None, &cells), 5), malformed, "{epoch}");
        }
        assert_eq!((layer.next_epoch(), layer.tiles().count()), (Epoch(1), 0));
        assert_eq!(layer.update(&update(EPOCHS_AHEAD, 1, None, &cells), 5).1, Ok(()));
        assert_eq!(layer.next_epoch(), Epoch(EPOCHS_AHEAD + 1));
        // A cure (a correction of the robot's constant errors) grants epochs further ahead.
        layer.retire(Epoch(1 << 20));
        assert_eq!(layer.update(&update((1 << 20) + 1, 1, None, &cells), 5).1, Ok(()));
    }

    /// A sender may answer a Request with a version that it has sent before.
    #[test]
    fn a_discarded_state_is_replaced_by_the_same_version() {
        let mut layer = RobotLayer::default();
        let wrong = tile(&[(0, Cell::Occupied), (1, Cell::Occupied)]);
        let right = tile(&[(0, Cell::Free)]);
        assert_eq!(layer.update(&update(1, 4, None, &wrong), 5).1, Ok(()));
        let written = layer.record(ID, Epoch(1)).unwrap();
        layer.discard(ID, written.stamp);
        assert_eq!((layer.held(ID, Epoch(1)), layer.record(ID, Epoch(1))), (None, None));
        assert_eq!(layer.seen(ID).unwrap().tile, wrong, "until it is replaced");
        assert_eq!(layer.update(&update(1, 4, None, &right), 6).1, Ok(()));
        assert_eq!(layer.seen(ID).unwrap().tile, right);
        layer.kept(&written);
        assert_eq!(layer.on_disk(ID, Epoch(1)), None, "the record holds the discarded state");
        layer.kept(&layer.record(ID, Epoch(1)).unwrap());
        assert!(layer.on_disk(ID, Epoch(1)).is_some());
    }

    #[test]
    fn a_missing_base_is_named_and_leaves_no_trace() {
        let base = tile(&[(0, Cell::Free)]);
        let coded = update(1, 2, Some((1, &base)), &tile(&[(0, Cell::Occupied)]));
        let mut layer = RobotLayer::default();
        // An epoch is held even if it knows no cells.
        assert_eq!(layer.update(&update(0, 1, None, &Tile::UNKNOWN), 5).1, Ok(()));
        let (updated, result) = layer.update(&coded, 5);
        assert_eq!((updated.missing, result), (Some(ID), Ok(())));
        assert!(layer.held(ID, Epoch(0)).is_some() && layer.held(ID, Epoch(1)).is_none());
        assert!(updated.tiles.is_empty());
        assert_eq!(layer.seen(ID).unwrap().tile, Tile::UNKNOWN);
        assert_eq!(layer.update(&update(1, 1, None, &base), 5).1, Ok(()));
        assert_eq!(layer.update(&coded, 6).0.missing, None);
        let seen = layer.seen(ID).unwrap();
        assert_eq!((seen.tile.cell(0, 0), seen.seconds[0]), (Cell::Occupied, 6));
    }
}
