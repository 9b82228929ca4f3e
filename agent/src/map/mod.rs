//! From a range scan and its pose to the robot's own layer of the map.

mod evidence;
mod gate;
mod local_map;
mod own_tile;
mod sighting;

pub use evidence::{Evidence, RowSighting};
pub use gate::Gate;
pub use local_map::{LocalMap, Mapped};
pub use own_tile::{OwnTile, Pool};
pub use sighting::{MAX_RADIUS, PixelCounts, Sighting, SightingConfig, scratch_words};
