//! Whether the robot moved smoothly when a scan was taken.

use heapless::Deque;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose},
};

/// Minimum interval of odometry for measuring the turn rate.
const MIN_TURN_SPAN: Duration = Duration::from_millis(20);
/// Minimum interval of odometry for measuring the speed, as positions are rounded to millimetres.
const MIN_SPEED_SPAN: Duration = Duration::from_millis(100);
/// Maximum interval of odometry; if it is longer, the motion within it is unknown.
const MAX_SPAN: Duration = Duration::from_secs(1);
/// Duration before and after a jolt within which frames are not mapped.
const RINGING: Duration = Duration::from_millis(50);
/// Number of shaken intervals remembered: scans wait a second or two for their poses.
const REMEMBERED: usize = 8;

/// Limits beyond which a frame is not mapped: it is smeared, and its time stamp is not precise
/// enough to know its heading (a limit that the paper states, Aluckal III.C).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SteadyLimits {
    /// Maximum turn rate, as the angle in one second in either direction; less than a whole turn.
    pub turn: Angle,
    /// Maximum acceleration or deceleration, in mm/s^2.
    pub acceleration: Millimetres,
}

impl Default for SteadyLimits {
    /// 90 degrees/s, which smears a frame exposed for 10 ms by one degree; and 3 m/s^2, which
    /// wheels exceed only in a collision.
    fn default() -> Self {
        Self { turn: Angle(16_384), acceleration: Millimetres(3_000) }
    }
}

/// When the robot was shaken recently, as detected by its odometry, and by a gyroscope if it has
/// one.
///
/// Odometry in whole millimetres detects a jolt 0.1 s late. If the pose of a scan is known at once,
/// by odometry alone, the scan may be mapped before that; a gyroscope or an accelerometer detects
/// the jolt in time.
#[derive(Debug)]
pub struct Steadiness {
    limits: SteadyLimits,
    /// The last odometry used, and the speed at that time: mm/s along x and y of `odom`.
    last: Option<(Instant, Pose)>,
    speed: Option<(f32, f32)>,
    /// Start and end of each shaken interval, oldest first.
    shaken: Deque<(Instant, Instant), REMEMBERED>,
}

impl Steadiness {
    /// A robot at standstill.
    pub fn new(limits: SteadyLimits) -> Self {
        Self { limits, last: None, speed: None, shaken: Deque::new() }
    }

    /// Processes an odometry reading.
    pub fn odometry(&mut self, moment: Instant, pose: Pose) {
        let Some((since, from)) = self.last else {
            self.last = Some((moment, pose));
            return;
        };
        let span = moment.since(since);
        if span < MIN_TURN_SPAN {
            return;
        }
        if span > MAX_SPAN {
            (self.last, self.speed) = (Some((moment, pose)), None);
            return;
        }
        // In single precision: a division of 64 bits costs a microcontroller 1 kB of flash.
        let per_second = 1.0e6 / span.micros() as u32 as f32;
        let turned = f32::from(pose.heading.distance(from.heading));
        if turned * per_second > f32::from(self.limits.turn.0) {
            self.shook(since, moment);
        }
        if span < MIN_SPEED_SPAN {
            return;
        }
        self.last = Some((moment, pose));
        let along =
            |to: Millimetres, from: Millimetres| to.0.saturating_sub(from.0) as f32 * per_second;
        let speed = (along(pose.x, from.x), along(pose.y, from.y));
        let before = self.speed.replace(speed).unwrap_or(speed);
        let gained = ((speed.0 - before.0) * per_second, (speed.1 - before.1) * per_second);
        let most = self.limits.acceleration.0 as f32;
        if gained.0 * gained.0 + gained.1 * gained.1 > most * most {
            self.shook(since, moment);
        }
    }

    /// Processes a gyroscope reading: the turn rate about the vertical axis, as the magnitude of
    /// the angle in one second.
    pub fn gyro(&mut self, moment: Instant, turn: Angle) {
        if turn.0 > self.limits.turn.0 {
            self.jolt(moment);
        }
    }

    /// Records a jolt, for example from an accelerometer's or a bumper's interrupt.
    pub fn jolt(&mut self, moment: Instant) {
        self.shook(moment - RINGING, moment + RINGING);
    }

    /// Whether the robot was shaken at a time.
    pub fn is_shaken(&self, moment: Instant) -> bool {
        self.shaken.iter().any(|&(from, to)| (from..=to).contains(&moment))
    }

