//! The state of a robot at a running server.

use std::fmt;

use serde::Serialize;

/// The state of a robot at a running server.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ServedRobot {
    /// The robot's number.
    pub robot: u16,
    /// Whether it has a session.
    pub session: bool,
    /// The port at which it was last heard.
    pub port: Option<String>,
    /// Seconds since bytes arrived at that port.
    pub heard_s_ago: Option<f64>,
    /// Its newest pose in `map`, from cameras or its own reports: x and y in metres, heading in degrees.
    pub pose: Option<[f64; 3]>,
    /// The age of that pose in seconds.
    pub pose_s_ago: Option<f64>,
    /// Whether it has booted out of view, where nothing has told yet where it is: its pose is the one before.
    pub is_sought: bool,
    /// How far, in metres, what it drew was moved at most, as it was not where it believed.
    pub map_moved_m: f64,
    /// What it is doing, as a sentence that starts with the robot.
    pub doing: String,
}

/// "robot 1: at 2.00 m, 3.00 m, 90 degrees, 0.1 s ago; drives to 4.00 m, 2.00 m; heard 0.2 s ago at udp:4000".
impl fmt::Display for ServedRobot {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "robot {}: ", self.robot)?;
        match (self.pose, self.pose_s_ago) {
            (Some([x, y, heading]), Some(age)) => {
                // Without the sign of a negative zero.
                let heading = heading.round() + 0.0;
                write!(f, "at {x:.2} m, {y:.2} m, {heading} degrees, {age:.1} s ago")?;
            }
            _ => write!(f, "never seen by a camera")?,
        }
        if self.is_sought {
            write!(f, ", if it has not moved since it booted")?;
        }
        write!(f, "; {}", self.doing)?;
        if self.map_moved_m >= 0.1 {
            write!(f, "; what it drew was moved by up to {:.1} m", self.map_moved_m)?;
        }
        match (&self.port, self.heard_s_ago) {
            (Some(port), Some(age)) => write!(f, "; heard {age:.1} s ago at {port}")?,
            (Some(port), None) => write!(f, "; was at {port}")?,
            (None, _) => write!(f, "; never heard")?,
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_is_told_in_a_line() {
        let robot = ServedRobot {
            robot: 1,
            session: true,
            port: Some("udp:4000".into()),
            heard_s_ago: Some(0.2),
            pose: Some([2.0, 3.0, -0.3]),
            pose_s_ago: Some(0.1),
            is_sought: false,
            map_moved_m: 0.04,
            doing: "has nothing to do".into(),
        };
        assert_eq!(
            robot.to_string(),
            "robot 1: at 2.00 m, 3.00 m, 0 degrees, 0.1 s ago; has nothing to do; heard 0.2 s ago at udp:4000"
        );
        let adrift = ServedRobot { map_moved_m: 0.43, port: None, ..robot };
        assert_eq!(
            adrift.to_string(),
            "robot 1: at 2.00 m, 3.00 m, 0 degrees, 0.1 s ago; has nothing to do; \
             what it drew was moved by up to 0.4 m; never heard"
        );
    }
}
