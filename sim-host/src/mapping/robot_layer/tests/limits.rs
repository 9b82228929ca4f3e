//! Limits of memory, and what the layer says about its tiles.

use super::*;

/// A layer with a memory limit.
fn limited(bytes: usize) -> RobotLayer {
    let mut layer = RobotLayer::default();
    layer.set_limit(bytes);
    layer
}

/// The limit that an update of a tile would exceed; without one it is applied.
fn refused(layer: &mut RobotLayer, x: i16, epoch: u32, version: u32) -> Option<Limit> {
    let mut out = [0; 64];
    let mut encoder = TileEncoder::new(&mut out);
    let stamp = Stamp { epoch: Epoch(epoch), version: Version(version) };
    let cells = tile(&[(version as usize, Cell::Free)]);
    encoder.push(TileId { x, y: 0 }, stamp, None, 0, &Tile::UNKNOWN, &cells).unwrap();
    let length = encoder.finish().unwrap();
    let (updated, result) = layer.update(&out[..length], 5);
    assert_eq!(result, Ok(()));
    assert_eq!(updated.refused.is_some(), updated.missing.is_some());
    updated.refused
}

#[test]
fn a_limit_is_used_up_exactly() {
    let tile = TILE_MEMORY + EPOCH_MEMORY;
    // (6 << 10) + 640 bytes.
    assert_eq!(tile, 6_784);
    let mut layer = limited(2 * tile + EPOCH_MEMORY);
    assert_eq!(refused(&mut layer, 0, 1, 1), None);
    assert_eq!(layer.memory(), tile);
    assert_eq!(refused(&mut layer, 1, 1, 1), None);
    assert_eq!(refused(&mut layer, 2, 1, 1), Some(Limit::AllRobots), "a third tile");
    assert_eq!(refused(&mut layer, 0, 2, 1), None, "a second epoch of the first tile");
    assert_eq!(layer.memory(), 2 * tile + EPOCH_MEMORY);
    assert_eq!(refused(&mut layer, 1, 2, 1), Some(Limit::AllRobots), "one more epoch");
    assert_eq!(refused(&mut layer, 1, 1, 2), None, "what is held can always be updated");
    assert_eq!((layer.epochs(), layer.tiles().count()), (3, 2));
    // One byte less is too little.
    let mut layer = limited(tile - 1);
    assert_eq!(refused(&mut layer, 0, 1, 1), Some(Limit::AllRobots));
    assert_eq!(layer.tiles().count(), 0);
}

#[test]
fn a_lower_limit_refuses_only_growth() {
    let mut layer = limited(1 << 20);
    assert_eq!(refused(&mut layer, 0, 1, 1), None);
    layer.set_limit(1);
    assert_eq!(refused(&mut layer, 0, 1, 2), None, "what is held can always be updated");
    assert_eq!(refused(&mut layer, 1, 1, 1), Some(Limit::AllRobots));
}

#[test]
fn a_robot_has_at_most_24_576_epochs() {
    let mut layer = RobotLayer::default();
    assert_eq!(refused(&mut layer, 0, 1, 1), None);
    layer.epochs = 24_575;
    assert_eq!(refused(&mut layer, 1, 1, 1), None, "the last one");
    assert_eq!(layer.epochs, 24_576);
    assert_eq!(refused(&mut layer, 1, 1, 2), None, "what is held can always be updated");
    assert_eq!(refused(&mut layer, 1, 2, 1), Some(Limit::Robot));
}

#[test]
fn a_closed_epoch_makes_room_for_the_next_one() {
    let full = TILE_MEMORY + MAX_HELD * EPOCH_MEMORY;
    let mut layer = limited(full);
    for epoch in 1..10 {
        assert_eq!(refused(&mut layer, 0, epoch, 1), None, "epoch {epoch}");
        assert_eq!(layer.epochs(), MAX_HELD.min(epoch as usize));
    }
    assert_eq!(layer.memory(), full);
    // Epochs from the barrier on stay open, so each needs memory of its own.
    layer.set_barrier(Some(Epoch(9)));
    assert_eq!(refused(&mut layer, 0, 10, 1), None, "epoch 8 is closed");
    assert_eq!(refused(&mut layer, 0, 11, 1), Some(Limit::AllRobots), "epoch 9 stays open");
    layer.set_barrier(None);
    assert_eq!(refused(&mut layer, 0, 11, 1), None);
}

