//! From a range scan and its pose to the robot's own layer of the map.
//!
//! | file | what |
//! |---|---|
//! | `gate`, `change` | which scans are mapped: the robot has moved, or its view has changed |
//! | `policy`, `selection`, `omission` | which of a scan's readings are mapped |
//! | `peers` | readings of other robots, which are left out |
//! | `projection`, `scan_window`, `trace` | a scan as free and occupied cells of a window |
//! | `evidence` | a counter per cell that accumulates the observations |
//! | `movable` | cells whose occupant is likely to move again |
//! | `own_tile` | the robot's tiles and the pool that holds them |
//! | `local_map` | the stages joined: takes a scan and its pose |

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
