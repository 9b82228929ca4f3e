//! The filter: fuses odometry with fixes, which arrive late.
//!
//! The estimate for a time is computed from the measurements in the order of their time stamps, not
//! of their arrival: the filter starts from a state that is older than all remembered measurements
//! and replays these. So a late fix takes its place in time, and the odometry after it is replayed.

use core::fmt;

use ubimap_protocol::{
    message::Certainty,
    time::{Duration, Instant},
    units::Pose,
};

use super::{
    estimate::{Estimate, Fix, Variances},
    history::{HISTORY_SPAN, History},
    odometry::{MotionNoise, between},
};
use crate::timing::BRIDGED_GAP;

/// Number of odometry readings remembered, and the minimum interval between them. Their product is
/// at least the time that a scan waits for its pose. Hard braking between two readings displaces
/// the robot by a millimetre.
const READINGS: usize = 15;
const READING_INTERVAL: Duration = Duration::from_millis(100);
/// Minimum interval between the readings remembered for scans, which later readings do not replace:
/// at 15 Hz the readings of one second are remembered.
const SCAN_INTERVAL: Duration = Duration::from_millis(60);
/// Minimum span for measuring the speed: over a shorter one, the rounding of readings to
/// millimetres causes an error above 20 mm/s.
const SPEED_SPAN: Duration = Duration::from_millis(50);
/// Maximum turn between two readings for a steady robot: half a degree, in binary angle units.
const STEADY: u16 = 91;
/// Number of fixes remembered: half a second at 15 Hz.
const FIXES: usize = 8;
/// Number of consecutive rejected fixes that agree with one another before they are accepted: a
/// third of a second at 15 Hz.
const RIVALS: u8 = 5;

/// The result of processing a fix.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FixOutcome {
    /// The fix is the first, or the pose was lost: the estimate starts anew from this fix.
    Began,
    /// The fix was accepted.
    Taken,
    /// The fix was rejected as an outlier.
    Rejected,
    /// The fix was accepted because it agrees with several that were rejected: the robot was
    /// carried.
    Moved,
}

/// Why a fix was not processed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FixError {
    /// A fix of this time was received before.
    Repeated,
    /// The fix is older than the history.
    TooOld,
    /// The fix's time is in the future.
    Future,
    /// The clocks are not synchronised yet, so its time is unknown.
    Untimed,
    /// The robot uses odometry only.
    Unused,
}

impl fmt::Display for FixError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Repeated => f.write_str("a fix of this time was received before"),
            Self::TooOld => f.write_str("the fix is older than the history"),
            Self::Future => f.write_str("the fix is from the future"),
            Self::Untimed => {
                f.write_str("the clocks are not synchronised, so the time of the fix is unknown")
            }
            Self::Unused => f.write_str("the robot uses odometry only"),
        }
    }
}

impl core::error::Error for FixError {}

/// An odometry reading is older than its predecessor, or than the history.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backwards;

impl fmt::Display for Backwards {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the odometry reading is older than the previous one or the history")
    }
}

impl core::error::Error for Backwards {}

/// The estimate for a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Told {
    /// `base_link` in `map`.
    pub(super) pose: Pose,
    pub(super) variances: Variances,
    /// Whether part of the motion since the last fix is unknown.
    pub(super) guessed: bool,
}

/// The state of the filter at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Belief {
    moment: Instant,
    /// The newest known pose in `odom` up to this time.
    odometry: Pose,
    /// Whether that odometry is of exactly this time.
    attached: bool,
    estimate: Option<Estimate>,
    /// The estimate according to the last rejected fixes, and how many of them agree.
    rival: Option<(Estimate, u8)>,
}

impl Belief {
    fn told(&self) -> Option<Told> {
        let estimate = self.estimate.as_ref()?;
        Some(Told {
            pose: estimate.pose(self.odometry.heading),
            variances: estimate.variances(),
            guessed: estimate.is_guessed(),
        })
    }

