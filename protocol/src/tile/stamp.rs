//! Stamps: which state of a tile is newer.

use serde::{Deserialize, Serialize};

/// The epoch of a tile: raised when its writer starts it again (after a reboot or an eviction).
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Epoch(pub u32);

/// How far the epochs of a robot may run ahead of the `first_epoch` that the server would grant it
/// now: twice the margin of a cure. The server refuses later ones.
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
    /// Compared first.
    pub epoch: Epoch,
    /// Compared within an epoch.
    pub version: Version,
}

impl Stamp {
    /// The stamp of a tile that is not held.
    pub const NOTHING: Self = Self { epoch: Epoch(0), version: Version(0) };
}
