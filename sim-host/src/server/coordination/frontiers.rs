//! Frontiers: edges of the known ground beyond which no camera sees (Yamauchi 1997).

use ubimap_protocol::tile::Cell;

use super::{
    ground::{Ground, Point},
    route::Ways,
    settings::Settings,
};

/// Number of rays that are cast from a cell.
const RAYS: usize = 32;

/// Connected unknown cells that no camera sees, next to free cells.
#[derive(Clone, Debug)]
pub(super) struct Frontier {
    /// The cell nearest to its centroid.
    pub(super) place: Point,
    /// Largest area of unknown ground visible through one of its cells, in square metres.
    pub(super) gain_m2: f64,
    pub(super) vantages: Vec<Vantage>,
}

/// A place from which a frontier is visible.
#[derive(Clone, Copy, Debug)]
pub(super) struct Vantage {
    /// The cell.
    pub(super) at: usize,
    /// Distance to the frontier in metres.
    pub(super) away_m: f64,
    /// Whether there is a known wall behind the frontier, within sensor range of the place.
    pub(super) is_backed: bool,
}

impl Frontier {
    /// Lowest cost, in metres, of the way to a place from which the frontier is visible; `None` if
    /// no such place is reachable.
    pub(super) fn metres(&self, ways: &Ways<'_>) -> Option<f64> {
        self.vantages.iter().filter_map(|it| ways.metres(it.at)).min_by(f64::total_cmp)
    }
}

/// All frontiers of the ground.
pub(super) fn frontiers(ground: &Ground, settings: &Settings) -> Vec<Frontier> {
    let rules = &settings.frontiers;
    let width = ground.width();
    let is_frontier = |at: usize| {
        let beside = [at.checked_sub(width), at.checked_sub(1), Some(at + 1), Some(at + width)];
        let is_free = |at: usize| at < ground.len() && ground.cell(at) == Cell::Free;
        ground.is_blind(at) && beside.into_iter().flatten().any(is_free)
    };
    let mut open: Vec<bool> = (0..ground.len()).map(is_frontier).collect();
    let mut found = Vec::new();
    for first in 0..ground.len() {
        if open[first] {
            let piece = piece(ground, &mut open, first, rules.piece_m);
            found.extend(Some(piece).filter(|it| it.len() >= rules.least_cells));
        }
    }
    let rays = Rays::new(ground, settings);
    let frontiers = found.into_iter().map(|cells| {
        let middle = cells.iter().fold(Point::origin(), |sum, &at| sum + ground.place(at).coords)
            / cells.len() as f64;
        let off = |at: &usize| (ground.place(*at) - middle).norm_squared();
        let nearest = cells.iter().copied().min_by(|a, b| off(a).total_cmp(&off(b)));
        let at = nearest.unwrap_or(cells[0]);
        let mut through = vec![at];
        for &cell in &cells {
            let away =
                |&it: &usize| (ground.place(it) - ground.place(cell)).norm() >= rules.through_m;
            if through.iter().all(away) {
                through.push(cell);
            }
        }
        let mut frontier = Frontier { place: ground.place(at), gain_m2: 0.0, vantages: Vec::new() };
        for at in through {
            let (gain_m2, towards) = rays.gain(at);
            frontier.gain_m2 = frontier.gain_m2.max(gain_m2);
            frontier.vantages.extend(rays.vantages(at, towards));
        }
        frontier
    });
    frontiers.filter(|it| it.gain_m2 >= rules.least_gain_m2).collect()
}

/// Removes the cells of one piece of a frontier from `open`, and returns them: connected cells
/// within `piece_m` of the first.
fn piece(ground: &Ground, open: &mut [bool], first: usize, piece_m: f64) -> Vec<usize> {
    let width = ground.width() as isize;
    let mut piece = vec![first];
    open[first] = false;
    let mut next = 0;
    while let Some(&at) = piece.get(next) {
        next += 1;
        for step in [1, -1, width, -width, width + 1, width - 1, 1 - width, -1 - width] {
            let beside = at.wrapping_add_signed(step);
            if open.get(beside) == Some(&true)
                && (ground.place(beside) - ground.place(first)).norm() <= piece_m
            {
                open[beside] = false;
                piece.push(beside);
            }
        }
    }
    piece
}

/// Casts rays over the ground.
struct Rays<'a> {
    ground: &'a Ground,
    settings: &'a Settings,
    directions: Vec<nalgebra::Vector2<f64>>,
}

impl<'a> Rays<'a> {
    fn new(ground: &'a Ground, settings: &'a Settings) -> Self {
        let turn = |ray| core::f64::consts::TAU * ray as f64 / RAYS as f64;
        let direction = |ray| nalgebra::Vector2::new(libm::cos(turn(ray)), libm::sin(turn(ray)));
        Self { ground, settings, directions: (0..RAYS).map(direction).collect() }
    }

