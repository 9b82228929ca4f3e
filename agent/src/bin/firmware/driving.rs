//! The drive of a robot that follows the server's paths. Change the constants for another robot.

use ubimap_agent::drive::{Driving, Gaze, Motion};

/// The radius of the robot, in millimetres: of a Create 2, or of a small robot with two motors.
const RADIUS: u16 = if cfg!(feature = "motors") { 80 } else { 170 };

/// The maximum speed, in mm/s, below that of the wheels.
const TOP_SPEED: f32 = if cfg!(feature = "motors") { 250.0 } else { 450.0 };

/// The configuration of the drive.
pub(crate) fn driving() -> Driving {
    let motion =
        Motion { radius: RADIUS, top_speed: TOP_SPEED, top_turn: 1.3, ..Motion::default() };
    // Half the field of view, in radians.
    let gaze = Gaze { half_view: 0.61, reach: 2_500, radius: RADIUS };
    Driving { motion, looks_at_goal: Some(gaze), ..Driving::default() }
}
