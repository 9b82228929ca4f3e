//! Where the known ground ends at ground that no camera sees (frontiers: Yamauchi 1997).

use ubimap_protocol::tile::Cell;

use super::{
    ground::{Disc, Ground, Point},
    route::Ways,
};

/// Fewer cells side by side are noise.
const LEAST_CELLS: usize = 4;
/// A frontier is cut into pieces of this reach, in metres: several robots may share a long one.
const PIECE_M: f64 = 1.0;
/// Less ground in sight is not worth a drive, in square metres.
const LEAST_GAIN_M2: f64 = 0.05;
/// A frontier is looked at from this far at least, in metres: sensors are blind before themselves.
const NEAREST_M: f64 = 0.4;
/// A frontier is looked at so that its unknown ground is ahead: within 70 degrees (the cosine).
/// Along the edge of a shadow nothing more is to be seen than what cast it.
const AHEAD: f64 = 0.34;
/// Of places on one straight way the last is the best: what is left of it counts more than what is
/// driven.
const LAST: f64 = 1.5;
/// A view without a known surface behind the frontier is so much worse, in metres.
const UNBACKED_M: f64 = 0.5;
/// Rays by which ground in sight is found.
const RAYS: usize = 32;

/// Unknown, blind cells side by side, next to free ones.
#[derive(Clone, Debug)]
pub(super) struct Frontier {
    /// One of its cells, in the middle of them.
    pub(super) place: Point,
    /// The unknown ground that can be seen through it, in square metres.
    pub(super) gain_m2: f64,
    /// The cells from which it is in view, and whether a surface is known behind it from there.
    views: Vec<(usize, bool)>,
}

/// Where to stand to look at a frontier.
#[derive(Clone, Copy, Debug)]
pub(super) struct View {
    pub(super) place: Point,
    /// The way there.
    pub(super) metres: f64,
}

impl Frontier {
    /// The place from which it is in view that a robot passes last on the shortest way to it, none
    /// of those that were tried in vain: it looks there as it drives, and need not stop.
    pub(super) fn view(&self, ground: &Ground, ways: &Ways<'_>, tried: &[Disc]) -> Option<View> {
        let view = |&(at, is_backed): &(usize, bool)| {
            let view = View { place: ground.place(at), metres: ways.metres(at)? };
            let doubt = if is_backed { 0.0 } else { UNBACKED_M };
            Some((view.metres + LAST * (view.place - self.place).norm() + doubt, view))
        };
        let is_new = |(_, view): &(f64, View)| {
            tried.iter().all(|disc| (view.place - disc.centre).norm() > disc.radius)
        };
        let views = self.views.iter().filter_map(view).filter(is_new);
        views.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, view)| view)
    }
}

/// All frontiers of the ground, in view from so far, for sensors that see so far.
pub(super) fn frontiers(ground: &Ground, view_m: f64, range_m: f64) -> Vec<Frontier> {
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
            let piece = piece(ground, &mut open, first);
            found.extend(Some(piece).filter(|it| it.len() >= LEAST_CELLS));
        }
    }
    let rays = Rays::new(ground, view_m);
    let frontiers = found.into_iter().map(|cells| {
        let middle = cells.iter().fold(Point::origin(), |sum, &at| sum + ground.place(at).coords)
            / cells.len() as f64;
        let off = |at: &usize| (ground.place(*at) - middle).norm_squared();
        let nearest = cells.iter().copied().min_by(|a, b| off(a).total_cmp(&off(b)));
        let at = nearest.unwrap_or(cells[0]);
        let (gain_m2, towards) = rays.gain(at);
        Frontier { place: ground.place(at), gain_m2, views: rays.views(at, towards, range_m) }
    });
    frontiers.filter(|it| it.gain_m2 >= LEAST_GAIN_M2).collect()
}

