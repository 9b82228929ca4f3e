//! From a sensor's readings to a range scan that waits for its pose.

mod beams;
mod waiting;

pub use beams::{Beam, DIRECTION_BITS, SensorModel, fill_beams};
pub use waiting::{ScanError, WaitingScans};
