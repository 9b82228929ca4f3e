//! The pose at the time of a scan: whether it is final, and whether it is certain enough for
//! mapping.

use ubimap_protocol::{
    message::Certainty,
    time::Instant,
    units::{Angle, Millimetres, Pose},
};

use super::{
    estimate::Variances,
    filter::{Backwards, Filter, FixError, FixOutcome, seconds},
    odometry::{MotionNoise, OdometryNoise, between},
    systematic::SystematicErrors,
};
use crate::{
    timing::{BLIND_AFTER, BRIDGED_GAP},
    trigonometry::RADIANS,
};

/// Maximum motion between two odometry readings of a robot at standstill: in millimetres along x
/// and along y, and in binary angle units (one degree).
const STANDS_WITHIN: (u32, u16) = (5, 182);

/// The source of the poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// The server's fixes; odometry, if there is any, bridges the gaps between them.
    Fixes,
    /// Odometry alone, starting from this pose of `odom` in `map`. Its errors are ignored, because
    /// no other map can contradict this one.
    Odometry(Pose),
}

/// Maximum standard deviations of a pose for its scan to be mapped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UncertaintyLimit {
    /// Deviation of the position.
    pub position: Millimetres,
    /// Deviation of the heading.
    pub heading: Angle,
}

impl Default for UncertaintyLimit {
    /// 15 cm and 3 degrees: a wall drawn three cells off becomes a second wall, and 3 degrees
    /// displace points at 3 m by the same distance.
    fn default() -> Self {
        Self { position: Millimetres(150), heading: Angle(546) }
    }
}

/// The answer to a request for the pose at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Located {
    /// The pose (`base_link` in `map`) and its uncertainty.
    At(Pose, Variances),
    /// The pose (`base_link` in `map`), but its uncertainty exceeds the limit.
    Unsure(Pose),
    /// A measurement that determines or improves the pose may still arrive.
    NotYet,
    /// The pose is unknown, and the caller can't wait any longer.
    Never,
}

/// Estimates the robot's pose from fixes and odometry.
#[derive(Debug)]
pub struct Locator {
    filter: Filter,
    errors: SystematicErrors,
    takes_fixes: bool,
    limit: UncertaintyLimit,
}

impl Locator {
    /// A locator without an estimate. The noise is ignored if odometry is the only source.
    pub fn new(source: PoseSource, noise: &OdometryNoise, limit: UncertaintyLimit) -> Self {
        let filter = match source {
            PoseSource::Fixes => Filter::new(MotionNoise::of(noise), None),
            PoseSource::Odometry(start) => Filter::new(MotionNoise::default(), Some(start)),
        };
        let errors = SystematicErrors::new(noise);
        Self { filter, errors, takes_fixes: source == PoseSource::Fixes, limit }
    }

    /// Processes a fix that arrived at `now`: `base_link` in `map` at the server's time `server`,
    /// which is `local` by the robot's clock, if that is known. Returns the outcome and the
    /// estimated pose at that time.
    ///
    /// # Errors
    /// [`FixError`]; the estimate is unchanged.
    pub fn fix(
        &mut self,
        server: Instant,
        local: Option<Instant>,
        pose: Pose,
        certainty: Certainty,
        now: Instant,
    ) -> Result<(FixOutcome, Pose), FixError> {
        if !self.takes_fixes {
            return Err(FixError::Unused);
        }
        let local = local.ok_or(FixError::Untimed)?;
        // Allows for the error of clock synchronisation.
        if local > now + BRIDGED_GAP {
            return Err(FixError::Future);
        }
        self.filter.fix(server, local, pose, certainty)
    }

    /// Processes an odometry reading: `base_link` in `odom` at a time of the robot's clock. A
    /// second reading for the same time is ignored.
    ///
    /// # Errors
    /// [`Backwards`]; the estimate is unchanged.
    pub fn odometry(&mut self, moment: Instant, pose: Pose) -> Result<(), Backwards> {
        if self.filter.is_new(moment)? {
            let corrected = self.errors.corrected(pose);
            self.filter.odometry(moment, corrected);
        }
        Ok(())
    }

    /// Announces that the pose of a scan taken at `taken` will be requested. The pose is most
    /// accurate if this is called before the first odometry reading after that time arrives.
    pub(crate) fn expect(&mut self, taken: Instant) {
        self.filter.expect(taken);
    }

    /// Learns the systematic errors of the odometry from an accepted camera fix.
    pub(crate) fn learn(&mut self, local: Instant, pose: Pose, certainty: Certainty) {
        if let Some(odometry) = self.filter.steady_odometry(local) {
            self.errors.learn(local, pose, certainty, odometry, self.filter.noise());
        }
    }

