//! Joining closed epochs saves memory and must not change the layer.

use proptest::prelude::*;

use super::*;

/// Reference: a layer that keeps every epoch of each tile.
#[derive(Clone, Debug, Default)]
struct Plain(BTreeMap<(TileId, Epoch), Tile>);

impl Plain {
    /// The tile with each cell from the newest epoch that knows it.
    fn joined(&self, id: TileId) -> Tile {
        let mut joined = Tile::UNKNOWN;
        for (_, tile) in self.0.iter().filter(|((other, _), _)| *other == id) {
            for (x, y) in (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (x, y))) {
                if tile.cell(x, y) != Cell::Unknown {
                    joined.set(x, y, tile.cell(x, y));
                }
            }
        }
        joined
    }
}

/// The robot's current state of a tile.
#[derive(Clone, Copy, Debug)]
struct Live {
    stamp: Stamp,
    tile: Tile,
}

/// A robot that draws a few tiles, evicts them and draws them again; its layer on the server; and
/// the server's disk.
#[derive(Debug, Default)]
struct Story {
    epoch: u32,
    live: BTreeMap<TileId, Live>,
    /// Updates that have arrived and may arrive again.
    sent: Vec<Vec<u8>>,
    layer: RobotLayer,
    plain: Plain,
    /// The first epoch that the robot was asked to use, until its answer arrives.
    first: Option<Epoch>,
    unsaved: BTreeSet<(TileId, Epoch)>,
    disk: BTreeMap<(TileId, Epoch), TileRecord>,
    /// Reference for the layer that is restored from the disk.
    stored: Plain,
}

impl Story {
    fn draw(&mut self, id: TileId, seed: u32) {
        let begun = Stamp { epoch: Epoch(self.epoch), version: Version(0) };
        let live = self.live.entry(id).or_insert(Live { stamp: begun, tile: Tile::UNKNOWN });
        let base = Some(live.stamp.version).filter(|it| it.0 > 0 && !seed.is_multiple_of(3));
        let old = if base.is_some() { live.tile } else { Tile::UNKNOWN };
        for step in 0..1 + seed % 7 {
            let place = seed.wrapping_mul(2_654_435_761).wrapping_add(step * 37) >> 7;
            let code = [Cell::Free, Cell::Occupied, Cell::Movable][(place >> 10) as usize % 3];
            // Draws in a few rows only, so that epochs overlap.
            live.tile.set(place as usize % TILE_SIDE, place as usize / TILE_SIDE % 3, code);
        }
        live.stamp.version.0 += 1;
        let mut out = [0; 1024];
        let mut encoder = TileEncoder::new(&mut out);
        encoder.push(id, live.stamp, base, 0, &old, &live.tile).unwrap();
        let len = encoder.finish().unwrap();
        self.plain.0.insert((id, live.stamp.epoch), live.tile);
        self.sent.push(out[..len].to_vec());
        let (updated, result) = self.layer.update(&out[..len], 5);
        assert_eq!((result, updated.missing, updated.refused), (Ok(()), None, None));
        self.unsaved.extend(updated.complete.into_iter().chain(updated.folded));
    }

    /// A copy of an earlier update arrives.
    fn repeat(&mut self, seed: u32) {
        let Some(last) = self.sent.len().checked_sub(1) else { return };
        let coded = &self.sent[seed as usize % (last + 1)];
        let (updated, _) = self.layer.update(coded, 6);
        assert!(updated.tiles.is_empty() && updated.folded.is_empty(), "{updated:?}");
    }

    /// The first call makes the robot discard all tiles; the next one tells the server, which voids
    /// them.
    fn begin_anew(&mut self) {
        match self.first.take() {
            Some(first) => {
                self.unsaved.extend(self.layer.retire(first).folded);
                for plain in [&mut self.plain, &mut self.stored] {
                    plain.0.retain(|&(_, epoch), _| epoch >= first);
                }
                self.disk.retain(|&(_, epoch), _| epoch >= first);
            }
            None => {
                self.epoch += 100;
                self.live.clear();
                self.first = Some(Epoch(self.epoch));
            }
        }
        self.layer.set_barrier(self.first);
    }

