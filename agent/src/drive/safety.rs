//! When the robot must stop, whatever its path.

use ubimap_protocol::{
    message::Waypoint,
    time::{Duration, Instant},
    units::Pose,
};

use super::{follow::DriveCommand, reason::Reason, root::root};
use crate::timing::{SCAN_STALE, SERVER_SILENT, WHEELS_RETRY};

/// The limits of the safety checks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafetyLimits {
    /// Maximum time without a message from the server; `None` for a robot that may drive without
    /// one.
    pub silence: Option<Duration>,
    /// Maximum age of the scan that the robot drives by.
    pub scan_age: Duration,
    /// Standard deviation of the position at which the pose counts as lost, in millimetres.
    pub most_unsure: f32,
    /// The area that the robot may not leave: its south-western and north-eastern corner.
    pub fence: Option<[Waypoint; 2]>,
    /// How long the robot stands before it tries faulty wheels again.
    pub retry: Duration,
}

impl Default for SafetyLimits {
    /// 2 s without a message, a scan age of 0.5 s, a standard deviation of 50 cm, and no fence.
    fn default() -> Self {
        Self {
            silence: Some(SERVER_SILENT),
            scan_age: SCAN_STALE,
            most_unsure: 500.0,
            fence: None,
            retry: WHEELS_RETRY,
        }
    }
}

/// The inputs of a check.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Health {
    /// The time of the check.
    pub now: Instant,
    /// When the last message from the server arrived.
    pub heard: Option<Instant>,
    /// Whether the server has commanded a stop.
    pub must_stop: bool,
    /// `base_link` in `map`, and the standard deviation of the position in millimetres.
    pub pose: Option<(Pose, f32)>,
    /// `base_link` in `odom`.
    pub odometry: Option<Pose>,
    /// When the newest scan was taken.
    pub scan: Option<Instant>,
}

/// Interval over which the wheels are compared with their commands and with the pose.
const SPAN: Duration = Duration::from_secs(1);
/// End of that interval in which commands do not count: wheels need time to follow a new command, and
/// odometry to arrive.
const LAG: Duration = Duration::from_millis(300);
/// Number of consecutive faults after which the wheels are not tried again.
const TRIES: u8 = 3;

/// Checks that the robot may drive.
#[derive(Clone, Debug)]
pub struct Safety {
    limits: SafetyLimits,
    watch: Option<Watch>,
    /// The fault of the wheels and when it was found; the number of consecutive faults; whether the
    /// wheels are being tried again.
    fault: Option<(Reason, Instant)>,
    tries: u8,
    is_trying: bool,
}

/// The motion commanded and measured since a certain time.
#[derive(Clone, Copy, Debug)]
struct Watch {
    since: Instant,
    last: Instant,
    /// `base_link` in `map` and in `odom` at `since`.
    pose: Pose,
    odometry: Pose,
    /// Standard deviation of `pose`, in millimetres.
    unsure: f32,
    /// The odometry at the last check.
    seen: Pose,
    /// Total distance and total angle, in millimetres and radians.
    commanded: (f32, f32),
    measured: (f32, f32),
}

impl Safety {
    /// Checks with these limits.
    pub fn new(limits: SafetyLimits) -> Self {
        Self { limits, watch: None, fault: None, tries: 0, is_trying: false }
    }

    /// Allows wheels that were given up to be tried again.
    pub fn forgive(&mut self) {
        (self.fault, self.tries, self.is_trying) = (None, 0, false);
    }

    /// The last fault of the wheels, while they are being tried again.
    pub fn doubt(&self) -> Option<Reason> {
        self.fault.filter(|_| self.is_trying).map(|(reason, _)| reason)
    }

    /// The reason why the robot must stop; `None` if it may drive. One that has a pose but does not know it
    /// well enough ([`Reason::PoseLost`]) may turn on the spot. `command` is the command executed since the
    /// last check.
    pub fn check(&mut self, health: &Health, command: DriveCommand) -> Option<Reason> {
        let limits = &self.limits;
        let now = health.now;
        let is_old = |then: Option<Instant>, most| then.is_none_or(|it| now.since(it) > most);
        let sure = health.pose.filter(|&(_, unsure)| unsure <= limits.most_unsure);
        let amiss = if health.must_stop {
            Some(Reason::Stopped)
        } else if limits.silence.is_some_and(|most| is_old(health.heard, most)) {
            Some(Reason::LinkLost)
        } else if health.pose.is_none() {
            Some(Reason::PoseLost)
        } else if is_old(health.scan, limits.scan_age) {
            Some(Reason::SensorLost)
        } else if sure.is_some_and(|(pose, _)| !self.is_inside(pose)) {
            Some(Reason::OutsideMap)
        } else {
            None
        };
        if amiss.is_some() {
            self.watch = None;
            return amiss;
        }
        if let Some((fault, since)) = self.fault.filter(|_| !self.is_trying) {
            if self.tries >= TRIES || now.since(since) < limits.retry {
                return Some(fault);
            }
            self.is_trying = true;
        }
        let measured = health.pose.zip(health.odometry);
        let fault = measured.and_then(|(pose, odometry)| self.watch(now, pose, odometry, command));
        let Some(fault) = fault else { return sure.is_none().then_some(Reason::PoseLost) };
        self.watch = None;
        self.tries += 1;
        (self.fault, self.is_trying) = (Some((fault, now)), false);
        Some(fault)
    }

