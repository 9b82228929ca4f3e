//! Sends robots to look again at what blocks the way to frontiers, such as a person who may have left.

use ubimap_protocol::time::Instant;

use super::{
    coordinator::Coordinator,
    frontiers::Frontier,
    ground::{Disc, Ground},
    target::Target,
};

impl Coordinator {
    /// The robot to look again, and its target: one of the idle ones at once if no robot has anything to look at, and
    /// otherwise one of those that have been shut in for long. `left` are the frontiers that are not given up.
    pub(super) fn second_look(
        &self,
        ground: &Ground,
        left: &[&Frontier],
        idle: &[usize],
        shut_in: &[usize],
        now: Instant,
    ) -> Option<(usize, Target)> {
        if self.members.iter().all(|member| member.target.is_none()) {
            return self.nearest_look(ground, left, idle, &self.failed_views());
        }
        let looks_for_way = |index: &usize| self.looks_for_way(*index, now);
        let shut_in: Vec<usize> = shut_in.iter().copied().filter(looks_for_way).collect();
        // A viewpoint that failed for a frontier may still show what blocks the way.
        let (index, target) = self.nearest_look(ground, left, &shut_in, &[])?;
        Some((index, target.shut_in()))
    }

    /// Whether a robot that is shut in has been so for long, and has not looked often in vain.
    fn looks_for_way(&self, index: usize, now: Instant) -> bool {
        let (rules, member) = (&self.settings.exploration, &self.members[index]);
        let is_long_so = member.shut_in_since.is_some_and(|it| now.since(it) >= rules.shut_in_for);
        is_long_so && member.no_way_out.len() < rules.most_looks
    }

    /// Whether a robot has been shut in for `no_way_out_for`, has nowhere left to look, and was not given up yet.
    /// Cost: one search if the time is over.
    pub(super) fn finds_no_way_out(
        &self,
        ground: &Ground,
        left: &[&Frontier],
        index: usize,
        now: Instant,
    ) -> bool {
        let (rules, member) = (&self.settings.exploration, &self.members[index]);
        !member.is_given_up
            && member.shut_in_since.is_some_and(|it| now.since(it) >= rules.no_way_out_for)
            && self.nearest_look(ground, left, &[index], &[]).is_none()
    }

    /// Of these robots and the places that they can reach, the pair with the least cost of driving there plus straight
    /// distance to a frontier. Leaves out where a robot has looked for a way out in vain, and `failed` views.
    fn nearest_look(
        &self,
        ground: &Ground,
        left: &[&Frontier],
        robots: &[usize],
        failed: &[Disc],
    ) -> Option<(usize, Target)> {
        let tried_m = self.settings.exploration.tried_m;
        let looks = robots.iter().flat_map(|&index| {
            let own = self.members[index].no_way_out.iter().map(|tried| tried.views(tried_m));
            let tried: Vec<Disc> = failed.iter().copied().chain(own).collect();
            let views = self.approach(ground, index, &tried).before(left);
            left.iter().zip(views).filter_map(move |(frontier, view)| {
                let view = view?;
                let away_m = (view.place - frontier.place).norm();
                Some((view.cost_m + away_m, index, Target::new(frontier.place, view.place)))
            })
        });
        let (_, index, target) = looks.min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some((index, target))
    }
}
