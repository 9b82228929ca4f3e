//! Scores for the agreement of one map with another.

use serde::Serialize;
use ubimap_protocol::tile::Cell;

use super::occupancy::OccupancyGrid;

/// Added to the tolerance, so that rounding does not exclude cells at exactly that distance.
const ROUNDING_M: f64 = 1e-6;

/// The agreement of a map with a reference. Fractions are from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// Maximum distance between the centres of two matching occupied cells, in metres.
    pub tolerance_m: f64,
    /// The fraction of the map's occupied cells that have an occupied cell of the reference within
    /// the tolerance; 1 if the map has none.
    pub precision: f64,
    /// The fraction of the reference's occupied cells that have an occupied cell of the map within
    /// the tolerance; 1 if the reference has none.
    pub recall: f64,
    /// The harmonic mean of precision and recall: 1 if neither map has occupied cells, 0 if only
    /// one map has.
    pub f1: f64,
    /// Among the cells known in both maps, the fraction that is free in both or occupied in both.
    /// If no cell is known in both: 1 if neither map has a known cell, otherwise 0.
    pub agreement_known: f64,
    /// Known cells of the map whose centres lie in known cells of the reference.
    pub known_in_both: usize,
    /// Occupied cells of the map.
    pub occupied: usize,
    /// Occupied cells of the reference.
    pub occupied_reference: usize,
}

impl Scores {
    /// The scores as indented JSON with a trailing line break.
    pub fn to_json_pretty(&self) -> String {
        // A plain struct of numbers, so serialising it can't fail.
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }
}

/// Scores a map against a reference.
///
/// Distances are Euclidean, between the centres of cells in `map`; the grids may differ in
/// resolution, origin and yaw. Fixed and movable cells both count as occupied. `tolerance_m` is in
/// metres; `None` means one cell of the reference, which includes its four neighbours but not the
/// diagonal ones. Cost: one binary search per occupied cell and row within the tolerance.
pub fn compare(map: &OccupancyGrid, reference: &OccupancyGrid, tolerance_m: Option<f64>) -> Scores {
    let tolerance_m = tolerance_m.unwrap_or(reference.resolution_m());
    let map_index = OccupiedIndex::of(map);
    let reference_index = OccupiedIndex::of(reference);
    let precision = share_matched(&map_index, &reference_index, tolerance_m);
    let recall = share_matched(&reference_index, &map_index, tolerance_m);
    let (agreement_known, known_in_both) = agreement(map, reference);
    Scores {
        tolerance_m,
        precision,
        recall,
        f1: if precision + recall > 0.0 {
            2.0 * precision * recall / (precision + recall)
        } else {
            0.0
        },
        agreement_known,
        known_in_both,
        occupied: map_index.columns.len(),
        occupied_reference: reference_index.columns.len(),
    }
}

/// The fraction of the cells of `from` that have a cell of `to` within the tolerance.
fn share_matched(from: &OccupiedIndex<'_>, to: &OccupiedIndex<'_>, tolerance_m: f64) -> f64 {
    if from.columns.is_empty() {
        return 1.0;
    }
    let reach = (tolerance_m + ROUNDING_M) / to.grid.resolution_m();
    let matched = from
        .centres()
        .filter(|centre| to.has_within(to.grid.from_map(from.grid.to_map(*centre)), reach))
        .count();
    matched as f64 / from.columns.len() as f64
}

/// The fraction of agreeing cells among those known in both maps, and the number of cells known in
/// both.
fn agreement(map: &OccupancyGrid, reference: &OccupancyGrid) -> (f64, usize) {
    let mut known_in_both = 0;
    let mut agreeing = 0;
    for y in 0..map.height() {
        for x in 0..map.width() {
            let Some(occupied) = is_occupied(map.cell(x, y)) else { continue };
            let centre = map.to_map([x as f64 + 0.5, y as f64 + 0.5]);
            let [column, row] = reference.from_map(centre).map(f64::floor);
            if column < 0.0 || row < 0.0 {
                continue;
            }
            let there = is_occupied(reference.cell(column as usize, row as usize));
            if let Some(there) = there {
                known_in_both += 1;
                agreeing += usize::from(there == occupied);
            }
        }
    }
    let share = if known_in_both > 0 {
        agreeing as f64 / known_in_both as f64
    } else if map.counts().known == 0 && reference.counts().known == 0 {
        1.0
    } else {
        0.0
    };
    (share, known_in_both)
}

fn is_occupied(cell: Cell) -> Option<bool> {
    match cell {
        Cell::Unknown => None,
        Cell::Free => Some(false),
        Cell::Occupied | Cell::Movable => Some(true),
    }
}

/// The occupied cells of a grid, sorted, so that binary search finds the nearest in a row.
struct OccupiedIndex<'a> {
    grid: &'a OccupancyGrid,
    /// Columns of the occupied cells, row by row.
    columns: Vec<u32>,
    /// Start index of each row in `columns`, and the end of the last.
    rows: Vec<usize>,
}

impl<'a> OccupiedIndex<'a> {
    fn of(grid: &'a OccupancyGrid) -> Self {
        let mut columns = Vec::new();
        let mut rows = vec![0];
        for row in grid.cells().chunks(grid.width()) {
            let occupied =
                row.iter().enumerate().filter(|(_, cell)| is_occupied(**cell) == Some(true));
            columns.extend(occupied.map(|(x, _)| x as u32));
            rows.push(columns.len());
        }
        Self { grid, columns, rows }
    }

