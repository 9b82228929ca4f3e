//! Shortest routes over the ground for one robot.

use super::{
    ground::{Disc, Ground, Point},
    settings::Settings,
};

/// Cost factor of open ground. The factors of other ground are in
/// [`CrossingCosts`](super::settings::CrossingCosts).
const ROOMY: u8 = 2;
/// Marks a cell that can be left but not entered.
const SHUT: u8 = 0;
/// Cost factor for leaving ground with too little clearance.
const LEAVING: u32 = 16;

/// Length of a straight step in fifths of a cell.
const STRAIGHT: u32 = 5;
/// Length of a diagonal step in fifths of a cell; 1 % shorter than exact.
const DIAGONAL: u32 = 7;
/// Steps to the neighbouring cells: columns, rows, and length in fifths of a cell.
const NEIGHBOURS: [(isize, isize, u32); 8] = [
    (1, 0, STRAIGHT),
    (0, 1, STRAIGHT),
    (-1, 0, STRAIGHT),
    (0, -1, STRAIGHT),
    (1, 1, DIAGONAL),
    (-1, 1, DIAGONAL),
    (-1, -1, DIAGONAL),
    (1, -1, DIAGONAL),
];
/// Maximum cost factor of a cell.
const MAX_WEIGHT: u8 = 63;
/// Number of buckets of the queue. It exceeds the largest increase of a route's estimated total
/// cost in one step: [`MAX_WEIGHT`] times a diagonal step, plus the change of the estimate.
const BUCKETS: usize = 512;
const _: () = assert!(((MAX_WEIGHT + ROOMY) as u32 * DIAGONAL) < BUCKETS as u32);
/// A straight line may cost this much more than the steps that it replaces.
const SAME_COST: f64 = 1.1;
/// Maximum distance between consecutive points of a route, in metres.
pub(super) const SPACING_M: f64 = 0.1;

/// The ground as one robot can cross it.
#[derive(Clone, Debug)]
pub(super) struct Terrain<'a> {
    ground: &'a Ground,
    weights: Vec<u8>,
    /// The cost factor of ground with little clearance.
    tight: u8,
    /// The maximum cost factor of ground that nothing makes dear.
    clear: u8,
    /// Squared distance from walls, in cells, that the robot keeps except in narrow places.
    least: u32,
}

impl<'a> Terrain<'a> {
    /// The ground for a robot that needs `room_m` around its centre, in metres.
    pub(super) fn new(ground: &'a Ground, room_m: f64, settings: &Settings) -> Self {
        let costs = &settings.costs;
        // Squared distance, in cells, between the centres of a cell and of an occupied one. Half a
        // cell is added, because the wall begins at the edge of the occupied cell.
        let squared = |metres: f64| {
            let cells = metres / ground.side_m() + 0.5;
            (cells * cells).ceil() as u32
        };
        let (least, roomy) = (squared(room_m), squared(room_m + settings.clearances.spare_m));
        let landmarks = squared(0.5 * settings.range_m);
        let (wall_m, narrow_m) = (settings.clearances.wall_m, settings.clearances.narrow_m);
        let narrow = squared(room_m - wall_m + narrow_m);
        let weight = |at| match (ground.to_wall(at), ground.to_movable(at)) {
            (wall, _) if wall < narrow => SHUT,
            // A robot that has drawn the cell itself, which the server has forgotten, may cross it.
            _ if !ground.is_trusted(at) => costs.unknown.min(MAX_WEIGHT),
            (wall, _) if wall < least => costs.narrow.min(MAX_WEIGHT),
            (_, movable) if movable < least => costs.movable.min(MAX_WEIGHT),
            (wall, movable) if wall.min(movable) < roomy => costs.tight.min(MAX_WEIGHT),
            // Cameras localise the robot there.
            (wall, movable) if wall.min(movable) < landmarks || ground.is_covered(at) => ROOMY,
            _ => costs.empty.min(MAX_WEIGHT),
        };
        let weights = (0..ground.len()).map(weight).collect();
        let [tight, clear] =
            [costs.tight, costs.tight.max(costs.empty)].map(|it| it.min(MAX_WEIGHT));
        Self { ground, weights, tight, clear, least }
    }

