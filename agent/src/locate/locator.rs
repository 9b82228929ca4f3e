//! The pose of the moment a scan was taken: when it is known as well as it will be, and whether
//! that is well enough to map.

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

/// A robot stands that moves less from one reading of the odometry to the next: in millimetres along
/// x and along y, and in binary angle units (a degree).
const STANDS_WITHIN: (u32, u16) = (5, 182);

/// Where the poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// The server's fixes; odometry, if there is any, bridges what they miss.
    Fixes,
    /// Odometry alone, from this pose of `odom` in `map`. It is taken at its word: nothing is
    /// there that its map could be at odds with.
    Odometry(Pose),
}

/// How unsure a pose may be for a scan to be mapped from it: standard deviations.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UncertaintyLimit {
    /// Of the distance from the true position.
    pub position: Millimetres,
    /// Of the heading.
    pub heading: Angle,
}

impl Default for UncertaintyLimit {
    /// 15 cm and 3 degrees: a wall that is drawn three cells off becomes a second wall, and
    /// 3 degrees put what is 3 m away as far off.
    fn default() -> Self {
        Self { position: Millimetres(150), heading: Angle(546) }
    }
}

/// How the pose of a moment stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Located {
    /// `base_link` in `map`, and how unsure it is.
    At(Pose, Variances),
    /// `base_link` in `map`, less sure than is allowed.
    Unsure(Pose),
    /// What would tell may still come.
    NotYet,
    /// Nothing that may still come would tell.
    Never,
}

/// The filter, and what is asked of it.
#[derive(Debug)]
pub struct Locator {
    filter: Filter,
    errors: SystematicErrors,
    takes_fixes: bool,
    limit: UncertaintyLimit,
}

impl Locator {
    /// A locator that knows nothing yet. The noise is of no account if odometry is the source.
    pub fn new(source: PoseSource, noise: &OdometryNoise, limit: UncertaintyLimit) -> Self {
        let filter = match source {
            PoseSource::Fixes => Filter::new(MotionNoise::of(noise), None),
            PoseSource::Odometry(start) => Filter::new(MotionNoise::default(), Some(start)),
        };
        let errors = SystematicErrors::new(noise);
        Self { filter, errors, takes_fixes: source == PoseSource::Fixes, limit }
    }

