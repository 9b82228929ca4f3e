//! Drives robots to and fro in the cameras' view, where they learn the systematic errors of their odometry: what robots
//! draw far out of view is as good as their odometry.

use ubimap_protocol::time::{Duration, Instant};

use super::{
    coordinator::Coordinator,
    ground::{Disc, Ground, Point},
    member::Member,
};

/// What is known of the calibration of a robot's odometry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OdometryCalibration {
    /// It is missing. The robot may be called into view for it from then on.
    Missing(Instant),
    /// The robot comes into view for it, or drives there: since then.
    Due(Instant),
    /// The robot has driven far enough in view.
    Done,
}

impl OdometryCalibration {
    /// Whether the robot may be called into view for it.
    pub(super) fn is_wanted(self, now: Instant) -> bool {
        match self {
            Self::Missing(from) => from <= now,
            Self::Due(_) => true,
            Self::Done => false,
        }
    }

    pub(super) fn is_due(self) -> bool {
        matches!(self, Self::Due(_))
    }

    /// Lets the robot explore without it until then.
    pub(super) fn put_off(&mut self, until: Instant) {
        if self.is_due() {
            *self = Self::Missing(until);
        }
    }

    /// Whether it was begun at least this long ago.
    fn is_late(self, patience: Duration, now: Instant) -> bool {
        matches!(self, Self::Due(since) if now.since(since) >= patience)
    }
}

impl Coordinator {
    /// Sends a robot whose calibration is due to the other end of a straight way in the cameras' view, until it has
    /// driven far enough there. One robot each time, so that the next one knows its route. Cost: one terrain.
    pub(super) fn calibrate(&mut self, ground: &Ground, now: Instant) {
        let rules = self.settings.calibration;
        for member in &mut self.members {
            if member.seen_m >= rules.distance_m {
                member.calibration = OdometryCalibration::Done;
            }
            if member.calibration.is_late(rules.patience, now) {
                member.calibration.put_off(now + rules.put_off);
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

impl Member {
    /// Whether the robot is where cameras see it, and free to calibrate its odometry.
    fn calibrates(&self) -> bool {
        let is_free = self.is_exploring() && self.target.is_none() && self.recall.is_some();
        self.calibration.is_due() && is_free
    }
}
