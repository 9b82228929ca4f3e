//! Messages from a robot to the server.

use heapless::{String, Vec};
use serde::{Deserialize, Serialize};

use super::{
    added,
    shared::{Digests, MAX_PARAMETERS, ParameterValue, Request, TileUpdateHead},
    table::messages,
};
use crate::{
    tile::TileId,
    time::Instant,
    units::{Angle, Millimetres, Pose, RobotId},
};

messages! {
    ToServer, against ToRobot: ToServerKind, ToServerMessage;
    1 Hello(Hello),
    2 TimeRequest(TimeRequest),
    3 TileUpdate(TileUpdateHead),
    4 State(State),
    5 Interest(Interest),
    6 Request(Request),
    7 DistanceVector(DistanceVector),
    8 Event(Event),
    9 Digests(Digests),
    10 ParameterReport(ParameterReport),
}

/// Opens a session, in a handshake frame: the robot's identity and capabilities.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// The newest version of the protocol that the robot speaks.
    pub version: u8,
    /// The oldest version that it still speaks.
    pub min_version: u8,
    /// The robot's number.
    pub robot: RobotId,
    /// Different for every attempt of every boot, so that a stale welcome is not accepted.
    pub nonce: u32,
    /// The largest frame that the robot can receive, in bytes on the wire.
    pub frame: u16,
    /// The side of its map's cells.
    pub resolution: Millimetres,
    /// Number of fused tiles that the robot can hold.
    pub fused_tiles: u16,
}

/// Asks for the server's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimeRequest {
    /// The nonce of the request, returned in the reply.
    pub nonce: u16,
}

/// The robot's status; sent periodically, which keeps the session alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct State {
    /// The time of `pose`, in the server's clock; `None` before the clocks are synchronised.
    pub time: Option<Instant>,
    /// Estimated pose (`base_link` in `map`); `None` if unknown.
    pub pose: Option<Pose>,
    /// The newest odometry pose (`base_link` in `odom`); `None` if the robot has no odometry.
    pub odometry: Option<Pose>,
    /// Cells not mapped since start because the tile pool was full.
    pub cells_refused: u32,
}

/// The rectangle of tiles that the robot wants from the server, corners included.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Interest {
    /// Counts the changes of interest: of two, the higher number wins.
    pub number: u32,
    /// The south-western tile.
    pub from: TileId,
    /// The north-eastern tile.
    pub to: TileId,
}

impl Interest {
    /// Whether the rectangle contains a tile.
    pub fn contains(&self, tile: TileId) -> bool {
        (self.from.x..=self.to.x).contains(&tile.x) && (self.from.y..=self.to.y).contains(&tile.y)
    }

    /// The tiles of the rectangle, row by row from the south-west.
    pub fn ids(&self) -> impl Iterator<Item = TileId> + use<> {
        let (from, to) = (self.from, self.to);
        (from.y..=to.y).flat_map(move |y| (from.x..=to.x).map(move |x| TileId { x, y }))
    }

    /// Number of tiles in the rectangle.
    pub fn tiles(&self) -> u32 {
        let side = |from: i16, to: i16| (i32::from(to) - i32::from(from) + 1).max(0) as u32;
        side(self.from.x, self.to.x).saturating_mul(side(self.from.y, self.to.y))
    }
}

/// Maximum number of columns in one [`DistanceVector`].
pub const MAX_COLUMNS: usize = 64;

/// The free distance around the robot in a number of columns (Ahmed 2.1). The server estimates the
/// robot's pose error from it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DistanceVector {
    /// When the scan was taken, in the server's clock.
    pub time: Instant,
    /// The robot's estimated pose at that time (`base_link` in `map`).
    pub pose: Pose,
    /// The bearing of the first column's centre in `base_link`.
    pub first: Angle,
    /// Angle from one column to the next, in binary angle units; negative for clockwise.
    pub step: i16,
    /// For each column the free distance from the origin of `base_link`, in units of
    /// [`DistanceVector::UNIT`]; 0 if unknown, [`DistanceVector::BEYOND`] for 5.1 m and more.
    pub distances: Vec<u8, MAX_COLUMNS>,
    /// Odometry pose (`base_link` in `odom`) at the same time: unlike `pose` it contains no fixes, so two of them
    /// give a motion. `None` from robots without odometry, of earlier versions, or with small frames.
    #[serde(default, with = "added", skip_serializing_if = "Option::is_none")]
    pub odometry: Option<Pose>,
}

impl DistanceVector {
    /// The unit of the distances.
    pub const UNIT: Millimetres = Millimetres(20);
    /// The code of all distances from 5.1 m on.
    pub const BEYOND: u8 = 255;
    /// Maximum size of the message without its columns and its odometry, in bytes, kind and length included.
    pub const OVERHEAD: usize = 33;
    /// Maximum size of the odometry.
    pub const ODOMETRY: usize = 13;
}

/// The severity of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Severity {
    /// Informational.
    Info,
    /// Something is degraded.
    Warning,
    /// Something has failed.
    Error,
}