    /// Takes a fix that arrived at `now`: `base_link` in `map` at the moment `server` of the
    /// server's clock, which is `local` of the robot's (if that is known). With the outcome comes
    /// the pose that is believed for that moment.
    ///
    /// # Errors
    /// Every [`FixError`]; nothing has changed then.
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
        // Clocks agree but so far.
        if local > now + BRIDGED_GAP {
            return Err(FixError::Future);
        }
        self.filter.fix(server, local, pose, certainty)
    }

    /// Takes a reading of the odometry: `base_link` in `odom` at a moment of the robot's clock.
    /// Two of one moment are one, the first.
    ///
    /// # Errors
    /// [`Backwards`]; nothing has changed then.
    pub fn odometry(&mut self, moment: Instant, pose: Pose) -> Result<(), Backwards> {
        if self.filter.is_new(moment)? {
            let corrected = self.errors.corrected(pose);
            self.filter.odometry(moment, corrected);
        }
        Ok(())
    }

    /// The pose of a scan will be asked for. Odometry that comes before and after it tells that pose best
    /// if this is known when it comes.
    pub(crate) fn expect(&mut self, taken: Instant) {
        self.filter.expect(taken);
    }

    /// Learns from a camera's fix that was taken in what odometry gets wrong each time.
    pub(crate) fn learn(&mut self, local: Instant, pose: Pose, certainty: Certainty) {
        if let Some(odometry) = self.filter.steady_odometry(local) {
            self.errors.learn(local, pose, certainty, odometry, self.filter.noise());
        }
    }

    /// The newest reading of the odometry without the errors that are known: `base_link` in `odom`.
    pub fn newest_odometry(&self) -> Option<Pose> {
        self.filter.newest_odometry().map(|(_, pose)| pose)
    }

    /// The newest reading of the odometry, if the robot has hardly moved since the one before: then
    /// it is where the robot is now, too. `base_link` in `odom`.
    pub(crate) fn standing_odometry(&self) -> Option<Pose> {
        let (newest, before) = self.filter.newest_two()?;
        let moved = |to: Millimetres, from: Millimetres| to.0.abs_diff(from.0) > STANDS_WITHIN.0;
        let turned = newest.heading.distance(before.heading) > STANDS_WITHIN.1;
        let moves = moved(newest.x, before.x) || moved(newest.y, before.y) || turned;
        (!moves).then_some(newest)
    }

    /// The moment of the newest fix.
    pub fn newest_fix(&self) -> Option<Instant> {
        self.filter.newest_fix()
    }

    /// Whether the fixes have stopped: there was none in the third of a second before `moment`.
    pub fn is_blind(&self, moment: Instant) -> bool {
        let newest = self.filter.newest_fix();
        self.takes_fixes && newest.is_none_or(|newest| moment.since(newest) >= BLIND_AFTER)
    }

    /// The pose at `moment`, asked for at `now` (robot's clock). With `last_chance` it is not
    /// waited for anything better.
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

    /// Whether a measurement may come, late or after the moment, that tells more of it.
    fn may_know_better(&self, moment: Instant, now: Instant) -> bool {
        let fresh = |newest: Instant| now.since(newest) <= BRIDGED_GAP;
        let odometry = self.filter.newest_odometry().map(|(newest, _)| newest);
        if !self.takes_fixes {
            return odometry.is_none_or(|newest| newest < moment);
        }
        let driven = odometry.is_some_and(fresh);
        let fix = self.filter.newest_fix();
        // Without odometry nothing but a fix can tell; with it, one that is likely to come.
        let seen = fix.is_some_and(fresh) || !driven;
        fix.is_none_or(|newest| newest < moment) && seen
            || driven && odometry.is_some_and(|newest| newest < moment)
    }

    /// The pose at a moment, and how unsure it is.
    pub(crate) fn best(&self, moment: Instant) -> Option<(Pose, Variances)> {
        let before = self.filter.at(moment);
        if let Some(told) = before.filter(|told| !told.guessed) {
            return Some((told.pose, told.variances));
        }
        // The motion is not known: it goes by the fixes on both sides, if they are near.
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

    /// The pose at a moment that may lie after the newest reading of the odometry, and how unsure it
    /// is. Up to a third of a second after that reading the robot is taken to go on as it did.
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
        // A gap that is too wide is not believed.
        fix_at(&mut locator, 2_100, pose(1100, 0, 10.0));
        assert!(matches!(at(&locator, 1_600, true), Located::Unsure(_)));
        assert_eq!(at(&locator, 2_200, false), Located::NotYet);
        // One that was taken just before the first fix is where that says.
        near(at(&locator, 1_000, true), pose(0, 0, 0.0));
        near(locator.at(Instant(999_990), moment(1_000), true), pose(0, 0, 0.0));
    }

    #[test]
    fn odometry_carries_a_fix_on_until_it_is_too_unsure() {
        let mut locator = locator(PoseSource::Fixes);
        // At 0.5 m/s, read at 20 Hz; in `map` it goes north from (1, 2) m.
        let drive = |locator: &mut Locator, from: u64, to: u64| {
            for millis in (from..to).step_by(50) {
                let x = (millis / 2) as i32;
                locator.odometry(moment(millis), pose(x, 0, 0.0)).unwrap();
            }
        };
        drive(&mut locator, 0, 1_050);
        fix_at(&mut locator, 1_000, pose(1000, 2000, 90.0));
        let at = |locator: &Locator, scan, now| locator.at(moment(scan), moment(now), false);
        // A fix may come yet, and so may odometry.
        assert_eq!(at(&locator, 1_020, 1_030), Located::NotYet);
        drive(&mut locator, 1_050, 2_050);
        near(at(&locator, 1_910, 2_020), pose(1000, 2455, 90.0));
        assert_eq!(at(&locator, 2_040, 2_041), Located::NotYet);
        drive(&mut locator, 2_050, 9_050);
        near(at(&locator, 9_000, 9_000), pose(1000, 6000, 90.0));
        // After 9.5 m a heading that was unsure by a degree makes 17 cm, and there is more.
        drive(&mut locator, 9_050, 20_050);
        let Located::Unsure(lost) = at(&locator, 20_000, 20_000) else { panic!() };
        assert_eq!(lost, pose(1000, 11_500, 90.0));
        // The next fix mends it.
        fix_at(&mut locator, 20_000, pose(1000, 11_400, 90.0));
        assert!(matches!(at(&locator, 20_000, 20_000), Located::At(..)));
    }

    /// Readings that are remembered lie 100 ms apart; at the moment of a scan the ones that came just
    /// before and after it count.
    #[test]
    fn the_odometry_of_a_scans_moment_is_remembered() {
        let (mut locator, mut other) = (
            locator(PoseSource::Odometry(pose(0, 0, 0.0))),
            locator(PoseSource::Odometry(pose(0, 0, 0.0))),
        );
        // It turns ever faster, by 2,000 degrees/s^2.
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
        // Binary units: 182 are a degree.
        for scan in [200, 300, 400] {
            assert!(off(&locator, scan) <= 90, "{}", off(&locator, scan));
            assert!(off(&other, scan) > off(&locator, scan), "{}", off(&other, scan));
        }
    }

    /// A step of the drive comes when it is due, and not with a reading of the odometry.
    #[test]
    fn soon_after_the_odometry_the_pose_is_known_and_then_it_is_lost() {
        for turn in [0.0, 60.0] {
            // At 0.5 m/s, read at 66 Hz, with fixes at 10 Hz until a tenth of a second ago.
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
        // With one reading the speed is not known, and a robot does not go far in 50 ms.
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
    fn a_robot_that_is_carried_off_is_believed_after_five_fixes() {
        let mut locator = locator(PoseSource::Fixes);
        for millis in (0..4_000).step_by(50) {
            locator.odometry(moment(millis), pose(0, 0, 0.0)).unwrap();
        }
        let (here, there) = (pose(0, 0, 0.0), pose(3_000, 0, 0.0));
        assert_eq!(fix_at(&mut locator, 3_000, here), FixOutcome::Began);
        assert_eq!(fix_at(&mut locator, 3_066, here), FixOutcome::Taken);
        // A fix elsewhere now and then, or one that agrees with no other, is left out.
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
    fn what_cannot_be_placed_in_time_is_refused() {
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
        // Another one that came to be of the same moment is one more.
        assert_eq!(fix(8_801, Some(1_800), 2_000), Ok(FixOutcome::Taken));
        assert_eq!(fix(8_802, Some(1_800), 2_000), Ok(FixOutcome::Taken));
        assert_eq!(fix(3, Some(2_351), 2_000), Err(FixError::Future));
        // After 450 ms without odometry nothing is known any more.
        assert_eq!(fix(3, Some(2_350), 2_000), Ok(FixOutcome::Began));
        locator.odometry(moment(3_000), origin).unwrap();
        assert!(locator.odometry(moment(2_999), origin).is_err());
        assert_eq!(locator.odometry(moment(3_000), pose(9, 9, 9.0)), Ok(()));
        assert_eq!(locator.newest_odometry(), Some(origin));
    }
}
