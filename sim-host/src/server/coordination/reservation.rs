//! Reserves ground so that robots neither collide nor deadlock: no two robots hold the same place,
//! and robots never wait for each other in a cycle.
//!
//! Each robot's whole route is known in advance, and is granted piece by piece. It holds the discs
//! around the granted points that it has not passed yet. By the banker's algorithm (Dijkstra 1965;
//! for vehicles Reveliotis 2000) a piece is granted only if the resulting state is safe: the robots
//! can be ordered so that each in turn can drive its whole route, while those later in the order
//! stay on the ground that they hold, and those earlier stand at the ends of their routes. This
//! follows from two rules for pairs of robots:
//!
//! - if a route crosses ground that another robot holds, the other robot goes first;
//! - if a route crosses the end of another robot's route, the robot that crosses goes first.
//!
//! Such an order exists exactly if these precedences have no cycle, and the first robot in it can
//! be granted its whole route.

use ubimap_protocol::message::MAX_WAYPOINTS;

use super::{ground::Point, route::SPACING_M, settings::GrantingRules};

/// Number of points after a robot's last position on its route among which it is located. Limited
/// because a route may cross itself.
const SEARCHED_POINTS: usize = 8;

/// How much closer than usual two robots are that hold each other up, in metres; less is for the errors of poses.
const TOO_CLOSE_M: f64 = 0.05;
/// How much closer one point of such a robot's route may be than it is itself, in metres: less than the way to
/// it, so that no route leads closer.
const TANGENT_M: f64 = 0.01;

/// The ground that one robot holds, and the rest of its route.
#[derive(Clone, Debug)]
pub(super) struct Claim {
    /// The robot's last known position.
    position: Point,
    /// Radius of the discs that the robot holds, in metres.
    disc_m: f64,
    /// The part of `disc_m` beyond the robot's radius while the robot has a destination, in metres.
    margin_m: f64,
    /// The route; never empty. Points are at most [`SPACING_M`] apart.
    points: Vec<Point>,
    /// Indices of the corners among the points, including the last point.
    corners: Vec<usize>,
    /// Index of the point where the robot is, and of the last granted point.
    tail: usize,
    granted: usize,
    /// Index of the last point that was sent to the robot.
    sent: usize,
}

impl Claim {
    /// The claim of a standing robot with this radius. `margin_m` is the tolerance for driving
    /// beside the route. Both in metres.
    pub(super) fn standing(position: Point, radius_m: f64, margin_m: f64) -> Self {
        let disc_m = radius_m + margin_m;
        let (points, corners) = (vec![position], vec![0]);
        Self { position, disc_m, margin_m, points, corners, tail: 0, granted: 0, sent: 0 }
    }

    /// Sets the robot's radius. A robot without a destination (`has_nowhere_to_go`) holds a disc
    /// without margin.
    pub(super) fn set_radius(&mut self, radius_m: f64, has_nowhere_to_go: bool) {
        self.disc_m = if has_nowhere_to_go { radius_m } else { radius_m + self.margin_m };
    }

    pub(super) fn position(&self) -> Point {
        self.position
    }

    pub(super) fn disc_m(&self) -> f64 {
        self.disc_m
    }

    /// Distance that this robot and another one keep, in metres. Robots that have stopped closer to each other, as
    /// when the server was away, may drive apart: they would hold each other up for ever.
    pub(super) fn reach(&self, other: &Self) -> f64 {
        let usual = self.disc_m + other.disc_m;
        let apart = (self.position - other.position).norm();
        if apart < usual - TOO_CLOSE_M { apart - TANGENT_M } else { usual }
    }

    /// The end of the granted part of the route.
    pub(super) fn granted_end(&self) -> Point {
        self.points[self.granted]
    }

    /// The end of the route.
    pub(super) fn end(&self) -> Point {
        self.points[self.points.len() - 1]
    }

    /// Whether the whole route is granted.
    pub(super) fn is_all_granted(&self) -> bool {
        self.granted + 1 == self.points.len()
    }

    /// Whether the robot has driven the whole route.
    pub(super) fn is_at_end(&self) -> bool {
        self.is_all_granted() && self.is_at_grant()
    }

    /// Whether the robot is at the end of the granted part.
    pub(super) fn is_at_grant(&self) -> bool {
        self.tail == self.granted
    }

    /// Straight-line distance from the robot to the end of the granted part, in metres.
    pub(super) fn to_grant_m(&self) -> f64 {
        (self.granted_end() - self.position).norm()
    }

    /// Length of the granted part ahead of the robot, in metres.
    fn granted_m(&self) -> f64 {
        (self.granted - self.tail) as f64 * SPACING_M
    }

