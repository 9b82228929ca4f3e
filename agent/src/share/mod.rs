//! Sharing the map: updates of the robot's tiles to the server, and the server's tiles on the
//! robot.

mod commands;
mod distance_vectors;
mod events;
mod publish;
mod receive;

pub use commands::Commands;
pub(crate) use distance_vectors::DistanceVectors;
pub use events::Events;
pub use publish::Publisher;
pub use receive::{FusedMap, FusedTile};
