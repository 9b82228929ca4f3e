//! The configuration of a robot with an LD06 lidar, in the place of `configuration.rs`: its devices and
//! its memory. Change the constants for another robot.

use ubimap_agent::{
    Bounds, Config,
    device::ld06::{self, Ld06},
};
use ubimap_protocol::units::{Angle, Millimetres, Pose, RobotId};

/// The robot's id, unique in a deployment.
const ROBOT: RobotId = RobotId(1);

/// The baud rates of the ports to the server, the lidar and the wheels.
pub(crate) const BAUDS: [u32; 3] = [115_200, ld06::BAUD, 115_200];

/// The lidar in `base_link`: over the middle between the wheels, its arrow ahead.
const MOUNTING: Pose = Pose { x: Millimetres(0), y: Millimetres(0), heading: Angle(0) };

/// Number of readings per turn, the size of the buffer: one per degree.
pub(crate) const SLICE_LENGTH: usize = 360;

/// The sizes of the robot's memory. The side of a cell must equal the server's.
pub(crate) const BOUNDS: Bounds =
    Bounds { readings: SLICE_LENGTH, max_range: 2_500, ..Bounds::REFERENCE };

/// The robot's configuration without a drive, for a random number that differs from boot to boot.
pub(crate) fn config(boot_nonce: u32) -> Config {
    let config = Config::new(ROBOT, Ld06::sensor(SLICE_LENGTH), BOUNDS);
    Config { boot_nonce, mounting: MOUNTING, validity: Ld06::validity(), ..config }
}

/// The driver of the lidar.
pub(crate) fn sensor(buffer: &mut [u16]) -> Option<Ld06<'_>> {
    Some(Ld06::new(buffer))
}