    /// Raises the cost factor in a disc to `weight`, at most to [`MAX_WEIGHT`].
    pub(super) fn make_dear(&mut self, disc: &Disc, weight: u8) {
        let Self { ground, weights, .. } = self;
        ground.within(disc, |at| {
            if weights[at] != SHUT {
                weights[at] = weights[at].max(weight.min(MAX_WEIGHT));
            }
        });
    }

    /// Makes a disc impassable; shrinks it if necessary so that `start` stays outside.
    pub(super) fn shut(&mut self, disc: &Disc, start: Point) {
        let Self { ground, weights, .. } = self;
        let radius = disc.radius.min((start - disc.centre).norm() - ground.side_m());
        ground.within(&Disc { radius, ..*disc }, |at| weights[at] = SHUT);
    }

    /// Whether the robot may stand in a cell.
    pub(super) fn is_open(&self, at: usize) -> bool {
        self.weights[at] != SHUT && !self.is_narrow(at)
    }

    /// Whether the robot may stand in a cell that is known, and not close to people, standing robots or movable things.
    pub(super) fn is_clear(&self, at: usize) -> bool {
        self.is_open(at) && self.weights[at] <= self.clear
    }

    /// Whether the robot may cross the cell, but is not sent to stand there.
    fn is_narrow(&self, at: usize) -> bool {
        self.weights[at] != SHUT && self.ground.to_wall(at) < self.least
    }

