//! From a depth frame or a sensor's readings to a range scan that waits for its pose.
//!
//! A [`Slicer`] reduces a frame to one reading per column. A table of [`Beam`]s, computed once,
//! gives the direction of each reading. [`Validity`] decides which readings are valid, and
//! [`Steadiness`] which scans were taken while the robot moved smoothly.

mod beams;
mod camera;
mod clearance;
mod columns;
mod distance_vector;
mod exposure;
mod floor;
mod level;
mod scale_curve;
mod slice;
mod steadiness;
mod validity;
mod waiting;

pub use beams::{Beam, DIRECTION_BITS, Removal, SensorModel, fill_beams, remove_beams};
pub use camera::{Camera, Distortion, PixelModel, Ray, Rays};
pub use clearance::GroundClearance;
pub use columns::Columns;
pub use distance_vector::{boundary_point, floor_readings, open_floor_readings};
pub use exposure::Exposure;
pub use floor::{COLUMNS, Floor, FloorConfig, ImageSizeError, LINES, floor_distances};
pub use scale_curve::{ScaleCurve, ScaleError, TABLE_1};
pub use slice::{Pick, Slice, SliceError, Slicer};
pub use steadiness::{Steadiness, SteadyLimits};
pub use validity::{NOTHING_IN_RANGE, Validity};
pub use waiting::{ScanError, WaitingScans};