    /// The centres of the occupied cells, in cells from the lower left corner.
    fn centres(&self) -> impl Iterator<Item = [f64; 2]> + '_ {
        self.rows.windows(2).enumerate().flat_map(|(y, ends)| {
            let columns = &self.columns[ends[0]..ends[1]];
            columns.iter().map(move |x| [f64::from(*x) + 0.5, y as f64 + 0.5])
        })
    }

    /// Whether the centre of an occupied cell lies within `reach` of a point (both in cells).
    fn has_within(&self, [x, y]: [f64; 2], reach: f64) -> bool {
        let first = (y - 0.5 - reach).ceil().max(0.0) as usize;
        let past = ((y - 0.5 + reach).floor() + 1.0).clamp(0.0, self.grid.height() as f64) as usize;
        (first..past).any(|row| {
            let away = row as f64 + 0.5 - y;
            let half = (reach * reach - away * away).max(0.0).sqrt();
            let columns = &self.columns[self.rows[row]..self.rows[row + 1]];
            let candidate = columns.partition_point(|column| f64::from(*column) + 0.5 < x - half);
            columns.get(candidate).is_some_and(|column| f64::from(*column) + 0.5 <= x + half)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(width: usize, height: usize, occupied: &[(usize, usize)]) -> OccupancyGrid {
        let mut grid = OccupancyGrid::new(0.05, [0.0, 0.0], width, height).unwrap();
        for (x, y) in occupied {
            grid.set(*x, *y, Cell::Occupied);
        }
        grid
    }

    fn moved(grid: &OccupancyGrid, resolution_m: f64, origin_m: [f64; 2]) -> OccupancyGrid {
        let mut moved =
            OccupancyGrid::new(resolution_m, origin_m, grid.width(), grid.height()).unwrap();
        for y in 0..grid.height() {
            for x in 0..grid.width() {
                moved.set(x, y, grid.cell(x, y));
            }
        }
        moved
    }

    #[test]
    fn a_tolerance_of_one_cell_excludes_diagonals() {
        let reference = grid(9, 9, &[(4, 4)]);
        for (x, y, f1) in [(4, 4, 1.0), (3, 4, 1.0), (4, 5, 1.0), (5, 5, 0.0), (4, 6, 0.0)] {
            assert_eq!(compare(&grid(9, 9, &[(x, y)]), &reference, None).f1, f1, "({x}, {y})");
        }
        let diagonal = grid(9, 9, &[(5, 5)]);
        assert_eq!(compare(&diagonal, &reference, Some(0.0708)).f1, 1.0);
        assert_eq!(compare(&diagonal, &reference, Some(0.0707)).f1, 0.0);
    }

    #[test]
    fn precision_and_recall_differ() {
        let map = grid(20, 3, &[(0, 1), (10, 1)]);
        let reference = grid(20, 3, &[(0, 1), (5, 1), (15, 1), (19, 1)]);
        let scores = compare(&map, &reference, None);
        assert_eq!((scores.precision, scores.recall), (0.5, 0.25));
        assert!((scores.f1 - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!((scores.occupied, scores.occupied_reference), (2, 4));
    }

    #[test]
    fn grids_may_differ_in_origin_and_resolution() {
        // The cell (2, 2) of 10 cm has its centre at (0.25, 0.25); the cell (7, 7) of 5 cm, with
        // the origin 12 cm to the south-west, at (0.255, 0.255).
        let reference = moved(&grid(5, 5, &[(2, 2)]), 0.1, [0.0, 0.0]);
        let map = moved(&grid(12, 12, &[(7, 7)]), 0.05, [-0.12, -0.12]);
        assert_eq!(compare(&map, &reference, Some(0.0071)).f1, 1.0);
        assert_eq!(compare(&map, &reference, Some(0.0070)).f1, 0.0);
        assert_eq!(compare(&map, &reference, Some(f64::MAX)).f1, 1.0);
        assert_eq!(compare(&map, &reference, None).agreement_known, 1.0);
    }

    #[test]
    fn a_rotated_grid_is_compared_in_map_coordinates() {
        let reference = grid(9, 9, &[(6, 2)]);
        // After a quarter turn about the corner, column 2 of row 6 is at that position.
        let turned = moved(&grid(9, 9, &[(2, 2)]), 0.05, [0.45, 0.0]);
        let turned = turned.with_yaw(std::f64::consts::FRAC_PI_2).unwrap();
        assert_eq!(compare(&turned, &reference, Some(0.0)).f1, 1.0);
    }

    #[test]
    fn empty_maps_have_defined_scores() {
        let (nothing, something) = (grid(3, 3, &[]), grid(3, 3, &[(1, 1)]));
        let both = compare(&nothing, &nothing, None);
        assert_eq!((both.precision, both.recall, both.f1), (1.0, 1.0, 1.0));
        assert_eq!((both.agreement_known, both.known_in_both), (1.0, 0));
        let missed = compare(&nothing, &something, None);
        assert_eq!((missed.precision, missed.recall, missed.f1), (1.0, 0.0, 0.0));
        assert_eq!(missed.agreement_known, 0.0);
        let invented = compare(&something, &nothing, None);
        assert_eq!((invented.precision, invented.recall, invented.f1), (0.0, 1.0, 0.0));
    }

    #[test]
    fn fixed_and_movable_cells_agree() {
        let mut map = grid(4, 1, &[(0, 0)]);
        let mut reference = grid(4, 1, &[]);
        reference.set(0, 0, Cell::Movable);
        map.set(1, 0, Cell::Free);
        reference.set(1, 0, Cell::Occupied);
        map.set(2, 0, Cell::Free);
        reference.set(3, 0, Cell::Free);
        let scores = compare(&map, &reference, None);
        assert_eq!((scores.agreement_known, scores.known_in_both), (0.5, 2));
    }
}
