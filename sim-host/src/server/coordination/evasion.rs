//! Sends robots aside if they stand in the way of another one.

use super::{
    ground::{Disc, Ground, Point},
    reservation::{Reservations, is_crossed},
    route::{SPACING_M, Terrain},
};

/// Every third point of a route is checked, with a correspondingly larger radius.
const STRIDE: usize = 3;

/// Gives `robot` a route, as a list of corners, and sends the robots that stand on it aside, each
/// to the nearest place where it blocks no other robot. Returns whether that succeeded; if not,
/// nothing has changed.
///
/// `may_yield` says which robots can be sent aside, and `terrain` returns the ground as a robot can
/// cross it. Cost: one search per robot sent aside.
pub(super) fn make_way<'a>(
    reservations: &mut Reservations,
    ground: &'a Ground,
    robot: usize,
    route: &[Point],
    may_yield: impl Fn(usize) -> bool,
    terrain: impl Fn(usize) -> Terrain<'a>,
) -> bool {
    let mut planned = reservations.clone();
    planned.plan(robot, route);
    let way = planned.claim(robot).ahead().to_vec();
    // The standing robots on the route, each with the last point of the route that it blocks.
    let mut standing: Vec<(usize, usize)> = Vec::new();
    for (other, claim) in planned.claims().iter().enumerate() {
        let reach = planned.claim(robot).reach(claim);
        let is_met = |point: &Point| is_crossed(&[*point], claim.held(), reach);
        if other != robot && claim.is_all_granted() {
            standing.extend(way.iter().rposition(is_met).map(|along| (along, other)));
        }
    }
    if standing.is_empty() || !standing.iter().all(|&(_, other)| may_yield(other)) {
        return false;
    }
    // The robot farthest along the route is sent aside first: the others may have to follow it.
    standing.sort_unstable_by(|a, b| b.cmp(a));
    let mut routes = Vec::new();
    for (_, other) in standing {
        let Some(aside) = aside(&planned, ground, terrain(other), robot, other) else {
            return false;
        };
        planned.plan(other, &aside);
        routes.push((other, aside));
    }
    routes.push((robot, route.to_vec()));
    reservations.admit(&routes)
}

/// The route of the robot `aside` to the nearest place where it blocks no other robot. The route
/// avoids the robot `driving`, to which it yields, and places where others will stop.
fn aside(
    planned: &Reservations,
    ground: &Ground,
    mut terrain: Terrain<'_>,
    driving: usize,
    aside: usize,
) -> Option<Vec<Point>> {
    let me = planned.claim(aside);
    let mut in_the_way = vec![false; ground.len()];
    for (other, claim) in planned.claims().iter().enumerate().filter(|(other, _)| *other != aside) {
        let reach = claim.disc_m() + me.disc_m();
        let stays = if other == driving { claim.granted_end() } else { claim.end() };
        terrain.shut(&Disc { centre: stays, radius: reach }, me.end());
        let room = reach + STRIDE as f64 * SPACING_M / 2.0;
        let route = claim.ahead().iter().step_by(STRIDE).copied();
        for centre in claim.held().chain(route).chain([claim.end()]) {
            ground.within(&Disc { centre, radius: room }, |at| in_the_way[at] = true);
        }
    }
    terrain.nearest(me.end(), |at| terrain.is_open(at) && !in_the_way[at])
}
