//! A tile of the robot's own layer: its evidence, and its state on the server.

use ubimap_protocol::{
    tile::{EPOCHS_AHEAD, Epoch, Publication, Row, Stamp, Tile, TileId, Version},
    time::Instant,
};

use super::{evidence::Evidence, movable::Changes};

/// One place in the pool of the robot's own tiles, free or in use.
#[derive(Clone, Debug)]
pub struct OwnTile {
    /// The tile's id, or `None` for a free place.
    pub(crate) id: Option<TileId>,
    /// The epoch of the tile's versions. A tile that is evicted and observed again gets a new one.
    pub(crate) epoch: Epoch,
    /// The evidence for its cells.
    pub(crate) evidence: Evidence,
    changes: Changes,
    /// The record of what the server holds of the tile.
    pub(crate) publication: Publication,
    /// The newest version that the server has on disk, if it stores tiles.
    pub(crate) stored: Version,
    /// Whether the evidence may contain unpublished changes.
    pub(crate) dirty: bool,
    /// The number of the last scan that observed this tile.
    pub(crate) touched: u32,
}

impl OwnTile {
    /// A free place.
    pub const FREE: Self = Self {
        id: None,
        epoch: Epoch(0),
        evidence: Evidence::NONE,
        changes: Changes::NONE,
        publication: Publication::NOTHING,
        stored: Version(0),
        dirty: false,
        touched: 0,
    };

    /// The tile's id, or `None` for a free place.
    pub fn id(&self) -> Option<TileId> {
        self.id
    }

    /// The epoch of the tile's versions. A tile that is evicted and observed again gets a new one.
    pub fn epoch(&self) -> Epoch {
        self.epoch
    }

    /// The record of what the server holds of the tile.
    pub fn publication(&self) -> &Publication {
        &self.publication
    }

    /// The newest version that the server has reported to be on disk.
    pub fn stored(&self) -> Version {
        self.stored
    }

    /// Whether the evidence may contain unpublished changes.
    pub fn is_dirty(&self) -> bool {
        self.dirty
    }

    /// Updates the history of changes from which movable cells are detected. Must be called before
    /// the tile is published.
    pub(crate) fn look(&mut self, now: Instant) {
        self.changes.look(&self.evidence, now);
    }

    /// The cells to publish, with movable marks.
    pub fn cells(&self) -> Tile {
        let mut cells = self.evidence.cells();
        self.changes.mark(&mut cells);
        cells
    }

    /// The observed state of a row of cells, without movable marks.
    pub fn row(&self, y: usize) -> Row {
        self.evidence.row(y)
    }

    /// Whether evicting the tile loses nothing: the server has all of it, on disk if the server
    /// stores tiles.
    fn is_safe(&self, server_stores: bool) -> bool {
        let stored = !server_stores || self.stored == self.publication.version();
        !self.dirty && self.publication.is_acknowledged() && stored
    }
}

/// The fixed pool of the robot's own tiles, in the caller's memory.
#[derive(Debug)]
pub struct Pool<'b> {
    /// The tiles in use, followed by the free places.
    places: &'b mut [OwnTile],
    kept: usize,
    /// The epoch of new tiles: increases by one with each eviction.
    epoch: Epoch,
    evicted: u32,
    /// Where the next search starts: after the place found last.
    next: usize,
    /// Whether the server reports when a tile is on disk.
    server_stores: bool,
}

impl<'b> Pool<'b> {
    /// An empty pool with room for `places.len()` tiles.
    pub fn new(places: &'b mut [OwnTile]) -> Self {
        places.fill(OwnTile::FREE);
        Self { places, kept: 0, epoch: Epoch(0), evicted: 0, next: 0, server_stores: false }
    }

    /// Number of tiles evicted.
    pub fn evicted(&self) -> u32 {
        self.evicted
    }

    /// Starts a session. If `server_stores`, tiles may be evicted only once the server has them on
    /// disk. Unless `same_server`, earlier reports of tiles on disk are forgotten.
    pub(crate) fn begin_session(&mut self, server_stores: bool, same_server: bool) {
        self.server_stores = server_stores;
        if !same_server {
            self.places.iter_mut().for_each(|tile| tile.stored = Version(0));
        }
    }

