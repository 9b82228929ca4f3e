//! Message bodies that travel in both directions.

use heapless::Vec;
use serde::{Deserialize, Deserializer, Serialize, de::Error};

use super::direction::{Body, Traffic};
use crate::tile::{Layer, Stamp, TileId};

/// Number of frame sequence numbers: they have 11 bits and wrap.
pub const SEQUENCE_MODULUS: u16 = 1 << 11;

/// Acknowledges reliable frames. Kind 0 in both directions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ack {
    /// All reliable frames before this sequence number have arrived. Malformed from
    /// [`SEQUENCE_MODULUS`] on.
    #[serde(deserialize_with = "sequence_number")]
    pub next: u16,
    /// If bit `i` is set, the frame `next + 1 + i` has also arrived.
    pub later: u32,
}

fn sequence_number<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u16, D::Error> {
    let number = u16::deserialize(deserializer)?;
    if number < SEQUENCE_MODULUS { Ok(number) } else { Err(D::Error::custom("no sequence number")) }
}

impl<D: Traffic> Body<D> for Ack {
    const KIND: D::Kind = D::ACK;
}

/// The fixed part of a tile update. The coded tiles follow it in the body
/// ([`TileEncoder`](crate::tile::TileEncoder)).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TileUpdateHead {
    /// The layer that the tiles belong to.
    pub layer: Layer,
    /// When the newest scan in the tiles was taken, in whole seconds of the server's clock; for the
    /// server's layers, when the update was written.
    pub seconds: u32,
}

/// Maximum number of tiles in one [`Digests`].
pub const MAX_DIGESTS: usize = 8;

/// The states of some tiles as published by their writer. A receiver that holds an older state or
/// other cells asks for the tile with a [`Request`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Digests {
    /// The layer.
    pub layer: Layer,
    /// The tiles.
    pub tiles: Vec<TileDigest, MAX_DIGESTS>,
}

/// The state of one tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TileDigest {
    /// The tile.
    pub id: TileId,
    /// The state of the tile.
    pub stamp: Stamp,
    /// The hash of its cells ([`tile_hash`](crate::tile::tile_hash)).
    pub hash: u32,
}

/// Maximum number of tiles in one [`Request`].
pub const MAX_REQUESTS: usize = 8;

/// Asks the writer of a layer for whole tiles, after an update whose base the receiver does not
/// hold.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// The layer of the tiles.
    pub layer: Layer,
    /// The tiles; an empty list means all.
    pub tiles: Vec<TileId, MAX_REQUESTS>,
}

/// Maximum number of parameters of a robot.
pub const MAX_PARAMETERS: usize = 16;

/// A parameter and its value; SPEC.md lists the parameters, their units and ranges.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParameterValue {
    /// The parameter's number.
    pub parameter: u16,
    /// The value, in the parameter's unit.
    pub value: i32,
}