    /// The newest odometry, corrected for the learnt errors: `base_link` in `odom`.
    pub fn newest_odometry(&self) -> Option<Pose> {
        self.filter.newest_odometry().map(|(_, pose)| pose)
    }

    /// The odometry at the time of a scan, corrected for the learnt errors: `base_link` in `odom`. `None` without
    /// readings about that time.
    pub fn odometry_at(&self, moment: Instant) -> Option<Pose> {
        self.filter.odometry_at(moment)
    }

    /// The newest odometry if the robot has hardly moved since the reading before, so that it is
    /// likely still there: `base_link` in `odom`.
    pub(crate) fn standing_odometry(&self) -> Option<Pose> {
        let (newest, before) = self.filter.newest_two()?;
        let moved = |to: Millimetres, from: Millimetres| to.0.abs_diff(from.0) > STANDS_WITHIN.0;
        let turned = newest.heading.distance(before.heading) > STANDS_WITHIN.1;
        let moves = moved(newest.x, before.x) || moved(newest.y, before.y) || turned;
        (!moves).then_some(newest)
    }

    /// The time of the newest fix.
    pub fn newest_fix(&self) -> Option<Instant> {
        self.filter.newest_fix()
    }

    /// Whether there was no fix in the third of a second before `moment`.
    pub fn is_blind(&self, moment: Instant) -> bool {
        let newest = self.filter.newest_fix();
        self.takes_fixes && newest.is_none_or(|newest| moment.since(newest) >= BLIND_AFTER)
    }

    /// The pose at `moment`, requested at `now` (both by the robot's clock). With `last_chance`,
    /// the answer is never [`Located::NotYet`].
    pub fn at(&self, moment: Instant, now: Instant, last_chance: bool) -> Located {
        if !last_chance && self.may_know_better(moment, now) {
            return Located::NotYet;
        }
        let Some((pose, variances)) = self.best(moment) else {
            return if last_chance { Located::Never } else { Located::NotYet };
        };
        if self.is_within_limit(variances) {
            Located::At(pose, variances)
        } else {
            Located::Unsure(pose)
        }
    }

    /// Whether a measurement that improves the pose at `moment` may still arrive.
    fn may_know_better(&self, moment: Instant, now: Instant) -> bool {
        let fresh = |newest: Instant| now.since(newest) <= BRIDGED_GAP;
        let odometry = self.filter.newest_odometry().map(|(newest, _)| newest);
        if !self.takes_fixes {
            return odometry.is_none_or(|newest| newest < moment);
        }
        let driven = odometry.is_some_and(fresh);
        let fix = self.filter.newest_fix();
        // Without odometry, only a fix can help. With odometry, a fix is awaited only if the last
        // one is recent, so that another is likely.
        let seen = fix.is_some_and(fresh) || !driven;
        fix.is_none_or(|newest| newest < moment) && seen
            || driven && odometry.is_some_and(|newest| newest < moment)
    }

    /// The most likely pose at a time, and its uncertainty.
    pub(crate) fn best(&self, moment: Instant) -> Option<(Pose, Variances)> {
        let before = self.filter.at(moment);
        if let Some(told) = before.filter(|told| !told.guessed) {
            return Some((told.pose, told.variances));
        }
        // The motion is unknown here. If the fixes before and after are close enough in time, the
        // pose is interpolated between them.
        let (last, next) = self.filter.fixes_around(moment);
        let after = next.and_then(|next| Some((next, self.filter.at(next)?)));
        if let Some((last, (next, to))) = last.zip(after)
            && next.since(last) <= BRIDGED_GAP
            && let Some(from) = self.filter.at(last)
        {
            let part = seconds(moment.since(last)) / seconds(next.since(last));
            let variances = from.variances.between(to.variances, part);
            return Some((between(from.pose, to.pose, part), variances));
        }
        let after = after
            .map(|(next, told)| (told.pose, told.variances.after(seconds(next.since(moment)))));
        let before = before.map(|told| (told.pose, told.variances));
        match (before, after) {
            (Some(before), Some(after)) if after.1.position < before.1.position => Some(after),
            (before, after) => before.or(after),
        }
    }

    /// The pose at a time that may be after the newest odometry, and its uncertainty. Extrapolates
    /// up to a third of a second with constant motion.
    pub(crate) fn predicted(&self, moment: Instant) -> Option<(Pose, Variances)> {
        let soon = self.filter.soon_after_odometry(moment);
        soon.map(|told| (told.pose, told.variances)).or_else(|| self.best(moment))
    }

