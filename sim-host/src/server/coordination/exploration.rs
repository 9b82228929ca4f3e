//! Sharing out what nobody has seen.

use ubimap_protocol::time::{Duration, Instant};

use super::{
    assignment::{NEVER, assign},
    coordinator::{Coordinator, Settings},
    frontiers::{View, frontiers},
    ground::{Disc, Ground, Point},
    member::Target,
};

/// A square metre of unknown ground is worth so many metres of way.
const WORTH_M: f64 = 0.5;
/// Two frontiers nearer to each other are one, in metres.
const APART_M: f64 = 1.0;
/// The places around this one, in metres, are then not tried for so long.
const TRIED_M: f64 = 0.3;
const TRIED: Duration = Duration::from_secs(300);
/// A frontier that was looked at from so many places and is still there can't be seen.
const MOST_LOOKS: usize = 3;
/// Until the server has heard what a robot saw.
const HEARD: Duration = Duration::from_millis(1_500);
/// A frontier to which others leave no room is given up after so long, for a while.
const PATIENCE: Duration = Duration::from_secs(8);
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
            let is_vain = target.looked.is_some_and(|looked| now.since(looked) >= HEARD)
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
        let taken: Vec<_> =
            self.members.iter().filter_map(|member| member.target).map(|it| it.frontier).collect();
        let open: Vec<_> = self
            .frontiers
            .iter()
            .filter(|it| taken.iter().all(|taken| (it.place - taken).norm() > APART_M))
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
        let views: Vec<Vec<Option<View>>> = idle
            .iter()
            .map(|&index| {
                let terrain = self.terrain(ground, index);
                let ways = terrain.everywhere(self.reservations.claim(index).granted_end());
                open.iter().map(|it| it.view(ground, ways.as_ref()?, &tried)).collect()
            })
            .collect();
        let cost = |view: &Option<View>, gain_m2: f64| {
            // Millimetres.
            view.map_or(NEVER, |view| ((view.metres - WORTH_M * gain_m2) * 1000.0) as i64)
        };
        let costs: Vec<Vec<i64>> = views
            .iter()
            .map(|row| row.iter().zip(&open).map(|(view, it)| cost(view, it.gain_m2)).collect())
            .collect();
        let mut given: Vec<(usize, Target)> = Vec::new();
        for ((column, row), &index) in assign(&costs).into_iter().zip(&views).zip(&idle) {
            let Some((frontier, view)) = column.and_then(|it| Some((open[it].place, row[it]?)))
            else {
                continue;
            };
            // Of two that are one, one robot gets none until the next time.
            let is_apart =
                |(_, other): &(usize, Target)| (other.frontier - frontier).norm() > APART_M;
            if given.iter().all(is_apart) {
                given.push((
                    index,
                    Target { frontier, view: view.place, reached: None, looked: None },
                ));
            }
        }
        for (index, target) in given {
            self.members[index].target = Some(target);
            self.members[index].set_out(now);
            self.reservations.drop_ahead(index);
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
