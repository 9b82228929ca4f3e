//! The robot's configuration: its devices and its memory. Change the constants for another robot.
//! A PC that repeats the run of a robot compiles this file, too.

use ubimap_agent::{
    Bounds, Config,
    device::a010::{A010, A010Config},
    sense::{Camera, Pick, Slice, Slicer, Validity},
};
use ubimap_protocol::units::{Angle, Millimetres, Pose, RobotId};

/// The robot's id, unique in a deployment.
const ROBOT: RobotId = RobotId(1);

/// The baud rates of the ports to the server, the depth sensor and the wheels.
pub(crate) const BAUDS: [u32; 3] = [115_200; 3];

/// The depth sensor: as fine as its port carries ten frames per second.
const SENSOR: A010Config = A010Config::for_port(BAUDS[1]).expect("the port is too slow");

/// Pixels per row of the sensor.
const SIDE: usize = SENSOR.binning.side();

/// The middle of the image, in pixels.
const MIDDLE: f32 = (SIDE - 1) as f32 / 2.0;

/// The focal length in pixels: half the width divided by the tangent of half the field of view of 70
/// degrees.
const FOCAL: f32 = SIDE as f32 / 2.0 / 0.700_207_5;

/// The sensor's optics.
const CAMERA: Camera = Camera::new((FOCAL, FOCAL), (MIDDLE, MIDDLE));

/// The sensor in `base_link`: 10 cm ahead of the middle between the wheels, facing ahead.
const MOUNTING: Pose = Pose { x: Millimetres(100), y: Millimetres(0), heading: Angle(0) };

/// The rows of the image that are mapped: the middle one and its neighbours, for a sensor that looks
/// straight ahead above the highest bump of the floor.
const SLICE: Slice = Slice::Band { first: (SIDE / 2 - 1) as u16, rows: 3, pick: Pick::Nearest };

/// Size of the slicer's buffer, in readings.
pub(crate) const SLICE_LENGTH: usize = SLICE.buffer_len(SIDE);

/// The sizes of the robot's memory. The side of a cell must equal the server's.
pub(crate) const BOUNDS: Bounds = Bounds { readings: SIDE, max_range: 2_500, ..Bounds::REFERENCE };

/// The robot's configuration without a drive, for a random number that differs from boot to boot.
pub(crate) fn config(boot_nonce: u32) -> Config {
    let config = Config::new(ROBOT, SLICE.sensor(CAMERA), BOUNDS);
    Config { boot_nonce, mounting: MOUNTING, ..config }
}

/// The driver of the depth sensor; `None` if the slice is not one of the sensor's images.
pub(crate) fn sensor(buffer: &mut [u16]) -> Option<A010<'_>> {
    let slicer = Slicer::new(SLICE, CAMERA, SIDE, Validity::default(), buffer).ok()?;
    A010::new(SENSOR, slicer).ok()
}