/// Events on a robot. Codes from 0x8000 on are reserved for deployments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum EventCode {
    /// The robot has started.
    Started = 1,
    /// A scan was dropped because no pose was known for its time within the scan deadline.
    PoseLost = 2,
    /// The robot has a pose again.
    PoseFound = 3,
    /// No scan has arrived, or only invalid readings.
    SensorFault = 4,
    /// A wheel or a motor has failed.
    DriveFault = 5,
    /// The tile pool is full; cells were not mapped.
    PoolFull = 6,
    /// The battery is low.
    LowBattery = 7,
    /// The robot has run into something.
    Collision = 8,
    /// A person has stopped it.
    StoppedByPerson = 9,
    /// The path is blocked.
    PathBlocked = 10,
    /// The robot has reached the end of its path.
    PathDone = 11,
    /// The watchdog has restarted it.
    Watchdog = 12,
    /// The queue of scans waiting for their poses is full.
    ScanOverflow = 13,
    /// A scan's time stamp went backwards.
    ClockBackwards = 14,
    /// A fix was rejected as implausible.
    FixRejected = 15,
}

impl EventCode {
    const ALL: [Self; 15] = [
        Self::Started,
        Self::PoseLost,
        Self::PoseFound,
        Self::SensorFault,
        Self::DriveFault,
        Self::PoolFull,
        Self::LowBattery,
        Self::Collision,
        Self::StoppedByPerson,
        Self::PathBlocked,
        Self::PathDone,
        Self::Watchdog,
        Self::ScanOverflow,
        Self::ClockBackwards,
        Self::FixRejected,
    ];

    /// The event with this number, or `None` if this version does not know it.
    pub fn from_number(number: u16) -> Option<Self> {
        Self::ALL.into_iter().find(|code| *code as u16 == number)
    }

    /// The usual severity of this event.
    pub fn usual_severity(self) -> Severity {
        match self {
            Self::Started | Self::PoseFound | Self::PathDone => Severity::Info,
            Self::SensorFault
            | Self::DriveFault
            | Self::Collision
            | Self::Watchdog
            | Self::ClockBackwards => Severity::Error,
            _ => Severity::Warning,
        }
    }
}

/// Maximum length of an event's detail, in bytes.
pub const MAX_DETAIL: usize = 32;

/// An event on the robot.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// When it happened, in the server's clock; `None` before the clocks are synchronised.
    pub time: Option<Instant>,
    /// The severity of the event.
    pub severity: Severity,
    /// The number of an [`EventCode`], or a code that this version does not know.
    pub code: u16,
    /// Details for people, in UTF-8.
    pub detail: String<MAX_DETAIL>,
}

/// Parameter values, in answer to a [`ParameterCommand`](super::ParameterCommand).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParameterReport {
    /// The number of the command.
    pub number: u16,
    /// The result of the command.
    pub outcome: ParameterOutcome,
    /// The requested parameters with their current values.
    pub values: Vec<ParameterValue, MAX_PARAMETERS>,
}

/// The result of a parameter command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ParameterOutcome {
    /// The command was executed.
    Done,
    /// The robot has no such parameter.
    Unknown,
    /// The value is out of range; nothing was changed.
    OutOfRange,
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    #[test]
    fn a_window_contains_the_tiles_that_it_lists() {
        let window = |from: (i16, i16), to: (i16, i16)| {
            let [from, to] = [from, to].map(|(x, y)| TileId { x, y });
            Interest { number: 1, from, to }
        };
        let listed = window((-1, 2), (1, 3));
        let ids: Vec<_> = listed.ids().map(|id| (id.x, id.y)).collect();
        assert_eq!(ids, [(-1, 2), (0, 2), (1, 2), (-1, 3), (0, 3), (1, 3)]);
        for (x, y) in (-3..4).flat_map(|x| (0..6).map(move |y| (x, y))) {
            assert_eq!(listed.contains(TileId { x, y }), ids.contains(&(x, y)), "({x}, {y})");
        }
        assert_eq!(listed.tiles(), 6);
        let empty = window((0, 0), (-1, 5));
        assert_eq!((empty.tiles(), empty.ids().count()), (0, 0));
        let all = window((i16::MIN, i16::MIN), (i16::MAX, i16::MAX));
        assert_eq!(all.tiles(), u32::MAX, "2^32 tiles");
    }

    #[test]
    fn every_event_is_found_by_its_number() {
        for code in EventCode::ALL {
            assert_eq!(EventCode::from_number(code as u16), Some(code));
        }
        assert_eq!([0, 16].map(EventCode::from_number), [None, None]);
        let count = |severity| {
            EventCode::ALL.iter().filter(|code| code.usual_severity() == severity).count()
        };
        use Severity::{Error, Info, Warning};
        assert_eq!([Info, Warning, Error].map(count), [3, 7, 5]);
        assert_eq!(EventCode::Started.usual_severity(), Info);
        assert_eq!(EventCode::LowBattery.usual_severity(), Warning);
        assert_eq!(EventCode::Collision.usual_severity(), Error);
    }
}