    /// Advances to a time. `odometry` is the pose in `odom` at that time, if known.
    fn go(&mut self, moment: Instant, odometry: Option<Pose>, noise: &MotionNoise) {
        let seconds = seconds(moment.since(self.moment));
        let rival = self.rival.as_mut().map(|(rival, _)| rival);
        for estimate in [self.estimate.as_mut(), rival].into_iter().flatten() {
            match odometry.filter(|_| self.attached) {
                Some(to) => estimate.drive(self.odometry, to, seconds, noise),
                None => {
                    estimate.wander(seconds);
                    let to = odometry.unwrap_or(self.odometry);
                    estimate.rebase(self.odometry.heading, to.heading);
                }
            }
        }
        self.moment = moment;
        self.attached = odometry.is_some();
        self.odometry = odometry.unwrap_or(self.odometry);
    }

    fn take(&mut self, fix: &Fix) -> FixOutcome {
        let heading = self.odometry.heading;
        let Some(estimate) = self.estimate.as_mut().filter(|estimate| !estimate.is_lost()) else {
            (self.estimate, self.rival) = (Some(Estimate::of(fix, heading)), None);
            return FixOutcome::Began;
        };
        if estimate.take(fix, heading) {
            self.rival = None;
            return FixOutcome::Taken;
        }
        let rival = self.rival.as_mut().filter(|(rival, _)| !rival.is_lost());
        let agreed = rival.and_then(|(rival, fixes)| rival.take(fix, heading).then_some(fixes));
        let Some(fixes) = agreed else {
            self.rival = Some((Estimate::of(fix, heading), 1));
            return FixOutcome::Rejected;
        };
        *fixes += 1;
        if *fixes < RIVALS {
            return FixOutcome::Rejected;
        }
        self.estimate = self.rival.take().map(|(rival, _)| rival);
        FixOutcome::Moved
    }
}

/// The last measurements, and the state before them. About 800 bytes.
#[derive(Debug)]
pub(super) struct Filter {
    noise: MotionNoise,
    /// The state at a time before all measurements.
    base: Belief,
    /// A later state, cached because most queries are near it and need not replay everything.
    recent: Belief,
    odometry: History<Pose, READINGS>,
    /// The time of the newest scan whose pose will be requested.
    scan: Instant,
    /// The fixes by the robot's clock, each with the lower word of its server time, to detect
    /// repetitions.
    fixes: History<(u32, Fix), FIXES>,
}

impl Filter {
    /// A filter whose first estimate is `start`, the origin of `odom` in `map`; without it, the
    /// filter has no estimate yet.
    pub(super) fn new(noise: MotionNoise, start: Option<Pose>) -> Self {
        let odometry = Pose::default();
        let base = Belief {
            moment: Instant(0),
            odometry,
            attached: start.is_some(),
            estimate: start.map(|pose| Estimate::certain(pose, odometry.heading)),
            rival: None,
        };
        Self {
            noise,
            base,
            recent: base,
            odometry: History::new(),
            scan: Instant(0),
            fixes: History::new(),
        }
    }

    /// Processes a fix taken at the server's time `server`, which is `local` by the robot's clock.
    /// Returns the outcome and the estimated pose at that time.
    pub(super) fn fix(
        &mut self,
        server: Instant,
        local: Instant,
        pose: Pose,
        certainty: Certainty,
    ) -> Result<(FixOutcome, Pose), FixError> {
        let server = server.0 as u32;
        if self.fixes.iter().any(|(_, (known, _))| *known == server) {
            return Err(FixError::Repeated);
        }
        let oldest = self.fixes.oldest().filter(|_| self.fixes.is_full());
        let least = oldest.map_or(self.base.moment, |(oldest, _)| oldest.max(self.base.moment));
        let newest = self.newest_fix().unwrap_or(Instant(0));
        if local <= least || newest.since(local) >= HISTORY_SPAN {
            return Err(FixError::TooOld);
        }
        if oldest.is_some() {
            self.forget_until(least);
        }
        self.forget_what_is_old(local);
        let newest = self.newest_fix().filter(|newest| *newest < local);
        if let Some(newest) = newest {
            self.recent = self.replay(newest).0;
        }
        if local <= self.recent.moment {
            self.recent = self.base;
        }
        self.fixes.insert(local, (server, Fix { pose, certainty }));
        let (belief, outcome) = self.replay(local);
        if newest.is_none() {
            self.recent = belief;
        }
        // If there is no outcome, the fix could not be inserted: it is too old.
        outcome.zip(belief.told().map(|told| told.pose)).ok_or(FixError::TooOld)
    }

