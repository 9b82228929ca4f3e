//! The floor that robots may use, as a user states it.

use std::collections::BTreeMap;

use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, TileId},
    units::Millimetres,
};

use crate::grid::{GridError, MAX_CELLS, OccupancyGrid, is_inside, span};

/// An area of the floor.
#[derive(Clone, Debug, PartialEq)]
pub enum Area {
    /// The inside of a polygon, given by its corners in `map`, in metres.
    Polygon(Vec<[f64; 2]>),
    /// The free cells of a map.
    FreeCells(OccupancyGrid),
}

/// Why a floor was refused, in one line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AreaError {
    /// Fewer than three corners.
    #[error("has {0} corners; a polygon needs at least 3")]
    Corners(usize),
    /// A coordinate is not finite, or absurd.
    #[error("must lie within 10 km of the origin")]
    Far,
    /// It covers too many cells.
    #[error(
        "covers more than {MAX_CELLS} cells; give a smaller one or larger cells (resolution_m)"
    )]
    Large,
    /// Robots may go nowhere.
    #[error("leaves robots no cell to drive on")]
    Nothing,
}

/// The floor that robots may use: an area without the walls of a floor plan.
///
/// It consists of whole cells: those whose middle lies in a polygon, or that lie altogether in free
/// cells of a map, and touch no occupied cell of the plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DrivableFloor {
    /// Which cells of a tile robots may use, row by row.
    tiles: BTreeMap<TileId, [u32; TILE_SIDE]>,
    /// Whether they may use the cells of all other tiles.
    is_open_beyond: bool,
}

impl DrivableFloor {
    /// The floor for a map with cells of this side. Without an area, all of it but the plan's walls.
    ///
    /// # Errors
    /// [`AreaError`].
    pub fn new(
        side: Millimetres,
        area: Option<&Area>,
        plan: Option<&OccupancyGrid>,
    ) -> Result<Self, AreaError> {
        let mut floor = Self { tiles: BTreeMap::new(), is_open_beyond: area.is_none() };
        let corners = match (area, plan) {
            (Some(Area::Polygon(corners)), _) if corners.len() < 3 => {
                return Err(AreaError::Corners(corners.len()));
            }
            (Some(Area::Polygon(corners)), _) => corners.clone(),
            (Some(Area::FreeCells(grid)), _) | (None, Some(grid)) => outline(grid).into(),
            (None, None) => return Ok(floor),
        };
        let side_m = Millimetres(side.0.max(1)).metres();
        let [columns, rows] = [0, 1].map(|axis| span(&corners, axis, side_m));
        let (columns, rows) = columns.zip(rows).ok_or(AreaError::Far)?;
        if columns.len() * rows.len() > MAX_CELLS {
            return Err(AreaError::Large);
        }
        for row in rows {
            for column in columns.clone() {
                let corner = [column, row].map(|cell| f64::from(cell) * side_m);
                let is_wall = |plan: &OccupancyGrid| plan.square(corner, side_m) == Cell::Occupied;
                let is_open = area.is_none_or(|area| area.contains(corner, side_m))
                    && !plan.is_some_and(is_wall);
                let id = TileId::of_cell(column, row).ok_or(AreaError::Far)?;
                let outside = if floor.is_open_beyond { u32::MAX } else { 0 };
                let tile = floor.tiles.entry(id).or_insert([outside; TILE_SIDE]);
                let bit = 1 << column.rem_euclid(TILE_SIDE as i32);
                let word = &mut tile[row.rem_euclid(TILE_SIDE as i32) as usize];
                *word = if is_open { *word | bit } else { *word & !bit };
            }
        }
        let has_any = floor.tiles.values().any(|tile| tile.iter().any(|row| *row != 0));
        if has_any || floor.is_open_beyond { Ok(floor) } else { Err(AreaError::Nothing) }
    }

