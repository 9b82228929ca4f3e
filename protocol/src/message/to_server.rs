//! What a robot says to the server.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::{
    tile::{Layer, TileId},
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};

/// The kinds of messages to the server. Kind 0 is [`Ack`](super::Ack).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ToServerKind {
    /// [`Hello`], in a handshake frame.
    Hello = 1,
    /// [`TimeRequest`].
    TimeRequest = 2,
    /// A [`TileUpdateHead`](super::TileUpdateHead) and coded tiles of the robot's layer.
    TileUpdate = 3,
    /// [`State`].
    State = 4,
    /// [`Interest`].
    Interest = 5,
    /// [`Request`].
    Request = 6,
}

impl ToServerKind {
    /// The kind of this number, or `None` for one that this version does not know.
    pub fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            1 => Self::Hello,
            2 => Self::TimeRequest,
            3 => Self::TileUpdate,
            4 => Self::State,
            5 => Self::Interest,
            6 => Self::Request,
            _ => return None,
        })
    }
}

/// Opens a conversation: who the robot is and what it can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// The newest version of the protocol that the robot speaks.
    pub version: u8,
    /// The oldest version that it still speaks.
    pub min_version: u8,
    /// Which robot.
    pub robot: RobotId,
    /// Different at every attempt of every boot, so that an old welcome is not taken for a new one.
    pub nonce: u32,
    /// The largest frame that the robot can receive, in bytes on the wire.
    pub frame: u16,
    /// The side of its map's cells.
    pub resolution: Millimetres,
    /// How many fused tiles the robot can hold.
    pub fused_tiles: u16,
}

/// Asks for the server's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimeRequest {
    /// Given back in the reply.
    pub nonce: u16,
}

/// How the robot fares; sent now and then, which keeps the session alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    /// The moment that `pose` is for, in the server's clock; `None` before the clocks agree.
    pub time: Option<Instant>,
    /// Where the robot believes that it is (`base_link` in `map`); `None` if it doesn't know.
    pub pose: Option<Pose>,
    /// Cells that it could not map since it started because its pool of tiles was full.
    pub cells_refused: u32,
}

/// The rectangle of which the robot wants the server's tiles, corners included.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Interest {
    /// Counts the changes of interest: of two, the one with the higher number holds.
    pub number: u32,
    /// The south-western tile.
    pub from: TileId,
    /// The north-eastern tile.
    pub to: TileId,
}

impl Interest {
    /// Whether a tile lies in the rectangle.
    pub fn contains(&self, tile: TileId) -> bool {
        (self.from.x..=self.to.x).contains(&tile.x) && (self.from.y..=self.to.y).contains(&tile.y)
    }

    /// How many tiles the rectangle holds.
    pub fn tiles(&self) -> u32 {
        let side = |from: i16, to: i16| (i32::from(to) - i32::from(from) + 1).max(0) as u32;
        side(self.from.x, self.to.x).saturating_mul(side(self.from.y, self.to.y))
    }
}

/// The most tiles that one [`Request`] can name.
pub const MAX_REQUESTS: usize = 8;

/// Asks for whole tiles: an update came for a base that is not held. The same in both directions.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// The layer of the tiles.
    pub layer: Layer,
    /// Which tiles; none means all.
    pub tiles: Vec<TileId, MAX_REQUESTS>,
}