    fn shook(&mut self, from: Instant, to: Instant) {
        if let Some(last) = self.shaken.back_mut()
            && last.1 >= from
        {
            *last = (last.0.min(from), last.1.max(to));
            return;
        }
        if self.shaken.is_full() {
            self.shaken.pop_front();
        }
        // A place was freed above, so the push succeeds.
        let _ = self.shaken.push_back((from, to));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant(millis * 1_000)
    }

    /// Odometry at 50 Hz, interpolated between (ms, mm, degrees).
    fn drive(path: &[(u64, f64, f64)]) -> Steadiness {
        let mut steadiness = Steadiness::new(SteadyLimits::default());
        for leg in path.windows(2) {
            let ((start, x0, turn0), (end, x1, turn1)) = (leg[0], leg[1]);
            for moment in (start..end).step_by(20) {
                let part = (moment - start) as f64 / (end - start) as f64;
                let heading = Angle::from_degrees(turn0 + (turn1 - turn0) * part);
                let x = Millimetres((x0 + (x1 - x0) * part) as i32);
                steadiness.odometry(at(moment), Pose { x, heading, ..Pose::default() });
            }
        }
        steadiness
    }

    fn shaken(steadiness: &Steadiness) -> std::vec::Vec<u64> {
        (0..4_000).step_by(100).filter(|&moment| steadiness.is_shaken(at(moment))).collect()
    }

    #[test]
    fn normal_driving_and_turning_are_steady() {
        let path = [(0, 0.0, 0.0), (1_000, 250.0, 0.0), (2_000, 250.0, 85.0), (3_000, 500.0, 85.0)];
        assert_eq!(shaken(&drive(&path)), [0; 0]);
    }

    #[test]
    fn a_fast_turn_shakes_while_it_lasts() {
        let path = [(0, 0.0, 0.0), (1_000, 0.0, 0.0), (2_000, 0.0, -120.0), (3_000, 0.0, -120.0)];
        let shaken = shaken(&drive(&path));
        assert_eq!(shaken, (10..=20).map(|tenth| tenth * 100).collect::<std::vec::Vec<_>>());
    }

    #[test]
    fn a_bump_shakes_for_a_moment() {
        // From 600 mm/s to standstill.
        let path = [(0, 0.0, 0.0), (1_000, 600.0, 0.0), (2_000, 600.0, 0.0)];
        let shaken = shaken(&drive(&path));
        assert!(!shaken.is_empty() && shaken.iter().all(|moment| (900..=1_200).contains(moment)));
    }

    #[test]
    fn sparse_odometry_detects_nothing() {
        let path: [(u64, f64, f64); 2] = [(0, 0.0, 0.0), (1_500, 9_000.0, 170.0)];
        let mut steadiness = Steadiness::new(SteadyLimits::default());
        for (millis, x, degrees) in path {
            let (x, heading) = (Millimetres(x as i32), Angle::from_degrees(degrees));
            steadiness.odometry(at(millis), Pose { x, heading, ..Pose::default() });
        }
        assert_eq!(shaken(&steadiness), [0; 0]);
    }

    #[test]
    fn gyroscope_and_jolts_are_recorded_and_the_oldest_forgotten() {
        let mut steadiness = Steadiness::new(SteadyLimits::default());
        steadiness.gyro(at(1_000), Angle(16_384));
        assert_eq!(shaken(&steadiness), [0; 0]);
        steadiness.gyro(at(1_000), Angle(16_385));
        steadiness.jolt(at(1_080));
        steadiness.jolt(at(1_500));
        assert_eq!(shaken(&steadiness), [1_000, 1_100, 1_500]);
        for second in 3..20 {
            steadiness.jolt(at(1_000 * second));
        }
        assert_eq!(shaken(&steadiness), [0; 0]);
        assert!(steadiness.is_shaken(at(19_000)));
    }

    #[test]
    fn odometry_that_jumps_or_goes_back_in_time_is_harmless() {
        let mut steadiness = Steadiness::new(SteadyLimits::default());
        for (millis, x) in
            [(0, i32::MIN), (100, i32::MAX), (50, 0), (200, i32::MIN), (u64::MAX / 1_000, 0)]
        {
            let pose = Pose { x: Millimetres(x), y: Millimetres(x), ..Pose::default() };
            steadiness.odometry(at(millis), pose);
        }
        assert!(steadiness.is_shaken(at(150)));
    }
}
