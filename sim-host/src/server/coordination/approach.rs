//! Chooses the viewpoint from which a robot looks at a frontier: close to it, reached at low cost,
//! and not in the way of other robots.

use super::{
    frontiers::{Frontier, Vantage},
    ground::{Disc, Ground, Point},
    route::{Terrain, Ways},
    settings::ViewpointCosts,
};

/// The inputs for choosing a robot's viewpoints.
pub(super) struct Approach<'a> {
    pub(super) ground: &'a Ground,
    pub(super) terrain: Terrain<'a>,
    /// The robot's start position, and its heading in radians.
    pub(super) from: Point,
    pub(super) heading: f64,
    /// For each cell, whether the robot would block another robot there.
    pub(super) in_the_way: Vec<bool>,
    /// Areas around viewpoints that have failed.
    pub(super) tried: &'a [Disc],
    /// The costs by which viewpoints are compared.
    pub(super) rules: &'a ViewpointCosts,
}

/// Where to stand to look at a frontier.
#[derive(Clone, Copy, Debug)]
pub(super) struct Viewpoint {
    pub(super) place: Point,
    /// Cost of driving there, in metres; includes turning and waiting.
    pub(super) cost_m: f64,
}

impl Approach<'_> {
    /// For each frontier, the reachable viewpoint with the lowest cost, except failed ones. `None`
    /// if there is none. Cost: one search.
    pub(super) fn views(&self, frontiers: &[&Frontier]) -> Vec<Option<Viewpoint>> {
        if frontiers.is_empty() {
            return Vec::new();
        }
        let ways = self.terrain.everywhere(self.from);
        frontiers.iter().map(|frontier| self.view(frontier, ways.as_ref()?)).collect()
    }

    /// For each frontier, the reachable place closest to it, from which the robot checks again what
    /// blocks the way. Excludes failed viewpoints, places near the robot, and places where it would
    /// block others. Cost: one search.
    pub(super) fn before(&self, frontiers: &[&Frontier]) -> Vec<Option<Viewpoint>> {
        let ways = self.terrain.everywhere(self.from);
        let view = |at| {
            let cost_m = ways.as_ref()?.metres(at)?;
            Some(Viewpoint { place: self.ground.place(at), cost_m })
        };
        let is_afresh = |view: &Viewpoint| (view.place - self.from).norm() >= self.rules.afresh_m;
        let places = (0..self.ground.len()).filter(|&at| !self.in_the_way[at]).filter_map(view);
        let places: Vec<Viewpoint> =
            places.filter(|view| is_afresh(view) && self.is_untried(view)).collect();
        let nearest = |frontier: &&Frontier| {
            let away = |view: &Viewpoint| (view.place - frontier.place).norm();
            places.iter().copied().min_by(|a, b| away(a).total_cmp(&away(b)))
        };
        frontiers.iter().map(nearest).collect()
    }

    fn is_untried(&self, view: &Viewpoint) -> bool {
        self.tried.iter().all(|disc| (view.place - disc.centre).norm() > disc.radius)
    }

    fn view(&self, frontier: &Frontier, ways: &Ways<'_>) -> Option<Viewpoint> {
        let view = |&Vantage { at, away_m, is_backed }: &Vantage| {
            let place = self.ground.place(at);
            let waiting = if self.in_the_way[at] { self.rules.wait_m } else { 0.0 };
            let cost_m = ways.metres(at)? + self.turn_m(place) + waiting;
            let doubt = if is_backed { 0.0 } else { self.rules.unbacked_m };
            Some((cost_m + self.rules.away * away_m + doubt, Viewpoint { place, cost_m }))
        };
        let views = frontier.vantages.iter().filter_map(view);
        let views = views.filter(|(_, view)| self.is_untried(view));
        views.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, view)| view)
    }

    /// The cost of turning towards a place, in metres.
    fn turn_m(&self, place: Point) -> f64 {
        let way = place - self.from;
        if way.norm() < self.rules.here_m {
            return 0.0;
        }
        let off = libm::atan2(way.y, way.x) - self.heading;
        self.rules.turn_m * libm::acos(libm::cos(off))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::coordination::{
        frontiers::frontiers,
        settings::{CrossingCosts, Settings},
        tests::plan::{Plan, drawn},
    };

    #[test]
    fn the_viewpoint_is_the_last_untried_one_on_the_way() {
        let plan = Plan::room(8.0, 6.0);
        let ground = drawn(&plan, |x, _| x > 6.0);
        let from = Point::new(1.0, 3.0);
        // Here a metre of driving costs the same everywhere.
        let costs = CrossingCosts { empty: 2, ..CrossingCosts::default() };
        let settings = Settings { view_m: 2.0, costs, ..Settings::default() };
        let (nearest_m, turn_m) = (settings.frontiers.nearest_m, settings.viewpoints.turn_m);
        let found = frontiers(&ground, &settings);
        let off = |it: &&Frontier| (it.place.y - 3.0).abs();
        let middle = found.iter().min_by(|a, b| off(a).total_cmp(&off(b))).unwrap();
        let view = |heading: f64, tried: &[Disc], is_in_the_way: &dyn Fn(Point) -> bool| {
            let in_the_way = (0..ground.len()).map(|at| is_in_the_way(ground.place(at))).collect();
            let terrain = Terrain::new(&ground, 0.3, &settings);
            let rules = &settings.viewpoints;
            let approach =
                Approach { ground: &ground, terrain, from, heading, in_the_way, tried, rules };
            approach.views(&[middle])[0]
        };
        let nowhere = |_| false;
        let best = view(0.0, &[], &nowhere).unwrap();
        // The viewpoint need not be opposite the middle: the frontier extends a metre to both
        // sides.
        let away = (best.place - middle.place).norm();
        assert!((nearest_m..nearest_m + 1.0).contains(&away), "{best:?}");
        let straight = (middle.place - from).norm();
        assert!(best.cost_m < straight && best.cost_m + nearest_m > 0.95 * straight, "{best:?}");
        // Turning round first takes time, as does waiting for others.
        let turned = view(core::f64::consts::PI, &[], &nowhere).unwrap();
        assert!((turned.cost_m - best.cost_m - turn_m * core::f64::consts::PI).abs() < 0.1);
        let near = |place: Point| (place - best.place).norm() < 0.3;
        let beside = view(0.0, &[], &near).unwrap();
        assert!((beside.place - best.place).norm() >= 0.3, "{beside:?}");
        let tried = Disc { centre: best.place, radius: 0.5 };
        let other = view(0.0, &[tried], &nowhere).unwrap();
        assert!((other.place - best.place).norm() > 0.5);
        let all = Disc { centre: middle.place, radius: 4.0 };
        assert!(view(0.0, &[all], &nowhere).is_none());
    }
}