#[test]
fn an_update_of_other_cells_is_requested_and_changes_nothing() {
    let mut layer = RobotLayer::default();
    let held = tile(&[(0, Cell::Free), (1, Cell::Occupied)]);
    assert_eq!(layer.update(&update(1, 1, None, &held), 5).1, Ok(()));
    let before = layer.clone();
    // The sender believes that other cells are held.
    let other = tile(&[(0, Cell::Occupied), (5, Cell::Free), (6, Cell::Free)]);
    let next = tile(&[(0, Cell::Occupied), (5, Cell::Free), (6, Cell::Occupied)]);
    let (updated, result) = layer.update(&update(1, 2, Some((1, &other)), &next), 6);
    assert_eq!((updated.missing, updated.refused, result), (Some(ID), None, Ok(())));
    assert!(updated.tiles.is_empty() && updated.complete.is_empty());
    assert_eq!(layer.seen(ID), before.seen(ID));
    assert_eq!(layer.held(ID, Epoch(1)), before.held(ID, Epoch(1)));
}

#[test]
fn each_cell_has_the_time_of_its_last_change() {
    let mut layer = RobotLayer::default();
    let mut cells = Tile::UNKNOWN;
    cells.set(3, 5, Cell::Free);
    cells.set(7, 20, Cell::Occupied);
    assert_eq!(layer.update(&update(1, 1, None, &cells), 4).1, Ok(()));
    let early = cells;
    cells.set(3, 6, Cell::Occupied);
    cells.set(31, 31, Cell::Free);
    assert_eq!(layer.update(&update(1, 2, Some((1, &early)), &cells), 9).1, Ok(()));
    let seen = layer.seen(ID).unwrap();
    for (x, y) in (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (x, y))) {
        let expected = match (early.cell(x, y), cells.cell(x, y)) {
            (_, Cell::Unknown) => 0,
            (Cell::Unknown, _) => 9,
            _ => 4,
        };
        assert_eq!(seen.seconds[y * TILE_SIDE + x], expected, "({x}, {y})");
    }
    assert_eq!(layer.seen(ID).unwrap().by(3), Tile::UNKNOWN);
    assert_eq!([4, 8].map(|second| layer.seen(ID).unwrap().by(second)), [early; 2]);
    assert_eq!(layer.seen(ID).unwrap().by(9), cells);
}

#[test]
fn voided_epochs_leave_the_layer_and_others_stay() {
    let mut layer = RobotLayer::default();
    assert_eq!(layer.first_epoch(), Epoch(0));
    for epoch in 1..=5 {
        let cells = tile(&[(epoch as usize, Cell::Free)]);
        assert_eq!(layer.update(&update(epoch, 1, None, &cells), 5).1, Ok(()));
    }
    // Epochs 1 to 3 are closed, 4 and 5 are open.
    assert_eq!([3, 4].map(|epoch| layer.is_closed(ID, Epoch(epoch))), [true, false]);
    assert_eq!(layer.epochs(), MAX_HELD);
    let known = |layer: &RobotLayer| {
        let tile = layer.seen(ID).unwrap().tile;
        (0..TILE_SIDE).filter(|&x| tile.cell(x, 0) != Cell::Unknown).collect::<Vec<_>>()
    };
    layer.retire(Epoch(3));
    assert_eq!((layer.first_epoch(), known(&layer)), (Epoch(3), vec![1, 2, 3, 4, 5]));
    layer.retire(Epoch(4));
    assert_eq!((layer.epochs(), known(&layer)), (2, vec![4, 5]));
    layer.retire(Epoch(5));
    assert_eq!((layer.first_epoch(), known(&layer)), (Epoch(5), vec![5]));
    assert!(layer.is_closed(ID, Epoch(4)) || layer.held(ID, Epoch(4)).is_none());
}

