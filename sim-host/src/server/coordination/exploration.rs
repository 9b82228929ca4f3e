//! Distributes frontiers among robots.

use ubimap_protocol::time::Instant;

use super::{
    approach::{Approach, Viewpoint},
    assignment::{NEVER, assign},
    coordinator::Coordinator,
    frontiers::{Frontier, frontiers},
    ground::{Disc, Ground},
    member::Member,
    situation::Notice,
    target::{Target, Tried},
};

impl Coordinator {
    /// Gives idle exploring robots frontiers of their own.
    pub(super) fn share_out(&mut self, now: Instant) {
        let Some(ground) = self.ground.take() else { return };
        self.tried.retain(|tried| now < tried.until);
        for member in &mut self.members {
            member.no_way_out.retain(|tried| now < tried.until);
        }
        self.frontiers.clear();
        if self.members.iter().any(|member| member.explores) {
            self.frontiers = frontiers(&ground, &self.settings);
        }
        self.drop_targets(now);
        self.call_back(&ground, now);
        self.calibrate(&ground, now);
        self.assign_targets(&ground, now);
        self.send_back(&ground, now);
        self.ground = Some(ground);
    }

    /// Drops targets that have been explored, or that turn out to be invisible from the chosen
    /// viewpoint. A robot that is shut in looks, whoever explores the frontier meanwhile.
    fn drop_targets(&mut self, now: Instant) {
        let (look, rules) = (self.settings.look, self.settings.exploration);
        let arrives = self.settings.following.tiles_arrive;
        for member in &mut self.members {
            let Some(target) = member.target else { continue };
            let is_left =
                self.frontiers.iter().any(|it| (it.place - target.frontier).norm() <= rules.same_m);
            // A frontier that remains after the robot has looked can't be seen from this viewpoint.
            let is_vain = target.is_heard_of(arrives, now)
                || target.reached.is_some_and(|reached| now.since(reached) >= look);
            if target.is_shut_in && is_vain {
                member.no_way_out.push(Tried::new(&target, now + rules.tried_for));
            } else if is_vain && is_left {
                self.tried.push(Tried::new(&target, now + rules.tried_for));
            }
            if is_vain || !is_left && !target.is_shut_in {
                member.target = None;
            }
        }
    }

    fn assign_targets(&mut self, ground: &Ground, now: Instant) {
        let (open, taken) = self.frontiers_left();
        // The open ones come first.
        let left: Vec<&Frontier> = open.iter().chain(&taken).copied().collect();
        let is_idle = |index: &usize| self.members[*index].is_idle();
        let idle: Vec<usize> = (0..self.members.len()).filter(is_idle).collect();
        let tried = self.failed_views();
        let views: Vec<Vec<Option<Viewpoint>>> =
            idle.iter().map(|&index| self.approach(ground, index, &tried).views(&left)).collect();
        let mut given = self.cheapest(ground, &open, &idle, &views);
        let has_none = |views: &Vec<Option<Viewpoint>>| views.iter().all(Option::is_none);
        // Where a look was in vain, it could stand.
        let is_shut_in = |index: usize| has_none(&self.approach(ground, index, &[]).views(&left));
        let viewless = idle.iter().zip(&views).filter(|(_, views)| has_none(views));
        let shut_in: Vec<usize> = viewless
            .map(|(&index, _)| index)
            .filter(|&index| !left.is_empty() && is_shut_in(index))
            .collect();
        if given.is_empty() {
            given.extend(self.second_look(ground, &left, &idle, &shut_in, now));
        }
        let finds_no_way_out = |index: &usize| self.finds_no_way_out(ground, &left, *index, now);
        let given_up: Vec<usize> = shut_in.iter().copied().filter(finds_no_way_out).collect();
        for (index, member) in self.members.iter_mut().enumerate() {
            let since = member.shut_in_since.unwrap_or(now);
            member.shut_in_since = shut_in.contains(&index).then_some(since);
            if idle.contains(&index) && !shut_in.contains(&index) {
                member.no_way_out.clear();
                member.is_given_up = false;
            }
            if given_up.contains(&index) {
                member.is_given_up = true;
                self.notices.push_back((member.id, Notice::ShutIn));
            }
        }
        for (index, target) in given {
            let member = &mut self.members[index];
            (member.target, member.refuge) = (Some(target), None);
            member.set_out(now);
            self.reservations.drop_ahead(index);
        }
    }

    /// The frontiers that have not been given up: those that are no robot's target, and the others.
    pub(super) fn frontiers_left(&self) -> (Vec<&Frontier>, Vec<&Frontier>) {
        let rules = &self.settings.exploration;
        let is_seen_in_vain = |it: &Frontier| {
            let looks = self.tried.iter().filter(|tried| tried.is_of(it.place, rules.tried_m));
            looks.count() >= rules.most_looks
        };
        let is_open =
            |it: &&Frontier| self.frontier_targets().all(|target| self.is_apart(it, &target));
        self.frontiers.iter().filter(|it| !is_seen_in_vain(it)).partition(is_open)
    }

