//! From a sensor's readings to a range scan that waits for its pose.

mod beams;
mod clearance;
mod floor;
mod waiting;

pub use beams::{Beam, DIRECTION_BITS, SensorModel, fill_beams};
pub use clearance::GroundClearance;
pub use floor::{COLUMNS, Floor, FloorConfig, ImageSizeError, LINES, floor_distances};
pub use waiting::{ScanError, WaitingScans};
