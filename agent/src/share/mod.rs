//! What the robot tells the server of its map, and the server's map on the robot.

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
