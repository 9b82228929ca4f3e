//! What a robot says to the server.

use heapless::{String, Vec};
use serde::{Deserialize, Serialize};

use super::{
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

/// Opens a conversation, in a handshake frame: who the robot is and what it can do.
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
    /// Where its wheels say that it is (`base_link` in `odom`) at the same moment; `None` if it
    /// has no odometry.
    pub odometry: Option<Pose>,
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

    /// The tiles of the rectangle, row by row from the south-west.
    pub fn ids(&self) -> impl Iterator<Item = TileId> + use<> {
        let (from, to) = (self.from, self.to);
        (from.y..=to.y).flat_map(move |y| (from.x..=to.x).map(move |x| TileId { x, y }))
    }

    /// How many tiles the rectangle holds.
    pub fn tiles(&self) -> u32 {
        let side = |from: i16, to: i16| (i32::from(to) - i32::from(from) + 1).max(0) as u32;
        side(self.from.x, self.to.x).saturating_mul(side(self.from.y, self.to.y))
    }
}

/// The most columns of one [`DistanceVector`].
pub const MAX_COLUMNS: usize = 64;

/// The free distance in front of the robot, a few columns wide (Ahmed 2.1): from it the server
/// measures the error of the robot's pose.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DistanceVector {
    /// When it was taken, in the server's clock.
    pub time: Instant,
    /// Where the robot believed to be (`base_link` in `map`).
    pub pose: Pose,
    /// The bearing of the first column's middle in `base_link`.
    pub first: Angle,
    /// From one column to the next, in binary angle units; negative for clockwise.
    pub step: i16,
    /// For each column the free distance from the origin of `base_link` in units of 2 cm; 0 where
    /// nothing is known, 255 for 5.1 m and more.
    pub distances: Vec<u8, MAX_COLUMNS>,
}

impl DistanceVector {
    /// The most bytes of its message that are not columns.
    pub const OVERHEAD: usize = 33;
}

/// How much an event matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Severity {
    /// Good to know.
    Info,
    /// Something works less well than it should.
    Warning,
    /// Something does not work.
    Error,
}

/// What can happen on a robot. Codes from 0x8000 on are a deployment's own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u16)]
pub enum EventCode {
    /// The robot has started.
    Started = 1,
    /// No pose for a second.
    PoseLost = 2,
    /// There is a pose again.
    PoseFound = 3,
    /// No scan, or one that can't be of this sensor.
    SensorFault = 4,
    /// A wheel or a motor does not do what it should.
    DriveFault = 5,
    /// The pool of tiles is full: cells were refused.
    PoolFull = 6,
    /// The battery is low.
    LowBattery = 7,
    /// The robot has run into something.
    Collision = 8,
    /// A person has stopped it.
    StoppedByPerson = 9,
    /// It can't go on along its path.
    PathBlocked = 10,
    /// It is at the end of its path.
    PathDone = 11,
    /// The watchdog has restarted it.
    Watchdog = 12,
    /// A scan found no room to wait for its pose.
    ScanOverflow = 13,
    /// The clock of a scan went backwards.
    ClockBackwards = 14,
    /// A fix was rejected as absurd.
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

    /// The code of this number, or `None` for one that this version does not know.
    pub fn from_number(number: u16) -> Option<Self> {
        Self::ALL.into_iter().find(|code| *code as u16 == number)
    }

    /// How much such an event usually matters.
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

/// The most bytes of an event's detail.
pub const MAX_DETAIL: usize = 32;

/// Something that happened on the robot.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Event {
    /// When, in the server's clock; `None` before the clocks agree.
    pub time: Option<Instant>,
    /// How much it matters.
    pub severity: Severity,
    /// What happened: an [`EventCode`], or a code that this version does not know.
    pub code: u16,
    /// More about it, for people: UTF-8.
    pub detail: String<MAX_DETAIL>,
}

/// The values of parameters, in answer to a [`ParameterCommand`](super::ParameterCommand).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParameterReport {
    /// The number of the command.
    pub number: u16,
    /// How it went.
    pub outcome: ParameterOutcome,
    /// The parameters that were asked for, as they are now.
    pub values: Vec<ParameterValue, MAX_PARAMETERS>,
}

/// How a command about parameters went.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ParameterOutcome {
    /// It was carried out.
    Done,
    /// The robot has no such parameter.
    Unknown,
    /// The value is out of its range; nothing was changed.
    OutOfRange,
}
