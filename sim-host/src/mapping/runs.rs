//! The cells of an observation, grouped by tile.

use ubimap_protocol::tile::{Cell, TILE_SIDE, TileId};

use crate::camera::Observation;

/// Runs of consecutive cells in one tile. Each cell comes with its column and row in the tile.
pub(super) fn runs(
    observation: &Observation,
) -> impl Iterator<Item = (TileId, impl Iterator<Item = (usize, usize, Cell)>)> {
    let tile = |cell: &((i32, i32), Cell)| TileId::of_cell(cell.0.0, cell.0.1);
    let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
    observation.cells.chunk_by(move |a, b| tile(a) == tile(b)).filter_map(move |run| {
        let cells = run.iter().map(move |&((x, y), cell)| (within(x), within(y), cell));
        Some((tile(run.first()?)?, cells))
    })
}