    /// The cells on a ray up to the view distance, except the first one, each with its distance in
    /// metres.
    fn ray(&self, from: usize, direction: usize) -> impl Iterator<Item = (f64, usize)> {
        self.long_ray(from, direction, self.settings.view_m)
    }

    /// Like `ray`, up to a distance of `metres`.
    fn long_ray(
        &self,
        from: usize,
        direction: usize,
        metres: f64,
    ) -> impl Iterator<Item = (f64, usize)> {
        let (start, way) = (self.ground.place(from), self.directions[direction]);
        let steps = (metres / self.ground.side_m()) as usize;
        let at = move |step: usize| {
            let metres = step as f64 * self.ground.side_m();
            Some((metres, self.ground.at(start + way * metres)?))
        };
        (1..=steps).map_while(at)
    }

    /// Returns the area of unknown ground that would be visible from a cell if unknown cells were
    /// free, in square metres, and the sum of the directions to that ground, weighted by area.
    fn gain(&self, from: usize) -> (f64, nalgebra::Vector2<f64>) {
        let side_m = self.ground.side_m();
        let ring = core::f64::consts::TAU / RAYS as f64 * side_m;
        let all = (0..RAYS).flat_map(|direction| {
            let until_wall = move |(_, at): &(f64, usize)| {
                !matches!(self.ground.cell(*at), Cell::Occupied | Cell::Movable)
            };
            self.ray(from, direction).take_while(until_wall).map(move |it| (direction, it))
        });
        let unknown = all.filter(|(_, (_, at))| self.ground.is_blind(*at));
        unknown.fold(
            (0.0, nalgebra::Vector2::zeros()),
            |(sum, towards), (direction, (metres, _))| {
                (sum + metres * ring, towards + self.directions[direction] * metres * ring)
            },
        )
    }

    /// Whether there is a known wall within `reach_m` behind the cell `from`, in this direction.
    /// `None` if there is no wall, but known ground at the end of that range: the beam would get no
    /// echo, and a beam without an echo leaves everything before it unknown, for example along an
    /// aisle that is longer than the sensor's range.
    fn is_backed(&self, from: usize, direction: usize, reach_m: f64) -> Option<bool> {
        let mut last = None;
        for (_, at) in self.long_ray(from, direction, reach_m) {
            if self.ground.cell(at) == Cell::Occupied {
                return Some(true);
            }
            last = Some(at);
        }
        last.is_none_or(|at| self.ground.is_blind(at)).then_some(false)
    }

    /// The free cells from which the frontier cell `from` is visible across free ground, with the
    /// unknown ground behind it, in the direction `towards`.
    fn vantages(&self, from: usize, towards: nalgebra::Vector2<f64>) -> Vec<Vantage> {
        let Settings { range_m, frontiers, .. } = self.settings;
        let ahead = |direction: &usize| {
            -self.directions[*direction].dot(&towards) >= frontiers.ahead_cosine * towards.norm()
        };
        let mut vantages: Vec<Vantage> = (0..RAYS)
            .filter(ahead)
            .flat_map(|direction| {
                let ray = self.ray(from, direction);
                let free = ray.take_while(|(metres, at)| {
                    // Close to the cell, the frontier itself may continue.
                    let near = *metres < frontiers.nearest_m && self.ground.is_blind(*at);
                    near || self.ground.cell(*at) == Cell::Free
                });
                let far = free.filter(|(metres, _)| *metres >= frontiers.nearest_m);
                let behind = (direction + RAYS / 2) % RAYS;
                far.filter_map(move |(metres, at)| {
                    let is_backed = self.is_backed(from, behind, range_m - metres)?;
                    Some(Vantage { at, away_m: metres, is_backed })
                })
            })
            .collect();
        // If a cell is on several rays, a vantage with a wall behind the frontier is kept.
        vantages.sort_by_key(|it| (it.at, !it.is_backed));
        vantages.dedup_by_key(|it| it.at);
        vantages
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::coordination::tests::plan::{Plan, drawn};

    #[test]
    fn every_frontier_is_found_and_long_ones_are_divided() {
        let plan = Plan::room(8.0, 6.0);
        // The eastern quarter and a small pocket are unknown.
        let hidden = |x: f64, y: f64| x > 6.0 || (x - 1.0).hypot(y - 1.0) < 0.08;
        let ground = drawn(&plan, hidden);
        let found = frontiers(&ground, &Settings { view_m: 2.0, ..Settings::default() });
        assert!(found.iter().all(|it| (it.place.x - 6.0).abs() < 0.1), "{found:?}");
        assert!(found.len() >= 3 && found.len() <= 6, "{}", found.len());
        // Half a disc of 2 m is visible across the edge: 17 or 18 of 32 rays.
        let most = found.iter().map(|it| it.gain_m2).fold(0.0, f64::max);
        assert!(most > 6.2 && most < 7.2, "{most}");
    }
}
