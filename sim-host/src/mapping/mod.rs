//! Camera evidence, robot layers and the fused layer.

mod camera_layer;
mod fused_layer;
mod robot_layer;

pub use camera_layer::CameraLayer;
pub use fused_layer::{FusedLayer, fuse};
pub use robot_layer::{RobotLayer, SeenTile, TileRecord, Updated};
