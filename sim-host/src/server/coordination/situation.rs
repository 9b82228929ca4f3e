//! The coordinator's input, and its notices.

use core::fmt;

use nalgebra::Vector2;
use ubimap_protocol::{
    message::Obstacle,
    time::Instant,
    units::{Pose, RobotId},
};

use super::ground::{Disc, Point};
use crate::{mapping::ServedLayer, perception::Footprint};

/// The state of the room.
#[derive(Clone, Copy, Debug)]
pub struct Situation<'a> {
    /// The map that all robots get.
    pub fused: &'a ServedLayer,
    /// The cells that cameras see now.
    pub coverage: &'a ServedLayer,
    /// All robots with a known position, including those without a session.
    pub robots: &'a [Whereabouts],
    /// People, and other tracked things.
    pub obstacles: &'a [Obstacle],
}

/// The position of a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Whereabouts {
    /// The robot's id.
    pub robot: RobotId,
    /// The time of the pose.
    pub moment: Instant,
    /// The pose of `base_link` in `map`.
    pub pose: Pose,
    /// Whether cameras saw the robot at that time or shortly before.
    pub is_in_view: bool,
    /// The robot's footprint.
    pub footprint: Footprint,
    /// Whether the robot can be commanded: it has a session, and was not told to stop.
    pub obeys: bool,
}

/// Why a goal was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GoalError {
    /// The robot's position is unknown.
    #[error("the position of robot {} is unknown; it must be seen by a camera or report its pose", .0.0)]
    UnknownRobot(RobotId),
    /// The goal is outside of the floor that robots may use.
    #[error("the goal is outside the floor that robots may use")]
    OutsideFloor,
    /// The goal is outside of the map.
    #[error("the goal is outside the map")]
    OutsideMap,
    /// The goal is in unknown ground.
    #[error("the goal is in unknown ground; let a robot explore it first")]
    UnknownGround,
    /// A wall, another obstacle or the edge of the floor that robots may use is closer to the goal than the
    /// robot's radius plus clearance.
    #[error(
        "the goal is too close to a wall, to another obstacle or to the edge of the robots' floor"
    )]
    Occupied,
    /// Walls, closed doors or unknown ground surround the goal.
    #[error("there is no route to the goal")]
    Unreachable,
}

/// Progress or the end of a robot's drive. The text continues a sentence that starts with the
/// robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Notice {
    /// The robot has reached its goal.
    Reached,
    /// The robot's goal was refused.
    Refused(GoalError),
    /// There is no longer a route to its goal. The search is repeated from time to time, without
    /// another notice.
    NoWay,
    /// The robot can't continue on its path, and will get another one. Told once for a place.
    Blocked,
    /// The robot was blocked so often that its goal is given up.
    GaveUp,
    /// The robot explores, is shut in, and has nowhere to look for a way out. Told once until it is out.
    ShutIn,
}

impl fmt::Display for Notice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Reached => write!(f, "has reached its goal"),
            Self::Refused(error) => write!(f, "gets no path: {error}"),
            Self::NoWay => write!(f, "has no way to its goal any more"),
            Self::Blocked => write!(f, "is blocked and will get another path"),
            Self::GaveUp => write!(
                f,
                "was blocked again and again, and has given up its goal; clear its way and send it anew"
            ),
            Self::ShutIn => {
                write!(f, "is shut in, and finds no way out; clear its way, or carry it elsewhere")
            }
        }
    }
}

impl Whereabouts {
    pub(super) fn place(&self) -> Point {
        Point::new(self.pose.x.metres(), self.pose.y.metres())
    }

    /// The room that the robot needs beside walls, in metres.
    pub(super) fn radius_m(&self) -> f64 {
        self.footprint.radius_m()
    }

    /// The room that other robots leave it, in metres: they know its length and width alone.
    pub(super) fn corner_m(&self) -> f64 {
        self.footprint.corner_m()
    }
}

/// A person or a moving thing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Passer {
    /// The ground that the thing occupies now, in half a second and in a second.
    pub(super) discs: [Disc; 3],
}

impl Passer {
    /// Predicts an obstacle's position from its velocity.
    pub(super) fn new(obstacle: &Obstacle) -> Self {
        let now = Point::new(obstacle.x.metres(), obstacle.y.metres());
        let velocity =
            Vector2::new(obstacle.velocity_x, obstacle.velocity_y).map(f64::from) / 1000.0;
        let radius = f64::from(obstacle.radius) / 1000.0;
        Self {
            discs: [0.0, 0.5, 1.0].map(|seconds| Disc { centre: now + velocity * seconds, radius }),
        }
    }

    /// Whether a disc of radius `radius_m` around a place overlaps any of these discs.
    pub(super) fn is_near(&self, place: Point, radius_m: f64) -> bool {
        self.discs.iter().any(|it| (it.centre - place).norm() < it.radius + radius_m)
    }
}