    fn is_inside(&self, pose: Pose) -> bool {
        self.limits.fence.is_none_or(|[low, high]| {
            (low.x..=high.x).contains(&pose.x) && (low.y..=high.y).contains(&pose.y)
        })
    }

    /// Compares the measured motion with the command and the pose with the odometry, once per
    /// [`SPAN`]. Returns the fault if the wheels do not turn as commanded, or the robot does not
    /// move as they turn.
    fn watch(
        &mut self,
        now: Instant,
        (pose, unsure): (Pose, f32),
        odometry: Pose,
        command: DriveCommand,
    ) -> Option<Reason> {
        let mut watch = self.watch.unwrap_or(Watch {
            since: now,
            last: now,
            pose,
            odometry,
            unsure,
            seen: odometry,
            commanded: (0.0, 0.0),
            measured: (0.0, 0.0),
        });
        let elapsed = now.since(watch.last).micros().min(SPAN.micros()) as u32 as f32 * 1.0e-6;
        if now.since(watch.since) + LAG <= SPAN {
            watch.commanded.0 += f32::from(command.speed).abs() * elapsed;
            watch.commanded.1 += f32::from(command.turn).abs() * 1.0e-3 * elapsed;
        }
        watch.measured.0 += way(watch.seen, odometry);
        let turned = f32::from(watch.seen.heading.distance(odometry.heading));
        watch.measured.1 += turned * (core::f32::consts::PI / 32_768.0);
        (watch.last, watch.seen) = (now, odometry);
        if now.since(watch.since) < SPAN {
            self.watch = Some(watch);
            return None;
        }
        self.watch = None;
        let (commanded, measured) = (watch.commanded, watch.measured);
        // The motion is less than a third of the commanded one, and the commanded one is long
        // enough to judge.
        let stuck = |commanded: f32, measured: f32, enough: f32| {
            commanded > enough && measured < commanded / 3.0
        };
        let by_map = way(watch.pose, pose);
        let by_wheels = way(watch.odometry, odometry);
        // The difference is larger than what corrections of the pose explain.
        let corrected = 100.0 + 2.0 * watch.unsure;
        let slips = (by_map - by_wheels).abs() > corrected + 0.3 * by_map.min(by_wheels);
        if stuck(commanded.0, measured.0, 70.0) || stuck(commanded.1, measured.1, 0.3) {
            return Some(Reason::WheelsStuck);
        }
        if slips {
            return Some(Reason::WheelsSlip);
        }
        if commanded.0 > 70.0 {
            self.forgive();
        }
        None
    }
}