#[test]
fn a_record_that_is_not_newer_changes_nothing() {
    let record = |epoch: u32, version: u32, cells: &Tile| {
        let mut layer = RobotLayer::default();
        assert_eq!(layer.update(&update(epoch, version, None, cells), 5).1, Ok(()));
        layer.record(ID, Epoch(epoch)).unwrap()
    };
    let (first, second) = (tile(&[(0, Cell::Free)]), tile(&[(0, Cell::Occupied)]));
    let mut layer = RobotLayer::default();
    assert_eq!(layer.restore(&record(3, 2, &second)).tiles.len(), 1);
    for old in [record(3, 1, &first), record(3, 2, &first)] {
        assert!(layer.restore(&old).tiles.is_empty());
        assert_eq!(layer.seen(ID).unwrap().tile, second);
    }
    assert_eq!(layer.restore(&record(3, 3, &first)).tiles.len(), 1);
    assert_eq!((layer.seen(ID).unwrap().tile, layer.epochs()), (first, 1));

    // A record of closed epochs replaces them and all older open ones, and nothing else.
    let closed = |newest: u32, cells: &Tile| TileRecord {
        stamp: Stamp { epoch: Epoch(newest), version: Version(0) },
        cells: *cells,
        known: *cells,
        ..record(1, 1, cells)
    };
    let joined = tile(&[(9, Cell::Free)]);
    layer.restore(&closed(3, &joined));
    assert_eq!((layer.seen(ID).unwrap().tile, layer.epochs()), (joined, 1));
    let other = tile(&[(8, Cell::Free)]);
    for newest in [2, 3] {
        layer.restore(&closed(newest, &other));
        assert_eq!(layer.seen(ID).unwrap().tile, joined, "up to epoch {newest}");
    }
    assert!(layer.restore(&record(3, 9, &other)).tiles.is_empty(), "epoch 3 is closed");
    layer.restore(&record(4, 1, &first));
    assert_eq!(layer.epochs(), 2);
    layer.restore(&closed(3, &other));
    assert!(layer.held(ID, Epoch(4)).is_some(), "epoch 4 is not among the closed ones");
}

/// A whole tile replaces the state of an epoch; cells that the epoch has known stay in the map.
#[test]
fn cells_that_an_epoch_has_known_stay_known() {
    let mut layer = RobotLayer::default();
    let first = tile(&[(0, Cell::Free), (1, Cell::Free)]);
    let second = tile(&[(1, Cell::Occupied), (2, Cell::Free)]);
    let third = tile(&[(3, Cell::Free)]);
    assert_eq!(layer.update(&update(1, 1, None, &first), 5).1, Ok(()));
    assert_eq!(layer.update(&update(1, 2, None, &second), 5).1, Ok(()));
    let both = tile(&[(0, Cell::Free), (1, Cell::Occupied), (2, Cell::Free)]);
    assert_eq!(layer.seen(ID).unwrap().tile, both);
    assert_eq!(layer.update(&update(1, 3, None, &third), 5).1, Ok(()));
    let mut all = third;
    all.fill_unknown_from(&both);
    assert_eq!(layer.seen(ID).unwrap().tile, all);
    // A copy of an old state brings nothing back.
    assert_eq!(layer.update(&update(1, 1, None, &first), 5).1, Ok(()));
    assert_eq!(layer.seen(ID).unwrap().tile, all);
    // A delta takes its own cells away: unknown again.
    let fourth = tile(&[(3, Cell::Occupied), (4, Cell::Free)]);
    assert_eq!(layer.update(&update(1, 4, Some((3, &third)), &fourth), 5).1, Ok(()));
    assert_eq!(layer.seen(ID).unwrap().tile.cell(3, 0), Cell::Occupied);
    assert_eq!(layer.record(ID, Epoch(1)).unwrap().known.cell(0, 0), Cell::Free);
    assert_eq!(layer.record(ID, Epoch(1)).unwrap().cells, fourth);
    // A discarded state may be wrong: what replaces it does not keep its cells.
    let stamp = Stamp { epoch: Epoch(1), version: Version(4) };
    layer.discard(ID, stamp);
    assert_eq!(layer.update(&update(1, 4, None, &third), 5).1, Ok(()));
    assert_eq!(layer.seen(ID).unwrap().tile, third);
}