    /// Records that the server has a version of a tile on disk.
    pub(crate) fn stored(&mut self, id: TileId, stamp: Stamp) {
        let mut tiles = self.places.iter_mut();
        if let Some(tile) = tiles.find(|tile| tile.id == Some(id) && tile.epoch == stamp.epoch) {
            tile.stored = tile.stored.max(stamp.version);
        }
    }

    /// Gives new tiles and those never sent the epoch `epoch` or a later one: earlier epochs may
    /// have been used before a reboot. Tiles that were sent are moved as well if they must be
    /// `renumbered`. If the pool's epoch is more than `EPOCHS_AHEAD` above `epoch`, the server has
    /// lost its records, and all tiles are moved to `epoch`.
    pub fn start_epochs_at(&mut self, epoch: Epoch, renumbered: bool) {
        let is_too_far = self.epoch.0 > epoch.0.saturating_add(EPOCHS_AHEAD);
        self.epoch = if is_too_far { epoch } else { self.epoch.max(epoch) };
        for tile in self.places.iter_mut() {
            let is_published = tile.publication.version().0 != 0;
            if is_published && (is_too_far || renumbered) {
                tile.publication.forget();
                tile.stored = Version(0);
            }
            if !is_published || is_too_far || renumbered {
                tile.epoch = self.epoch;
            }
        }
    }

    /// Discards all tiles, published or not. Later tiles have at least this epoch.
    pub(crate) fn begin_anew(&mut self, epoch: Epoch) {
        self.places.fill(OwnTile::FREE);
        (self.kept, self.next) = (0, 0);
        self.epoch = Epoch(self.epoch.0.wrapping_add(1)).max(epoch);
    }

    /// The tile with this id, if it is in the pool.
    pub fn find(&self, id: TileId) -> Option<&OwnTile> {
        self.places.iter().find(|tile| tile.id == Some(id))
    }

    /// The tile with this id, created if necessary. `None` if the pool is full and no tile can be
    /// evicted: each has changes that the server has not stored, or was observed by this same scan
    /// (number `scan`).
    pub fn find_or_begin(&mut self, id: TileId, scan: u32) -> Option<&mut OwnTile> {
        // The search starts after the last tile found, as scans visit the same few tiles in the
        // same order.
        let kept = self.places.get(..self.kept)?;
        let next = self.next.min(kept.len());
        let (before, after) = kept.split_at_checked(next)?;
        let place = |tiles: &[OwnTile]| tiles.iter().position(|tile| tile.id == Some(id));
        let index = match place(after).map(|index| index + next).or_else(|| place(before)) {
            Some(index) => index,
            None => {
                let index = self.place_for_new(scan)?;
                let epoch = self.epoch;
                let tile = self.places.get_mut(index)?;
                (tile.id, tile.epoch) = (Some(id), epoch);
                index
            }
        };
        self.next = index + 1;
        let tile = self.places.get_mut(index)?;
        tile.touched = scan;
        Some(tile)
    }

    /// A free place, or the place of the least recently observed tile that is safe to evict.
    fn place_for_new(&mut self, scan: u32) -> Option<usize> {
        if self.kept < self.places.len() {
            self.kept += 1;
            return Some(self.kept - 1);
        }
        let idle = self
            .places
            .iter()
            .enumerate()
            .filter(|(_, tile)| tile.is_safe(self.server_stores) && tile.touched != scan);
        let (index, _) = idle.min_by_key(|(_, tile)| tile.touched)?;
        self.evicted = self.evicted.wrapping_add(1);
        self.epoch.0 = self.epoch.0.wrapping_add(1);
        *self.places.get_mut(index)? = OwnTile::FREE;
        Some(index)
    }

    /// The tiles in use.
    pub fn tiles(&self) -> impl Iterator<Item = &OwnTile> {
        self.places.iter().take(self.kept)
    }