    /// Whether robots may use a cell.
    pub fn allows(&self, column: i32, row: i32) -> bool {
        let id = TileId::of_cell(column, row);
        id.map_or(self.is_open_beyond, |id| {
            let word = self.rows(id)[row.rem_euclid(TILE_SIDE as i32) as usize];
            word >> column.rem_euclid(TILE_SIDE as i32) & 1 == 1
        })
    }

    /// Which cells of a tile robots may use: a word for each row, the westernmost cell first.
    pub(super) fn rows(&self, id: TileId) -> [u32; TILE_SIDE] {
        let beyond = [if self.is_open_beyond { u32::MAX } else { 0 }; TILE_SIDE];
        self.tiles.get(&id).copied().unwrap_or(beyond)
    }
}

impl Area {
    /// The free and occupied cells of a map, and all within `margin_m` metres of them along both axes.
    ///
    /// # Errors
    /// [`GridError`], if that is too large.
    pub fn around_known(map: &OccupancyGrid, margin_m: f64) -> Result<Self, GridError> {
        let margin = (margin_m / map.resolution_m()).ceil() as usize;
        let (width, height) = (map.width() + 2 * margin, map.height() + 2 * margin);
        let origin = map.to_map([-(margin as f64); 2]);
        let area = OccupancyGrid::new(map.resolution_m(), origin, width, height)?;
        let mut area = area.with_yaw(map.yaw_rad())?;
        // Along the rows, and then along the columns: from the last known cell before to the next one behind.
        for y in 0..map.height() {
            let is_known = |x: &usize| map.cell(*x, y) != Cell::Unknown;
            let mut next = 0;
            for x in (0..map.width()).filter(is_known) {
                (next.max(x)..=x + 2 * margin).for_each(|x| area.set(x, y + margin, Cell::Free));
                next = x + 2 * margin + 1;
            }
        }
        for x in 0..width {
            let is_known = |y: &usize| area.cell(x, y + margin) == Cell::Free;
            let known: Vec<usize> = (0..map.height()).filter(is_known).collect();
            let mut next = 0;
            for y in known {
                (next.max(y)..=y + 2 * margin).for_each(|y| area.set(x, y, Cell::Free));
                next = y + 2 * margin + 1;
            }
        }
        Ok(Self::FreeCells(area))
    }

    fn contains(&self, corner: [f64; 2], side_m: f64) -> bool {
        match self {
            Self::Polygon(corners) => is_inside(corners, corner.map(|it| it + side_m / 2.0)),
            Self::FreeCells(grid) => grid.square(corner, side_m) == Cell::Free,
        }
    }
}

