//! Draws a map from views at given poses.

use std::collections::BTreeMap;

use nalgebra::{Point2, Vector2};
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId},
    units::Millimetres,
};

use super::{correlation::cell, rigid::Motion, view::View};

/// Minimum share of hits among the rays that meet a cell, for the cell to be occupied: rays that pass
/// along a wall cross its cells.
const LEAST_HITS: f64 = 0.4;

/// Number of rays that ended in a cell, and of those that crossed it.
type Rays = [[u32; 2]; TILE_SIDE * TILE_SIDE];

/// The tiles that these views draw, with rays of at most `range_m` metres. A cell is occupied if
/// enough of the rays that meet it end there, and free if any crosses it.
pub fn draw<'v>(
    views: impl IntoIterator<Item = (&'v View, &'v Motion)>,
    range_m: f64,
    resolution: Millimetres,
) -> BTreeMap<TileId, Tile> {
    let side_m = resolution.metres();
    let mut counts: BTreeMap<TileId, Box<Rays>> = BTreeMap::new();
    let mut count = |(x, y): (i32, i32), kind: usize| {
        let Some(id) = TileId::of_cell(x, y) else { return };
        let rays = counts.entry(id).or_insert_with(|| Box::new([[0; 2]; TILE_SIDE * TILE_SIDE]));
        let (first_x, first_y) = id.first_cell();
        rays[(y - first_y) as usize * TILE_SIDE + (x - first_x) as usize][kind] += 1;
    };
    for (view, pose) in views {
        let surfaces = view.surfels.iter().map(|surfel| (surfel.at, true));
        for (end, is_surface) in surfaces.chain(view.open.iter().map(|end| (*end, false))) {
            let (length, is_surface) = (end.norm(), is_surface && end.norm() <= range_m);
            let place = |at: Vector2<f64>| cell((pose * Point2::from(at)).coords, side_m);
            let hit = is_surface.then(|| place(end));
            let mut last = hit;
            for step in 0..(length.min(range_m) * 2.0 / side_m) as usize {
                let crossed = place(end * (step as f64 * side_m / (2.0 * length)));
                if last != Some(crossed) && hit != Some(crossed) {
                    count(crossed, 1);
                    last = Some(crossed);
                }
            }
            hit.into_iter().for_each(|hit| count(hit, 0));
        }
    }
    counts.iter().map(|(id, rays)| (*id, tile(rays))).collect()
}

fn tile(rays: &Rays) -> Tile {
    let mut tile = Tile::UNKNOWN;
    for (index, &[hits, crossings]) in rays.iter().enumerate() {
        let code = if hits > 0 && f64::from(hits) >= LEAST_HITS * f64::from(hits + crossings) {
            Cell::Occupied
        } else if crossings > 0 {
            Cell::Free
        } else {
            continue;
        };
        tile.set(index % TILE_SIDE, index / TILE_SIDE, code);
    }
    tile
}
