//! The coordinator's input, and its notices.

use nalgebra::Vector2;
use ubimap_protocol::{
    message::Obstacle,
    time::Instant,
    units::{Pose, RobotId},
};

use super::ground::{Disc, Point};
use crate::{mapping::ServedLayer, perception::Footprint};

/// Everything that is known of the room.
#[derive(Clone, Copy, Debug)]
pub struct Situation<'a> {
    /// The map that everybody gets.
    pub fused: &'a ServedLayer,
    /// The cells that the cameras see now.
    pub coverage: &'a ServedLayer,
    /// Every robot whose place is known, those without a session too.
    pub robots: &'a [Whereabouts],
    /// People, and whatever else moves.
    pub obstacles: &'a [Obstacle],
}

/// Where a robot is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Whereabouts {
    /// Which robot.
    pub robot: RobotId,
    /// When it was there.
    pub moment: Instant,
    /// `base_link` in `map`.
    pub pose: Pose,
    /// What it takes up.
    pub footprint: Footprint,
    /// Whether it can be commanded.
    pub has_session: bool,
}

/// Why a goal is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GoalError {
    /// Nobody has said where the robot is.
    #[error("nobody knows where robot {} is", .0.0)]
    UnknownRobot(RobotId),
    /// There is no map there.
    #[error("the goal is outside the map")]
    OutsideMap,
    /// Nobody has seen the place.
    #[error("nobody knows what is at the goal: let a robot explore")]
    UnknownGround,
    /// A wall or the like is there, or nearer than the robot's own radius.
    #[error("something is in the way at the goal")]
    Occupied,
    /// Walls, closed doors or unknown ground are all around it.
    #[error("there is no way to the goal")]
    Unreachable,
}

/// What has become of a robot's drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Notice {
    /// It is at the goal that it was given.
    Reached,
    /// Its goal is refused.
    Refused(GoalError),
    /// There is no way to its goal any more. The search is repeated now and then, without another
    /// notice.
    NoWay,
    /// It can't go on along its path, and will get another one.
    Blocked,
}

impl Whereabouts {
    pub(super) fn place(&self) -> Point {
        Point::new(self.pose.x.metres(), self.pose.y.metres())
    }

    /// The radius of a disc that holds the robot however it turns, in metres.
    pub(super) fn radius_m(&self) -> f64 {
        let Footprint { half_length, half_width } = self.footprint;
        Vector2::new(f64::from(half_length), f64::from(half_width)).norm() / 1000.0
    }
}

/// A person or a thing that moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Passer {
    /// The floor that is taken up now, in half a second and in a second.
    pub(super) discs: [Disc; 3],
}

impl Passer {
    /// Where an obstacle is now, in half a second and in a second.
    pub(super) fn new(obstacle: &Obstacle) -> Self {
        let now = Point::new(obstacle.x.metres(), obstacle.y.metres());
        let velocity =
            Vector2::new(obstacle.velocity_x, obstacle.velocity_y).map(f64::from) / 1000.0;
        let radius = f64::from(obstacle.radius) / 1000.0;
        Self {
            discs: [0.0, 0.5, 1.0].map(|seconds| Disc { centre: now + velocity * seconds, radius }),
        }
    }

    /// Whether a disc about a place is touched.
    pub(super) fn is_near(&self, place: Point, radius_m: f64) -> bool {
        self.discs.iter().any(|it| (it.centre - place).norm() < it.radius + radius_m)
    }
}
