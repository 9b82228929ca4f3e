//! Walls that a map shows twice.

use std::collections::BTreeSet;

use nalgebra::{Matrix2, Vector2};
use ubimap_protocol::tile::Cell;
use ubimap_sim_host::grid::OccupancyGrid;

/// Radius in cells in which a wall's direction is found, and minimum number of occupied cells there.
const AROUND: i32 = 10;
const LEAST: usize = 10;
/// Maximum ratio of the variances of a wall's cells, across it to along it, and minimum deviation along it, in cells. Two
/// walls 0.3 m apart have 0.27.
const ELONGATED: f64 = 0.3;
const SPREAD: f64 = 3.0;
/// Distance of a second wall in cells: beyond one cell of free ground or of noise, within 0.3 m at 5 cm.
const SECOND: core::ops::RangeInclusive<f64> = 2.5..=6.2;
/// Half the length of a second wall, in cells, and minimum number of its cells along that.
const HALF: f64 = 5.0;
const CELLS: usize = 5;

/// Number of occupied cells that have a wall parallel to their own within 0.3 m (at 5 cm a cell), and of all.
pub fn doubled(map: &OccupancyGrid) -> (usize, usize) {
    let width = map.width();
    let occupied: BTreeSet<(i32, i32)> = (0..map.cells().len())
        .filter(|&index| map.cells()[index] == Cell::Occupied)
        .map(|index| ((index % width) as i32, (index / width) as i32))
        .collect();
    let count = occupied.iter().filter(|&&cell| is_doubled(&occupied, cell)).count();
    (count, occupied.len())
}

fn is_doubled(occupied: &BTreeSet<(i32, i32)>, (x, y): (i32, i32)) -> bool {
    let square = (-AROUND..=AROUND).flat_map(|dy| (-AROUND..=AROUND).map(move |dx| (dx, dy)));
    let about: Vec<Vector2<f64>> = square
        .filter(|(dx, dy)| dx * dx + dy * dy <= AROUND * AROUND)
        .filter(|(dx, dy)| occupied.contains(&(x + dx, y + dy)))
        .map(|(dx, dy)| Vector2::new(f64::from(dx), f64::from(dy)))
        .collect();
    if about.len() < LEAST {
        return false;
    }
    let count = about.len() as f64;
    let mean = about.iter().sum::<Vector2<f64>>() / count;
    let spread: Matrix2<f64> =
        about.iter().map(|it| (it - mean) * (it - mean).transpose() / count).sum();
    let axes = spread.symmetric_eigen();
    let (across, along) = if axes.eigenvalues[0] < axes.eigenvalues[1] { (0, 1) } else { (1, 0) };
    let (thin, long) = (axes.eigenvalues[across], axes.eigenvalues[along]);
    if long.sqrt() < SPREAD || thin > ELONGATED * long {
        return false;
    }
    let (across, along) = (axes.eigenvectors.column(across), axes.eigenvectors.column(along));
    [1.0, -1.0].iter().any(|side| {
        let beside = about.iter().filter(|it| SECOND.contains(&(side * it.dot(&across))));
        let places = beside.map(|it| it.dot(&along)).filter(|place| place.abs() <= HALF);
        places.map(|place| place.round() as i32).collect::<BTreeSet<_>>().len() >= CELLS
    })
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::{
        tile::{Tile, TileId},
        units::Millimetres,
    };

    use super::*;

    /// A map of one tile with walls from the left to the right, that rise by a cell in seven.
    fn walls(rows: &[usize]) -> OccupancyGrid {
        let mut tile = Tile::UNKNOWN;
        for (row, x) in rows.iter().flat_map(|row| (0..32).map(move |x| (row, x))) {
            tile.set(x, row + x / 7, Cell::Occupied);
        }
        let tiles = [(TileId { x: 0, y: 0 }, &tile)];
        OccupancyGrid::from_tiles(tiles, Millimetres(50)).unwrap()
    }

    #[test]
    fn walls_that_are_drawn_twice_are_counted() {
        assert_eq!(doubled(&walls(&[10])), (0, 32));
        assert_eq!(doubled(&walls(&[10, 11])), (0, 64), "thick");
        assert_eq!(doubled(&walls(&[8, 18])), (0, 64), "half a metre apart");
        for apart in 3..=5 {
            let (found, all) = doubled(&walls(&[10, 10 + apart]));
            assert!(all == 64 && found > 16, "{apart}: {found}");
        }
    }
}
