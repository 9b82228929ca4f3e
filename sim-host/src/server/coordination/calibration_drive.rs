//! Drives robots to and fro in the cameras' view, where they learn the systematic errors of their odometry. Far out of view,
//! their maps are only as good as their odometry.

use ubimap_protocol::time::Instant;

use super::{
    coordinator::Coordinator,
    ground::{Disc, Ground, Point},
    odometry_calibration::OdometryCalibration,
};

impl Coordinator {
    /// Sends robots whose calibration is due along straight ways in the cameras' view, until they have driven far enough
    /// there. At most one robot per survey, so that the next one sees the ground that this one reserves.
    pub(super) fn calibrate(&mut self, ground: &Ground, now: Instant) {
        let rules = self.settings.calibration;
        for member in &mut self.members {
            if member.seen_m >= rules.distance_m {
                member.calibration = OdometryCalibration::Done;
            }
        }
        let begins = |index: &usize| {
            let (member, claim) = (&self.members[*index], self.reservations.claim(*index));
            let off_m = |end: Point| (end - claim.position()).norm();
            member.calibrates() && member.refuge.is_none_or(|end| off_m(end) <= rules.turn_within_m)
        };
        let Some(index) = (0..self.members.len()).find(begins) else { return };
        let end = self.far_end(ground, index);
        let member = &mut self.members[index];
        let Some(end) = end else { return member.fail_calibration(&self.settings, now) };
        member.refuge = Some(end);
        member.set_out(now);
        self.reservations.drop_ahead(index);
    }

    /// The end of the longest straight way through clear ground in view, on which no other robot stands or is to drive.
    /// Cost: 2 to 3 ms for 540,000 cells.
    fn far_end(&self, ground: &Ground, index: usize) -> Option<Point> {
        let (rules, member) = (&self.settings.calibration, &self.members[index]);
        let approach = self.approach(ground, index, &[]);
        let place = self.reservations.claim(index).position();
        let hidden_m = member.radius_m + rules.hidden_m;
        let suits = |on_way: Point| {
            ground.at(on_way).is_some_and(|at| {
                let is_seen = ground.is_covered(at) || (on_way - place).norm() <= hidden_m;
                is_seen && approach.terrain.is_clear(at) && !approach.in_the_way[at]
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
