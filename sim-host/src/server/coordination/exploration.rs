//! Sharing out what nobody has seen.

use ubimap_protocol::time::{Duration, Instant};

use super::{
    approach::{Approach, View},
    assignment::{NEVER, assign},
    coordinator::{Coordinator, Settings},
    frontiers::{Frontier, frontiers},
    ground::{Disc, Ground, Point},
    member::Target,
};

/// A square metre of unknown ground is worth so many metres of way.
const WORTH_M: f64 = 0.2;
/// Frontiers with less way than this between them are better left to one robot, in metres, and how
/// much dearer each metre of that makes them for another one: two are in each other's way there.
const NEIGHBOURS_M: f64 = 2.0;
const NEIGHBOURS_COST: f64 = 2.0;
/// Two frontiers nearer to each other are one, in metres.
const APART_M: f64 = 1.0;
/// The places around this one, in metres, are then not tried for so long.
const TRIED_M: f64 = 0.3;
const TRIED: Duration = Duration::from_secs(300);
/// A frontier that was looked at from so many places and is still there can't be seen.
const MOST_LOOKS: usize = 3;
/// A frontier to which others leave no room is given up after so long, for a while.
const PATIENCE: Duration = Duration::from_secs(2);
const PUT_OFF: Duration = Duration::from_secs(20);

/// A frontier that was looked at in vain, or to which there was no way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tried {
    frontier: Point,
    view: Point,
    /// When it is tried again.
    until: Instant,
}

impl Tried {
    fn new(target: &Target, until: Instant) -> Self {
        Self { frontier: target.frontier, view: target.view, until }
    }

    fn is_of(&self, frontier: Point) -> bool {
        (self.frontier - frontier).norm() <= TRIED_M
    }

    /// The places from which it looked so.
    fn views(&self) -> Disc {
        Disc { centre: self.view, radius: TRIED_M }
    }
}

impl Coordinator {
    /// Gives robots that explore, and have nothing to do, frontiers of their own.
    pub(super) fn share_out(&mut self, now: Instant) {
        let Some(ground) = self.ground.take() else { return };
        self.tried.retain(|tried| now < tried.until);
        self.frontiers.clear();
        if self.members.iter().any(|member| member.explores) {
            let Settings { view_m, range_m, .. } = self.settings;
            self.frontiers = frontiers(&ground, view_m, range_m);
        }
        self.drop_targets(now);
        self.assign_targets(&ground, now);
        self.ground = Some(ground);
    }

    /// Drops targets of which nothing is left to be seen, or seen from there.
    fn drop_targets(&mut self, now: Instant) {
        let look = self.settings.look;
        for member in &mut self.members {
            let Some(target) = member.target else { continue };
            let is_left =
                self.frontiers.iter().any(|it| (it.place - target.frontier).norm() <= APART_M);
            // If it is still there, it can't be seen from here.
            let is_vain = target.is_heard_of(now)
                || target.reached.is_some_and(|reached| now.since(reached) >= look);
            if is_vain && is_left {
                self.tried.push(Tried::new(&target, now + TRIED));
            }
            if is_vain || !is_left {
                member.target = None;
            }
        }
    }

