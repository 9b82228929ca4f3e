//! The server's map of robots' layers, cell by cell: an independent version of what the server
//! computes for 32 cells at a time. The cameras have seen nothing but free ground, all of it out of
//! the robots' reach.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId},
    units::RobotId,
};
use ubimap_sim_host::{
    mapping::{SeenTile, Weight},
    server::Server,
};

use crate::plain_moved::moved;

const SIDE: i32 = TILE_SIDE as i32;
/// Age at which a movable cell is forgotten, in seconds.
const MOVABLE_S: i64 = 300;
/// Time in seconds by which a claim counts as older, for each grade of weight that its robot lacks.
const GRADE_S: i64 = 60;

/// The claims of all robots, and the time by which the map ages.
pub struct PlainMap<'s> {
    server: &'s Server,
    layers: Vec<(Weight, BTreeMap<TileId, SeenTile>)>,
    /// The cells that cameras have seen free.
    free: &'s BTreeSet<(i32, i32)>,
    now_s: i64,
}

impl<'s> PlainMap<'s> {
    /// The map of a server with these robots, whose cameras have seen these cells free.
    pub fn of(
        server: &'s Server,
        robots: &BTreeSet<RobotId>,
        free: &'s BTreeSet<(i32, i32)>,
    ) -> Self {
        let layers = robots.iter().map(|&robot| (server.weight(robot), moved(server, robot)));
        // The time is a multiple of ten seconds.
        let now_s = server.map_time().next().micros() as i64 / 1_000_000 - 10;
        Self { server, layers: layers.collect(), free, now_s }
    }

    /// What a fused tile must contain.
    pub fn fused(&self, id: TileId) -> Tile {
        let mut tile = Tile::UNKNOWN;
        let under = self.server.under(id);
        for (x, y) in (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y))) {
            let at = (i32::from(id.x) * SIDE + x, i32::from(id.y) * SIDE + y);
            let mut code = self.claimed(at);
            if code == Cell::Occupied && !self.can_be_seen(at) {
                code = Cell::Unknown;
            }
            let is_below_a_robot = under[y as usize] >> x & 1 != 0;
            if is_below_a_robot && matches!(code, Cell::Occupied | Cell::Movable) {
                code = Cell::Free;
            }
            tile.set(x as usize, y as usize, code);
        }
        tile
    }

    /// What the robots claim of a cell of the grid.
    fn claimed(&self, (x, y): (i32, i32)) -> Cell {
        if self.free.contains(&(x, y)) {
            return Cell::Free;
        }
        let id = TileId { x: x.div_euclid(SIDE) as i16, y: y.div_euclid(SIDE) as i16 };
        let (x, y) = (x.rem_euclid(SIDE) as usize, y.rem_euclid(SIDE) as usize);
        let mut claims: Vec<(i64, Cell)> = Vec::new();
        for (weight, tiles) in &self.layers {
            let Some(seen) = tiles.get(&id).filter(|_| *weight != Weight::NONE) else { continue };
            let (cell, second) = (seen.tile.cell(x, y), i64::from(seen.seconds[y * TILE_SIDE + x]));
            let is_forgotten =
                cell == Cell::Movable && self.now_s > second && self.now_s - second >= MOVABLE_S;
            if cell != Cell::Unknown && !is_forgotten {
                claims.push((second - GRADE_S * i64::from(weight.short_of_full()), cell));
            }
        }
        // The newest claim wins; of those in one second movable beats occupied, which beats free.
        claims.sort_by_key(|&(second, cell)| (second, cell.code()));
        let Some(&(_, newest)) = claims.last() else { return Cell::Unknown };
        let alternations = claims.windows(2).filter(|pair| {
            pair[0].0 != pair[1].0 && (pair[0].1 == Cell::Free) != (pair[1].1 == Cell::Free)
        });
        if newest == Cell::Occupied && alternations.count() >= 3 { Cell::Movable } else { newest }
    }

    /// Whether an occupied cell is close enough to free ground to have been seen: at most two
    /// cells, or three with nothing fixed in between.
    fn can_be_seen(&self, at: (i32, i32)) -> bool {
        self.is_near(at, 2)
            || self.is_near(at, 3) && !around(at, 1).any(|beside| self.is_second(beside))
    }

    fn is_near(&self, at: (i32, i32), steps: i32) -> bool {
        around(at, steps).any(|beside| self.claimed(beside) == Cell::Free)
    }

    fn is_first(&self, at: (i32, i32)) -> bool {
        self.claimed(at) == Cell::Occupied && self.is_near(at, 1)
    }

    fn is_second(&self, at: (i32, i32)) -> bool {
        self.claimed(at) == Cell::Occupied && around(at, 1).any(|beside| self.is_first(beside))
    }
}

/// The cells within some steps of a cell, itself included.
fn around((x, y): (i32, i32), steps: i32) -> impl Iterator<Item = (i32, i32)> {
    let reach = move || -steps..=steps;
    reach().flat_map(move |dy| reach().map(move |dx| (x + dx, y + dy)))
}