/// Distance between two poses, in millimetres.
fn way(from: Pose, to: Pose) -> f32 {
    let (x, y) = ((to.x - from.x).0 as f32, (to.y - from.y).0 as f32);
    root(x * x + y * y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::units::{Angle, Millimetres};

    fn at(millis: u64) -> Instant {
        Instant(millis * 1_000)
    }

    fn well(now: Instant) -> Health {
        Health {
            now,
            heard: Some(now),
            must_stop: false,
            pose: Some((Pose::default(), 20.0)),
            odometry: Some(Pose::default()),
            scan: Some(now),
        }
    }

    #[test]
    fn each_fault_has_its_reason_and_its_limit() {
        let corner = |metres| {
            let at = Millimetres::from_metres(metres);
            Waypoint { x: at, y: at }
        };
        let fence = Some([corner(-1.0), corner(1.0)]);
        let limits = SafetyLimits { fence, ..SafetyLimits::default() };
        let now = at(10_000);
        let check = |health: Health| Safety::new(limits).check(&health, DriveCommand::STAND);
        let well = well(now);
        assert_eq!(check(well), None);
        assert_eq!(check(Health { must_stop: true, ..well }), Some(Reason::Stopped));
        for (heard, reason) in [
            (Some(8_000), None),
            (Some(7_999), Some(Reason::LinkLost)),
            (None, Some(Reason::LinkLost)),
        ] {
            assert_eq!(check(Health { heard: heard.map(at), ..well }), reason);
        }
        for (scan, reason) in [
            (Some(9_500), None),
            (Some(9_499), Some(Reason::SensorLost)),
            (None, Some(Reason::SensorLost)),
        ] {
            assert_eq!(check(Health { scan: scan.map(at), ..well }), reason);
        }
        for (unsure, reason) in
            [(500.0, None), (501.0, Some(Reason::PoseLost)), (f32::NAN, Some(Reason::PoseLost))]
        {
            assert_eq!(check(Health { pose: Some((Pose::default(), unsure)), ..well }), reason);
        }
        assert_eq!(check(Health { pose: None, ..well }), Some(Reason::PoseLost));
        let outside = Pose::from_metres(0.0, -1.001, 0.0);
        assert_eq!(check(Health { pose: Some((outside, 0.0)), ..well }), Some(Reason::OutsideMap));
        let alone = SafetyLimits { silence: None, ..limits };
        let silent = Health { heard: None, ..well };
        assert_eq!(Safety::new(alone).check(&silent, DriveCommand::STAND), None);
    }

    /// The reasons over 40 s at 20 Hz, one entry per change. `by_map` and `by_wheels` are the
    /// ratios of the measured to the commanded motion.
    fn driven(command: DriveCommand, by_map: f32, by_wheels: f32) -> std::vec::Vec<Option<Reason>> {
        let mut safety = Safety::new(SafetyLimits::default());
        let (mut way, mut turned) = (0.0, 0.0);
        let mut reasons = std::vec::Vec::new();
        let mut done = command;
        for step in 0..800u64 {
            way += f32::from(done.speed) * 0.05;
            turned += f32::from(done.turn) * 0.05e-3 * 10_430.0;
            let pose = |part: f32| Pose {
                x: Millimetres((way * part) as i32),
                y: Millimetres(0),
                heading: Angle((turned * part) as i32 as u16),
            };
            let now = at(1_000 + 50 * step);
            let (pose, odometry) = (Some((pose(by_map), 10.0)), Some(pose(by_wheels)));
            let reason = safety.check(&Health { pose, odometry, ..well(now) }, done);
            done = if reason.is_some() { DriveCommand::STAND } else { command };
            if reasons.last() != Some(&reason) {
                reasons.push(reason);
            }
        }
        reasons
    }

    #[test]
    fn wheels_that_do_not_turn_or_slip_are_tried_three_times() {
        let ahead = DriveCommand { speed: 300, turn: 100 };
        let round = DriveCommand { speed: 0, turn: 1_000 };
        for command in [ahead, round, DriveCommand::STAND] {
            assert_eq!(driven(command, 1.0, 1.0), [None]);
            assert_eq!(driven(command, 0.9, 1.1), [None], "an odometry error is no wheel fault");
        }
        for (command, by_map, by_wheels, fault) in [
            (ahead, 0.0, 0.0, Reason::WheelsStuck),
            (round, 0.0, 0.0, Reason::WheelsStuck),
            (ahead, 0.0, 1.0, Reason::WheelsSlip),
            (ahead, 1.0, 0.4, Reason::WheelsSlip),
        ] {
            let fault = Some(fault);
            let expected = [None, fault, None, fault, None, fault];
            assert_eq!(driven(command, by_map, by_wheels), expected, "{command:?}");
        }
    }

    #[test]
    fn wheels_that_follow_a_new_command_300_ms_later_are_well() {
        const LATE: usize = 6;
        for command in
            [DriveCommand { speed: 450, turn: 0 }, DriveCommand { speed: 0, turn: 1_300 }]
        {
            for begin in 0..40usize {
                let mut safety = Safety::new(SafetyLimits::default());
                let commanded = |step: usize| {
                    if (begin..begin + 10).contains(&step) { command } else { DriveCommand::STAND }
                };
                let (mut way, mut turned) = (0.0, 0.0);
                for step in 0..80usize {
                    let done = step.checked_sub(LATE).map_or(DriveCommand::STAND, commanded);
                    way += f32::from(done.speed) * 0.05;
                    turned += f32::from(done.turn) * 0.05e-3 * 10_430.0;
                    let pose = Pose {
                        x: Millimetres(way as i32),
                        y: Millimetres(0),
                        heading: Angle(turned as i32 as u16),
                    };
                    let now = at(1_000 + 50 * step as u64);
                    let (pose, odometry) = (Some((pose, 10.0)), Some(pose));
                    let health = Health { pose, odometry, ..well(now) };
                    let reason = safety.check(&health, commanded(step));
                    assert_eq!(reason, None, "{command:?} from step {begin}, at step {step}");
                }
            }
        }
    }
}