/// The corners of a grid in `map`.
fn outline(grid: &OccupancyGrid) -> [[f64; 2]; 4] {
    let (width, height) = (grid.width() as f64, grid.height() as f64);
    [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]].map(|corner| grid.to_map(corner))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SIDE: Millimetres = Millimetres(50);

    fn floor(area: Option<&Area>, plan: Option<&OccupancyGrid>) -> DrivableFloor {
        DrivableFloor::new(SIDE, area, plan).unwrap()
    }

    #[test]
    fn a_polygon_may_be_concave_and_lie_anywhere() {
        // An L around the origin, without its north-eastern quarter.
        let corners = [[-1.0, -1.0], [1.0, -1.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0], [-1.0, 1.0]];
        let floor = floor(Some(&Area::Polygon(corners.into())), None);
        let mut count = 0;
        for row in -60..60 {
            for column in -60..60 {
                let is_in = (-20..20).contains(&column)
                    && (-20..20).contains(&row)
                    && !(column >= 0 && row >= 0);
                assert_eq!(floor.allows(column, row), is_in, "{column}, {row}");
                count += u32::from(is_in);
            }
        }
        assert_eq!(count, 1_200);
    }

    #[test]
    fn a_wall_of_one_fine_cell_shuts_the_cell_that_it_is_in() {
        // Cells of 1 cm: a wall at x from 0.52 m to 0.53 m, all else free from 0 to 1 m.
        let mut plan = OccupancyGrid::new(0.01, [0.0, 0.0], 100, 100).unwrap();
        for index in 0..100 * 100 {
            let (x, y) = (index % 100, index / 100);
            plan.set(x, y, if x == 52 { Cell::Occupied } else { Cell::Free });
        }
        let with_plan = floor(None, Some(&plan));
        assert!((-30..50).all(|column| with_plan.allows(column, 7) == (column != 10)));
        assert!(with_plan.allows(10, 20) && with_plan.allows(1_000, -1_000), "beyond the plan");
        let mask = floor(Some(&Area::FreeCells(plan.clone())), None);
        assert!((-30..50).all(|column| {
            mask.allows(column, 7) == ((0..20).contains(&column) && column != 10)
        }));
        let around = floor(Some(&Area::around_known(&plan, 0.2).unwrap()), None);
        assert!((-30..50).all(|column| around.allows(column, 7) == (-4..24).contains(&column)));
        // Both together: the plan's walls go from any area.
        let half = Area::Polygon(vec![[0.4, 0.0], [2.0, 0.0], [2.0, 1.0], [0.4, 1.0]]);
        let both = floor(Some(&half), Some(&plan));
        assert!((0..60).all(|column| {
            both.allows(column, 7) == ((8..40).contains(&column) && column != 10)
        }));
    }

    /// A plan with two known cells, turned by 90 degrees.
    #[test]
    fn the_ground_around_what_is_known_of_a_map_leaves_the_rest_of_its_picture_out() {
        let plan = OccupancyGrid::new(0.05, [1.0, 1.0], 40, 20).unwrap();
        let mut plan = plan.with_yaw(std::f64::consts::FRAC_PI_2).unwrap();
        plan.set(0, 0, Cell::Free);
        plan.set(30, 10, Cell::Occupied);
        let around = floor(Some(&Area::around_known(&plan, 0.1).unwrap()), None);
        // A column of the picture is a row of the floor, and its rows go west.
        let is_near = |column: i32, row: i32, [x, y]: [i32; 2]| {
            let (x, y) = (row - 20 - x, 19 - column - y);
            x.abs().max(y.abs()) <= 2
        };
        for (column, row) in (-20..30).flat_map(|column| (10..70).map(move |row| (column, row))) {
            let is_in = [[0, 0], [30, 10]].iter().any(|it| is_near(column, row, *it));
            assert_eq!(around.allows(column, row), is_in, "{column} {row}");
        }
    }

    #[test]
    fn a_floor_that_can_not_be_meant_is_refused() {
        let polygon = |corners: &[[f64; 2]]| Some(Area::Polygon(corners.to_vec()));
        let square = |side: f64| polygon(&[[0.0, 0.0], [side, 0.0], [side, side], [0.0, side]]);
        for (area, told) in [
            (polygon(&[[0.0, 0.0], [1.0, 1.0]]), "has 2 corners"),
            (square(f64::NAN), "within 10 km"),
            (square(1e9), "within 10 km"),
            (square(5_000.0), "covers more than"),
            (square(0.01), "no cell to drive on"),
        ] {
            let error = DrivableFloor::new(SIDE, area.as_ref(), None).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
        assert!(floor(None, None).allows(i32::MAX, i32::MIN));
    }

    proptest! {
        /// The oracle: a convex polygon is where all its edges have a point on their left.
        #[test]
        fn convex_polygons_are_the_intersection_of_half_planes(
            turns in proptest::collection::btree_set(0u32..360, 3..8),
            (x, y) in (-3.0..3.0f64, -3.0..3.0f64),
        ) {
            let corner = |turn: &u32| {
                let angle = f64::from(*turn).to_radians();
                [2.0 * angle.cos(), 2.0 * angle.sin()]
            };
            let corners: Vec<[f64; 2]> = turns.iter().map(corner).collect();
            let is_left = |index: usize| {
                let (a, b) = (corners[index], corners[(index + 1) % corners.len()]);
                (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0.0
            };
            prop_assert_eq!(is_inside(&corners, [x, y]), (0..corners.len()).all(is_left));
        }
    }
}
