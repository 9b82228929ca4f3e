//! From a sensor's readings to a range scan that waits for its pose.

mod beams;
mod camera;
mod clearance;
mod columns;
mod distance_vector;
mod floor;
mod scale_curve;
mod waiting;

pub use beams::{Beam, DIRECTION_BITS, Removal, SensorModel, fill_beams, remove_beams};
pub use camera::{Camera, Distortion, PixelModel, Ray, Rays};
pub use clearance::GroundClearance;
pub use columns::Columns;
pub use distance_vector::{boundary_point, floor_readings};
pub use floor::{COLUMNS, Floor, FloorConfig, ImageSizeError, LINES, floor_distances};
pub use scale_curve::{ScaleCurve, ScaleError, TABLE_1};
pub use waiting::{ScanError, WaitingScans};