    /// The targets of the robots that are sent to frontiers.
    pub(super) fn frontier_targets(&self) -> impl Iterator<Item = Target> {
        self.members.iter().filter_map(Member::frontier_target)
    }

    /// Areas around the viewpoints from which frontiers were not seen.
    pub(super) fn failed_views(&self) -> Vec<Disc> {
        let tried_m = self.settings.exploration.tried_m;
        self.tried.iter().map(|tried| tried.views(tried_m)).collect()
    }

    /// Whether a frontier is not that of the target.
    fn is_apart(&self, frontier: &Frontier, target: &Target) -> bool {
        (frontier.place - target.frontier).norm() > self.settings.exploration.same_m
    }

    /// The minimum-cost assignment of idle robots to open frontiers, which come first in each robot's `views`.
    fn cheapest(
        &self,
        ground: &Ground,
        open: &[&Frontier],
        idle: &[usize],
        views: &[Vec<Option<Viewpoint>>],
    ) -> Vec<(usize, Target)> {
        if idle.is_empty() || open.is_empty() {
            return Vec::new();
        }
        let crowding = self.crowding(ground, open);
        let cost = |((view, frontier), crowded_m): ((&Option<Viewpoint>, &&Frontier), &f64)| {
            let worth_m = self.settings.exploration.worth_m * frontier.gain_m2;
            // Costs in millimetres.
            view.map_or(NEVER, |view| ((view.cost_m + crowded_m - worth_m) * 1000.0) as i64)
        };
        let costs: Vec<Vec<i64>> = views
            .iter()
            .map(|row| row.iter().zip(open).zip(&crowding).map(cost).collect())
            .collect();
        let mut given: Vec<(usize, Target)> = Vec::new();
        for ((column, row), &index) in assign(&costs).into_iter().zip(views).zip(idle) {
            let Some((frontier, view)) = column.and_then(|it| Some((open[it], row[it]?))) else {
                continue;
            };
            // Two pieces of the same frontier go to one robot; the other robot waits for the next
            // assignment.
            if given.iter().all(|(_, other)| self.is_apart(frontier, other)) {
                given.push((index, Target::new(frontier.place, view.place)));
            }
        }
        given
    }

    /// For each frontier, the extra cost in metres because other robots look at places near it.
    fn crowding(&self, ground: &Ground, open: &[&Frontier]) -> Vec<f64> {
        let rules = &self.settings.exploration;
        let mut crowding = vec![0.0_f64; open.len()];
        for (index, member) in self.members.iter().enumerate() {
            let Some(target) = member.frontier_target() else { continue };
            let terrain = self.terrain(ground, index);
            let Some(ways) = terrain.everywhere(target.view) else { continue };
            for (frontier, crowded_m) in open.iter().zip(&mut crowding) {
                let between_m = frontier.metres(&ways).unwrap_or(f64::INFINITY);
                let near_m = (rules.neighbours_m - between_m).max(0.0);
                *crowded_m = crowded_m.max(rules.neighbours_cost * near_m);
            }
        }
        crowding
    }

    /// The inputs for choosing a robot's viewpoints; the search starts at the end of its granted
    /// route.
    pub(super) fn approach<'a>(
        &'a self,
        ground: &'a Ground,
        index: usize,
        tried: &'a [Disc],
    ) -> Approach<'a> {
        let me = self.reservations.claim(index);
        let mut in_the_way = vec![false; ground.len()];
        let others = self.reservations.claims().iter().enumerate();
        for (_, claim) in others.filter(|(other, _)| *other != index) {
            let radius = claim.disc_m() + me.disc_m();
            for centre in claim.held().chain(claim.ahead().iter().copied()) {
                ground.within(&Disc { centre, radius }, |at| in_the_way[at] = true);
            }
        }
        Approach {
            ground,
            terrain: self.terrain(ground, index),
            from: me.granted_end(),
            heading: self.members[index].heading,
            in_the_way,
            tried,
            rules: &self.settings.viewpoints,
        }
    }

    /// Gives up a target that can't be reached.
    pub(super) fn give_up_target(&mut self, index: usize, now: Instant) {
        self.put_off_target(index, now + self.settings.exploration.put_off);
    }

    /// Gives up a robot's target, or its calibration, until then.
    pub(super) fn put_off_target(&mut self, index: usize, until: Instant) {
        let member = &mut self.members[index];
        (member.refuge, member.idle_since) = (None, None);
        member.calibration.put_off(until);
        let Some(target) = member.target.take() else { return };
        let tried = if target.is_shut_in { &mut member.no_way_out } else { &mut self.tried };
        tried.push(Tried::new(&target, until));
    }

    /// Gives up a frontier if other robots have blocked the way for too long.
    pub(super) fn give_up_waiting(&mut self, index: usize, now: Instant) {
        let waits_since = self.members[index].waits_since;
        let patience = self.settings.exploration.patience;
        if waits_since.is_some_and(|since| now.since(since) >= patience) {
            self.give_up_target(index, now);
        }
    }
}
