//! Occupancy grids, ROS map files and scores.
//!
//! [`OccupancyGrid`] is a map as one rectangle of cells, the form in which maps are read and
//! written. [`read_map`], [`pgm`] and [`yaml`] read and write the files of ROS's `map_server`;
//! [`compare`] scores one grid against another.

mod clusters;
mod labels;
mod occupancy;
mod polygon;
pub(crate) mod raster;
mod ros_map;
mod score;

pub(crate) use clusters::clusters;
pub use labels::{Class, Label, LabelConfig, labels, read_labels};
pub use occupancy::{CellCounts, GridError, MAX_CELLS, OccupancyGrid};
pub(crate) use polygon::{is_inside, span};
pub use raster::RasterError;
pub use ros_map::{MapError, Thresholds, pgm, read_map, yaml};
pub use score::{Scores, compare};
