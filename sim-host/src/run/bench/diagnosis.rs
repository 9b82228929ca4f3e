//! What is wrong with a robot's wheels, from how it was told to move and how it has moved.
//!
//! A wheel that turns backwards and an encoder that counts backwards look alike to the robot itself: only who
//! sees the robot (its own sensor, or a person) can tell them apart.

use std::fmt;

use serde::Serialize;

use super::motion::Motion;

/// Below this nothing has moved, in metres and radians.
const STILL: Motion = Motion { ahead: 0.02, turn: 0.09 };
/// From this on it has turned, in radians.
const TURNED: f64 = 0.3;
/// Minimum part of the way asked for that counts as driven.
const LEAST_WAY: f64 = 0.5;
/// Part of the way, and way in metres, by which good wheels may be wrong: they slip, and start and stop.
const SLIP: f64 = 0.015;
const JERK: f64 = 0.005;

/// What a robot has done, roughly.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Seen {
    /// It has driven ahead.
    Ahead,
    /// It has driven backwards.
    Back,
    /// It has turned to the left, counter-clockwise, on the spot or in a curve.
    Left,
    /// It has turned to the right.
    Right,
    /// It has stood still.
    Nothing,
}

impl Seen {
    /// What a motion is.
    pub(super) fn of(motion: Motion) -> Self {
        match motion {
            Motion { turn, .. } if turn > TURNED => Self::Left,
            Motion { turn, .. } if turn < -TURNED => Self::Right,
            Motion { ahead, .. } if ahead > STILL.ahead => Self::Ahead,
            Motion { ahead, .. } if ahead < -STILL.ahead => Self::Back,
            _ => Self::Nothing,
        }
    }
}

impl fmt::Display for Seen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Ahead => "drove ahead",
            Self::Back => "drove backwards",
            Self::Left => "turned to the left",
            Self::Right => "turned to the right",
            Self::Nothing => "stood still",
        })
    }
}

/// A try: what the wheels have counted, and what was seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Try {
    /// By the odometry.
    pub(super) counted: Motion,
    /// The same at an early moment of the motion, before the robot reacts to it; `None` if none was reported.
    pub(super) early: Option<Motion>,
    /// By the sensor, or a person.
    pub(super) seen: Option<Seen>,
    /// How far it really went, and by how much that may be wrong, in metres.
    pub(super) way_m: Option<[f64; 2]>,
}

/// What is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "finding", rename_all = "snake_case")]
pub enum Finding {
    /// The wheels do what they are told.
    Good,
    /// The wheels have not turned, by their counts, and nobody has seen the robot move.
    Still,
    /// The robot has moved, but no counts have come.
    NoCounts,
    /// The wheels turn, and the robot stands.
    Spinning,
    /// A wheel turns backwards: its motor's wires are swapped.
    Motor {
        /// Whether it is the left one.
        left: bool,
    },
    /// A wheel's encoder counts backwards.
    Encoder {
        /// Whether it is the left one.
        left: bool,
    },
    /// One of these two: nobody has seen the robot.
    MotorOrEncoder {
        /// Whether it is the left one.
        left: bool,
    },
    /// Both motors turn backwards.
    BothMotors,
    /// Both encoders count backwards.
    BothEncoders,
    /// One of these two: nobody has seen the robot.
    BothMotorsOrEncoders,
    /// The motors are swapped: each gets the other one's commands.
    SwappedMotors,
    /// The encoders are swapped.
    SwappedEncoders,
    /// One of these two: nobody has seen the robot.
    SwappedMotorsOrEncoders,
    /// Motors and encoders are swapped: the robot turns to the wrong side and counts the right one.
    SwappedWheels,
    /// The counts of a metre are wrong.
    Ticks {
        /// The way that the wheels have counted, divided by the true one.
        ratio: f64,
        /// By how much that may be wrong.
        error: f64,
    },
    /// The motion is none of these.
    Unclear,
}

