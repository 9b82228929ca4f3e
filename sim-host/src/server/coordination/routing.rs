//! Finds the robots' routes, and decides how far they may drive along them now.

use ubimap_protocol::time::Instant;

use super::{
    coordinator::Coordinator,
    evasion::make_way,
    ground::{Disc, Ground},
    reservation::{Claim, Held},
    route::Terrain,
    situation::Notice,
};

impl Coordinator {
    /// Drops the routes of robots that wait for each other in a cycle, so that they get new ones. A
    /// cycle can arise after a robot has lost its route or stopped in the way of others.
    pub(super) fn untangle(&mut self) {
        let mut order: Vec<usize> = (0..self.members.len()).rev().collect();
        order.sort_by_key(|&index| self.members[index].goal.is_some());
        for index in order {
            if !self.reservations.claim(index).is_all_granted()
                && self.reservations.is_on_cycle(index)
            {
                self.reservations.drop_ahead(index);
            }
        }
    }

    /// Finds routes for robots without one. Robots with a goal from a user come first, then those
    /// that have waited longest.
    pub(super) fn find_routes(&mut self, now: Instant) {
        let (rates, following) = (self.settings.rates, self.settings.following);
        let is_waiting = |index: &usize| {
            let (member, claim) = (&self.members[*index], self.reservations.claim(*index));
            let has_none = member.destination().is_some_and(|it| it != claim.end());
            let is_there = claim.is_at_end() && member.is_there(claim.position(), &following);
            let is_due = claim.is_all_granted() && member.retry <= now;
            member.can_drive() && has_none && !is_there && is_due
        };
        let mut waiting: Vec<usize> = (0..self.members.len()).filter(is_waiting).collect();
        waiting.sort_by_key(|&index| {
            let member = &self.members[index];
            (member.goal.is_none(), member.waits_since.unwrap_or(now))
        });
        for index in waiting.into_iter().take(rates.routes_per_tick) {
            self.find_route(index, now);
        }
    }

    fn find_route(&mut self, index: usize, now: Instant) {
        let Some(ground) = self.ground.take() else { return };
        let outcome = self.try_routes(&ground, index);
        self.ground = Some(ground);
        let (rates, member) = (&self.settings.rates, &mut self.members[index]);
        match outcome {
            Outcome::Admitted => member.set_out(now),
            Outcome::NoRoom => {
                member.retry = now + rates.retry;
                member.waits_since = member.waits_since.or(Some(now));
                self.give_up_waiting(index, now);
            }
            Outcome::NoWay => {
                member.retry = now + rates.retry_no_way;
                if member.goal.is_some() && !member.is_told {
                    member.is_told = true;
                    self.notices.push_back((member.id, Notice::NoWay));
                }
                // A person who stands in a door shuts the only way, until the robot sees them leave.
                if !member.is_behind_person(&self.settings.following, now) {
                    self.give_up_target(index, now);
                }
            }
        }
    }

    fn try_routes(&mut self, ground: &Ground, index: usize) -> Outcome {
        let Some(destination) = self.members[index].destination() else { return Outcome::NoWay };
        let from = self.reservations.claim(index).granted_end();
        let mut terrain = self.terrain(ground, index);
        let Some(route) = terrain.route(from, destination) else { return Outcome::NoWay };
        if self.reservations.admit(&[(index, route.clone())]) {
            return Outcome::Admitted;
        }
        let Self { members, reservations, .. } = &*self;
        let mut changed = reservations.clone();
        let may_yield = |other: usize| members[other].can_drive();
        let terrain_of = |other| self.terrain(ground, other);
        if make_way(&mut changed, ground, index, &route, may_yield, terrain_of) {
            self.reservations = changed;
            return Outcome::Admitted;
        }
        // The route must avoid all standing robots, at any cost.
        for (_, claim) in self.standing(index) {
            let radius = claim.disc_m() + self.reservations.claim(index).disc_m();
            terrain.shut(&Disc { centre: claim.end(), radius }, from);
        }
        let around = terrain.route(from, destination);
        match around.is_some_and(|around| self.reservations.admit(&[(index, around)])) {
            true => Outcome::Admitted,
            false => Outcome::NoRoom,
        }
    }

    /// The ground as one robot can cross it. Places of unreachable robots are closed; those of
    /// other standing robots cost more.
    pub(super) fn terrain<'a>(&self, ground: &'a Ground, index: usize) -> Terrain<'a> {
        let (member, mine) = (&self.members[index], self.reservations.claim(index));
        let (clearances, costs) = (&self.settings.clearances, &self.settings.costs);
        let room_m = member.radius_m + clearances.wall_m;
        let mut terrain = Terrain::new(ground, room_m, &self.settings);
        for (disc, _) in &self.held_up {
            terrain.make_dear(&disc.grown(member.radius_m), costs.held_up);
        }
        for disc in self.passers.iter().flat_map(|passer| &passer.discs) {
            let respect_m = member.radius_m + clearances.person_m;
            terrain.make_dear(&disc.grown(respect_m), costs.standing);
        }
        for (other, claim) in self.standing(index) {
            let disc = Disc { centre: claim.end(), radius: claim.disc_m() + mine.disc_m() };
            if self.members[other].lost.is_some() {
                terrain.shut(&disc, mine.granted_end());
            } else {
                terrain.make_dear(&disc, costs.standing);
            }
        }
        terrain
    }

    /// The other robots without a route ahead, which stay where they are.
    fn standing(&self, index: usize) -> impl Iterator<Item = (usize, &Claim)> {
        let claims = self.reservations.claims().iter().enumerate();
        claims.filter(move |(other, claim)| *other != index && claim.is_all_granted())
    }

    /// Grants robots more of their routes. Another robot comes first each time.
    pub(super) fn grant(&mut self, now: Instant) {
        let rules = self.settings.granting;
        let count = self.members.len();
        self.turn = (self.turn + 1) % count.max(1);
        for index in (0..count).map(|place| (place + self.turn) % count) {
            let member = &mut self.members[index];
            if !member.can_drive() {
                continue;
            }
            let respect_m = member.radius_m + self.settings.clearances.person_m;
            let taken = |place| self.passers.iter().any(|passer| passer.is_near(place, respect_m));
            if self.reservations.extend(index, rules.ahead_m, taken) != Held::ByOthers {
                member.held_up = None;
            } else if now.since(*member.held_up.get_or_insert(now)) >= rules.patience {
                member.held_up = None;
                member.set_out(now);
                self.reservations.drop_ahead(index);
            }
        }
    }
}

/// The outcome of the search for a route.
enum Outcome {
    Admitted,
    /// There is a route, but other robots block it.
    NoRoom,
    NoWay,
}