    /// The points that the robot holds: the granted points that it has not passed, and its position
    /// if it is off the route.
    pub(super) fn held(&self) -> impl Iterator<Item = Point> {
        let is_beside = self.off_m() > self.margin_m;
        let beside = is_beside.then_some(self.position);
        self.points[self.tail..=self.granted].iter().copied().chain(beside)
    }

    /// Distance of the robot from its route in metres.
    pub(super) fn off_m(&self) -> f64 {
        (self.points[self.tail] - self.position).norm()
    }

    /// The part of the route that is not granted yet.
    pub(super) fn ahead(&self) -> &[Point] {
        &self.points[self.granted + 1..]
    }

    /// The point of the route at this distance ahead of the robot, in metres, or the end of the
    /// route.
    pub(super) fn point_before(&self, metres: f64) -> Point {
        let at = self.tail + (metres / SPACING_M) as usize;
        self.points[at.min(self.points.len() - 1)]
    }

    /// The corners and the last point of the granted part, if it is time to send them: enough
    /// points were granted since the last path, and the robot approaches the end of that path. At
    /// most [`MAX_WAYPOINTS`].
    pub(super) fn poll_path(&mut self, rules: &GrantingRules) -> Option<Vec<Point>> {
        let known = self.sent.saturating_sub(self.tail);
        let more = self.granted.saturating_sub(self.sent);
        let is_worth_it = more >= rules.least_points || self.is_all_granted();
        if more == 0 || known > rules.urgent_points && (known > rules.low_points || !is_worth_it) {
            return None;
        }
        let corners =
            self.corners.iter().copied().filter(|at| *at > self.tail && *at < self.granted);
        let path: Vec<usize> = corners.chain([self.granted]).take(MAX_WAYPOINTS).collect();
        self.sent = path.last().copied().unwrap_or(self.granted);
        Some(path.iter().map(|&at| self.points[at]).collect())
    }

    /// Causes the path to be sent again, because the robot may not have received it.
    pub(super) fn forget_sent(&mut self) {
        self.sent = self.tail;
    }

    /// Updates the robot's position and releases the ground that it has passed. A robot that has
    /// finished beside the end of its route holds its position instead of the end.
    pub(super) fn advance(&mut self, position: Point) {
        self.position = position;
        let off = |at: &usize| (self.points[*at] - position).norm();
        let window = self.tail..=self.granted.min(self.tail + SEARCHED_POINTS);
        self.tail = window.min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(self.tail);
        if self.is_at_end() && self.off_m() > self.margin_m {
            self.stand();
        }
    }

    /// Sets the robot's place on the route to the end of the granted part.
    pub(super) fn arrive(&mut self) {
        self.tail = self.granted;
    }

    /// Releases the route; the robot holds only its position.
    pub(super) fn stand(&mut self) {
        *self = Self { disc_m: self.disc_m, ..Self::standing(self.position, 0.0, self.margin_m) };
    }

    fn drop_ahead(&mut self) {
        self.points.truncate(self.granted + 1);
        self.corners.retain(|&at| at < self.granted);
        self.corners.push(self.granted);
    }

    /// Replaces the route beyond the granted part by a new one, given by its corners.
    fn set_route(&mut self, corners: &[Point]) {
        self.drop_ahead();
        self.points.drain(..self.tail);
        self.corners.retain(|&at| at >= self.tail);
        self.corners.iter_mut().for_each(|at| *at -= self.tail);
        self.granted -= self.tail;
        self.sent = self.sent.saturating_sub(self.tail);
        self.tail = 0;
        for pair in corners.windows(2) {
            let way = pair[1] - pair[0];
            let parts = (way.norm() / SPACING_M).ceil().max(1.0);
            let part = |part| pair[0] + way * (f64::from(part) / parts);
            self.points.extend((1..parts as u32).map(part));
            self.points.push(pair[1]);
            self.corners.push(self.points.len() - 1);
        }
    }
}

/// The claims of all robots, which are identified by their index.
#[derive(Clone, Debug, Default)]
pub(super) struct Reservations {
    claims: Vec<Claim>,
    /// For each pair of robots, whether the one (row) must go before the other (column), row by
    /// row.
    precedes: Vec<bool>,
}

/// What limited the extension of a robot's grant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Held {
    /// Nothing: the grant was extended as requested.
    NotAtAll,
    /// Another robot holds the next place, or must go there first.
    ByRobots,
    /// A person stands there.
    ByOthers,
}

impl Reservations {
    /// Inserts a robot at an index.
    pub(super) fn insert(&mut self, index: usize, claim: Claim) {
        self.claims.insert(index, claim);
        self.order_anew();
    }

    pub(super) fn claim(&self, robot: usize) -> &Claim {
        &self.claims[robot]
    }

    pub(super) fn claims(&self) -> &[Claim] {
        &self.claims
    }

    /// A robot's claim for changes; call [`Self::order_anew`] after the last change.
    pub(super) fn claim_mut(&mut self, robot: usize) -> &mut Claim {
        &mut self.claims[robot]
    }