    fn assign_targets(&mut self, ground: &Ground, now: Instant) {
        let taken: Vec<_> = self.members.iter().filter_map(|member| member.target).collect();
        let is_apart = |it: &Frontier, taken: &Target| (it.place - taken.frontier).norm() > APART_M;
        let open: Vec<_> = self
            .frontiers
            .iter()
            .filter(|it| taken.iter().all(|taken| is_apart(it, taken)))
            .filter(|it| {
                let looks = self.tried.iter().filter(|tried| tried.is_of(it.place));
                looks.count() < MOST_LOOKS
            })
            .collect();
        let is_idle = |index: &usize| {
            let member = &self.members[*index];
            member.explores && member.destination().is_none() && member.can_drive()
        };
        let idle: Vec<usize> = (0..self.members.len()).filter(is_idle).collect();
        if idle.is_empty() || open.is_empty() {
            return;
        }
        let tried: Vec<Disc> = self.tried.iter().map(Tried::views).collect();
        let crowding = self.crowding(ground, &open);
        let views: Vec<Vec<Option<View>>> =
            idle.iter().map(|&index| self.approach(ground, index, &tried).views(&open)).collect();
        let cost = |((view, frontier), crowded_m): ((&Option<View>, &&Frontier), &f64)| {
            let worth_m = WORTH_M * frontier.gain_m2;
            // Millimetres.
            view.map_or(NEVER, |view| ((view.cost_m + crowded_m - worth_m) * 1000.0) as i64)
        };
        let costs: Vec<Vec<i64>> = views
            .iter()
            .map(|row| row.iter().zip(&open).zip(&crowding).map(cost).collect())
            .collect();
        let mut given: Vec<(usize, Target)> = Vec::new();
        for ((column, row), &index) in assign(&costs).into_iter().zip(&views).zip(&idle) {
            let Some((frontier, view)) = column.and_then(|it| Some((open[it], row[it]?))) else {
                continue;
            };
            // Of two that are one, one robot gets none until the next time.
            if given.iter().all(|(_, other)| is_apart(frontier, other)) {
                given.push((index, Target::new(frontier.place, view.place)));
            }
        }
        if given.is_empty() && taken.is_empty() {
            given.extend(self.look_again(ground, &open, &idle, &tried));
        }
        for (index, target) in given {
            self.members[index].target = Some(target);
            self.members[index].set_out(now);
            self.reservations.drop_ahead(index);
        }
    }

    /// Who looks again at what keeps all robots from a frontier, and from where: somebody may have
    /// stood there. The nearest that can be reached.
    fn look_again(
        &self,
        ground: &Ground,
        open: &[&Frontier],
        idle: &[usize],
        tried: &[Disc],
    ) -> Option<(usize, Target)> {
        let looks = idle.iter().flat_map(|&index| {
            let views = self.approach(ground, index, tried).before(open);
            open.iter().zip(views).filter_map(move |(frontier, view)| {
                let view = view?;
                let away_m = (view.place - frontier.place).norm();
                Some((view.cost_m + away_m, index, Target::new(frontier.place, view.place)))
            })
        });
        let (_, index, target) = looks.min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some((index, target))
    }

    /// What it costs to look at each of these frontiers beside those who go to look near it, in
    /// metres.
    fn crowding(&self, ground: &Ground, open: &[&Frontier]) -> Vec<f64> {
        let mut crowding = vec![0.0_f64; open.len()];
        for (index, member) in self.members.iter().enumerate() {
            let Some(target) = member.target else { continue };
            let terrain = self.terrain(ground, index);
            let Some(ways) = terrain.everywhere(target.view) else { continue };
            for (frontier, crowded_m) in open.iter().zip(&mut crowding) {
                let between_m = frontier.metres(&ways).unwrap_or(f64::INFINITY);
                let near_m = (NEIGHBOURS_M - between_m).max(0.0);
                *crowded_m = crowded_m.max(NEIGHBOURS_COST * near_m);
            }
        }
        crowding
    }

    /// How a robot can come to look at frontiers from where it may drive now.
    fn approach<'a>(&self, ground: &'a Ground, index: usize, tried: &'a [Disc]) -> Approach<'a> {
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
        }
    }

    /// There is no way to a frontier.
    pub(super) fn give_up_target(&mut self, index: usize, now: Instant) {
        if let Some(target) = self.members[index].target.take() {
            self.tried.push(Tried::new(&target, now + PUT_OFF));
        }
    }

    /// Others leave no room on the way to a frontier.
    pub(super) fn give_up_waiting(&mut self, index: usize, now: Instant) {
        let waits_since = self.members[index].waits_since;
        if waits_since.is_some_and(|since| now.since(since) >= PATIENCE) {
            self.give_up_target(index, now);
        }
    }
}
