//! The corrections of one robot.

use std::collections::VecDeque;

use ubimap_protocol::{
    message::{Certainty, DistanceVector, FixSource, ParameterReport, PoseFix},
    tile::Epoch,
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};

use super::{
    blind::{BlindTrip, reach},
    cure::{Cure, CureStep},
    odometry::{Reported, SystematicErrors},
};
use crate::{
    mapping::{
        ConstantErrors, CureRecord, Match, Prior, Search, Surfaces, Trail, points,
        submaps::{View, motion},
        trajectories::Trajectories,
    },
    server::{shared_map::SharedMap, surroundings::Place},
    timing::{FIX_GAP, FIX_HISTORY, OUT_OF_VIEW},
};

/// Search range for a robot in view, around the pose seen by cameras.
const IN_VIEW: Search = Search {
    position: Millimetres(100),
    turn: Angle(2_600),
    prior: Prior::Measured(Millimetres(25)),
};
/// Minimum interval between processed distance vectors of a robot; robots send one per second.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);

/// The result of processing a distance vector.
pub(super) enum Finding {
    /// The pose in blind ground.
    Fix(PoseFix),
    /// The robot is in view. Contains the number of its points on surfaces that cameras see, and
    /// the number in free ground.
    Agreement(u32, u32),
}

/// One robot's fixes, constant errors and time in blind ground.
#[derive(Debug, Default)]
pub(super) struct RobotCorrection {
    errors: ConstantErrors,
    cure: Cure,
    /// Distance vectors up to this time were taken before the last correction, and are ignored.
    corrected: Instant,
    /// Recent camera fixes, corrected; newest last.
    fixes: VecDeque<(Instant, Pose)>,
    blind: Option<BlindTrip>,
    /// Outlasts the trips.
    systematic: SystematicErrors,
    next_look: Instant,
}

impl RobotCorrection {
    /// Starts without measurements, from a stored record.
    pub(super) fn of(record: &CureRecord) -> Self {
        let cure = if record.is_over { Cure::None } else { Cure::LeftOff };
        Self { errors: ConstantErrors::of(record.cured), cure, ..Self::default() }
    }

    /// The estimates of the robot's constant errors.
    pub(super) fn errors(&self) -> &ConstantErrors {
        &self.errors
    }

    /// The first epoch that the robot was told to use, until its earlier epochs are void.
    pub(super) fn retiring(&self) -> Option<Epoch> {
        self.cure.retiring()
    }

    /// Adds a camera fix; returns the corrected pose.
    pub(super) fn fix(&mut self, captured: Instant, seen: Pose) -> Pose {
        if self.fixes.back().is_some_and(|&(newest, _)| captured <= newest) {
            return self.errors.corrected(seen);
        }
        let pose = self.errors.fix(captured, seen);
        if self.blind.take().is_some() {
            self.systematic.doubt();
        }
        self.fixes.push_back((captured, pose));
        self.fixes.retain(|&(moment, _)| captured.since(moment) <= FIX_HISTORY);
        pose
    }

    /// Begins a trip of the robot, which has booted, around the place where it was. It has forgotten its calibration.
    pub(super) fn seek(&mut self, about: &Place) {
        self.systematic = SystematicErrors::default();
        self.blind = Some(BlindTrip::about(about));
    }

    /// Whether the robot has booted out of view and was not found yet.
    pub(super) fn is_sought(&self) -> bool {
        self.blind.as_ref().is_some_and(BlindTrip::is_sought)
    }

