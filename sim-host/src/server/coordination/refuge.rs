//! Sends exploring robots back into the cameras' view.

use ubimap_protocol::time::Instant;

use super::{
    coordinator::Coordinator,
    frontiers::Frontier,
    ground::{Disc, Ground},
    member::Member,
    odometry_calibration::OdometryCalibration,
};

impl Coordinator {
    /// Calls robots back into the cameras' view whose poses may have drifted, and lets those that cameras have
    /// seen again go on. Uncalibrated ones are called back earlier while ground far from the view is left to explore.
    pub(super) fn call_back(&mut self, ground: &Ground, now: Instant) {
        let (rules, calibration) = (self.settings.exploration, self.settings.calibration);
        let (open, taken) = self.frontiers_left();
        let left = [open, taken].concat();
        let is_any_left = !left.is_empty();
        let is_worthwhile = self.is_calibration_worthwhile(ground, &left);
        for index in 0..self.members.len() {
            let member = &mut self.members[index];
            if !is_any_left {
                member.calibration.put_off(now);
            }
            if !member.is_exploring() {
                continue;
            }
            let is_wanted =
                member.calibration.is_due() || is_worthwhile && member.calibration.is_wanted(now);
            let blind_m = if is_wanted { calibration.blind_m } else { rules.blind_m };
            let is_adrift = member.is_adrift(blind_m);
            match member.recall {
                None if !is_adrift => member.recall = Some(now),
                // It had to give up the way, or nobody sees it where cameras should.
                None if member.refuge.is_none() => member.recall = Some(now + rules.recall_again),
                // Nobody has seen it since.
                Some(from) if is_adrift && from <= now && member.calibration.is_due() => {
                    member.recall = Some(now + rules.recall_again);
                    member.fail_calibration(&self.settings, now);
                }
                Some(from) if is_adrift && from <= now => {
                    if self.take_refuge(ground, index, now) {
                        let member = &mut self.members[index];
                        (member.target, member.recall) = (None, None);
                        if is_wanted {
                            member.calibration = OdometryCalibration::Due;
                        }
                    } else {
                        self.members[index].recall = Some(now + rules.recall_again);
                    }
                }
                _ => {}
            }
        }
    }

    /// Whether calibration is worth its time: a robot that explores is not calibrated, and a frontier that is left is far from
    /// the cameras' view. Cost: up to 20,000 cells of 5 cm per frontier.
    fn is_calibration_worthwhile(&self, ground: &Ground, left: &[&Frontier]) -> bool {
        let is_calibrated = |it: &Member| it.calibration == OdometryCalibration::Done;
        let radius = self.settings.calibration.far_m;
        let is_far = |it: &&Frontier| !ground.is_partly_in_view(&Disc { centre: it.place, radius });
        self.members.iter().any(|it| it.explores && !is_calibrated(it)) && left.iter().any(is_far)
    }

    /// Sends robots that find nothing to look at back into the cameras' view, where their poses do not drift and
    /// they are in nobody's way.
    pub(super) fn send_back(&mut self, ground: &Ground, now: Instant) {
        let Some(returns_after) = self.settings.exploration.returns_after else { return };
        for index in 0..self.members.len() {
            let radius = self.members[index].radius_m;
            let place = self.reservations.claim(index).position();
            let stays = !self.members[index].is_idle()
                || ground.is_in_view(&Disc { centre: place, radius });
            let member = &mut self.members[index];
            if stays {
                member.idle_since = None;
                continue;
            }
            let idle_since = *member.idle_since.get_or_insert(now);
            if member.refuge.is_some() || now.since(idle_since) < returns_after {
                continue;
            }
            // If there is no such place, it looks for one again after a while.
            member.idle_since = Some(now);
            self.take_refuge(ground, index, now);
        }
    }

    /// Sends a robot to the nearest place in the cameras' view that no other robot stands on or is to cross.
    /// Returns whether there is one.
    fn take_refuge(&mut self, ground: &Ground, index: usize, now: Instant) -> bool {
        let radius = self.members[index].radius_m + self.settings.exploration.within_m;
        let approach = self.approach(ground, index, &[]);
        let suits = |at| {
            let disc = Disc { centre: ground.place(at), radius };
            approach.terrain.is_open(at) && !approach.in_the_way[at] && ground.is_in_view(&disc)
        };
        let route = approach.terrain.nearest(approach.from, suits);
        let refuge = route.and_then(|route| route.last().copied());
        if refuge.is_some() {
            let member = &mut self.members[index];
            member.refuge = refuge;
            member.set_out(now);
            self.reservations.drop_ahead(index);
        }
        refuge.is_some()
    }
}
