//! Lets robots drive to and fro in the cameras' view, where they learn the systematic errors of their odometry: what
//! robots draw far out of view is as good as their odometry.

use ubimap_protocol::time::Instant;

use super::{
    coordinator::Coordinator,
    ground::{Disc, Ground, Point},
};

/// What is known of the calibration of a robot's odometry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Calibration {
    /// It is missing. The robot may be called into view for it from then on.
    Missing(Instant),
    /// The robot drives in view for it, or comes into view.
    Due,
    /// The robot has driven far enough in view.
    Done,
}

impl Calibration {
    /// Whether the robot is not to be called into view for it.
    pub(super) fn is_over(self, now: Instant) -> bool {
        self == Self::Done || matches!(self, Self::Missing(from) if now < from)
    }

    /// Lets the robot explore without it until then.
    pub(super) fn put_off(&mut self, until: Instant) {
        if *self == Self::Due {
            *self = Self::Missing(until);
        }
    }
}

impl Coordinator {
    /// Sends robots whose calibration is due to the other end of a straight way in the cameras' view, until they have
    /// driven far enough there or nothing is left to explore. Cost: 25,000 cells for each way that begins.
    pub(super) fn calibrate(&mut self, ground: &Ground, now: Instant) {
        let rules = self.settings.calibration;
        let (open, taken) = self.frontiers_left();
        let is_of_use = !open.is_empty() || !taken.is_empty();
        for index in 0..self.members.len() {
            let member = &mut self.members[index];
            if member.seen_m >= rules.way_m {
                member.calibration = Calibration::Done;
            }
            if !is_of_use {
                member.calibration.put_off(now);
            }
            let is_here =
                member.is_exploring() && member.target.is_none() && member.recall.is_some();
            if member.calibration != Calibration::Due || !is_here {
                continue;
            }
            let place = self.reservations.claim(index).position();
            if member.refuge.is_some_and(|end| (end - place).norm() > rules.next_m) {
                continue;
            }
            match self.far_end(ground, index) {
                Some(end) => {
                    let member = &mut self.members[index];
                    member.refuge = Some(end);
                    member.set_out(now);
                    self.reservations.drop_ahead(index);
                }
                None => self.members[index].calibration.put_off(now + rules.put_off),
            }
        }
    }

    /// The end of the longest straight way through open ground in view, on which no other robot stands or is to drive.
    fn far_end(&self, ground: &Ground, index: usize) -> Option<Point> {
        let rules = &self.settings.calibration;
        let approach = self.approach(ground, index, &[]);
        let suits = |place| {
            ground.at(place).is_some_and(|at| {
                let is_open = approach.terrain.is_open(at) && !approach.in_the_way[at];
                is_open && ground.is_covered(at)
            })
        };
        let from = approach.from;
        // The robot itself hides the ground below it from cameras.
        let hidden_m = self.members[index].radius_m;
        let is_straight = |end: Point| {
            let way = end - from;
            let steps = (way.norm() / ground.side_m()).ceil();
            let parts = (1..=steps as usize).map(|step| step as f64 / steps);
            let mut parts = parts.filter(|part| part * way.norm() > hidden_m);
            parts.all(|part| suits(from + way * part))
        };
        let mut best = (rules.least_m, None);
        ground.within(&Disc { centre: from, radius: rules.most_m }, |at| {
            let end = ground.place(at);
            let way_m = (end - from).norm();
            if way_m > best.0 && is_straight(end) {
                best = (way_m, Some(end));
            }
        });
        best.1
    }
}
