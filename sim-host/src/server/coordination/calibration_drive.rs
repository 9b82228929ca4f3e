//! Drives robots to and fro in the cameras' view, where they learn the systematic errors of their odometry: what robots
//! draw far out of view is as good as their odometry.

use ubimap_protocol::time::Instant;

use super::{
    coordinator::Coordinator,
    ground::{Disc, Ground, Point},
    odometry_calibration::OdometryCalibration,
};

impl Coordinator {
    /// Sends a robot whose calibration is due to the other end of a straight way in the cameras' view, until it has
    /// driven far enough there. One robot each time, so that the next one knows its route. Cost: one terrain.
    pub(super) fn calibrate(&mut self, ground: &Ground, now: Instant) {
        let rules = self.settings.calibration;
        for member in &mut self.members {
            if member.seen_m >= rules.distance_m {
                member.calibration = OdometryCalibration::Done;
            }
        }
        let begins = |index: &usize| {
            let place = self.reservations.claim(*index).position();
            self.members[*index].calibrates()
                && self.members[*index]
                    .refuge
                    .is_none_or(|end| (end - place).norm() <= rules.turn_within_m)
        };
        let Some(index) = (0..self.members.len()).find(begins) else { return };
        let end = self.far_end(ground, index);
        let member = &mut self.members[index];
        let Some(end) = end else { return member.calibration.put_off(now + rules.put_off) };
        member.refuge = Some(end);
        member.set_out(now);
        self.reservations.drop_ahead(index);
    }

    /// The end of the longest straight way through free ground in view, on which no other robot stands or is to drive.
    fn far_end(&self, ground: &Ground, index: usize) -> Option<Point> {
        let (rules, member) = (&self.settings.calibration, &self.members[index]);
        let mut approach = self.approach(ground, index, &[]);
        let passers = self.passers.iter().flat_map(|passer| &passer.discs);
        for disc in passers.chain(self.held_up.iter().map(|(disc, _)| disc)) {
            ground.within(&disc.grown(member.radius_m), |at| approach.in_the_way[at] = true);
        }
        let movable_cells = member.radius_m / ground.side_m();
        // Cameras do not see the ground below the robot and behind it.
        let hidden_m = member.radius_m + rules.hidden_m;
        let place = self.reservations.claim(index).position();
        let suits = |on_way: Point| {
            ground.at(on_way).is_some_and(|at| {
                let is_free = f64::from(ground.to_movable(at)) >= movable_cells * movable_cells;
                let is_seen = ground.is_covered(at) || (on_way - place).norm() <= hidden_m;
                approach.terrain.is_open(at) && !approach.in_the_way[at] && is_free && is_seen
            })
        };
        let from = approach.from;
        let is_straight = |end: Point| {
            let steps = ((end - from).norm() / ground.side_m()).ceil();
            (1..=steps as usize).all(|step| suits(from + (end - from) * (step as f64 / steps)))
        };
        let (mut longest_m, mut far_end) = (rules.least_m, None);
        ground.within(&Disc { centre: from, radius: rules.most_m }, |at| {
            let end = ground.place(at);
            let way_m = (end - from).norm();
            if way_m > longest_m && ground.is_covered(at) && is_straight(end) {
                (longest_m, far_end) = (way_m, Some(end));
            }
        });
        far_end
    }
}