    fn save(&mut self, count: usize) {
        for _ in 0..count {
            let Some((id, epoch)) = self.unsaved.pop_first() else { return };
            let Some(record) = self.layer.record(id, epoch) else { continue };
            let is_stored = |&(other, older): &(TileId, Epoch)| {
                other == id && (older == epoch || record.is_closed() && older < epoch)
            };
            self.disk.retain(|key, _| !is_stored(key));
            let news = self.plain.0.iter().filter(|(key, _)| is_stored(key));
            self.stored.0.extend(news);
            self.layer.kept(&record);
            self.disk.insert((id, epoch), record);
        }
    }

    fn check(&self) {
        let mut restored = RobotLayer::default();
        self.disk.values().for_each(|record| drop(restored.restore(record)));
        for (id, seen) in self.layer.tiles() {
            assert_eq!(seen.tile, self.plain.joined(id));
            let kept = restored.seen(id).map_or(Tile::UNKNOWN, |seen| seen.tile);
            assert_eq!(kept, self.stored.joined(id));
        }
        if self.first.is_none() {
            let tiles = self.layer.tiles.values();
            assert!(tiles.clone().all(|epochs| epochs.len() <= MAX_HELD));
            assert_eq!(self.layer.epochs(), tiles.map(Epochs::len).sum::<usize>());
        }
    }
}

proptest! {
    /// This must also hold with late copies, while old epochs are about to become void, and while
    /// only a part of the layer is on disk.
    #[test]
    fn a_layer_that_folds_is_like_one_that_keeps_all_epochs(
        steps in proptest::collection::vec((0u8..16, 0i16..3, any::<u32>()), 1..120),
    ) {
        let mut story = Story { epoch: 1, ..Story::default() };
        for (step, x, seed) in steps {
            let id = TileId { x, y: 0 };
            match step {
                0..6 => story.draw(id, seed),
                6..10 => {
                    story.epoch += 1;
                    story.live.remove(&id);
                    story.draw(id, seed);
                }
                10..12 => story.repeat(seed),
                12..15 => story.save(seed as usize % 4),
                _ => story.begin_anew(),
            }
            story.check();
        }
    }
}

/// Simulates a robot that evicts and redraws its tiles for weeks.
#[test]
fn epochs_take_no_more_memory_with_time() {
    let mut story = Story { epoch: 1, ..Story::default() };
    let mut memory = Vec::new();
    for round in 0..4_000 {
        story.epoch += 1;
        story.live.clear();
        (0..4).for_each(|x| story.draw(TileId { x, y: 0 }, round));
        story.save(usize::MAX);
        story.sent.clear();
        story.plain.0.clear();
        story.stored.0.clear();
        memory.push((story.layer.memory(), story.disk.len()));
    }
    assert_eq!(memory[3], (4 * (TILE_MEMORY + MAX_HELD * EPOCH_MEMORY), 4 * MAX_HELD));
    assert!(memory[3..].iter().all(|it| *it == memory[3]));
}

/// Without its base a delta can't be decoded, and neither can the tiles after it.
#[test]
fn late_updates_of_closed_epochs_change_nothing() {
    let [first, second] =
        [Cell::Free, Cell::Occupied].map(|code| tile(&[(0, code), (7, Cell::Free)]));
    let mut layer = RobotLayer::default();
    for epoch in 1..=4 {
        assert_eq!(layer.update(&update(epoch, 1, None, &first), 5).1, Ok(()));
    }
    assert!(layer.is_closed(ID, Epoch(2)) && !layer.is_closed(ID, Epoch(3)));
    let before = layer.clone();
    for late in [update(1, 2, None, &second), update(2, 2, Some((1, &first)), &second)] {
        let (updated, result) = layer.update(&late, 9);
        assert_eq!((updated, result), (Updated { late: 1, ..Updated::default() }, Ok(())));
    }
    assert_eq!(layer.seen(ID), before.seen(ID));
    layer.discard(ID, Stamp { epoch: Epoch(2), version: Version(1) });
    assert_eq!(layer.record(ID, Epoch(2)), before.record(ID, Epoch(2)));
    assert_eq!((layer.record(ID, Epoch(1)), layer.on_disk(ID, Epoch(2))), (None, None));
}
