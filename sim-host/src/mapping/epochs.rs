//! The epochs of one tile of a robot. The newest two are kept apart (open), all older ones are
//! joined (closed).
//!
//! A robot ends an epoch of a tile before it begins the next one (SPEC.md, 7.2). Any update of an
//! older epoch that still arrives is a late copy, so older epochs need not be kept apart.

use std::collections::BTreeMap;

use ubimap_protocol::tile::{
    Applied, BaseMissing, Epoch, Replica, Stamp, Tile, TileDecoder, TileHeader, Version,
};

/// Number of epochs of a tile that are kept apart. The robot draws in the newest one; the one
/// before it is needed to answer late digests and notices.
const OPEN: usize = 2;
/// Maximum number of epochs of a tile in memory: the open ones, and one that joins all older ones.
pub(super) const MAX_HELD: usize = OPEN + 1;

/// One epoch of a tile.
#[derive(Clone, Debug, Default)]
pub(super) struct Held {
    replica: Replica,
    /// The cells that the replica had before a whole tile replaced them within the epoch: cells
    /// that an epoch has known stay known.
    before: Option<Tile>,
    /// The newest version on disk.
    pub(super) kept: Version,
}

impl Held {
    /// A state that was read from disk.
    pub(super) fn restored(cells: Tile, known: Tile, stamp: Stamp) -> Self {
        let replica = Replica::restored(cells, stamp, 0);
        Self { replica, before: Some(known), kept: stamp.version }
    }

    pub(super) fn replica(&self) -> &Replica {
        &self.replica
    }

    /// All cells that the epoch has ever known.
    pub(super) fn known(&self) -> Tile {
        let mut known = *self.replica.tile();
        if let Some(before) = &self.before {
            known.fill_unknown_from(before);
        }
        known
    }

    /// The stamp and cells of the newest state, if it is complete.
    pub(super) fn complete(&self) -> Option<(Stamp, &Tile)> {
        let stamp = self.replica.stamp();
        let is_complete = stamp != Stamp::NOTHING && !self.replica.is_partial();
        is_complete.then(|| (stamp, self.replica.tile()))
    }

    /// Reads the cells of an update.
    ///
    /// # Errors
    /// [`BaseMissing`]; nothing has changed.
    fn apply(
        &mut self,
        header: &TileHeader,
        decoder: &mut TileDecoder<'_>,
    ) -> Result<Applied, BaseMissing> {
        // Cells of a discarded state may be wrong.
        let is_discarded = self.replica.stamp() == Stamp::NOTHING;
        let mut before = if is_discarded { Tile::UNKNOWN } else { *self.replica.tile() };
        let applied = self.replica.apply(header, decoder)?;
        if applied != Applied::Old && header.base.is_none() && header.start == 0 {
            if let Some(earlier) = &self.before {
                before.fill_unknown_from(earlier);
            }
            self.before = Some(before);
        }
        Ok(applied)
    }

    /// Discards the state; its cells stay known until it is replaced.
    pub(super) fn discard(&mut self) {
        let replica = Replica::restored(self.known(), Stamp::NOTHING, 0);
        *self = Self { replica, before: None, kept: Version(0) };
    }
}

/// Older epochs, joined.
#[derive(Clone, Debug)]
struct Closed {
    /// The newest closed epoch.
    newest: Epoch,
    /// For each cell, the code from the newest closed epoch in which it is known.
    cells: Tile,
}

/// The epochs of one tile.
#[derive(Clone, Debug, Default)]
pub(super) struct Epochs {
    // Boxed, because each node of a `BTreeMap` reserves memory for eleven entries.
    open: BTreeMap<Epoch, Box<Held>>,
    closed: Option<Box<Closed>>,
}

impl Epochs {
    /// Number of epochs held; the closed ones count as one.
    pub(super) fn len(&self) -> usize {
        self.open.len() + usize::from(self.closed.is_some())
    }

    /// Whether an epoch can no longer change: it is joined with others, or older than the two open
    /// ones.
    pub(super) fn is_closed(&self, epoch: Epoch) -> bool {
        let is_below_closed = self.closed.as_ref().is_some_and(|closed| epoch <= closed.newest);
        let is_below_open = self.open.first_key_value().is_some_and(|(&oldest, _)| epoch < oldest);
        is_below_closed || is_below_open && self.open.len() >= OPEN
    }

