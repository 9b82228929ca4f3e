//! The configuration of a robot with a VL53L5CX or VL53L8CX, in the place of `configuration.rs`: its devices
//! and its memory. Change the constants for another robot.

use ubimap_agent::{
    Bounds, Config,
    device::zones::{SIDE, Zones},
    sense::{Camera, Pick, Slice, Slicer, Validity},
};
use ubimap_protocol::units::{Angle, Millimetres, Pose, RobotId};

/// The robot's id, unique in a deployment.
const ROBOT: RobotId = RobotId(1);

/// The baud rates of the ports to the server, a depth sensor that is not there, and the wheels.
pub(crate) const BAUDS: [u32; 3] = [115_200; 3];

/// The middle of the frame, in zones.
const MIDDLE: f32 = (SIDE - 1) as f32 / 2.0;

/// The focal length in zones: half the width divided by the tangent of half the field of view of 45
/// degrees.
const FOCAL: f32 = SIDE as f32 / 2.0 / 0.414_213_6;

/// The sensor's optics.
const CAMERA: Camera = Camera::new((FOCAL, FOCAL), (MIDDLE, MIDDLE));

/// The sensor in `base_link`: 5 cm ahead of the middle between the wheels, facing ahead.
const MOUNTING: Pose = Pose { x: Millimetres(50), y: Millimetres(0), heading: Angle(0) };

/// The rows that are mapped: the upper one of the two in the middle, which looks 0 to 6 degrees up.
const SLICE: Slice = Slice::Band { first: (SIDE / 2 - 1) as u16, rows: 1, pick: Pick::Nearest };

/// Size of the slicer's buffer, in readings.
pub(crate) const SLICE_LENGTH: usize = SLICE.buffer_len(SIDE);

/// The sizes of the robot's memory. The side of a cell must equal the server's.
pub(crate) const BOUNDS: Bounds = Bounds { readings: SIDE, max_range: 2_500, ..Bounds::REFERENCE };

/// The robot's configuration without a drive, for a random number that differs from boot to boot.
pub(crate) fn config(boot_nonce: u32) -> Config {
    let config = Config::new(ROBOT, SLICE.sensor(CAMERA), BOUNDS);
    Config { boot_nonce, mounting: MOUNTING, ..config }
}

/// The driver of the depth sensor; `None` if the slice is not one of the sensor's frames.
pub(crate) fn sensor(buffer: &mut [u16]) -> Option<Zones<'_>> {
    Zones::new(Slicer::new(SLICE, CAMERA, SIDE, Validity::default(), buffer).ok()?).ok()
}
