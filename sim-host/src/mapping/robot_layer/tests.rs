mod folding;
mod limits;

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
    let mut restore = |record: &TileRecord| restarted.restore(record).tiles.len();
    assert_eq!(restore(&layer.record(ID, Epoch(2)).unwrap()), 1);
    assert_eq!(restore(&record), 1);
    assert_eq!(restore(&record), 0);
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
        layer.tiles.insert(id, Epochs::default());
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
    let last = EPOCHS_AHEAD + 1;
    assert_eq!(layer.update(&update(last, 1, None, &cells), 5).1, Ok(()));
    assert_eq!(layer.next_epoch(), Epoch(last + 1));
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
fn a_record_of_a_discarded_newer_state_is_not_the_held_one() {
    let mut layer = RobotLayer::default();
    assert_eq!(layer.update(&update(1, 4, None, &tile(&[(0, Cell::Occupied)])), 5).1, Ok(()));
    let written = layer.record(ID, Epoch(1)).unwrap();
    layer.discard(ID, written.stamp);
    assert_eq!(layer.update(&update(1, 3, None, &tile(&[(0, Cell::Free)])), 6).1, Ok(()));
    layer.kept(&written);
    assert_eq!(layer.on_disk(ID, Epoch(1)), None);
}

#[test]
fn restored_closed_epochs_replace_open_ones() {
    let mut layer = RobotLayer::default();
    let record = |epoch, version, cells: Tile| {
        let stamp = Stamp { epoch: Epoch(epoch), version: Version(version) };
        TileRecord { id: ID, stamp, cells, known: cells, seconds: [5; TILE_CELLS as usize] }
    };
    let closed = tile(&[(0, Cell::Free)]);
    layer.restore(&record(3, 7, tile(&[(0, Cell::Occupied)])));
    layer.restore(&record(5, 0, closed));
    assert_eq!((layer.epochs(), layer.held(ID, Epoch(3))), (1, None));
    assert_eq!(layer.seen(ID).unwrap().tile, closed);
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