    /// The cheapest routes from a place to all cells. `None` if the place is outside of the ground.
    /// Cost: a few milliseconds for 100,000 cells.
    pub(super) fn everywhere(&self, from: Point) -> Option<Ways<'_>> {
        Some(self.search(self.ground.at(from)?, |_| 0, |_| false).0)
    }

    /// The cheapest route between two places (A*: Hart, Nilsson and Raphael 1968).
    pub(super) fn route(&self, from: Point, to: Point) -> Option<Vec<Point>> {
        let (start, goal) = (self.ground.at(from)?, self.ground.at(to)?);
        let width = self.ground.width();
        let estimate = |at: usize| {
            let along_x = (at % width).abs_diff(goal % width) as u32;
            let along_y = (at / width).abs_diff(goal / width) as u32;
            let diagonal = along_x.min(along_y);
            let straight = along_x.max(along_y) - diagonal;
            u32::from(ROOMY) * (diagonal * DIAGONAL + straight * STRAIGHT)
        };
        let (ways, found) = self.search(start, estimate, |at| at == goal);
        found?;
        ways.route(from, to)
    }

    /// The cheapest route to the nearest cell for which `will_do` is true.
    pub(super) fn nearest(
        &self,
        from: Point,
        will_do: impl Fn(usize) -> bool,
    ) -> Option<Vec<Point>> {
        let (ways, found) = self.search(self.ground.at(from)?, |_| 0, will_do);
        ways.route(from, self.ground.place(found?))
    }

    /// Dijkstra's search, or A* with a non-zero estimate, up to the first cell for which `will_do`
    /// is true. Returns the routes found so far, and that cell. The queue consists of buckets,
    /// because all costs are small integers (Dial 1969).
    fn search(
        &self,
        start: usize,
        estimate: impl Fn(usize) -> u32,
        will_do: impl Fn(usize) -> bool,
    ) -> (Ways<'_>, Option<usize>) {
        let width = self.ground.width();
        let mut costs = vec![u32::MAX; self.weights.len()];
        let mut towards_start = vec![0isize; self.weights.len()];
        let mut buckets: Vec<Vec<u32>> = vec![Vec::new(); BUCKETS];
        let mut total = estimate(start);
        costs[start] = 0;
        buckets[total as usize % BUCKETS].push(start as u32);
        let mut waiting = 1;
        let mut found = None;
        while waiting > 0 {
            let Some(at) = buckets[total as usize % BUCKETS].pop() else {
                total += 1;
                continue;
            };
            waiting -= 1;
            let at = at as usize;
            let cost = costs[at];
            if cost + estimate(at) != total {
                // The cell was reached at a lower cost since it was queued.
                continue;
            }
            if will_do(at) {
                found = Some(at);
                break;
            }
            for (x, y, length) in NEIGHBOURS {
                let step = y * width as isize + x;
                let next = at.wrapping_add_signed(step);
                let Some(weight) = self.weight_of_step(at, next) else { continue };
                let through = cost + weight * length;
                if through < costs[next] {
                    costs[next] = through;
                    towards_start[next] = -step;
                    buckets[(through + estimate(next)) as usize % BUCKETS].push(next as u32);
                    waiting += 1;
                }
            }
        }
        (Ways { terrain: self, start, costs, towards_start }, found)
    }

    /// Cost factor of a step from the cell `at` to `next`; `None` if it is not allowed. On ground
    /// with too little clearance, a robot may only move towards more clearance; off the floor that robots may
    /// use, only towards it.
    fn weight_of_step(&self, at: usize, next: usize) -> Option<u32> {
        let Self { ground, weights, .. } = self;
        match *weights.get(next)? {
            SHUT if weights[at] == SHUT => {
                let leaves = match (ground.to_floor(at), ground.to_floor(next)) {
                    (0, 0) => ground.to_wall(next) > ground.to_wall(at),
                    (from, to) => to < from,
                };
                leaves.then_some(LEAVING)
            }
            SHUT => None,
            weight => Some(u32::from(weight)),
        }
    }

    /// The corners of a route after string pulling: straight segments that cross nothing more
    /// expensive than the route itself, and cost no more in all.
    fn straightened(&self, cells: &[usize]) -> Vec<usize> {
        let mut corners: Vec<usize> = cells.first().copied().into_iter().collect();
        let mut anchor = 0;
        let (mut dearest, mut cost) = (SHUT, 0);
        for (next, pair) in cells.windows(2).enumerate().map(|(i, pair)| (i + 1, pair)) {
            let (weight, step) = (self.weights[pair[1]], pair[0].abs_diff(pair[1]));
            let is_diagonal = step != 1 && step != self.ground.width();
            let length = if is_diagonal { DIAGONAL } else { STRAIGHT };
            let step = u32::from(self.distinct(weight)) * length;
            (dearest, cost) = (dearest.max(weight), cost + step);
            if next - anchor > 1 && !self.is_straight(cells[anchor], pair[1], (dearest, cost)) {
                corners.push(pair[0]);
                anchor = next - 1;
                (dearest, cost) = (self.weights[pair[0]].max(weight), step);
            }
        }
        corners.extend(cells.last().filter(|_| cells.len() > 1));
        corners
    }

    /// The weight of a cell without the preference for clearance, which corners need not keep.
    fn distinct(&self, weight: u8) -> u8 {
        if weight <= self.tight { ROOMY } else { weight }
    }

    /// Whether all cells on the line between two cells are open and at most as expensive as
    /// `dearest`, and the line costs little more than `cost`.
    fn is_straight(&self, from: usize, to: usize, (dearest, cost): (u8, u32)) -> bool {
        let (a, b) = (self.ground.place(from), self.ground.place(to));
        let cells = (b - a).norm() / self.ground.side_m();
        let steps = (cells * 2.0).ceil();
        let mut sum = 0.0;
        let is_cheap = (0..=steps as usize).all(|step| {
            let on_line = self.ground.at(a + (b - a) * (step as f64 / steps));
            let weight = on_line.map_or(SHUT, |at| self.weights[at]);
            sum += f64::from(self.distinct(weight));
            (ROOMY..=dearest.max(self.tight)).contains(&weight)
        });
        let line = f64::from(STRAIGHT) * cells * sum / (steps + 1.0);
        is_cheap && line <= SAME_COST * f64::from(cost)
    }
}