    /// Whether an odometry reading at `moment` is new: `false` if it repeats the time of the last
    /// one.
    pub(super) fn is_new(&self, moment: Instant) -> Result<bool, Backwards> {
        let last = self.odometry.newest().map(|(last, _)| last);
        if moment < last.unwrap_or(self.base.moment) {
            return Err(Backwards);
        }
        Ok(last != Some(moment))
    }

    /// Announces that the pose at this time will be requested.
    pub(super) fn expect(&mut self, scan: Instant) {
        self.scan = scan;
    }

    /// Processes a new odometry reading. If a scan was taken between the previous one and this one,
    /// a reading for the scan's time is interpolated: remembered readings are farther apart.
    pub(super) fn odometry(&mut self, moment: Instant, pose: Pose) {
        if let Some((last, before)) = self.odometry.newest()
            && last < self.scan
            && self.scan < moment
            && moment.since(last) <= BRIDGED_GAP
        {
            let part = seconds(self.scan.since(last)) / seconds(moment.since(last));
            self.remember(self.scan, between(before, pose, part));
        }
        self.remember(moment, pose);
    }

    /// Remembers a reading. If readings come faster than the minimum interval, each replaces the
    /// previous one.
    #[inline(never)]
    fn remember(&mut self, moment: Instant, pose: Pose) {
        self.forget_what_is_old(moment);
        let (last, before) = {
            let mut newest = self.odometry.iter().rev().map(|(moment, _)| moment);
            (newest.next(), newest.next())
        };
        let least = if last == Some(self.scan) { SCAN_INTERVAL } else { READING_INTERVAL };
        let replaces = before.filter(|before| last.is_some_and(|last| last.since(*before) < least));
        // The cached state must not be newer than the last reading kept, as it would lack this one.
        if replaces.or(last).is_none_or(|known| known < self.recent.moment) {
            self.recent = self.base;
        }
        if replaces.is_some() {
            self.odometry.replace_newest(moment, pose);
            return;
        }
        if let Some((oldest, _)) = self.odometry.oldest().filter(|_| self.odometry.is_full()) {
            self.forget_until(oldest);
        }
        self.odometry.insert(moment, pose);
    }

    pub(super) fn newest_odometry(&self) -> Option<(Instant, Pose)> {
        self.odometry.newest()
    }

    /// The two newest remembered readings, newest first.
    pub(super) fn newest_two(&self) -> Option<(Pose, Pose)> {
        let mut readings = self.odometry.iter().rev().map(|(_, pose)| *pose);
        readings.next().zip(readings.next())
    }

    pub(super) fn noise(&self) -> &MotionNoise {
        &self.noise
    }

    /// The odometry at a time between two readings, if the robot hardly turned between them, so
    /// that its heading is known to a quarter of a degree.
    pub(super) fn steady_odometry(&self, moment: Instant) -> Option<Pose> {
        let before = self.odometry.iter().take_while(|(at, _)| *at <= moment).last();
        let after = self.odometry.iter().find(|(at, _)| *at > moment);
        let ((from, before), (to, after)) = before.zip(after)?;
        let turned = (after.heading - before.heading).0 as i16;
        if to.since(from) > BRIDGED_GAP || turned.unsigned_abs() > STEADY {
            return None;
        }
        let part = seconds(moment.since(from)) / seconds(to.since(from));
        Some(between(*before, *after, part))
    }

    pub(super) fn newest_fix(&self) -> Option<Instant> {
        self.fixes.newest().map(|(moment, _)| moment)
    }

    /// The times of the newest fix at or before `moment`, and of the oldest fix after it.
    pub(super) fn fixes_around(&self, moment: Instant) -> (Option<Instant>, Option<Instant>) {
        let moments = || self.fixes.iter().map(|(fix, _)| fix);
        let before = moments().take_while(|fix| *fix <= moment).last();
        (before, moments().find(|fix| *fix > moment))
    }

