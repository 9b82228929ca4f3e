//! Camera evidence, robot layers, and the fused and coverage layers that robots get.

mod agreement;
mod alignment;
mod camera_layer;
mod constant_errors;
mod coverage_layer;
mod epochs;
mod fused_layer;
mod hollow;
mod mask;
mod placed_layer;
mod prior_layer;
mod robot_layer;
mod ros_merge;
mod runs;
mod served_layer;
pub mod submaps;
pub mod trajectories;
mod volatility;

pub use agreement::{Agreements, Weight};
pub use alignment::{Match, Prior, Reading, Search, Surfaces, Trail, points, readings};
pub use camera_layer::{CameraLayer, CameraTile};
pub use constant_errors::{ConstantErrors, CureRecord, Cured, Estimated};
pub use coverage_layer::CoverageLayer;
pub use fused_layer::{MapTime, clear, fuse};
pub use hollow::{Sight, hollow};
pub use mask::Mask;
pub use placed_layer::{Correction, PlacedLayer, Placement};
pub use prior_layer::{CellLabel, CellPrior, PriorLayer, PriorTile};
pub use robot_layer::{Limit, RobotLayer, SeenTile, TileRecord, Updated};
pub use ros_merge::RosMerge;
pub use served_layer::ServedLayer;
pub use volatility::{Volatility, interval_s};