/// The cheapest routes from one place.
#[derive(Clone, Debug)]
pub(super) struct Ways<'a> {
    terrain: &'a Terrain<'a>,
    start: usize,
    costs: Vec<u32>,
    /// The step to the neighbour that is nearer to the start.
    towards_start: Vec<isize>,
}

impl Ways<'_> {
    /// The cost of the route to a cell, as metres of open ground. `None` if it is unreachable, not on the floor that
    /// robots may use, or too narrow to stand there.
    pub(super) fn metres(&self, at: usize) -> Option<f64> {
        if self.terrain.ground.to_floor(at) > 0 || self.terrain.is_narrow(at) {
            return None;
        }
        let cost = *self.costs.get(at).filter(|cost| **cost < u32::MAX)?;
        Some(
            f64::from(cost) * self.terrain.ground.side_m() / f64::from(u32::from(ROOMY) * STRAIGHT),
        )
    }

    /// The corners of the route from `from`, which is in the start cell, to `to`.
    fn route(&self, from: Point, to: Point) -> Option<Vec<Point>> {
        let goal = self.terrain.ground.at(to).filter(|goal| self.costs[*goal] < u32::MAX)?;
        let mut cells = vec![goal];
        let mut at = goal;
        while at != self.start {
            at = at.wrapping_add_signed(self.towards_start[at]);
            cells.push(at);
        }
        cells.reverse();
        let corners = self.terrain.straightened(&cells);
        let mut route: Vec<Point> =
            corners.iter().map(|&at| self.terrain.ground.place(at)).collect();
        // Use the exact end points instead of the centres of their cells.
        route.pop();
        match route.first_mut() {
            Some(first) => *first = from,
            None => route.push(from),
        }
        route.push(to);
        Some(route)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::coordination::tests::plan::{Plan, drawn};

    /// A room of 6 m by 4 m, divided by a wall with a door of 1 m at its north end.
    fn with_a_wall() -> Plan {
        let mut plan = Plan::room(6.0, 4.0);
        plan.wall(2.9, 0.0, 3.1, 2.9);
        plan
    }

    fn length(route: &[Point]) -> f64 {
        route.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum()
    }

    #[test]
    fn a_route_passes_a_door_with_clearance_on_all_sides() {
        let plan = with_a_wall();
        let ground = drawn(&plan, |_, _| false);
        let terrain = Terrain::new(&ground, 0.3, &Settings::default());
        let (from, to) = (Point::new(1.0, 1.0), Point::new(5.0, 1.0));
        let route = terrain.route(from, to).unwrap();
        assert_eq!((route[0], *route.last().unwrap()), (from, to));
        // The shortest route around a wall that is 0.3 m thicker on all sides: two tangents, two
        // arcs, and the segment between them.
        let to_corner = 1.9f64.hypot(1.9);
        let arc = 0.3 * (core::f64::consts::FRAC_PI_4 + (0.3 / to_corner).asin());
        let shortest = 2.0 * ((to_corner * to_corner - 0.09).sqrt() + arc) + 0.2;
        assert!(length(&route) >= shortest - 0.05, "{} < {shortest}", length(&route));
        assert!(length(&route) < 1.03 * shortest, "{} > {shortest}", length(&route));
        for pair in route.windows(2) {
            for part in 0..=50 {
                let at = pair[0] + (pair[1] - pair[0]) * (f64::from(part) / 50.0);
                assert!(plan.room_around(at) > 0.28, "{at} has {} m", plan.room_around(at));
            }
        }
        assert_eq!(
            Terrain::new(&ground, 0.6, &Settings::default()).route(from, to),
            None,
            "the door is too narrow"
        );
    }

    #[test]
    fn a_narrow_door_is_passed_where_there_is_no_other_but_nobody_stands_in_it() {
        let mut plan = Plan::room(6.0, 4.0);
        plan.wall(2.9, 0.0, 3.1, 1.8);
        plan.wall(2.9, 2.25, 3.1, 3.2);
        let settings = Settings::default();
        let (from, to) = (Point::new(1.0, 1.0), Point::new(5.0, 1.0));
        let route = |plan: &Plan, radius: f64| {
            let ground = drawn(plan, |_, _| false);
            let terrain = Terrain::new(&ground, radius + settings.clearances.wall_m, &settings);
            let door = ground.at(Point::new(3.0, 2.0)).unwrap();
            let ways = terrain.everywhere(from).unwrap();
            assert!(ways.metres(door).is_none() && !terrain.is_open(door));
            terrain.route(from, to)
        };
        let around = route(&plan, 0.15).unwrap();
        assert!(around.iter().any(|at| at.y > 3.2), "the wide door is near: {around:?}");
        plan.wall(2.9, 3.2, 3.1, 4.0);
        let narrow = route(&plan, 0.15).unwrap();
        assert!(narrow.iter().all(|at| plan.room_around(*at) > 0.19), "{narrow:?}");
        assert_eq!(route(&plan, 0.2), None, "the door is 0.45 m wide");
    }

    #[test]
    fn expensive_ground_is_avoided_if_the_detour_is_short() {
        let plan = Plan::room(6.0, 4.0);
        let ground = drawn(&plan, |_, _| false);
        let mut terrain = Terrain::new(&ground, 0.3, &Settings::default());
        let (from, to) = (Point::new(1.0, 2.0), Point::new(5.0, 2.0));
        let standing = Settings::default().costs.standing;
        let somebody = Disc { centre: Point::new(3.0, 2.0), radius: 0.5 };
        assert!((length(&terrain.route(from, to).unwrap()) - 4.0).abs() < 1e-9);
        terrain.make_dear(&somebody, standing);
        let around = terrain.route(from, to).unwrap();
        assert!(length(&around) > 4.1 && length(&around) < 4.5, "{}", length(&around));
        // If there is no way around the disc, it is crossed.
        let across = Disc { centre: Point::new(3.0, 2.0), radius: 2.2 };
        terrain.make_dear(&across, standing);
        assert!(terrain.route(from, to).is_some());
        terrain.shut(&across, from);
        assert_eq!(terrain.route(from, to), None);
    }

    #[test]
    fn outside_camera_coverage_a_route_stays_near_walls() {
        let plan = Plan::room(12.0, 9.0);
        let route = |is_covered: bool, from, to| {
            let ground = plan.ground(is_covered);
            Terrain::new(&ground, 0.3, &Settings::default()).route(from, to).unwrap()
        };
        let to_wall = |at: &Point| plan.room_around(*at);
        let (from, to) = (Point::new(1.0, 4.5), Point::new(11.0, 4.5));
        assert!((length(&route(true, from, to)) - 10.0).abs() < 0.1);
        let along = route(false, from, to);
        let farthest = along.iter().map(to_wall).fold(0.0, f64::max);
        assert!(farthest < 2.2 && length(&along) < 14.0, "{along:?}");
        // The same from the middle of the hall, where the line begins on such ground anyway.
        let (from, to) = (Point::new(6.0, 4.0), Point::new(11.0, 4.5));
        let along = route(false, from, to);
        assert!(along.iter().skip(1).map(to_wall).fold(0.0, f64::max) < 2.2, "{along:?}");
        // It does cross the hall if the way along the walls is more than twice as long.
        let (from, to) = (Point::new(6.0, 2.5), Point::new(6.0, 6.5));
        assert!(length(&route(false, from, to)) < 4.1);
    }

    #[test]
    fn a_robot_can_leave_ground_near_a_wall_but_not_enter_it() {
        let plan = Plan::room(6.0, 4.0);
        let ground = drawn(&plan, |_, _| false);
        let terrain = Terrain::new(&ground, 0.3, &Settings::default());
        let (near, far) = (Point::new(0.15, 2.0), Point::new(3.0, 2.0));
        assert!(terrain.route(near, far).is_some());
        assert_eq!(terrain.route(far, near), None);
    }
}