    /// The tiles in use, mutable.
    pub(crate) fn tiles_mut(&mut self) -> impl Iterator<Item = &mut OwnTile> {
        self.places.iter_mut().take(self.kept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::{Tile, TileEncoder};

    fn id(x: i16) -> TileId {
        TileId { x, y: 0 }
    }

    #[test]
    fn a_server_without_memory_gets_epochs_that_it_has_granted() {
        let mut places = [OwnTile::FREE; 2];
        let mut pool = Pool::new(&mut places);
        pool.start_epochs_at(Epoch(10_000), false);
        let mut out = [0; 64];
        let tile = pool.find_or_begin(id(0), 1).unwrap();
        let mut encoder = TileEncoder::new(&mut out);
        let (epoch, mut cells) = (tile.epoch, Tile::UNKNOWN);
        assert!(tile.publication.push(&mut encoder, id(0), epoch, Version(1), &mut cells, 7));
        for (granted, expected) in [(9_000, 10_000), (1_808, 10_000), (1_807, 1_807)] {
            pool.start_epochs_at(Epoch(granted), false);
            let epochs = pool.tiles().map(|tile| tile.epoch.0).collect::<std::vec::Vec<_>>();
            assert_eq!(epochs, [expected], "granted {granted}");
        }
        assert_eq!(pool.find_or_begin(id(1), 2).unwrap().epoch, Epoch(1_807));
    }

    #[test]
    fn a_robot_whose_number_was_used_meanwhile_begins_its_tiles_again() {
        let mut places = [OwnTile::FREE; 2];
        let mut pool = Pool::new(&mut places);
        pool.start_epochs_at(Epoch(5), false);
        let mut out = [0; 64];
        let tile = pool.find_or_begin(id(0), 1).unwrap();
        let mut encoder = TileEncoder::new(&mut out);
        let (epoch, mut cells) = (tile.epoch, Tile::UNKNOWN);
        assert!(tile.publication.push(&mut encoder, id(0), epoch, Version(1), &mut cells, 7));
        assert!(tile.publication.acknowledge(7));
        pool.stored(id(0), Stamp { epoch, version: Version(1) });
        for (granted, renumber, expected) in [(6, false, (5, true, 1)), (6, true, (6, false, 0))] {
            pool.start_epochs_at(Epoch(granted), renumber);
            let tile = pool.find(id(0)).unwrap();
            let found = (tile.epoch.0, tile.publication.is_acknowledged(), tile.stored.0);
            assert_eq!(found, expected, "granted {granted}");
        }
    }

    #[test]
    fn only_tiles_that_the_server_has_are_evicted() {
        let mut places = [OwnTile::FREE; 2];
        let mut pool = Pool::new(&mut places);
        for x in 0..2 {
            pool.find_or_begin(id(x), 1).unwrap().dirty = true;
        }
        assert!(pool.find_or_begin(id(2), 2).is_none(), "nothing is safe");
        pool.tiles_mut().for_each(|tile| tile.dirty = false);
        assert!(pool.find_or_begin(id(2), 2).is_none(), "nothing is acknowledged");
        assert_eq!(pool.evicted(), 0);

        // The server acknowledges tile 0, but stores it on disk only later.
        let mut out = [0; 64];
        let mut encoder = TileEncoder::new(&mut out);
        let tile = pool.find_or_begin(id(0), 2).unwrap();
        let stamp = Stamp { epoch: tile.epoch, version: Version(1) };
        let mut cells = Tile::UNKNOWN;
        let (epoch, version) = (stamp.epoch, stamp.version);
        assert!(tile.publication.push(&mut encoder, id(0), epoch, version, &mut cells, 7));
        assert!(tile.publication.acknowledge(7));
        pool.begin_session(true, true);
        assert!(pool.find_or_begin(id(2), 3).is_none(), "nothing is stored");
        pool.stored(id(0), stamp);
        assert!(pool.find_or_begin(id(2), 3).is_some());
        assert_eq!((pool.evicted(), pool.find(id(0)).is_none()), (1, true));
    }
}