    /// The estimate for a time; `None` before the first measurement, or if the time is older than
    /// the history.
    pub(super) fn at(&self, moment: Instant) -> Option<Told> {
        if moment < self.base.moment {
            return None;
        }
        self.replay(moment).0.told()
    }

    /// The odometry at a time within the history; `None` if it is unknown there.
    pub(super) fn odometry_at(&self, moment: Instant) -> Option<Pose> {
        let Belief { odometry, attached, .. } = self.replay(moment).0;
        (attached && moment >= self.base.moment).then_some(odometry)
    }

    /// The estimate for a time shortly after the newest odometry, extrapolated with constant
    /// motion. `None` for later times, or if the motion up to there is unknown.
    pub(super) fn soon_after_odometry(&self, moment: Instant) -> Option<Told> {
        let (newest, odometry) = self.odometry.newest()?;
        let ahead = moment.since(newest);
        if moment < newest || ahead > BRIDGED_GAP {
            return None;
        }
        let belief = self.replay(newest).0;
        let mut estimate = belief.estimate.filter(|estimate| !estimate.is_guessed())?;
        let mut readings = self.odometry.iter().rev();
        let before = readings.find(|(before, _)| newest.since(*before) >= SPEED_SPAN);
        let before = before.filter(|(before, _)| newest.since(*before) <= BRIDGED_GAP);
        let to = before.map_or(odometry, |(before, pose)| {
            let part = seconds(ahead) / seconds(newest.since(before));
            between(*pose, odometry, 1.0 + part)
        });
        estimate.drive(odometry, to, seconds(ahead), &self.noise);
        estimate.stray(seconds(ahead), before.is_some());
        Some(Told {
            pose: estimate.pose(to.heading),
            variances: estimate.variances(),
            guessed: false,
        })
    }

    /// The state after all measurements up to a time, and the outcome of the last fix among them.
    fn replay(&self, until: Instant) -> (Belief, Option<FixOutcome>) {
        let start = if until < self.recent.moment { &self.base } else { &self.recent };
        let (mut belief, mut outcome) = (*start, None);
        let mut readings = self.odometry.iter().skip_while(|(moment, _)| *moment <= start.moment);
        let mut next = readings.next();
        let mut drive = |belief: &mut Belief, to: Instant| {
            while let Some((moment, &pose)) = next.filter(|(moment, _)| *moment <= to) {
                belief.go(moment, Some(pose), &self.noise);
                next = readings.next();
            }
            let length = to.since(belief.moment);
            if length == Duration(0) {
                return;
            }
            let next = next.filter(|_| belief.attached);
            let odometry = next.and_then(|(next, pose)| {
                let gap = next.since(belief.moment);
                let part = seconds(length) / seconds(gap);
                (gap <= BRIDGED_GAP).then(|| between(belief.odometry, *pose, part))
            });
            belief.go(to, odometry, &self.noise);
        };
        let fixes = self.fixes.iter().skip_while(|(moment, _)| *moment <= start.moment);
        for (moment, (_, fix)) in fixes.take_while(|(moment, _)| *moment <= until) {
            drive(&mut belief, moment);
            outcome = Some(belief.take(fix));
        }
        drive(&mut belief, until);
        (belief, outcome)
    }

    /// Drops old entries, so that the history still spans at most [`HISTORY_SPAN`] after an entry
    /// for `moment` is added.
    fn forget_what_is_old(&mut self, moment: Instant) {
        let oldest = [self.odometry.oldest().map(|it| it.0), self.fixes.oldest().map(|it| it.0)];
        if oldest.into_iter().flatten().any(|oldest| moment.since(oldest) >= HISTORY_SPAN) {
            self.forget_until(moment - HISTORY_SPAN);
        }
    }

    /// Merges older measurements into the base state.
    fn forget_until(&mut self, moment: Instant) {
        self.base = self.replay(moment).0;
        if self.recent.moment < moment {
            self.recent = self.base;
        }
        self.odometry.forget_until(moment);
        self.fixes.forget_until(moment);
    }
}

/// A span in seconds; the span must be below an hour.
pub(super) fn seconds(span: Duration) -> f32 {
    u32::try_from(span.micros()).unwrap_or(u32::MAX) as f32 * 1.0e-6
}