/// Judges a try to drive ahead by `asked_m`.
pub(super) fn ahead(asked_m: f64, Try { counted, early, seen, way_m }: Try) -> Finding {
    // What comes first counts: later the robot has reacted to it.
    let by_wheels = Seen::of(early.filter(|it| Seen::of(*it) != Seen::Nothing).unwrap_or(counted));
    match by_wheels {
        Seen::Nothing => match seen {
            None | Some(Seen::Nothing) => Finding::Still,
            Some(_) => Finding::NoCounts,
        },
        Seen::Left | Seen::Right => {
            let left = by_wheels == Seen::Left;
            match seen {
                None => Finding::MotorOrEncoder { left },
                Some(Seen::Nothing) => Finding::Unclear,
                // It does as it counts: the counts are right.
                Some(seen) if seen == by_wheels => Finding::Motor { left },
                Some(_) => Finding::Encoder { left },
            }
        }
        Seen::Back => match seen {
            None => Finding::BothMotorsOrEncoders,
            Some(Seen::Back) => Finding::BothMotors,
            Some(Seen::Ahead) => Finding::BothEncoders,
            Some(_) => Finding::Unclear,
        },
        Seen::Ahead if seen == Some(Seen::Nothing) => Finding::Spinning,
        Seen::Ahead => match way_m {
            _ if counted.ahead < LEAST_WAY * asked_m => Finding::Unclear,
            Some([way, error])
                if way > 0.0 && (counted.ahead - way).abs() > error + JERK + SLIP * way =>
            {
                Finding::Ticks { ratio: counted.ahead / way, error: (error + JERK) / way + SLIP }
            }
            _ => Finding::Good,
        },
    }
}

