//! What a robot is doing for the coordinator.

use core::fmt;

use ubimap_protocol::units::RobotId;

use super::{coordinator::Coordinator, ground::Point, target::Target};

/// What a robot is doing for the coordinator. The text continues a sentence that starts with the robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Errand {
    /// It has no goal, and may not explore.
    Idle,
    /// It may explore, and no ground is left that it could look at now.
    Waits,
    /// It may explore, and has no way to any of the ground that is left.
    CutOff,
    /// It may explore, finds nothing to look at, and returns into the cameras' view, to that place.
    Returns([f64; 2]),
    /// It has driven out of the cameras' view, where its pose drifts, and returns into view at that place.
    Recalled([f64; 2]),
    /// It drives to and fro in the cameras' view, now to that place, to calibrate its odometry.
    Calibrates([f64; 2]),
    /// It drives to a goal in `map`, in metres.
    Goal([f64; 2]),
    /// There is no way to its goal at present.
    NoWay([f64; 2]),
    /// It drives to look at unknown ground there.
    Looks([f64; 2]),
    /// It is shut in, and drives to this place to look again at what blocks its way.
    LooksForWay([f64; 2]),
    /// It stands because somebody is in its way to this place.
    HeldUp([f64; 2]),
    /// It was blocked this many times in a row where it stands, and pauses.
    Blocked(u32),
}

impl Coordinator {
    /// What a robot is doing; `None` if its position was never known.
    pub fn errand(&self, robot: RobotId) -> Option<Errand> {
        let index = self.index(robot).ok()?;
        let (member, here) = (&self.members[index], self.reservations.claim(index).position());
        let place = |point: Point| [point.x, point.y];
        let goal = member.goal.map(place);
        let looks_at = |target: Target| match target.is_shut_in {
            true => place(target.view),
            false => place(target.frontier),
        };
        if member.held_up.is_some()
            && let Some(to) = goal.or(member.target.map(looks_at))
        {
            return Some(Errand::HeldUp(to));
        }
        Some(match (goal, member.target) {
            (Some(goal), _) if member.is_told => Errand::NoWay(goal),
            (Some(goal), _) => Errand::Goal(goal),
            (None, Some(target)) if target.is_shut_in => Errand::LooksForWay(looks_at(target)),
            (None, Some(target)) => Errand::Looks(looks_at(target)),
            (None, None) if member.recall.is_none() => {
                member.refuge.map_or(Errand::Waits, |it| Errand::Recalled(place(it)))
            }
            (None, None) if member.calibration.is_due() => {
                Errand::Calibrates(place(member.refuge.unwrap_or(here)))
            }
            (None, None) if member.refuge.is_some() => Errand::Returns(member.refuge.map(place)?),
            (None, None) if member.shut_in_since.is_some() => Errand::CutOff,
            (None, None) if member.explores => Errand::Waits,
            (None, None) => Errand::Idle,
        })
    }
}

impl fmt::Display for Errand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Idle => write!(f, "has nothing to do"),
            Self::Waits => write!(f, "explores; finds nothing to look at now"),
            Self::CutOff => write!(f, "explores; has no way to what is left"),
            Self::Goal([x, y]) => write!(f, "drives to {x:.2} m, {y:.2} m"),
            Self::NoWay([x, y]) => write!(f, "has no way to {x:.2} m, {y:.2} m"),
            Self::Looks([x, y]) => write!(f, "explores: looks at {x:.2} m, {y:.2} m"),
            Self::LooksForWay([x, y]) => {
                write!(
                    f,
                    "explores; is shut in, and looks again at what blocks its way, at {x:.2} m, {y:.2} m"
                )
            }
            Self::Returns([x, y]) => {
                write!(
                    f,
                    "explores; finds nothing to look at, and returns into view at {x:.2} m, {y:.2} m"
                )
            }
            Self::Recalled([x, y]) => {
                write!(
                    f,
                    "explores; its pose may have drifted, so that it comes into view at {x:.2} m, {y:.2} m"
                )
            }
            Self::Calibrates([x, y]) => {
                write!(
                    f,
                    "explores; drives to and fro in view to calibrate its odometry, now to {x:.2} m, {y:.2} m"
                )
            }
            Self::Blocked(1) => write!(f, "was blocked, and gets another path"),
            Self::Blocked(times) => {
                write!(f, "was blocked {times} times in a row; tries again soon")
            }
            Self::HeldUp([x, y]) => {
                write!(f, "somebody is in its way to {x:.2} m, {y:.2} m")
            }
        }
    }
}
