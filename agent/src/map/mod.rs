//! From a range scan and its pose to the robot's own layer of the map.

mod evidence;
mod gate;
mod local_map;
mod own_tile;
mod projection;
mod trace;
mod window;

pub use evidence::{Evidence, RowSighting};
pub use gate::Gate;
pub use local_map::{LocalMap, MAX_RADIUS, Mapped, MappingConfig, scratch_words};
pub use own_tile::{OwnTile, Pool};
pub use projection::MIN_RESOLUTION;
pub use trace::PixelCounts;