    /// Drops a robot's route beyond the granted part.
    pub(super) fn drop_ahead(&mut self, robot: usize) {
        self.claims[robot].drop_ahead();
        self.order(robot);
    }

    /// Recomputes all precedences. Cost: some 10 microseconds for ten robots.
    pub(super) fn order_anew(&mut self) {
        let count = self.claims.len();
        self.precedes.clear();
        self.precedes.resize(count * count, false);
        (0..count).for_each(|robot| self.order(robot));
    }

    /// Recomputes the precedences of one robot.
    fn order(&mut self, robot: usize) {
        let count = self.claims.len();
        for other in (0..count).filter(|other| *other != robot) {
            let (mine, its) = (&self.claims[robot], &self.claims[other]);
            let reach = mine.reach(its);
            let it_first = is_crossed(mine.ahead(), its.held(), reach)
                || is_crossed(its.ahead(), [mine.end()], reach);
            let me_first = is_crossed(its.ahead(), mine.held(), reach)
                || is_crossed(mine.ahead(), [its.end()], reach);
            self.precedes[other * count + robot] = it_first;
            self.precedes[robot * count + other] = me_first;
        }
    }

    /// Whether a robot is on a cycle of precedences, so that it must, indirectly, go before itself.
    pub(super) fn is_on_cycle(&self, robot: usize) -> bool {
        let count = self.claims.len();
        let mut seen = vec![false; count];
        let mut open = vec![robot];
        while let Some(at) = open.pop() {
            for next in (0..count).filter(|next| self.precedes[at * count + next]) {
                if next == robot {
                    return true;
                }
                if !seen[next] {
                    seen[next] = true;
                    open.push(next);
                }
            }
        }
        false
    }

    /// Replaces a robot's route beyond its grant by a new one, given by its corners, without
    /// checks. The precedences are invalid until [`Self::order_anew`].
    pub(super) fn plan(&mut self, robot: usize, corners: &[Point]) {
        self.claims[robot].set_route(corners);
    }

    /// Replaces the robots' routes beyond their grants by new ones, given by their corners, if all
    /// robots can then still finish. Either all routes are replaced or none; returns whether they
    /// were.
    pub(super) fn admit(&mut self, routes: &[(usize, Vec<Point>)]) -> bool {
        let before = self.clone();
        for (robot, corners) in routes {
            self.plan(*robot, corners);
        }
        routes.iter().for_each(|(robot, _)| self.order(*robot));
        let is_safe = !routes.iter().any(|(robot, _)| self.is_on_cycle(*robot));
        if !is_safe {
            *self = before;
        }
        is_safe
    }

    /// Extends a robot's grant up to `metres` ahead of it, as far as that is safe and no place is
    /// held by another robot or `taken`. Returns what limited it.
    pub(super) fn extend(
        &mut self,
        robot: usize,
        metres: f64,
        taken: impl Fn(Point) -> bool,
    ) -> Held {
        loop {
            let claim = &self.claims[robot];
            let Some(&next) = claim.ahead().first() else { return Held::NotAtAll };
            if claim.granted_m() >= metres {
                return Held::NotAtAll;
            }
            if taken(next) {
                return Held::ByOthers;
            }
            let mut others = self.claims.iter().enumerate().filter(|(other, _)| *other != robot);
            if others.any(|(_, it)| is_crossed(&[next], it.held(), claim.reach(it))) {
                return Held::ByRobots;
            }
            self.claims[robot].granted += 1;
            self.order(robot);
            if self.is_on_cycle(robot) {
                self.claims[robot].granted -= 1;
                self.order(robot);
                return Held::ByRobots;
            }
        }
    }
}