    /// Processes a distance vector of the robot. Cost: some milliseconds.
    pub(super) fn look(
        &mut self,
        robot: RobotId,
        vector: &DistanceVector,
        (map, resolution): (&SharedMap, Millimetres),
        now: Instant,
        trajectories: Option<&mut Trajectories>,
    ) -> Option<Finding> {
        if now < self.next_look {
            return None;
        }
        self.next_look = now + LOOK_INTERVAL;
        let points = points(vector);
        if let Some(pose) = self.seen_at(vector.time) {
            if let Some(trajectories) = trajectories {
                trajectories.add(robot, &View::of(vector), motion(pose), None, Some(motion(pose)));
            }
            let is_valid = vector.time > self.corrected;
            return is_valid.then(|| self.compare(&points, pose, map, resolution));
        }
        let newest = self.fixes.back().map_or(Instant(0), |&(newest, _)| newest);
        if vector.time < newest {
            return None;
        }
        let unseen = vector.time.since(newest);
        let blind =
            self.blind.get_or_insert_with(|| BlindTrip::after(unseen, Reported::by(vector)));
        if unseen < OUT_OF_VIEW {
            if let Some(trajectories) = trajectories {
                let pose = motion(vector.pose);
                trajectories.add(robot, &View::of(vector), pose, None, Some(pose));
            }
            blind.remember(vector, &points, resolution);
            return None;
        }
        let views = (map, resolution);
        let found =
            blind.locate(robot, vector, &points, views, &mut self.systematic, trajectories)?;
        Some(Finding::Fix(fix_of(&found, vector.time)))
    }

    /// The robot's pose at a given time, interpolated between camera fixes. `None` without fixes
    /// shortly before and after.
    fn seen_at(&self, moment: Instant) -> Option<Pose> {
        let after = self.fixes.iter().position(|&(fix, _)| fix >= moment)?;
        let (to, end) = self.fixes[after];
        let (from, start) = *self.fixes.get(after.checked_sub(1)?)?;
        let gap = to.since(from);
        if gap > FIX_GAP {
            return None;
        }
        let part = moment.since(from).micros() as f64 / gap.micros() as f64;
        let mix = |from: Millimetres, to: Millimetres| {
            from + Millimetres(libm::round(f64::from((to - from).0) * part) as i32)
        };
        let turn = Angle::from_radians((end.heading - start.heading).radians() * part);
        Some(Pose { x: mix(start.x, end.x), y: mix(start.y, end.y), heading: start.heading + turn })
    }

    /// Matches a distance vector from a known pose with what the cameras see. The rotation of the
    /// match is a measurement of the constant errors. The points that are then still off the
    /// surfaces count as contradictions between robot and cameras.
    fn compare(
        &mut self,
        points: &[[f64; 2]],
        pose: Pose,
        map: &SharedMap,
        resolution: Millimetres,
    ) -> Finding {
        let reach = reach(points) + IN_VIEW.position;
        let surfaces =
            Surfaces::about(pose, reach, resolution, |id| map.in_view(id), &Trail::default());
        let found = surfaces.find(points, pose, IN_VIEW);
        if let Some(found) = found {
            let [.., deviation] = found.deviations();
            let turned = (found.pose.heading - pose.heading).degrees();
            self.errors.turned(turned, deviation.to_degrees());
        }
        let (agree, contradict) =
            surfaces.agreement(points, found.map_or(pose, |found| found.pose));
        Finding::Agreement(agree, contradict)
    }

    /// The next step of the cure, if one is due. `next` is the first epoch after all that the robot
    /// is known to have used.
    pub(super) fn poll_cure(&mut self, next: Epoch, now: Instant) -> Option<CureStep> {
        let step = self.cure.poll(&mut self.errors, next, now);
        if matches!(step, Some(CureStep::IdentifierCorrected)) {
            self.fixes.clear();
            self.corrected = now;
        }
        step
    }

    /// Handles the robot's answer to a command of a cure.
    pub(super) fn reported(&mut self, report: &ParameterReport, now: Instant) -> Option<CureStep> {
        let step = self.cure.reported(&mut self.errors, report, now);
        if matches!(step, Some(CureStep::SensorCorrected)) {
            self.corrected = now;
        }
        step
    }
}

/// Converts a match to a fix. A fix carries no correlations between x, y and heading,
/// only their deviations, rounded up.
fn fix_of(found: &Match, time: Instant) -> PoseFix {
    let [x, y, heading] = found.deviations();
    // The casts saturate.
    let certainty = Certainty {
        x: x.ceil() as u16,
        y: y.ceil() as u16,
        heading: (heading / core::f64::consts::TAU * 65_536.0).ceil() as u16,
    };
    PoseFix {
        time,
        pose: found.pose,
        certainty,
        source: FixSource::MapMatch,
        earlier: heapless::Vec::new(),
    }
}
