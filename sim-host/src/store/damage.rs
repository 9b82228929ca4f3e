//! The losses that damaged rows cause.

use core::fmt;

use rusqlite::types::Value;
use ubimap_protocol::{
    tile::{Epoch, TileId},
    units::RobotId,
};

/// What was lost with a damaged row, according to its key, which may be damaged as well.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Damage {
    /// A robot's tile in one epoch.
    Tile(RobotId, TileId, Epoch),
    /// The times at which a robot saw the cells of a tile. The cells are kept with the oldest
    /// possible time.
    Times(RobotId, TileId),
    /// A tile of the cameras.
    CameraTile(TileId),
    /// The progress of a robot's cure (the correction of its constant errors).
    Cure(RobotId),
    /// What is known of where a robot was. What it has drawn stays where it drew it.
    Placement(RobotId),
    /// SQLite's log. The newest records may be missing.
    Log,
    /// A row whose key can't be read.
    Unknown,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tile(robot, TileId { x, y }, epoch) => write!(
                f,
                "tile ({x}, {y}) of robot {}, epoch {}, is damaged and left out; the robot is asked for it",
                robot.0, epoch.0
            ),
            Self::Times(robot, TileId { x, y }) => write!(
                f,
                "the times of tile ({x}, {y}) of robot {} are damaged; its cells count as the oldest",
                robot.0
            ),
            Self::CameraTile(TileId { x, y }) => write!(
                f,
                "tile ({x}, {y}) of the cameras is damaged and left out; they draw it again where they see it"
            ),
            Self::Cure(robot) => write!(
                f,
                "the corrected errors of robot {} are damaged and left out; they are estimated again",
                robot.0
            ),
            Self::Placement(robot) => write!(
                f,
                "the places of what robot {} has drawn are damaged and left out; it stays where it was drawn",
                robot.0
            ),
            Self::Log => f.write_str(
                "its -wal file is damaged, or a write to it failed: the newest tiles may be missing",
            ),
            Self::Unknown => f.write_str("a row without a readable key is damaged and left out"),
        }
    }
}

/// Each function takes the key of a damaged row of one table.
impl Damage {
    pub(super) fn tile(key: &[Value]) -> Self {
        let tile = || {
            let [robot, x, y, epoch] = key else { return None };
            Some(Self::Tile(RobotId(read(robot)?), tile_id(x, y)?, Epoch(read(epoch)?)))
        };
        tile().unwrap_or(Self::Unknown)
    }

    pub(super) fn times(key: &[Value]) -> Self {
        let times = || {
            let [robot, x, y] = key else { return None };
            Some(Self::Times(RobotId(read(robot)?), tile_id(x, y)?))
        };
        times().unwrap_or(Self::Unknown)
    }

    pub(super) fn camera_tile(key: &[Value]) -> Self {
        let [x, y] = key else { return Self::Unknown };
        tile_id(x, y).map_or(Self::Unknown, Self::CameraTile)
    }

    pub(super) fn cure(key: &[Value]) -> Self {
        let [robot] = key else { return Self::Unknown };
        read(robot).map_or(Self::Unknown, |robot| Self::Cure(RobotId(robot)))
    }

    pub(super) fn placement(key: &[Value]) -> Self {
        let [robot] = key else { return Self::Unknown };
        read(robot).map_or(Self::Unknown, |robot| Self::Placement(RobotId(robot)))
    }
}

fn tile_id(x: &Value, y: &Value) -> Option<TileId> {
    Some(TileId { x: read(x)?, y: read(y)? })
}

fn read<T: TryFrom<i64>>(value: &Value) -> Option<T> {
    let Value::Integer(number) = value else { return None };
    T::try_from(*number).ok()
}
