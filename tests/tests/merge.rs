//! Merging: in whatever order the states of a robot's tile arrive, and however often, the server
//! ends with the same layer. Of epochs older than the two newest, only late copies can arrive.

use proptest::prelude::*;
use ubimap_protocol::tile::{Cell, Epoch, Stamp, TILE_SIDE, Tile, TileEncoder, TileId, Version};
use ubimap_protocol::time::Instant;
use ubimap_sim_host::mapping::{MapTime, RobotLayer, SeenTile, Weight, fuse};

const ID: TileId = TileId { x: -3, y: 2 };
const CODES: [Cell; 4] = [Cell::Unknown, Cell::Free, Cell::Occupied, Cell::Movable];

/// The states of one epoch, by version. Within an epoch a known cell never becomes unknown again.
fn states() -> impl Strategy<Value = Vec<Tile>> {
    let cells = proptest::collection::vec((0..TILE_SIDE, 0..TILE_SIDE, 1..4usize), 0..60);
    proptest::collection::vec(cells, 1..5).prop_map(|changes| {
        let mut tile = Tile::UNKNOWN;
        let state = |cells: Vec<(usize, usize, usize)>| {
            cells.into_iter().for_each(|(x, y, code)| tile.set(x, y, CODES[code]));
            tile
        };
        changes.into_iter().map(state).collect()
    })
}

/// All states of a robot's tile in at most this number of epochs, with their stamps.
fn history(most: usize) -> impl Strategy<Value = Vec<(Stamp, Tile)>> {
    proptest::collection::vec(states(), 1..=most).prop_map(|epochs| {
        let numbered = |(epoch, states): (usize, Vec<Tile>)| {
            states.into_iter().enumerate().map(move |(version, tile)| {
                let (epoch, version) = (Epoch(epoch as u32 + 1), Version(version as u32 + 1));
                (Stamp { epoch, version }, tile)
            })
        };
        epochs.into_iter().enumerate().flat_map(numbered).collect()
    })
}

/// A history, and an arbitrary selection of its states in an arbitrary order.
fn arrivals(most: usize) -> impl Strategy<Value = (Vec<(Stamp, Tile)>, Vec<usize>, Vec<usize>)> {
    history(most).prop_flat_map(|history| {
        let indices: Vec<usize> = (0..history.len()).collect();
        let some = proptest::collection::vec(0..history.len(), 0..8);
        (Just(history), Just(indices).prop_shuffle(), some)
    })
}

fn coded(&(stamp, ref tile): &(Stamp, Tile)) -> Vec<u8> {
    let mut out = [0u8; 1_000];
    let mut encoder = TileEncoder::new(&mut out);
    encoder.push(ID, stamp, None, 0, &Tile::UNKNOWN, tile).expect("the tile fits");
    let len = encoder.finish().expect("the tile fits");
    out[..len].to_vec()
}

fn apply<'a>(layer: &mut RobotLayer, states: impl Iterator<Item = &'a (Stamp, Tile)>) {
    for state in states {
        let (updated, result) = layer.update(&coded(state), 5);
        assert_eq!((updated.missing, result), (None, Ok(())));
    }
}

/// The contents of a layer: each epoch's newest state, and the joined tile.
fn held(layer: &RobotLayer) -> (Vec<Option<(Stamp, Tile)>>, Option<Tile>) {
    let epoch = |epoch| layer.held(ID, Epoch(epoch)).map(|(stamp, tile)| (stamp, *tile));
    ((1..6).map(epoch).collect(), layer.seen(ID).map(|seen| seen.tile))
}

/// The joined tile as specified: each cell has the code of the newest epoch that knows it.
fn joined(history: &[(Stamp, Tile)]) -> Tile {
    let mut joined = Tile::UNKNOWN;
    for (x, y) in (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (x, y))) {
        let claims = history.iter().map(|(stamp, tile)| (stamp, tile.cell(x, y)));
        let known = claims.filter(|(_, cell)| *cell != Cell::Unknown);
        if let Some((_, newest)) = known.max_by_key(|(stamp, _)| **stamp) {
            joined.set(x, y, newest);
        }
    }
    joined
}

proptest! {
    /// Merging is commutative, associative and idempotent.
    #[test]
    fn any_order_of_the_states_of_two_epochs_ends_in_one_layer((history, order, again) in arrivals(2)) {
        let mut in_order = RobotLayer::default();
        apply(&mut in_order, history.iter());
        let expected = held(&in_order);
        prop_assert_eq!(expected.1, Some(joined(&history)));
        let mut other = RobotLayer::default();
        let pick = |indices: &'_ [usize]| indices.iter().map(|&i| history[i]).collect::<Vec<_>>();
        apply(&mut other, pick(&again).iter());
        apply(&mut other, pick(&order).iter());
        prop_assert_eq!(&held(&other), &expected);
        apply(&mut other, pick(&again).iter());
        prop_assert_eq!(&held(&other), &expected);
    }

    #[test]
    fn late_copies_of_any_epoch_change_nothing((history, order, again) in arrivals(5)) {
        let mut layer = RobotLayer::default();
        apply(&mut layer, history.iter());
        let expected = held(&layer);
        prop_assert_eq!(expected.1, Some(joined(&history)));
        for index in order.into_iter().chain(again) {
            apply(&mut layer, [history[index]].iter());
            prop_assert_eq!(&held(&layer), &expected);
        }
    }

    /// Known cells stay known, whatever arrives later.
    #[test]
    fn nothing_known_becomes_unknown((history, order, _) in arrivals(5)) {
        let mut layer = RobotLayer::default();
        let mut known = [0u32; TILE_SIDE];
        for index in order {
            apply(&mut layer, [history[index]].iter());
            let tile = layer.seen(ID).map_or(Tile::UNKNOWN, |seen| seen.tile);
            for (y, known) in known.iter_mut().enumerate() {
                let now = tile.row(y).known();
                prop_assert_eq!(*known & !now, 0);
                *known = now;
            }
        }
    }

    /// The fused tile does not depend on the order of the robots, nor on a robot without
    /// observations.
    #[test]
    fn the_order_of_the_robots_does_not_matter(
        robots in proptest::collection::vec((states(), 0u32..400, 0u8..5), 0..6),
        cameras in (states(), 0u32..400),
        now in 0u64..800,
    ) {
        let seen = |states: &[Tile], second: u32| {
            SeenTile { tile: states[0], seconds: [second; TILE_SIDE * TILE_SIDE] }
        };
        let silent = seen(&[Tile::UNKNOWN], 9);
        let cameras = seen(&cameras.0, cameras.1);
        let robots: Vec<(Weight, SeenTile)> = robots
            .iter()
            .map(|(states, second, grade)| (Weight::grade(*grade), seen(states, *second)))
            .collect();
        let there: Vec<_> = robots.iter().map(|(weight, seen)| (*weight, seen)).collect();
        let back: Vec<_> =
            there.iter().rev().copied().chain([(Weight::FULL, &silent)]).collect();
        let time = MapTime::at(Instant(now * 1_000_000));
        prop_assert_eq!(fuse(&cameras, &there, None, time), fuse(&cameras, &back, None, time));
    }
}
