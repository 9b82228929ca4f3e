//! The pose of the moment a scan was taken, from fixes of the server and odometry.

use nalgebra::{Isometry2, Vector2};
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose},
};

use super::track::{Around, Track};

/// Where the poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// The server's fixes; odometry, if there is any, bridges what they miss.
    Fixes,
    /// Odometry alone, from this pose of `odom` in `map`.
    Odometry(Pose),
}

/// How the pose of a moment stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Located {
    /// `base_link` in `map`.
    At(Pose),
    /// What would tell may still come.
    NotYet,
    /// Nothing that may still come would tell.
    Never,
}

/// Two fixes further apart than this say too little of what lies between.
const WIDEST_GAP: Duration = Duration::from_millis(350);
/// How long odometry is trusted to carry a fix on.
const LONGEST_BRIDGE: Duration = Duration::from_secs(5);

/// The last fixes and the last odometry.
#[derive(Debug)]
pub struct Locator {
    source: PoseSource,
    /// By the server's clock.
    fixes: Track<16>,
    /// By the robot's clock.
    odometry: Track<64>,
}

impl Locator {
    /// A locator that knows nothing yet.
    pub fn new(source: PoseSource) -> Self {
        Self { source, fixes: Track::default(), odometry: Track::default() }
    }

    /// Takes a fix: `base_link` in `map` at a moment of the server's clock.
    pub fn fix(&mut self, server_moment: Instant, pose: Pose) -> bool {
        self.fixes.insert(server_moment, pose)
    }

    /// Takes a reading of the odometry: `base_link` in `odom` at a moment of the robot's clock.
    pub fn odometry(&mut self, moment: Instant, pose: Pose) -> bool {
        self.odometry.insert(moment, pose)
    }

    /// The server's clock has begun anew: its earlier fixes mean nothing.
    pub fn forget_fixes(&mut self) {
        self.fixes.clear();
    }

    /// The pose at `moment` of the robot's clock, which is `server_moment` of the server's (if
    /// that is known). `to_local` converts the other way. With `last_chance` it is not waited
    /// for anything better. About 500 instructions, 5,000 where odometry is composed.
    pub fn at(
        &self,
        moment: Instant,
        server_moment: Option<Instant>,
        to_local: impl Fn(Instant) -> Option<Instant>,
        last_chance: bool,
    ) -> Located {
        if let PoseSource::Odometry(start) = self.source {
            return match self.odometry_at(moment) {
                Some(pose) => Located::At(to_pose(isometry(start) * isometry(pose))),
                None if last_chance => Located::Never,
                None => Located::NotYet,
            };
        }
        let Some(server_moment) = server_moment else {
            return if last_chance { Located::Never } else { Located::NotYet };
        };
        let around = self.fixes.around(server_moment);
        let narrow = around.gap().is_some_and(|gap| gap <= WIDEST_GAP);
        if let Some(pose) = around.at(server_moment)
            && (narrow || around.before.is_some_and(|(time, _)| time == server_moment))
        {
            return Located::At(pose);
        }
        // A fix that comes late may still close the gap.
        if !last_chance {
            return Located::NotYet;
        }
        self.bridge(&around, moment, to_local).map_or(Located::Never, Located::At)
    }

    /// The nearest fix, carried to `moment` by odometry.
    fn bridge(
        &self,
        around: &Around,
        moment: Instant,
        to_local: impl Fn(Instant) -> Option<Instant>,
    ) -> Option<Pose> {
        let carried = [around.before, around.after].into_iter().flatten().filter_map(|fix| {
            let local = to_local(fix.0)?;
            let span = moment.since(local).max(local.since(moment));
            (span <= LONGEST_BRIDGE).then_some((span, local, fix.1))
        });
        let (span, local, fix) = carried.min_by_key(|&(span, ..)| span)?;
        if span <= Duration::from_millis(10) {
            return Some(fix);
        }
        let then = isometry(self.odometry_at(local)?);
        let now = isometry(self.odometry_at(moment)?);
        Some(to_pose(isometry(fix) * (then.inverse() * now)))
    }

    fn odometry_at(&self, moment: Instant) -> Option<Pose> {
        self.odometry.around(moment).at(moment)
    }
}

fn isometry(pose: Pose) -> Isometry2<f32> {
    let heading = pose.heading.radians() as f32;
    Isometry2::new(Vector2::new(pose.x.0 as f32, pose.y.0 as f32), heading)
}

fn to_pose(isometry: Isometry2<f32>) -> Pose {
    let millimetres = |value: f32| Millimetres(libm::roundf(value) as i32);
    Pose {
        x: millimetres(isometry.translation.x),
        y: millimetres(isometry.translation.y),
        heading: Angle::from_radians(f64::from(isometry.rotation.angle())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(x: i32, y: i32, degrees: f64) -> Pose {
        Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle::from_degrees(degrees) }
    }

    fn near(found: Located, expected: Pose) {
        let Located::At(found) = found else { panic!("{found:?}") };
        assert!((found.x.0 - expected.x.0).abs() <= 1, "{found:?}");
        assert!((found.y.0 - expected.y.0).abs() <= 1, "{found:?}");
        assert!(found.heading.distance(expected.heading) <= 2, "{found:?}");
    }

    /// The server's clock is 7 s ahead.
    fn at(locator: &Locator, moment: u64, last_chance: bool) -> Located {
        let ahead = Duration::from_secs(7);
        let to_local = |server: Instant| Some(server - ahead);
        let moment = Instant(moment * 1000);
        locator.at(moment, Some(moment + ahead), to_local, last_chance)
    }

    #[test]
    fn a_scan_waits_until_fixes_enclose_it() {
        let mut locator = Locator::new(PoseSource::Fixes);
        locator.fix(Instant(8_000_000), pose(0, 0, 0.0));
        assert_eq!(at(&locator, 1_050, false), Located::NotYet);
        assert_eq!(at(&locator, 1_050, true), Located::Never);
        locator.fix(Instant(8_100_000), pose(100, 0, 10.0));
        near(at(&locator, 1_050, false), pose(50, 0, 5.0));
        // A gap that is too wide is not believed.
        locator.fix(Instant(9_100_000), pose(1100, 0, 10.0));
        assert_eq!(at(&locator, 1_600, true), Located::Never);
    }

    #[test]
    fn odometry_carries_a_fix_on() {
        let mut locator = Locator::new(PoseSource::Fixes);
        locator.fix(Instant(8_000_000), pose(1000, 2000, 90.0));
        locator.odometry(Instant(900_000), pose(0, 0, 0.0));
        locator.odometry(Instant(2_100_000), pose(1200, 0, 0.0));
        // In a second of the 1.2 s it drove 1 m forward, which is north.
        near(at(&locator, 2_000, true), pose(1000, 3000, 90.0));
    }

    #[test]
    fn odometry_alone_starts_from_a_given_pose() {
        let mut locator = Locator::new(PoseSource::Odometry(pose(500, 0, 180.0)));
        locator.odometry(Instant(0), pose(0, 0, 0.0));
        assert_eq!(at(&locator, 1, false), Located::NotYet);
        locator.odometry(Instant(2_000), pose(200, 0, 90.0));
        near(at(&locator, 2, false), pose(300, 0, -90.0));
    }
}
