//! Checks whether robots follow their paths, and handles those that are stuck, lost or off their
//! routes.

use ubimap_protocol::{message::ObstacleClass, time::Instant};

use super::{
    coordinator::Coordinator,
    ground::Disc,
    member::Member,
    reservation::Claim,
    situation::{Notice, Passer, Situation, Whereabouts},
};

impl Coordinator {
    /// Updates the positions of robots and obstacles.
    pub(super) fn see(&mut self, situation: &Situation<'_>, now: Instant) {
        let margin_m = self.settings.clearances.route_m;
        for robot in situation.robots {
            match self.index(robot.robot) {
                Ok(index) => self.see_again(index, robot, now),
                Err(index) => {
                    self.members.insert(index, Member::new(robot));
                    self.reservations
                        .insert(index, Claim::standing(robot.place(), robot.corner_m(), margin_m));
                }
            }
        }
        let others = situation.obstacles.iter().filter(|it| it.class != ObstacleClass::Fixed);
        let passers = others.map(Passer::new).filter(|passer| {
            // Cameras may report a robot as a moving thing.
            let is_it = |robot: &Whereabouts| {
                (robot.place() - passer.discs[0].centre).norm() < robot.radius_m()
            };
            !situation.robots.iter().any(is_it)
        });
        self.passers = passers.collect();
        self.held_up.retain(|(_, until)| now < *until);
    }

    fn see_again(&mut self, index: usize, robot: &Whereabouts, now: Instant) {
        let is_back = self.members[index].see(robot, &self.settings.following, now);
        let is_busy = self.members[index].explores || self.members[index].goal.is_some();
        let claim = self.reservations.claim_mut(index);
        claim.set_radius(robot.corner_m(), !is_busy && claim.is_at_end());
        claim.advance(robot.place());
        if is_back {
            claim.forget_sent();
        }
        let is_astray = !claim.is_at_end() && claim.off_m() > self.settings.following.astray_m;
        if is_astray && self.members[index].can_drive() {
            self.halt(index, now);
        }
    }

    /// Checks the progress of every robot.
    pub(super) fn follow(&mut self, now: Instant) {
        for index in 0..self.members.len() {
            let member = &self.members[index];
            if member.lost.is_some() {
                self.follow_lost(index, now);
            } else if member.halted.is_some() {
                self.follow_halted(index, now);
            } else {
                self.follow_driving(index, now);
            }
        }
    }

    /// Handles a robot that can't be commanded: it stops by itself.
    fn follow_lost(&mut self, index: usize, now: Instant) {
        let lost_for = self.members[index].lost.map(|lost| now.since(lost));
        let claim = self.reservations.claim_mut(index);
        if lost_for >= Some(self.settings.following.lost) && !claim.is_at_end() {
            claim.stand();
        }
    }

    /// Handles a robot that was told to stop. Once it stands still, it may get another route.
    fn follow_halted(&mut self, index: usize, now: Instant) {
        let (rules, member) = (&self.settings.following, &mut self.members[index]);
        if member.pauses(now) {
            return;
        }
        let Some(halted) = member.halted.map(|halted| now.since(halted)) else { return };
        let stands = member.still_for() >= rules.halted
            || halted >= rules.reported && member.unmoved_for(now) >= rules.halted;
        if halted >= rules.halting && stands {
            member.halted = None;
            member.set_out(now);
            self.reservations.claim_mut(index).stand();
        }
    }

    fn follow_driving(&mut self, index: usize, now: Instant) {
        let (rules, member) = (&self.settings.following, &mut self.members[index]);
        let claim = self.reservations.claim_mut(index);
        if claim.is_at_end() {
            let is_there = member.is_there(claim.position(), rules);
            match &mut member.target {
                _ if !is_there => {}
                Some(target) => drop(target.reached.get_or_insert(now)),
                None if member.goal.take().is_some() => {
                    self.notices.push_back((member.id, Notice::Reached));
                }
                None => member.refuge = None,
            }
            return;
        }
        let is_stuck = now.since(member.sent) >= rules.stalled
            && (member.still_for() >= rules.stalled || member.unmoved_for(now) >= rules.unmoved);
        if is_stuck && !claim.is_at_grant() {
            if claim.to_grant_m() > rules.arrived_m {
                self.blocked(index, now);
            } else {
                claim.arrive();
            }
        }
    }

    /// Handles a robot that can't continue on its path: stops it, and gives it another route from
    /// where it stands.
    pub(super) fn blocked(&mut self, index: usize, now: Instant) {
        let (costs, member) = (&self.settings.costs, &self.members[index]);
        let before_m = member.radius_m + costs.held_up_m / 2.0;
        let centre = self.reservations.claim(index).point_before(before_m);
        let disc = Disc { centre, radius: costs.held_up_m };
        // People go away sooner than things.
        let is_person = member.is_behind_person(&self.settings.following, now);
        let time = if is_person { costs.held_up_by_person_for } else { costs.held_up_for };
        let rules = self.settings.escalation;
        let place = self.reservations.claim(index).position();
        let times = self.members[index].block(place, &rules, now);
        self.held_up.push((disc, now + rules.longer(time, times)));
        let (is_first, is_last) = (times == 1, times == rules.gives_up);
        let member = &mut self.members[index];
        if is_last && member.goal.take().is_some() {
            self.notices.push_back((member.id, Notice::GaveUp));
        } else if is_first {
            self.notices.push_back((member.id, Notice::Blocked));
        }
        self.halt(index, now);
        if !is_first {
            let put_off = rules.longer(self.settings.exploration.put_off, times);
            self.put_off_target(index, now + put_off);
        }
    }

    fn halt(&mut self, index: usize, now: Instant) {
        self.members[index].halted = Some(now);
        self.command(index, &[], now);
    }
}
