//! The drive of a robot that follows the server's paths. Change the constants for another robot.

use ubimap_agent::drive::{Driving, Gaze, Motion};

/// The radius of the robot, in millimetres.
const RADIUS: u16 = 170;

/// The configuration of the drive.
pub(crate) fn driving() -> Driving {
    let motion = Motion { radius: RADIUS, top_speed: 450.0, top_turn: 1.3, ..Motion::default() };
    // Half the field of view, in radians.
    let gaze = Gaze { half_view: 0.61, reach: 2_500, radius: RADIUS };
    Driving { motion, looks_at_goal: Some(gaze), ..Driving::default() }
}
