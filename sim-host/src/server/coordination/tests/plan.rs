//! Floor plans, and the layers and the ground drawn from them.

use ubimap_protocol::tile::{Cell, TILE_SIDE, Tile, TileId};

use crate::{
    mapping::ServedLayer,
    server::coordination::{
        ground::{Ground, Point},
        settings::Settings,
    },
};

pub(in crate::server::coordination) const SIDE_M: f64 = 0.05;

/// A hall whose south-western corner is the origin, and its walls, given by their western,
/// southern, eastern and northern edges.
#[derive(Clone, Debug)]
pub(in crate::server::coordination) struct Plan {
    pub(super) width: f64,
    pub(super) height: f64,
    walls: Vec<[f64; 4]>,
}

impl Plan {
    pub(in crate::server::coordination) fn room(width: f64, height: f64) -> Self {
        let thick = 0.1;
        let walls = vec![
            [-thick, -thick, 0.0, height + thick],
            [width, -thick, width + thick, height + thick],
            [-thick, -thick, width + thick, 0.0],
            [-thick, height, width + thick, height + thick],
        ];
        Self { width, height, walls }
    }

    pub(in crate::server::coordination) fn wall(
        &mut self,
        west: f64,
        south: f64,
        east: f64,
        north: f64,
    ) {
        self.walls.push([west, south, east, north]);
    }

    /// The distance from a place to the nearest wall; zero inside one.
    pub(in crate::server::coordination) fn room_around(&self, place: Point) -> f64 {
        let to = |&[west, south, east, north]: &[f64; 4]| {
            let x = (west - place.x).max(place.x - east).max(0.0);
            let y = (south - place.y).max(place.y - north).max(0.0);
            (x * x + y * y).sqrt()
        };
        self.walls.iter().map(to).fold(f64::MAX, f64::min)
    }

    /// The true state of a place.
    pub(super) fn cell(&self, place: Point) -> Cell {
        let inside = (-0.1..self.width + 0.1).contains(&place.x)
            && (-0.1..self.height + 0.1).contains(&place.y);
        match inside {
            false => Cell::Unknown,
            true if self.room_around(place) == 0.0 => Cell::Occupied,
            true => Cell::Free,
        }
    }

    /// The fully mapped ground. Cameras cover either the whole floor or none of it.
    pub(in crate::server::coordination) fn ground(&self, is_covered: bool) -> Ground {
        let (mut fused, mut coverage) = (ServedLayer::default(), ServedLayer::default());
        set(&mut fused, self.places().map(|it| (it, self.cell(middle(it)))));
        if is_covered {
            set(&mut coverage, self.places().map(|it| (it, Cell::Free)));
        }
        Ground::survey(&fused, &coverage, &[], None, &Settings::default()).unwrap()
    }

    /// All cells of the plan.
    pub(super) fn places(&self) -> impl Iterator<Item = (i32, i32)> + use<> {
        let end = |metres: f64| ((metres + 0.1) / SIDE_M) as i32 + 1;
        let (width, height) = (end(self.width), end(self.height));
        (-3..height).flat_map(move |y| (-3..width).map(move |x| (x, y)))
    }
}

pub(super) fn middle((x, y): (i32, i32)) -> Point {
    Point::new((f64::from(x) + 0.5) * SIDE_M, (f64::from(y) + 0.5) * SIDE_M)
}

/// Sets cells of a layer.
pub(super) fn set(layer: &mut ServedLayer, cells: impl Iterator<Item = ((i32, i32), Cell)>) {
    let mut tiles: std::collections::BTreeMap<TileId, Tile> = Default::default();
    for ((x, y), cell) in cells {
        let id = TileId::of_cell(x, y).unwrap();
        let tile = tiles
            .entry(id)
            .or_insert_with(|| layer.get(id).map_or(Tile::UNKNOWN, |(_, tile)| *tile));
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        tile.set(within(x), within(y), cell);
    }
    for (id, tile) in tiles {
        layer.set(id, tile);
    }
}

/// The ground of a plan, unknown where `hides` is true.
pub(in crate::server::coordination) fn drawn(
    plan: &Plan,
    hides: impl Fn(f64, f64) -> bool,
) -> Ground {
    let mut fused = ServedLayer::default();
    let seen = plan.places().filter(|it| !hides(middle(*it).x, middle(*it).y));
    set(&mut fused, seen.map(|it| (it, plan.cell(middle(it)))));
    Ground::survey(&fused, &ServedLayer::default(), &[], None, &Settings::default()).unwrap()
}
