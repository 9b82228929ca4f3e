//! Who holds which floor, and who may have more of it: no two robots hold the same place, and
//! never does everybody wait for somebody else.
//!
//! A robot states its whole route beforehand and is granted it piece by piece. What it holds are
//! the discs about the granted points that it has not passed. By the banker's algorithm (Dijkstra
//! 1965; for vehicles Reveliotis 2000) a piece is granted if afterwards there is an order in which
//! each robot in turn can drive its whole route, while those after it stay where they hold and
//! those before it stand at their ends. That is a question of pairs:
//!
//! - a route crosses what another one holds: the other goes first;
//! - a route crosses the place where another one ends: it goes itself first.
//!
//! So there is such an order exactly if these precedences have no cycle, and whoever is first in
//! it can be granted all of its route.

use ubimap_protocol::message::MAX_WAYPOINTS;

use super::{ground::Point, route::SPACING_M, settings::GrantingRules};

/// Points ahead of where a robot was on its route among which its place is looked for. A route may
/// cross itself, so not all of it is searched.
const SEARCHED_POINTS: usize = 8;

/// What one robot holds and will need.
#[derive(Clone, Debug)]
pub(super) struct Claim {
    /// Where the robot was seen last.
    position: Point,
    /// The radius of the discs that it holds, in metres.
    disc_m: f64,
    /// The part of that beyond the robot's own radius while it follows a route, in metres.
    margin_m: f64,
    /// The route; never empty. From point to point [`SPACING_M`] at most.
    points: Vec<Point>,
    /// Which of the points are its corners, the last one included.
    corners: Vec<usize>,
    /// The point where the robot is, and the last one that it may drive to.
    tail: usize,
    granted: usize,
    /// The point up to which it was sent its route.
    sent: usize,
}

impl Claim {
    /// A robot of this radius that stands at a place and may be this far off its route, in metres.
    pub(super) fn standing(position: Point, radius_m: f64, margin_m: f64) -> Self {
        let disc_m = radius_m + margin_m;
        let (points, corners) = (vec![position], vec![0]);
        Self { position, disc_m, margin_m, points, corners, tail: 0, granted: 0, sent: 0 }
    }

    /// A robot without a destination holds no more than it takes up.
    pub(super) fn set_radius(&mut self, radius_m: f64, has_nowhere_to_go: bool) {
        self.disc_m = if has_nowhere_to_go { radius_m } else { radius_m + self.margin_m };
    }

    pub(super) fn position(&self) -> Point {
        self.position
    }

    pub(super) fn disc_m(&self) -> f64 {
        self.disc_m
    }

    /// Where it may drive now.
    pub(super) fn granted_end(&self) -> Point {
        self.points[self.granted]
    }

    /// Where its route ends.
    pub(super) fn end(&self) -> Point {
        self.points[self.points.len() - 1]
    }

    /// Whether it has no route beyond what it may drive now.
    pub(super) fn is_all_granted(&self) -> bool {
        self.granted + 1 == self.points.len()
    }

    /// Whether it has driven all of its route.
    pub(super) fn is_at_end(&self) -> bool {
        self.is_all_granted() && self.is_at_grant()
    }

    /// Whether it is where it may drive to.
    pub(super) fn is_at_grant(&self) -> bool {
        self.tail == self.granted
    }

    /// How far it is from where it may drive to, as the crow flies, in metres.
    pub(super) fn to_grant_m(&self) -> f64 {
        (self.granted_end() - self.position).norm()
    }

    /// Metres that it may still drive.
    fn granted_m(&self) -> f64 {
        (self.granted - self.tail) as f64 * SPACING_M
    }

    /// The points that it holds: those that it was granted and has not passed, and where it is if
    /// that is beside them.
    pub(super) fn held(&self) -> impl Iterator<Item = Point> {
        let is_beside = self.off_m() > self.margin_m;
        let beside = is_beside.then_some(self.position);
        self.points[self.tail..=self.granted].iter().copied().chain(beside)
    }

    /// How far it is from its route, in metres.
    pub(super) fn off_m(&self) -> f64 {
        (self.points[self.tail] - self.position).norm()
    }

    /// The part of the route that is not granted yet.
    pub(super) fn ahead(&self) -> &[Point] {
        &self.points[self.granted + 1..]
    }

    /// The point of the route at a distance ahead of the robot, in metres, or the end of the route.
    pub(super) fn point_before(&self, metres: f64) -> Point {
        let at = self.tail + (metres / SPACING_M) as usize;
        self.points[at.min(self.points.len() - 1)]
    }

    /// The corners of what it was granted, the last granted point included, if it should be sent
    /// them: it was granted enough more than it knows, and comes near the end of what it knows.
    /// At most [`MAX_WAYPOINTS`] of them.
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

    /// The robot may have forgotten its path: it is sent again.
    pub(super) fn forget_sent(&mut self) {
        self.sent = self.tail;
    }

    /// The robot was seen here: it gives up what it has passed. One that has come to its end, and
    /// is beside it, holds the place where it is instead.
    pub(super) fn advance(&mut self, position: Point) {
        self.position = position;
        let off = |at: &usize| (self.points[*at] - position).norm();
        let window = self.tail..=self.granted.min(self.tail + SEARCHED_POINTS);
        self.tail = window.min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(self.tail);
        if self.is_at_end() && self.off_m() > self.margin_m {
            self.stand();
        }
    }

    /// The robot is at the end of what it may drive.
    pub(super) fn arrive(&mut self) {
        self.tail = self.granted;
    }

    /// It stands where it is and holds no more than that.
    pub(super) fn stand(&mut self) {
        *self = Self { disc_m: self.disc_m, ..Self::standing(self.position, 0.0, self.margin_m) };
    }

