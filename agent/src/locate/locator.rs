//! The pose of the moment a scan was taken, from fixes of the server and odometry.

use nalgebra::{Isometry2, Vector2};
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose},
};

use super::track::Track;

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

/// Two fixes further apart than this say too little of what lies between. A robot without a fix
/// for as long is taken to be out of the cameras' sight.
const WIDEST_GAP: Duration = Duration::from_millis(350);
/// How long odometry is trusted to carry a fix on.
const LONGEST_BRIDGE: Duration = Duration::from_secs(30);

/// The last fixes and the last odometry.
#[derive(Debug)]
pub struct Locator {
    source: PoseSource,
    /// By the server's clock.
    fixes: Track<16>,
    /// By the robot's clock.
    odometry: Track<64>,
    /// The newest fix for which there was odometry: its moment (robot's clock), and `odom` in
    /// `map` as it tells.
    anchor: Option<(Instant, Isometry2<f32>)>,
}

impl Locator {
    /// A locator that knows nothing yet.
    pub fn new(source: PoseSource) -> Self {
        let (fixes, odometry) = (Track::default(), Track::default());
        Self { source, fixes, odometry, anchor: None }
    }

    /// Takes a fix: `base_link` in `map` at a moment of the server's clock, which is `local` of
    /// the robot's (if that is known). `false` if there was one of that moment.
    pub fn fix(&mut self, server_moment: Instant, local: Option<Instant>, pose: Pose) -> bool {
        let new = self.fixes.insert(server_moment, pose);
        if let Some(local) = local.filter(|_| new)
            && self.anchor.is_none_or(|(moment, _)| moment < local)
            && let Some(odometry) = self.odometry_at(local)
        {
            self.anchor = Some((local, isometry(pose) * isometry(odometry).inverse()));
        }
        new
    }

    /// Takes a reading of the odometry: `base_link` in `odom` at a moment of the robot's clock.
    pub fn odometry(&mut self, moment: Instant, pose: Pose) -> bool {
        self.odometry.insert(moment, pose)
    }

    /// The newest reading of the odometry: `base_link` in `odom`.
    pub fn newest_odometry(&self) -> Option<Pose> {
        self.odometry.newest().map(|(_, pose)| pose)
    }

    /// The server's clock has begun anew: its earlier fixes mean nothing.
    pub fn forget_fixes(&mut self) {
        self.fixes.clear();
    }

    /// The pose at `moment` of the robot's clock, which is `server_moment` of the server's (if
    /// that is known), `age` ago. With `last_chance` it is not waited for anything better.
    pub fn at(
        &self,
        moment: Instant,
        server_moment: Option<Instant>,
        age: Duration,
        last_chance: bool,
    ) -> Located {
        let pending = if last_chance { Located::Never } else { Located::NotYet };
        if let PoseSource::Odometry(start) = self.source {
            let pose = self.odometry_at(moment);
            return pose
                .map_or(pending, |pose| Located::At(to_pose(isometry(start) * isometry(pose))));
        }
        let Some(server_moment) = server_moment else { return pending };
        let around = self.fixes.around(server_moment);
        let narrow = around.gap().is_some_and(|gap| gap <= WIDEST_GAP);
        if let Some(pose) = around.at(server_moment)
            && (narrow || around.before.is_some_and(|(time, _)| time == server_moment))
        {
            return Located::At(pose);
        }
        // A fix that comes late may still close the gap, if the cameras see the robot at all.
        let newest = self.fixes.newest().map(|(fix, _)| (server_moment + age).since(fix));
        let seen = newest.is_some_and(|since| since <= WIDEST_GAP);
        if !last_chance && (seen || self.anchor.is_none()) {
            return Located::NotYet;
        }
        if let Some(pose) = self.bridge(moment) {
            return Located::At(pose);
        }
        let at_hand = [around.before, around.after].into_iter().flatten().find(|(fix, _)| {
            fix.since(server_moment).max(server_moment.since(*fix)) <= Duration::from_millis(10)
        });
        // Lost for longer than odometry is trusted: no fix to come would tell where it was here.
        at_hand.map_or(Located::Never, |(_, pose)| Located::At(pose))
    }

    /// The newest fix, carried to `moment` by odometry.
    fn bridge(&self, moment: Instant) -> Option<Pose> {
        let (anchored, odom_in_map) = self.anchor?;
        if moment.since(anchored) > LONGEST_BRIDGE {
            return None;
        }
        Some(to_pose(odom_in_map * isometry(self.odometry_at(moment)?)))
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

    const AHEAD: Duration = Duration::from_secs(7);

    /// The server's clock is 7 s ahead.
    fn at(locator: &Locator, moment: u64, last_chance: bool) -> Located {
        let moment = Instant(moment * 1000);
        locator.at(moment, Some(moment + AHEAD), Duration(0), last_chance)
    }

    fn fix(locator: &mut Locator, moment: u64, pose: Pose) {
        let moment = Instant(moment * 1000);
        assert!(locator.fix(moment + AHEAD, Some(moment), pose));
    }

    #[test]
    fn a_scan_waits_until_fixes_enclose_it() {
        let mut locator = Locator::new(PoseSource::Fixes);
        fix(&mut locator, 1_000, pose(0, 0, 0.0));
        assert_eq!(at(&locator, 1_050, false), Located::NotYet);
        assert_eq!(at(&locator, 1_050, true), Located::Never);
        fix(&mut locator, 1_100, pose(100, 0, 10.0));
        near(at(&locator, 1_050, false), pose(50, 0, 5.0));
        // A gap that is too wide is not believed.
        fix(&mut locator, 2_100, pose(1100, 0, 10.0));
        assert_eq!(at(&locator, 1_600, true), Located::Never);
    }

    #[test]
    fn odometry_carries_a_fix_on_where_no_camera_looks() {
        let mut locator = Locator::new(PoseSource::Fixes);
        locator.odometry(Instant(900_000), pose(0, 0, 0.0));
        locator.odometry(Instant(2_100_000), pose(1200, 0, 0.0));
        fix(&mut locator, 1_000, pose(1000, 2000, 90.0));
        assert_eq!(at(&locator, 1_200, false), Located::NotYet);
        let later = Instant(1_200_000);
        let found = locator.at(later, Some(later + AHEAD), Duration::from_millis(200), false);
        near(found, pose(1000, 2200, 90.0));
        // In a second of the 1.2 s it drove 1 m forward, which is north.
        near(at(&locator, 2_000, false), pose(1000, 3000, 90.0));
        locator.odometry(Instant(40_000_000), pose(1200, 0, 0.0));
        assert_eq!(at(&locator, 39_000, true), Located::Never);
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
