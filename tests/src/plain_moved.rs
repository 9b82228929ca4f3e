//! A robot's layer with its cells where they belong: an independent version of what the server computes tile by tile,
//! from the definition alone.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, TileId},
    units::{Pose, RobotId},
};
use ubimap_sim_host::{
    mapping::{Correction, Placement, SeenTile},
    server::Server,
};

const SIDE: i32 = TILE_SIDE as i32;
/// Side of a cell in metres.
const CELL_M: f64 = 0.05;

type Cells = BTreeMap<(i32, i32), (Cell, u32)>;

/// The tiles of a robot's layer, moved as the server knows by now.
pub fn moved(server: &Server, robot: RobotId) -> BTreeMap<TileId, SeenTile> {
    let Some(layer) = server.layer(robot) else { return BTreeMap::new() };
    let tiles = layer.tiles().map(|(id, seen)| (id, seen.clone()));
    let Some(Placement { corrections, ground }) = server.placement(robot) else {
        return tiles.collect();
    };
    let mut drawn = Cells::new();
    for (id, seen) in tiles {
        for (x, y) in (0..SIDE).flat_map(|x| (0..SIDE).map(move |y| (x, y))) {
            let cell = seen.tile.cell(x as usize, y as usize);
            if cell != Cell::Unknown {
                let at = (i32::from(id.x) * SIDE + x, i32::from(id.y) * SIDE + y);
                drawn.insert(at, (cell, seen.seconds[(y * SIDE + x) as usize]));
            }
        }
    }
    let mut torn = placed(&drawn, corrections);
    for (id, rows) in ground {
        let (west, south) = id.first_cell();
        for (x, y) in (0..SIDE).flat_map(|x| (0..SIDE).map(move |y| (x, y))) {
            if rows[y as usize] >> x & 1 == 1 {
                torn.entry((west + x, south + y)).or_insert((Cell::Free, 1));
            }
        }
    }
    let mut whole = torn.clone();
    let bounds = |at: fn(&(i32, i32)) -> i32| {
        torn.keys().map(at).min().unwrap_or(0)..=torn.keys().map(at).max().unwrap_or(-1)
    };
    for (x, y) in bounds(|it| it.0).flat_map(|x| bounds(|it| it.1).map(move |y| (x, y))) {
        if !torn.contains_key(&(x, y))
            && let Some(closed) = closed(&torn, (x, y), (1, 0)).or(closed(&torn, (x, y), (0, 1)))
        {
            whole.insert((x, y), closed);
        }
    }
    let mut tiles: BTreeMap<TileId, SeenTile> = BTreeMap::new();
    for ((x, y), (cell, second)) in whole {
        let id = TileId { x: x.div_euclid(SIDE) as i16, y: y.div_euclid(SIDE) as i16 };
        let (x, y) = (x.rem_euclid(SIDE) as usize, y.rem_euclid(SIDE) as usize);
        let tile = tiles.entry(id).or_insert(SeenTile::NOTHING);
        tile.tile.set(x, y, cell);
        tile.seconds[y * TILE_SIDE + x] = second;
    }
    tiles
}

/// The cells in which the middles of cells end up that are moved back. The newest wins, and then the higher code.
fn placed(drawn: &Cells, corrections: &[Correction]) -> Cells {
    let correction = |second: u32| {
        corrections.iter().rfind(|it| it.since <= second).map_or(Pose::default(), |it| it.by)
    };
    let all: BTreeSet<(i32, i32, u16)> = drawn
        .values()
        .map(|it| correction(it.1))
        .map(|it| (it.x.0, it.y.0, it.heading.0))
        .collect();
    let mut placed = Cells::new();
    let mut put = |at, (cell, second): (Cell, u32)| {
        let there = placed.entry(at).or_insert((cell, second));
        if (second, cell.code()) > (there.1, there.0.code()) {
            *there = (cell, second);
        }
    };
    for (x, y, heading) in all {
        let mine: Cells = drawn
            .iter()
            .filter(|(_, it)| {
                let by = correction(it.1);
                (by.x.0, by.y.0, by.heading.0) == (x, y, heading)
            })
            .map(|(at, it)| (*at, *it))
            .collect();
        let (dx, dy) = (f64::from(x) / 1_000.0, f64::from(y) / 1_000.0);
        let turn = f64::from(heading) / 65_536.0 * core::f64::consts::TAU;
        let (sin, cos) = turn.sin_cos();
        let middle = |it: i32| (f64::from(it) + 0.5) * CELL_M;
        let cell = |it: f64| (it / CELL_M).floor() as i32;
        for (&(from_x, from_y), &it) in &mine {
            if (x, y, heading) == (0, 0, 0) {
                put((from_x, from_y), it);
                continue;
            }
            let (from_x, from_y) = (middle(from_x), middle(from_y));
            let there = (cos * from_x - sin * from_y + dx, sin * from_x + cos * from_y + dy);
            for at in (-3..=3).flat_map(|x| (-3..=3).map(move |y| (x, y))) {
                let at = (cell(there.0) + at.0, cell(there.1) + at.1);
                let off = (middle(at.0) - dx, middle(at.1) - dy);
                let back = (cell(cos * off.0 + sin * off.1), cell(cos * off.1 - sin * off.0));
                if let Some(&it) = mine.get(&back) {
                    put(at, it);
                }
            }
        }
    }
    placed
}

/// What closes a gap of a cell along x or y.
fn closed(torn: &Cells, (x, y): (i32, i32), (along, up): (i32, i32)) -> Option<(Cell, u32)> {
    let (one, other) = (torn.get(&(x - along, y - up))?, torn.get(&(x + along, y + up))?);
    (one.0 == other.0).then(|| (one.0, one.1.min(other.1)))
}