/// Whether any point of a route is closer than `reach` to one of the places.
pub(super) fn is_crossed(
    route: &[Point],
    places: impl IntoIterator<Item = Point>,
    reach: f64,
) -> bool {
    places.into_iter().any(|place| {
        let mut at = 0;
        while let Some(point) = route.get(at) {
            let spare = (point - place).norm() - reach;
            if spare < 0.0 {
                return true;
            }
            // The next point within reach is at least this far along the route.
            at += ((spare / SPACING_M) as usize).max(1);
        }
        false
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn at(x: f64, y: f64) -> Point {
        Point::new(x, y)
    }

    fn of(starts: &[Point]) -> Reservations {
        let mut all = Reservations::default();
        for (index, &start) in starts.iter().enumerate() {
            all.insert(index, Claim::standing(start, 0.3, 0.1));
        }
        all
    }

    #[test]
    fn granted_ground_is_held_until_it_is_passed() {
        let mut all = of(&[at(0.0, 0.0)]);
        assert!(all.admit(&[(0, vec![at(0.0, 0.0), at(2.0, 0.0), at(2.0, 2.0)])]));
        assert_eq!(all.extend(0, 2.5, |_| false), Held::NotAtAll);
        assert!((all.claim(0).granted_end() - at(2.0, 0.5)).norm() < 1e-9);
        let path = all.claim_mut(0).poll_path(&GrantingRules::default()).unwrap();
        assert_eq!(path, [at(2.0, 0.0), all.claim(0).granted_end()]);
        assert_eq!(
            all.claim_mut(0).poll_path(&GrantingRules::default()),
            None,
            "nothing new to send"
        );
        all.claim_mut(0).advance(at(0.52, 0.05));
        assert!(all.claim(0).off_m() < 0.06);
        assert!(all.claim(0).held().all(|point| point.x > 0.45));
        assert_eq!(all.extend(0, 9.0, |place| place.y > 1.0), Held::ByOthers);
        assert!(all.claim(0).granted_end().y < 1.05);
    }

    #[test]
    fn opposing_routes_are_never_granted() {
        let mut all = of(&[at(0.0, 0.0), at(5.0, 0.0)]);
        assert!(!all.admit(&[(0, vec![at(0.0, 0.0), at(6.0, 0.0)])]), "blocked by the other robot");
        assert!(all.admit(&[(0, vec![at(0.0, 0.0), at(4.0, 0.0), at(4.0, 3.0)])]));
        assert!(
            all.admit(&[(1, vec![at(5.0, 0.0), at(-1.0, 0.0)])]),
            "safe after the other robot has gone"
        );
        all.extend(1, 9.0, |_| false);
        assert!(all.claim(1).granted_end().x > 4.7, "{}", all.claim(1).granted_end());
        assert_eq!(all.extend(0, 9.0, |_| false), Held::NotAtAll);
    }

    #[test]
    fn robots_that_stand_too_close_drive_apart() {
        let mut all = of(&[at(0.0, 0.0), at(0.5, 0.0)]);
        assert!(!all.admit(&[(0, vec![at(0.0, 0.0), at(2.0, 0.0)])]), "through the other robot");
        assert!(all.admit(&[(0, vec![at(0.0, 0.0), at(-1.0, 0.5)])]));
        assert!(all.admit(&[(1, vec![at(0.5, 0.0), at(0.5, 3.0)])]));
        for robot in [0, 1] {
            assert_eq!(all.extend(robot, 9.0, |_| false), Held::NotAtAll);
        }
        // Apart from each other they keep the usual distance again.
        for robot in [0, 1] {
            let end = all.claim(robot).end();
            all.claim_mut(robot).advance(end);
            all.claim_mut(robot).arrive();
        }
        assert_eq!(all.claim(0).reach(all.claim(1)), 0.8);
    }

    /// Robots at random places with random routes. In any order of granting ground, all robots must
    /// finish after a finite number of steps.
    fn check_progress(starts: &[(f64, f64)], ends: &[(f64, f64)], turns: &[usize]) {
        let mut places: Vec<Point> = Vec::new();
        for &(x, y) in starts {
            if places.iter().all(|it| (it - at(x, y)).norm() > 0.8) {
                places.push(at(x, y));
            }
        }
        let mut all = of(&places);
        for (robot, &(x, y)) in (0..places.len()).zip(ends) {
            all.admit(&[(robot, vec![places[robot], at(x, y)])]);
        }
        for &turn in turns {
            let robot = turn % places.len();
            all.extend(robot, 0.1 + (turn % 7) as f64 * 0.3, |_| false);
            if turn % 3 == 0 {
                let to = all.claim(robot).point_before(0.3);
                let to = if all.claim(robot).granted_m() > 0.3 {
                    to
                } else {
                    all.claim(robot).granted_end()
                };
                all.claim_mut(robot).advance(to);
                all.order_anew();
            }
            for (one, claim) in all.claims().iter().enumerate() {
                for other in &all.claims()[one + 1..] {
                    let held: Vec<Point> = claim.held().collect();
                    assert!(!is_crossed(&held, other.held(), 0.8 - 1e-9));
                }
            }
        }
        // In each round at least the first robot in the order reaches its end.
        for _ in 0..places.len() {
            for robot in 0..places.len() {
                all.extend(robot, f64::MAX, |_| false);
                let end = all.claim(robot).granted_end();
                all.claim_mut(robot).advance(end);
                all.claim_mut(robot).arrive();
                all.order_anew();
            }
        }
        assert!(all.claims().iter().all(Claim::is_all_granted));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn all_robots_finish_whatever_is_granted(
            starts in proptest::collection::vec((0.0..6.0, 0.0..4.0), 2..9),
            ends in proptest::collection::vec((0.0..6.0, 0.0..4.0), 9),
            turns in proptest::collection::vec(0usize..1000, 1..60),
        ) {
            check_progress(&starts, &ends, &turns);
        }
    }
}