    /// By how much [`len`](Self::len) grows when an update of `epoch` is applied and the older
    /// epochs are [folded](Self::fold).
    pub(super) fn growth(&self, epoch: Epoch, barrier: Option<Epoch>) -> usize {
        let is_new = !self.open.contains_key(&epoch);
        let oldest = self.open.first_key_value().map(|(&oldest, _)| oldest);
        let is_folded = self.closed.is_some()
            && self.open.len() >= OPEN
            && oldest.is_some_and(|oldest| !is_beyond(oldest, barrier));
        usize::from(is_new && !is_folded)
    }

    /// An open epoch.
    pub(super) fn held(&self, epoch: Epoch) -> Option<&Held> {
        self.open.get(&epoch).map(Box::as_ref)
    }

    /// An open epoch.
    pub(super) fn held_mut(&mut self, epoch: Epoch) -> Option<&mut Held> {
        self.open.get_mut(&epoch).map(Box::as_mut)
    }

    /// The joined cells of the closed epochs, if `epoch` is the newest closed one.
    pub(super) fn closed_at(&self, epoch: Epoch) -> Option<&Tile> {
        let closed = self.closed.as_ref().filter(|closed| closed.newest == epoch)?;
        Some(&closed.cells)
    }

    /// Applies an update of an epoch that is not closed.
    ///
    /// # Errors
    /// [`BaseMissing`]; nothing has changed.
    pub(super) fn apply(
        &mut self,
        header: &TileHeader,
        decoder: &mut TileDecoder<'_>,
    ) -> Result<Applied, BaseMissing> {
        let epoch = header.stamp.epoch;
        let held = self.open.entry(epoch).or_default();
        let applied = held.apply(header, decoder);
        if applied.is_err() && held.replica == Replica::default() {
            self.open.remove(&epoch);
        }
        applied
    }

    /// Sets the state of an epoch. Returns false, without any change, if the epoch is closed or the
    /// state is not newer than the current one.
    pub(super) fn restore(&mut self, stamp: Stamp, held: Held) -> bool {
        let last = self.held(stamp.epoch).map(|last| last.replica.stamp());
        let is_news = !self.is_closed(stamp.epoch) && last.is_none_or(|last| last < stamp);
        if is_news {
            self.open.insert(stamp.epoch, Box::new(held));
        }
        is_news
    }

    /// Sets the joined cells of all epochs up to `newest`, which are then closed. Returns false,
    /// without any change, if those epochs are closed already.
    pub(super) fn restore_closed(&mut self, newest: Epoch, cells: Tile) -> bool {
        let is_news = self.closed.as_ref().is_none_or(|closed| closed.newest < newest);
        if is_news {
            self.open.retain(|&epoch, _| epoch > newest);
            self.closed = Some(Box::new(Closed { newest, cells }));
        }
        is_news
    }

    /// Closes all open epochs except the newest two, and epochs from `barrier` on, since those
    /// below it may soon be void. Returns the newest epoch that was closed, if any.
    pub(super) fn fold(&mut self, barrier: Option<Epoch>) -> Option<Epoch> {
        let mut folded = None;
        while self.open.len() > OPEN
            && let Some(oldest) = self.open.first_entry()
            && !is_beyond(*oldest.key(), barrier)
        {
            let (newest, held) = oldest.remove_entry();
            let mut cells = held.known();
            if let Some(closed) = &self.closed {
                cells.fill_unknown_from(&closed.cells);
            }
            self.closed = Some(Box::new(Closed { newest, cells }));
            folded = Some(newest);
        }
        folded
    }

    /// Drops the epochs below `first`.
    pub(super) fn retire(&mut self, first: Epoch) {
        self.open.retain(|&epoch, _| epoch >= first);
        self.closed.take_if(|closed| closed.newest < first);
    }

    /// For each cell, the code from the newest epoch in which it is known.
    pub(super) fn joined(&self) -> Tile {
        let mut joined = Tile::UNKNOWN;
        for held in self.open.values().rev() {
            joined.fill_unknown_from(held.replica.tile());
            if let Some(before) = &held.before {
                joined.fill_unknown_from(before);
            }
        }
        if let Some(closed) = &self.closed {
            joined.fill_unknown_from(&closed.cells);
        }
        joined
    }
}

fn is_beyond(epoch: Epoch, barrier: Option<Epoch>) -> bool {
    barrier.is_some_and(|barrier| epoch >= barrier)
}
