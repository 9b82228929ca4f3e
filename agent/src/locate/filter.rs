//! The filter: what odometry and fixes say together, fixes coming late.
//!
//! What it believes at a moment is worked out from the measurements in the order of their own
//! time stamps, not of their arrival: from a belief that is older than all that are remembered,
//! through each of them. So a late fix is taken in where it belongs, and the odometry since is
//! replayed.

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

/// Readings of the odometry that are remembered, and how far apart they are at least: as long as
/// a scan waits in any case. Who brakes like that strays by a millimetre in between.
const READINGS: usize = 15;
const READING_INTERVAL: Duration = Duration::from_millis(100);
/// Readings of the moments of scans, this far apart at least, are not replaced by later ones: at 15 Hz
/// those of a second are remembered.
const SCAN_INTERVAL: Duration = Duration::from_millis(60);
/// The speed is measured over this span at least: in a shorter one the millimetres that readings are
/// rounded to make more than 20 mm/s.
const SPEED_SPAN: Duration = Duration::from_millis(50);
/// Half a degree, in binary units.
const STEADY: u16 = 91;
/// Fixes that are remembered: half a second at 15 Hz.
const FIXES: usize = 8;
/// Rejected fixes in a row that agree with one another before they are believed: a third of a
/// second at 15 Hz.
const RIVALS: u8 = 5;

/// What became of a fix.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FixOutcome {
    /// It is the first, or nothing was known any more: the pose begins with it.
    Began,
    /// It is taken in.
    Taken,
    /// It is too far off, and is left out.
    Rejected,
    /// The last few were rejected, but agree: the robot is where they say. It was carried off.
    Moved,
}

/// Why a fix is not looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FixError {
    /// There was one of this moment.
    Repeated,
    /// It is older than what is remembered.
    TooOld,
    /// It is of a moment to come.
    Future,
    /// The clocks do not agree yet: nobody can tell when it was.
    Untimed,
    /// The robot goes by odometry alone.
    Unused,
}

/// A reading of the odometry is older than the one before, or than what is remembered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backwards;

/// Where the robot is taken to be at a moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Told {
    /// `base_link` in `map`.
    pub(super) pose: Pose,
    pub(super) variances: Variances,
    /// Whether the motion since the last fix is not known all the way.
    pub(super) guessed: bool,
}

/// What is believed at a moment.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Belief {
    moment: Instant,
    /// The newest pose in `odom` that is known.
    odometry: Pose,
    /// Whether it is of this moment.
    attached: bool,
    estimate: Option<Estimate>,
    /// Where the fixes that were rejected last say that it is, and how many of them agree.
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

    /// Goes on to a moment, at which the odometry's pose is known or not.
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

/// The last measurements, and what is believed before them. About 800 bytes.
#[derive(Debug)]
pub(super) struct Filter {
    noise: MotionNoise,
    /// Of a moment before all that follows.
    base: Belief,
    /// Of a later one, that most questions are about: not all need be replayed for them.
    recent: Belief,
    odometry: History<Pose, READINGS>,
    /// When the newest scan was taken whose pose will be asked for.
    scan: Instant,
    /// By the robot's clock; with each the lower word of its moment by the server's, to tell it
    /// again.
    fixes: History<(u32, Fix), FIXES>,
}

impl Filter {
    /// A filter that begins with `start`, where `odom` has its origin, or knows nothing yet.
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

    /// Takes a fix of the moment `server` of the server's clock, which is `local` of the robot's.
    /// With the outcome comes the pose that is believed then.
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
        // There is one, unless the insertion failed.
        outcome.zip(belief.told().map(|told| told.pose)).ok_or(FixError::TooOld)
    }

    /// Whether a reading of the odometry at a moment says something new.
    pub(super) fn is_new(&self, moment: Instant) -> Result<bool, Backwards> {
        let last = self.odometry.newest().map(|(last, _)| last);
        if moment < last.unwrap_or(self.base.moment) {
            return Err(Backwards);
        }
        Ok(last != Some(moment))
    }

    /// The pose of this moment will be asked for.
    pub(super) fn expect(&mut self, scan: Instant) {
        self.scan = scan;
    }

    /// Takes a reading of the odometry that says something new. Between the reading before it and
    /// this one it makes one of the moment of a scan: those that are remembered lie further apart.
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

    /// Remembers a reading. Readings that come faster than they are remembered replace one another.
    #[inline(never)]
    fn remember(&mut self, moment: Instant, pose: Pose) {
        self.forget_what_is_old(moment);
        let (last, before) = {
            let mut newest = self.odometry.iter().rev().map(|(moment, _)| moment);
            (newest.next(), newest.next())
        };
        let least = if last == Some(self.scan) { SCAN_INTERVAL } else { READING_INTERVAL };
        let replaces = before.filter(|before| last.is_some_and(|last| last.since(*before) < least));
        // What was believed after the reading before this one did not know of this one.
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

    /// The two newest readings that are remembered, the newest first.
    pub(super) fn newest_two(&self) -> Option<(Pose, Pose)> {
        let mut readings = self.odometry.iter().rev().map(|(_, pose)| *pose);
        readings.next().zip(readings.next())
    }

    pub(super) fn noise(&self) -> &MotionNoise {
        &self.noise
    }

    /// Where odometry says that the robot was at a moment between two readings in which it hardly
    /// turned: then it is known to a quarter of a degree.
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

    /// The moments of the newest fix at a moment or before it, and of the oldest after it.
    pub(super) fn fixes_around(&self, moment: Instant) -> (Option<Instant>, Option<Instant>) {
        let moments = || self.fixes.iter().map(|(fix, _)| fix);
        let before = moments().take_while(|fix| *fix <= moment).last();
        (before, moments().find(|fix| *fix > moment))
    }

    /// Where the robot is taken to have been at a moment; `None` if nothing told yet, or no
    /// longer.
    pub(super) fn at(&self, moment: Instant) -> Option<Told> {
        if moment < self.base.moment {
            return None;
        }
        self.replay(moment).0.told()
    }

    /// Where the robot is taken to be soon after the newest reading of the odometry: it goes on as it
    /// did before. `None` later, or if the motion is not known up to there.
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

    /// What is believed after all measurements up to a moment, and what became of the last fix
    /// among those that were replayed.
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

    /// Makes sure that all that is remembered lies within [`HISTORY_SPAN`] when something of this
    /// moment is added.
    fn forget_what_is_old(&mut self, moment: Instant) {
        let oldest = [self.odometry.oldest().map(|it| it.0), self.fixes.oldest().map(|it| it.0)];
        if oldest.into_iter().flatten().any(|oldest| moment.since(oldest) >= HISTORY_SPAN) {
            self.forget_until(moment - HISTORY_SPAN);
        }
    }

    /// Lets what is older be part of the belief that all begins with.
    fn forget_until(&mut self, moment: Instant) {
        self.base = self.replay(moment).0;
        if self.recent.moment < moment {
            self.recent = self.base;
        }
        self.odometry.forget_until(moment);
        self.fixes.forget_until(moment);
    }
}

/// Over an hour is an hour.
pub(super) fn seconds(span: Duration) -> f32 {
    u32::try_from(span.micros()).unwrap_or(u32::MAX) as f32 * 1.0e-6
}