/// Judges a try to turn to the left, after one ahead that was good.
pub(super) fn turn(Try { counted, early, seen, .. }: Try) -> Finding {
    let by_wheels = Seen::of(early.filter(|it| Seen::of(*it) != Seen::Nothing).unwrap_or(counted));
    match (by_wheels, seen) {
        (Seen::Left, None | Some(Seen::Left)) => Finding::Good,
        (Seen::Left, Some(Seen::Right)) => Finding::SwappedWheels,
        (Seen::Right, None) => Finding::SwappedMotorsOrEncoders,
        (Seen::Right, Some(Seen::Right)) => Finding::SwappedMotors,
        (Seen::Right, Some(Seen::Left)) => Finding::SwappedEncoders,
        (Seen::Nothing, None | Some(Seen::Nothing)) => Finding::Still,
        (Seen::Nothing, Some(_)) => Finding::NoCounts,
        _ => Finding::Unclear,
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let side = |left: bool| if left { "left" } else { "right" };
        match *self {
            Self::Good => f.write_str("good"),
            Self::Still => f.write_str(
                "the wheels do not turn: is the base on, is something in the way within half a metre, is the bumper free, \
                 does the sensor work (ubimap sensor)?",
            ),
            Self::NoCounts => f.write_str(
                "the robot moves, but its wheels count nothing: check the encoders' supply and lines",
            ),
            Self::Spinning => f.write_str(
                "the wheels count, but the robot stands: do they touch the floor, and are they tight on their axles?",
            ),
            Self::Motor { left } => write!(
                f,
                "the {0} wheel runs backwards: swap the two wires of the {0} motor",
                side(left)
            ),
            Self::Encoder { left } => write!(
                f,
                "the {0} wheel runs well, but its encoder counts backwards: swap A and B of the {0} encoder",
                side(left)
            ),
            Self::MotorOrEncoder { left } => write!(
                f,
                "the {0} wheel runs or counts backwards. If the robot really turned to the {0} at once: swap the two wires of \
                 the {0} motor. If not: swap A and B of the {0} encoder",
                side(left)
            ),
            Self::BothMotors => {
                f.write_str("both wheels run backwards: swap the two wires of each motor")
            }
            Self::BothEncoders => f.write_str(
                "both wheels run well, but both encoders count backwards: swap A and B of each encoder",
            ),
            Self::BothMotorsOrEncoders => f.write_str(
                "both wheels run or count backwards. If the robot really drove backwards: swap the two wires of each motor. If \
                 it drove ahead: swap A and B of each encoder",
            ),
            Self::SwappedMotors => f.write_str(
                "the motors are swapped: the left one gets the right one's commands. Swap their connectors",
            ),
            Self::SwappedEncoders => f.write_str(
                "the encoders are swapped: the left one is read as the right one. Swap their connectors",
            ),
            Self::SwappedMotorsOrEncoders => f.write_str(
                "the wheels are swapped. If the robot really turned to the right: swap the connectors of the motors. If it turned \
                 to the left: swap those of the encoders",
            ),
            Self::SwappedWheels => f.write_str(
                "both motors and encoders are swapped: the robot turns to the wrong side and counts the right one. Swap the \
                 connectors of both",
            ),
            Self::Ticks { ratio, error } => write!(
                f,
                "the wheels count {:.1} % too {}, give or take {:.1} %: measure a longer way (--way 1), then multiply the way per \
                 count (count_nm of the robot's WheelBase) by {:.3}",
                (ratio - 1.0).abs() * 100.0,
                if ratio > 1.0 { "much" } else { "little" },
                error * 100.0,
                1.0 / ratio
            ),
            Self::Unclear => f.write_str(
                "the motion fits no single fault: try again with more room, and look for a loose wheel or wire",
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tried(ahead: f64, turn: f64, seen: Option<Seen>) -> Try {
        Try { counted: Motion { ahead, turn }, early: None, seen, way_m: None }
    }

    #[test]
    fn each_fault_of_a_wheel_is_told_by_what_was_seen() {
        use Seen::{Ahead, Back, Left, Nothing, Right};
        for (counted, seen, finding) in [
            ((0.3, 0.0), None, Finding::Good),
            ((0.0, 0.8), None, Finding::MotorOrEncoder { left: true }),
            ((0.0, 0.8), Some(Left), Finding::Motor { left: true }),
            ((0.0, 0.8), Some(Ahead), Finding::Encoder { left: true }),
            ((-0.1, -0.8), Some(Right), Finding::Motor { left: false }),
            ((-0.1, -0.8), Some(Left), Finding::Encoder { left: false }),
            ((-0.3, 0.0), None, Finding::BothMotorsOrEncoders),
            ((-0.3, 0.0), Some(Back), Finding::BothMotors),
            ((-0.3, 0.0), Some(Ahead), Finding::BothEncoders),
            ((0.0, 0.0), None, Finding::Still),
            ((0.0, 0.0), Some(Nothing), Finding::Still),
            ((0.01, 0.0), Some(Ahead), Finding::NoCounts),
            ((0.1, 0.0), None, Finding::Unclear),
            ((0.3, 0.0), Some(Nothing), Finding::Spinning),
        ] {
            assert_eq!(
                ahead(0.3, tried(counted.0, counted.1, seen)),
                finding,
                "{counted:?} {seen:?}"
            );
        }
        for (counted, seen, finding) in [
            (1.3, None, Finding::Good),
            (1.3, Some(Right), Finding::SwappedWheels),
            (-2.0, None, Finding::SwappedMotorsOrEncoders),
            (-2.0, Some(Right), Finding::SwappedMotors),
            (-2.0, Some(Left), Finding::SwappedEncoders),
            (0.0, Some(Left), Finding::NoCounts),
        ] {
            assert_eq!(turn(tried(0.0, counted, seen)), finding, "{counted:?} {seen:?}");
        }
    }

    #[test]
    fn what_comes_first_counts() {
        // It spun to the left, and was turned back by its own control.
        let early = Some(Motion { ahead: 0.0, turn: 0.5 });
        let it = Try { early, ..tried(-0.1, -0.2, None) };
        assert_eq!(ahead(0.3, it), Finding::MotorOrEncoder { left: true });
        let early = Some(Motion { ahead: 0.001, turn: 0.0 });
        assert_eq!(ahead(0.3, Try { early, ..tried(0.29, 0.0, None) }), Finding::Good);
    }

    #[test]
    fn counts_are_compared_with_a_measured_way() {
        let way = |metres, error| {
            ahead(1.0, Try { way_m: Some([metres, error]), ..tried(1.03, 0.0, None) })
        };
        let Finding::Ticks { ratio, error } = way(1.0, 0.005) else {
            panic!("{:?}", way(1.0, 0.005))
        };
        assert!((ratio - 1.03).abs() < 1e-9 && (error - 0.025).abs() < 1e-9);
        let text = way(1.0, 0.005).to_string();
        assert!(text.contains("3.0 % too much, give or take 2.5 %"), "{text}");
        assert!(text.contains("by 0.971"), "{text}");
        // It may be the sensor, or the wheels' usual slip.
        assert_eq!(way(1.0, 0.02), Finding::Good);
        assert_eq!(way(1.02, 0.005), Finding::Good);
    }
}
