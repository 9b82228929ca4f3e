//! Where the known ground ends at ground that no camera sees (frontiers: Yamauchi 1997).

use ubimap_protocol::tile::Cell;

use super::{
    ground::{Ground, Point},
    route::Ways,
    settings::Settings,
};

/// Rays by which ground in sight is found.
const RAYS: usize = 32;

/// Unknown, blind cells side by side, next to free ones.
#[derive(Clone, Debug)]
pub(super) struct Frontier {
    /// One of its cells, in the middle of them.
    pub(super) place: Point,
    /// The most unknown ground that can be seen through one of its cells, in square metres.
    pub(super) gain_m2: f64,
    pub(super) vantages: Vec<Vantage>,
}

/// A place from which a frontier is in view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Vantage {
    /// The cell.
    pub(super) at: usize,
    /// How far the frontier is, in metres.
    pub(super) away_m: f64,
    /// Whether a surface is known behind it.
    pub(super) is_backed: bool,
}

impl Frontier {
    /// The way to the nearest place from which it is in view, in metres.
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

/// Takes the cells of one piece of a frontier: neighbours of neighbours, not far from the first.
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

/// Looks along straight lines.
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

    /// The cells on a ray from a cell, that one left out, and how far they are in metres.
    fn ray(&self, from: usize, direction: usize) -> impl Iterator<Item = (f64, usize)> {
        self.long_ray(from, direction, self.settings.view_m)
    }

    /// The same, so many metres long.
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

    /// The unknown ground in sight of a cell, if nothing stands in what is unknown, in square
    /// metres; and where most of it is.
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

    /// Whether a sensor that sees so far beyond a cell has a wall behind it; `None` if it has known
    /// ground alone at its end, from where nothing comes back: then nothing before it is known
    /// either, as along an aisle that is longer than sensors see.
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

    /// The known free cells in sight of a cell, over free ground alone, from where what is unknown
    /// is ahead; and whether a sensor that sees so far has a wall behind it from there.
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
                    // Beside the frontier there is more of it.
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
        // Of two ways to look from one cell the better one.
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
    fn each_end_of_the_known_ground_is_found_and_a_long_one_is_shared() {
        let plan = Plan::room(8.0, 6.0);
        // Unknown: the eastern quarter, and a little pocket.
        let hidden = |x: f64, y: f64| x > 6.0 || (x - 1.0).hypot(y - 1.0) < 0.08;
        let ground = drawn(&plan, hidden);
        let found = frontiers(&ground, &Settings { view_m: 2.0, ..Settings::default() });
        assert!(found.iter().all(|it| (it.place.x - 6.0).abs() < 0.1), "{found:?}");
        assert!(found.len() >= 3 && found.len() <= 6, "{}", found.len());
        // Across the edge half a disc of 2 m is to be seen: 17 or 18 of 32 rays.
        let most = found.iter().map(|it| it.gain_m2).fold(0.0, f64::max);
        assert!(most > 6.2 && most < 7.2, "{most}");
    }
}
