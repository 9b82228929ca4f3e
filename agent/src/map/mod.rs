//! From a range scan and its pose to the robot's own layer of the map.

mod change;
mod evidence;
mod gate;
mod local_map;
mod movable;
mod omission;
mod own_tile;
mod peers;
mod policy;
mod projection;
mod scan_window;
mod selection;
mod trace;

pub use evidence::{Evidence, RowSighting};
pub use gate::Gate;
pub use local_map::{LocalMap, MAX_RADIUS, Mapped, MappingConfig, Surround, scratch_words};
pub use own_tile::{OwnTile, Pool};
pub use peers::PeerMask;
pub(crate) use peers::{PeerMasks, ScanContext};
pub use policy::Policy;
pub use projection::MIN_RESOLUTION;
pub use selection::{Selected, Selection};
pub use trace::PixelCounts;
