//! Stamps: which state of a tile is newer.

use serde::{Deserialize, Serialize};

/// The epoch of a tile: raised when its writer starts the tile again, after a reboot or an
/// eviction.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Epoch(pub u32);

/// How far a robot's epochs may exceed the `first_epoch` that the server would grant it now: twice
/// the margin that the server uses when it corrects a robot. The server refuses later epochs.
pub const EPOCHS_AHEAD: u32 = 8_192;

/// The version of a tile within an epoch: raised by its writer at each published change. Zero means
/// that nothing has been published.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Version(pub u32);

/// Epoch and version: the state of a tile with the greater stamp is newer.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Stamp {
    /// The epoch, which is compared first.
    pub epoch: Epoch,
    /// The version, which is compared between stamps of the same epoch.
    pub version: Version,
}

impl Stamp {
    /// The stamp of a tile that is not held.
    pub const NOTHING: Self = Self { epoch: Epoch(0), version: Version(0) };
}