    fn drop_ahead(&mut self) {
        self.points.truncate(self.granted + 1);
        self.corners.retain(|&at| at < self.granted);
        self.corners.push(self.granted);
    }

    /// Gives it a route, by its corners, from the end of its grant.
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

/// What all robots hold and will need. A robot is named by its index.
#[derive(Clone, Debug, Default)]
pub(super) struct Reservations {
    claims: Vec<Claim>,
    /// Whether the one robot must go before the other, row by row.
    precedes: Vec<bool>,
}

/// Why a robot may not drive farther.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Held {
    /// It has all of its route.
    NotAtAll,
    /// Another robot holds the next place, or must go there first.
    ByRobots,
    /// A person stands there.
    ByOthers,
}

impl Reservations {
    /// Adds a robot before the one that has this index now.
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

    /// Changes what a robot holds; call [`Self::order_anew`] after the last of such changes.
    pub(super) fn claim_mut(&mut self, robot: usize) -> &mut Claim {
        &mut self.claims[robot]
    }

    /// A robot has no route any more beyond what it may drive.
    pub(super) fn drop_ahead(&mut self, robot: usize) {
        self.claims[robot].drop_ahead();
        self.order(robot);
    }

    /// Finds all precedences anew. Some ten microseconds for ten robots.
    pub(super) fn order_anew(&mut self) {
        let count = self.claims.len();
        self.precedes.clear();
        self.precedes.resize(count * count, false);
        (0..count).for_each(|robot| self.order(robot));
    }

    /// Finds the precedences of one robot anew.
    fn order(&mut self, robot: usize) {
        let count = self.claims.len();
        for other in (0..count).filter(|other| *other != robot) {
            let (mine, its) = (&self.claims[robot], &self.claims[other]);
            let reach = mine.disc_m + its.disc_m;
            let it_first = is_crossed(mine.ahead(), its.held(), reach)
                || is_crossed(its.ahead(), [mine.end()], reach);
            let me_first = is_crossed(its.ahead(), mine.held(), reach)
                || is_crossed(mine.ahead(), [its.end()], reach);
            self.precedes[other * count + robot] = it_first;
            self.precedes[robot * count + other] = me_first;
        }
    }

    /// Whether a robot must go before others that must go before it.
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

    /// Gives a robot a route, by its corners, from the end of its grant, whatever the others do.
    /// What the precedences are then is not known before [`Self::order_anew`].
    pub(super) fn plan(&mut self, robot: usize, corners: &[Point]) {
        self.claims[robot].set_route(corners);
    }

    /// Gives robots routes, by their corners, from the ends of their grants, all or none: whether
    /// there is an order in which all can be driven.
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

    /// Grants a robot its route up to a distance ahead of it, in metres, as far as that is safe and no
    /// place is held by a robot or `taken` otherwise. Returns what holds it back.
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
            if others.any(|(_, it)| is_crossed(&[next], it.held(), claim.disc_m + it.disc_m)) {
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

/// Whether a point of a route is nearer than `reach` to one of some places.
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
            // A point that is near enough is at least this far along the route.
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
    fn a_robot_holds_what_it_was_granted_until_it_has_passed() {
        let mut all = of(&[at(0.0, 0.0)]);
        assert!(all.admit(&[(0, vec![at(0.0, 0.0), at(2.0, 0.0), at(2.0, 2.0)])]));
        assert_eq!(all.extend(0, 2.5, |_| false), Held::NotAtAll);
        assert!((all.claim(0).granted_end() - at(2.0, 0.5)).norm() < 1e-9);
        let path = all.claim_mut(0).poll_path(&GrantingRules::default()).unwrap();
        assert_eq!(path, [at(2.0, 0.0), all.claim(0).granted_end()]);
        assert_eq!(all.claim_mut(0).poll_path(&GrantingRules::default()), None, "it knows that");
        all.claim_mut(0).advance(at(0.52, 0.05));
        assert!(all.claim(0).off_m() < 0.06);
        assert!(all.claim(0).held().all(|point| point.x > 0.45));
        assert_eq!(all.extend(0, 9.0, |place| place.y > 1.0), Held::ByOthers);
        assert!(all.claim(0).granted_end().y < 1.05);
    }

    #[test]
    fn nose_to_nose_is_never_granted() {
        let mut all = of(&[at(0.0, 0.0), at(5.0, 0.0)]);
        assert!(!all.admit(&[(0, vec![at(0.0, 0.0), at(6.0, 0.0)])]), "the other one stands there");
        assert!(all.admit(&[(0, vec![at(0.0, 0.0), at(4.0, 0.0), at(4.0, 3.0)])]));
        assert!(all.admit(&[(1, vec![at(5.0, 0.0), at(-1.0, 0.0)])]), "once the first has gone");
        all.extend(1, 9.0, |_| false);
        assert!(all.claim(1).granted_end().x > 4.7, "{}", all.claim(1).granted_end());
        assert_eq!(all.extend(0, 9.0, |_| false), Held::NotAtAll);
    }

    /// Robots at random places with random routes; whatever is granted in whatever order, there is
    /// an order in which all can be driven, and driving by grants comes to an end.
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
        // In each round at least the first in the order gets to its end.
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
        fn whatever_is_granted_all_get_to_their_ends(
            starts in proptest::collection::vec((0.0..6.0, 0.0..4.0), 2..9),
            ends in proptest::collection::vec((0.0..6.0, 0.0..4.0), 9),
            turns in proptest::collection::vec(0usize..1000, 1..60),
        ) {
            check_progress(&starts, &ends, &turns);
        }
    }
}