/// Takes the cells of one piece of a frontier: neighbours of neighbours, not far from the first.
fn piece(ground: &Ground, open: &mut [bool], first: usize) -> Vec<usize> {
    let width = ground.width() as isize;
    let mut piece = vec![first];
    open[first] = false;
    let mut next = 0;
    while let Some(&at) = piece.get(next) {
        next += 1;
        for step in [1, -1, width, -width, width + 1, width - 1, 1 - width, -1 - width] {
            let beside = at.wrapping_add_signed(step);
            if open.get(beside) == Some(&true)
                && (ground.place(beside) - ground.place(first)).norm() <= PIECE_M
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
    view_m: f64,
    directions: Vec<nalgebra::Vector2<f64>>,
}

impl<'a> Rays<'a> {
    fn new(ground: &'a Ground, view_m: f64) -> Self {
        let turn = |ray| core::f64::consts::TAU * ray as f64 / RAYS as f64;
        let direction = |ray| nalgebra::Vector2::new(libm::cos(turn(ray)), libm::sin(turn(ray)));
        Self { ground, view_m, directions: (0..RAYS).map(direction).collect() }
    }

    /// The cells on a ray from a cell, that one left out, and how far they are in metres.
    fn ray(&self, from: usize, direction: usize) -> impl Iterator<Item = (f64, usize)> {
        self.long_ray(from, direction, self.view_m)
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
    fn views(
        &self,
        from: usize,
        towards: nalgebra::Vector2<f64>,
        range_m: f64,
    ) -> Vec<(usize, bool)> {
        let ahead = |direction: &usize| {
            -self.directions[*direction].dot(&towards) >= AHEAD * towards.norm()
        };
        let mut views: Vec<(usize, bool)> = (0..RAYS)
            .filter(ahead)
            .flat_map(|direction| {
                let ray = self.ray(from, direction);
                let free = ray.take_while(|(metres, at)| {
                    // Beside the frontier there is more of it.
                    let near = *metres < NEAREST_M && self.ground.is_blind(*at);
                    near || self.ground.cell(*at) == Cell::Free
                });
                let far = free.filter(|(metres, _)| *metres >= NEAREST_M);
                let behind = (direction + RAYS / 2) % RAYS;
                far.filter_map(move |(metres, at)| {
                    Some((at, self.is_backed(from, behind, range_m - metres)?))
                })
            })
            .collect();
        // Of two ways to look from one cell the better one.
        views.sort_unstable_by_key(|&(at, is_backed)| (at, !is_backed));
        views.dedup_by_key(|(at, _)| *at);
        views
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::coordination::{
        route::Terrain,
        tests::plan::{Plan, drawn},
    };

    #[test]
    fn each_end_of_the_known_ground_is_found_and_a_long_one_is_shared() {
        let plan = Plan::room(8.0, 6.0);
        // Unknown: the eastern quarter, and a little pocket.
        let hidden = |x: f64, y: f64| x > 6.0 || (x - 1.0).hypot(y - 1.0) < 0.08;
        let ground = drawn(&plan, hidden);
        let found = frontiers(&ground, 2.0, 4.0);
        assert!(found.iter().all(|it| (it.place.x - 6.0).abs() < 0.1), "{found:?}");
        assert!(found.len() >= 3 && found.len() <= 6, "{}", found.len());
        // From the middle of the edge half a disc of 2 m is to be seen: 17 of 32 rays.
        let most = found.iter().map(|it| it.gain_m2).fold(0.0, f64::max);
        assert!(most > 6.2 && most < 6.9, "{most}");
    }

    #[test]
    fn a_frontier_is_looked_at_from_the_last_place_on_the_way_that_was_not_tried() {
        let plan = Plan::room(8.0, 6.0);
        let ground = drawn(&plan, |x, _| x > 6.0);
        let terrain = Terrain::new(&ground, 0.3);
        let ways = terrain.everywhere(Point::new(1.0, 3.0)).unwrap();
        let found = frontiers(&ground, 2.0, 4.0);
        let off = |it: &Frontier| (it.place.y - 3.0).abs();
        let middle = found.iter().min_by(|a, b| off(a).total_cmp(&off(b))).unwrap();
        let view = middle.view(&ground, &ways, &[]).unwrap();
        let away = (view.place - middle.place).norm();
        assert!((NEAREST_M..NEAREST_M + 0.2).contains(&away), "{view:?}");
        let straight = (middle.place - Point::new(1.0, 3.0)).norm();
        assert!(view.metres + away < 1.05 * straight, "{view:?}");
        let tried = Disc { centre: view.place, radius: 0.5 };
        let other = middle.view(&ground, &ways, &[tried]).unwrap();
        assert!((other.place - view.place).norm() > 0.5);
        let all = Disc { centre: middle.place, radius: 3.0 };
        assert!(middle.view(&ground, &ways, &[all]).is_none());
    }
}