    fn is_within_limit(&self, variances: Variances) -> bool {
        let square = |value: f32| value * value;
        variances.position <= square(self.limit.position.0 as f32)
            && variances.heading <= square(f32::from(self.limit.heading.0) * RADIANS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::time::Duration;

    fn pose(x: i32, y: i32, degrees: f64) -> Pose {
        Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle::from_degrees(degrees) }
    }

    #[track_caller]
    fn near(found: Located, expected: Pose) {
        let Located::At(found, _) = found else { panic!("{found:?}") };
        assert!((found.x.0 - expected.x.0).abs() <= 1, "{found:?}");
        assert!((found.y.0 - expected.y.0).abs() <= 1, "{found:?}");
        assert!(found.heading.distance(expected.heading) <= 20, "{found:?}");
    }

    fn locator(source: PoseSource) -> Locator {
        Locator::new(source, &OdometryNoise::default(), UncertaintyLimit::default())
    }

    fn moment(millis: u64) -> Instant {
        Instant(millis * 1_000)
    }

    /// The server's clock is 7 s ahead.
    fn fix_at(locator: &mut Locator, millis: u64, pose: Pose) -> FixOutcome {
        let local = moment(millis);
        let certainty = Certainty { x: 20, y: 20, heading: 182 };
        let server = local + Duration::from_secs(7);
        locator.fix(server, Some(local), pose, certainty, local).unwrap().0
    }

    #[test]
    fn a_scan_waits_until_fixes_enclose_it() {
        let mut locator = locator(PoseSource::Fixes);
        let at = |locator: &Locator, scan, last| locator.at(moment(scan), moment(scan), last);
        fix_at(&mut locator, 1_000, pose(0, 0, 0.0));
        assert_eq!(at(&locator, 1_050, false), Located::NotYet);
        assert_eq!(at(&locator, 1_050, true), Located::Unsure(pose(0, 0, 0.0)));
        fix_at(&mut locator, 1_100, pose(100, 0, 10.0));
        near(at(&locator, 1_050, false), pose(50, 0, 5.0));
        // Gaps that are too long are not bridged.
        fix_at(&mut locator, 2_100, pose(1100, 0, 10.0));
        assert!(matches!(at(&locator, 1_600, true), Located::Unsure(_)));
        assert_eq!(at(&locator, 2_200, false), Located::NotYet);
        // A scan from just before the first fix gets the pose of that fix.
        near(at(&locator, 1_000, true), pose(0, 0, 0.0));
        near(locator.at(Instant(999_990), moment(1_000), true), pose(0, 0, 0.0));
    }

    #[test]
    fn odometry_carries_a_fix_on_until_it_is_too_unsure() {
        let mut locator = locator(PoseSource::Fixes);
        // At 0.5 m/s, read at 20 Hz; in `map` it drives north from (1, 2) m.
        let drive = |locator: &mut Locator, from: u64, to: u64| {
            for millis in (from..to).step_by(50) {
                let x = (millis / 2) as i32;
                locator.odometry(moment(millis), pose(x, 0, 0.0)).unwrap();
            }
        };
        drive(&mut locator, 0, 1_050);
        fix_at(&mut locator, 1_000, pose(1000, 2000, 90.0));
        let at = |locator: &Locator, scan, now| locator.at(moment(scan), moment(now), false);
        // A fix or more odometry may still arrive.
        assert_eq!(at(&locator, 1_020, 1_030), Located::NotYet);
        drive(&mut locator, 1_050, 2_050);
        near(at(&locator, 1_910, 2_020), pose(1000, 2455, 90.0));
        assert_eq!(at(&locator, 2_040, 2_041), Located::NotYet);
        drive(&mut locator, 2_050, 9_050);
        near(at(&locator, 9_000, 9_000), pose(1000, 6000, 90.0));
        // After 9.5 m a heading deviation of one degree makes 17 cm, plus the odometry's own noise.
        drive(&mut locator, 9_050, 20_050);
        let Located::Unsure(lost) = at(&locator, 20_000, 20_000) else { panic!() };
        assert_eq!(lost, pose(1000, 11_500, 90.0));
        // The next fix corrects it.
        fix_at(&mut locator, 20_000, pose(1000, 11_400, 90.0));
        assert!(matches!(at(&locator, 20_000, 20_000), Located::At(..)));
    }

    #[test]
    fn the_odometry_of_a_time_is_known_between_readings_and_contains_no_fix() {
        let mut locator = locator(PoseSource::Fixes);
        fix_at(&mut locator, 900, pose(0, 0, 0.0));
        assert_eq!(locator.odometry_at(moment(900)), None, "no odometry yet");
        for millis in (1_000..3_001).step_by(50) {
            locator.odometry(moment(millis), pose((millis / 2) as i32, 0, 0.0)).unwrap();
            if millis == 2_500 {
                fix_at(&mut locator, 2_400, pose(5_000, 2_000, 90.0));
            }
        }
        let at = |millis| locator.odometry_at(moment(millis));
        for millis in [2_050, 2_080, 2_400, 2_500, 2_990, 3_000] {
            let found = at(millis).unwrap_or_else(|| panic!("{millis}"));
            assert!((found.x.0 - (millis / 2) as i32).abs() <= 1, "{millis}: {found:?}");
            assert_eq!((found.y, found.heading), (Millimetres(0), Angle(0)));
        }
        // Too old, and yet to come.
        for unknown in [0, 900, 3_050, 9_000] {
            assert_eq!(at(unknown), None, "{unknown}");
        }
    }

    /// Remembered readings are 100 ms apart, but for a scan the readings just before and after it
    /// are used.
    #[test]
    fn the_odometry_of_a_scans_moment_is_remembered() {
        let (mut locator, mut other) = (
            locator(PoseSource::Odometry(pose(0, 0, 0.0))),
            locator(PoseSource::Odometry(pose(0, 0, 0.0))),
        );
        // The robot turns with an acceleration of 2,000 degrees/s^2.
        let at = |millis: u64| pose(0, 0, 0.001 * (millis * millis) as f64);
        for millis in (10..600).step_by(50) {
            let is_scan = millis % 100 == 60;
            for locator in [&mut locator, &mut other] {
                locator.odometry(moment(millis), at(millis)).unwrap();
            }
            if is_scan {
                locator.expect(moment(millis + 40));
            }
        }
        let off =
            |locator: &Locator, millis: u64| match locator.at(moment(millis), moment(600), true) {
                Located::At(found, _) => found.heading.distance(at(millis).heading),
                missing => panic!("{missing:?}"),
            };
        // Headings in binary angle units: 182 are one degree.
        for scan in [200, 300, 400] {
            assert!(off(&locator, scan) <= 90, "{}", off(&locator, scan));
            assert!(off(&other, scan) > off(&locator, scan), "{}", off(&other, scan));
        }
    }

    /// The drive's steps happen at other times than the odometry readings.
    #[test]
    fn the_pose_is_extrapolated_shortly_after_the_odometry_and_then_lost() {
        for turn in [0.0, 60.0] {
            // At 0.5 m/s, read at 66 Hz, with fixes at 10 Hz until 0.1 s ago.
            let mut locator = locator(PoseSource::Fixes);
            let at = |millis: f64| {
                let degrees = turn * millis / 1_000.0;
                let heading = degrees.to_radians();
                let way = millis / 2.0;
                // Along an arc, or straight.
                let (sin, cos) = (libm::sin(heading), libm::cos(heading));
                let bend = if turn == 0.0 {
                    (way, 0.0)
                } else {
                    (way * sin / heading.max(1e-9), way * (1.0 - cos) / heading.max(1e-9))
                };
                pose(bend.0 as i32, bend.1 as i32, degrees)
            };
            for reading in 0..134u64 {
                let millis = reading * 15;
                locator.odometry(moment(millis), at(millis as f64)).unwrap();
                if reading % 7 == 6 && millis > 90 {
                    fix_at(&mut locator, millis - 90, at(millis as f64 - 90.0));
                }
            }
            let newest = 133 * 15;
            for micros in [0, 1, 1_900, 10_000, 25_000, 50_000] {
                let now = Instant(newest * 1_000 + micros);
                let (found, variances) = locator.predicted(now).unwrap();
                let truth = at(now.0 as f64 / 1e3);
                let off = libm::hypot((found.x - truth.x).metres(), (found.y - truth.y).metres());
                assert!(off < 0.006, "{micros} us: {off} m off");
                assert!(found.heading.distance(truth.heading) < 182, "{micros} us: {found:?}");
                assert!(libm::sqrtf(variances.position) < 30.0, "{micros} us: {variances:?}");
                assert!(locator.is_within_limit(variances));
            }
            let (_, later) = locator.predicted(moment(newest + 350)).unwrap();
            assert!(libm::sqrtf(later.position) > 60.0, "{later:?}");
            let (_, lost) = locator.predicted(moment(newest + 351)).unwrap();
            assert!(libm::sqrtf(lost.position) > 150.0, "{lost:?}");
        }
        // With one reading the speed is unknown, but a robot does not get far in 50 ms.
        let mut locator = locator(PoseSource::Odometry(pose(0, 0, 0.0)));
        assert_eq!(locator.predicted(moment(1)).map(|(pose, _)| pose), Some(pose(0, 0, 0.0)));
        locator.odometry(moment(10), pose(100, 0, 0.0)).unwrap();
        let (found, variances) = locator.predicted(moment(60)).unwrap();
        let deviation = libm::sqrtf(variances.position);
        assert_eq!(found, pose(100, 0, 0.0));
        assert!((20.0..60.0).contains(&deviation), "{deviation}");
    }

    #[test]
    fn odometry_alone_starts_from_a_given_pose() {
        let mut locator = locator(PoseSource::Odometry(pose(500, 0, 180.0)));
        locator.odometry(moment(0), pose(0, 0, 0.0)).unwrap();
        assert_eq!(locator.at(moment(1), moment(1), false), Located::NotYet);
        locator.odometry(moment(2), pose(200, 0, 90.0)).unwrap();
        near(locator.at(moment(2), moment(2), false), pose(300, 0, -90.0));
        near(locator.at(moment(1), moment(2), false), pose(400, 0, -135.0));
        let certainty = Certainty::default();
        let fixed = locator.fix(moment(2), Some(moment(2)), pose(0, 0, 0.0), certainty, moment(2));
        assert_eq!(fixed, Err(FixError::Unused));
    }

    #[test]
    fn fixes_of_a_carried_robot_are_accepted_after_five_rejections() {
        let mut locator = locator(PoseSource::Fixes);
        for millis in (0..4_000).step_by(50) {
            locator.odometry(moment(millis), pose(0, 0, 0.0)).unwrap();
        }
        let (here, there) = (pose(0, 0, 0.0), pose(3_000, 0, 0.0));
        assert_eq!(fix_at(&mut locator, 3_000, here), FixOutcome::Began);
        assert_eq!(fix_at(&mut locator, 3_066, here), FixOutcome::Taken);
        // Single outliers are rejected, also when they do not agree with one another.
        for (millis, x) in [(3_133, 3_000), (3_200, -3_000), (3_266, 3_000), (3_333, 5_000)] {
            assert_eq!(fix_at(&mut locator, millis, pose(x, 0, 0.0)), FixOutcome::Rejected);
        }
        near(locator.at(moment(3_333), moment(3_333), true), here);
        for millis in [3_400, 3_466, 3_533, 3_600] {
            assert_eq!(fix_at(&mut locator, millis, there), FixOutcome::Rejected);
        }
        assert_eq!(fix_at(&mut locator, 3_666, there), FixOutcome::Moved);
        near(locator.at(moment(3_700), moment(3_700), true), there);
        assert_eq!(fix_at(&mut locator, 3_733, there), FixOutcome::Taken);
    }

    #[test]
    fn fixes_and_odometry_with_invalid_times_are_refused() {
        let mut locator = locator(PoseSource::Fixes);
        let origin = pose(0, 0, 0.0);
        for fix in 10..20 {
            fix_at(&mut locator, fix * 100, origin);
        }
        let mut fix = |server: u64, local: Option<u64>, now: u64| {
            let certainty = Certainty::default();
            let refused =
                locator.fix(moment(server), local.map(moment), origin, certainty, moment(now));
            refused.map(|(outcome, _)| outcome)
        };
        assert_eq!(fix(8_900, Some(1_900), 2_000), Err(FixError::Repeated));
        assert_eq!(fix(1, None, 2_000), Err(FixError::Untimed));
        assert_eq!(fix(2, Some(1_100), 2_000), Err(FixError::TooOld));
        // Another server time that maps to the same local time is another fix.
        assert_eq!(fix(8_801, Some(1_800), 2_000), Ok(FixOutcome::Taken));
        assert_eq!(fix(8_802, Some(1_800), 2_000), Ok(FixOutcome::Taken));
        assert_eq!(fix(3, Some(2_351), 2_000), Err(FixError::Future));
        // After 450 ms without odometry the pose is lost.
        assert_eq!(fix(3, Some(2_350), 2_000), Ok(FixOutcome::Began));
        locator.odometry(moment(3_000), origin).unwrap();
        assert!(locator.odometry(moment(2_999), origin).is_err());
        assert_eq!(locator.odometry(moment(3_000), pose(9, 9, 9.0)), Ok(()));
        assert_eq!(locator.newest_odometry(), Some(origin));
    }
}
