//! What the server says to a robot.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use super::{
    shared::{Digests, ParameterValue, Request, TileUpdateHead},
    table::messages,
};
use crate::{
    tile::{Stamp, TileId},
    time::Instant,
    units::{Millimetres, Pose, RobotId, SessionId},
};

messages! {
    ToRobot, against ToServer: ToRobotKind, ToRobotMessage;
    1 Welcome(Welcome),
    2 TimeReply(TimeReply),
    3 TileUpdate(TileUpdateHead),
    4 PoseFix(PoseFix),
    5 Refusal(Refusal),
    6 Request(Request),
    7 Reset(Reset),
    8 Peers(Peers),
    9 Obstacles(Obstacles),
    10 Path(Path),
    11 Stop(Stop),
    12 Parameter(ParameterCommand),
    13 Stored(Stored),
    14 Digests(Digests),
    15 Freshness(Freshness),
}

/// Answers a hello in a handshake frame: the session begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome {
    /// The nonce of the hello.
    pub nonce: u32,
    /// The version that both sides speak from here on.
    pub version: u8,
    /// The session; never zero.
    pub session: SessionId,
    /// The largest frame that both sides can receive, in bytes on the wire.
    pub frame: u16,
    /// The server's epoch; the fused and coverage tiles of another one are void.
    pub server_epoch: u32,
    /// The first epoch that the robot has not used yet for its own tiles.
    pub first_epoch: u32,
    /// Whether the server says when a tile is on disk. If not, it keeps none, and the robot may
    /// evict a tile as soon as its update is acknowledged.
    pub stores: bool,
}

/// Answers a hello in a handshake frame: why there can be no session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// The nonce of the hello.
    pub nonce: u32,
    /// What does not match.
    pub reason: RefusalReason,
}

/// What does not match between a robot and the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum RefusalReason {
    /// No common version; the server speaks these.
    Version {
        /// The oldest version.
        min: u8,
        /// The newest version.
        current: u8,
    },
    /// The maps' cells have different sides; the server's is this.
    Resolution(Millimetres),
    /// The robot's frames are smaller than the server can work with; it needs this many bytes.
    Frame(u16),
}

/// Tells a robot that the server has no session with it, in a handshake frame: it is to say hello.
/// An empty body.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reset;

/// Answers a time request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimeReply {
    /// The nonce of the request.
    pub nonce: u16,
    /// When the request arrived, in the server's clock.
    pub received: Instant,
    /// When this reply left, in microseconds after `received`.
    pub held_micros: u32,
}

/// The most earlier fixes that one message repeats.
pub const MAX_EARLIER_FIXES: usize = 3;

/// Where the cameras saw the robot. The fixes before are repeated, so that one lost frame, or
/// even three, cost no fix.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PoseFix {
    /// When the newest frame was captured, in the server's clock.
    pub time: Instant,
    /// `base_link` in `map` at that moment.
    pub pose: Pose,
    /// How sure it is.
    pub certainty: Certainty,
    /// Where it comes from.
    pub source: FixSource,
    /// The fixes before it, newest first.
    pub earlier: Vec<EarlierFix, MAX_EARLIER_FIXES>,
}

/// How sure a fix is: standard deviations. The covariance that they stand for is diagonal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Certainty {
    /// Of x, in millimetres.
    pub x: u16,
    /// Of y, in millimetres.
    pub y: u16,
    /// Of the heading, in binary angle units.
    pub heading: u16,
}

/// Where a fix comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum FixSource {
    /// A camera saw the robot.
    #[default]
    Camera,
    /// What the robot saw was matched with the map.
    MapMatch,
}

/// A fix before the one that follows it in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct EarlierFix {
    /// How long before its successor the frame was captured, in microseconds.
    pub before_micros: u32,
    /// Its successor's x less its own, in millimetres.
    pub dx: i32,
    /// Its successor's y less its own, in millimetres.
    pub dy: i32,
    /// Its successor's heading less its own, in binary angle units.
    pub turn: i16,
}

impl PoseFix {
    /// The fixes that the message holds, newest first.
    pub fn fixes(&self) -> impl Iterator<Item = (Instant, Pose)> + '_ {
        let newest = (self.time, self.pose);
        let mut last = newest;
        core::iter::once(newest).chain(self.earlier.iter().map(move |step| {
            let (time, pose) = last;
            last = (
                Instant(time.0.saturating_sub(u64::from(step.before_micros))),
                Pose {
                    x: pose.x - Millimetres(step.dx),
                    y: pose.y - Millimetres(step.dy),
                    heading: crate::units::Angle(pose.heading.0.wrapping_sub(step.turn as u16)),
                },
            );
            last
        }))
    }

    /// The message for the newest fix and those before it, newest first: as many as it holds, up
    /// to the first step in time that it cannot express (over an hour).
    pub fn from_fixes(
        (time, pose): (Instant, Pose),
        before: impl Iterator<Item = (Instant, Pose)>,
        certainty: Certainty,
        source: FixSource,
    ) -> Self {
        let mut earlier = Vec::new();
        let mut last = (time, pose);
        for fix in before {
            let Ok(before_micros) = u32::try_from(last.0.since(fix.0).micros()) else { break };
            let step = EarlierFix {
                before_micros,
                dx: (last.1.x - fix.1.x).0,
                dy: (last.1.y - fix.1.y).0,
                turn: (last.1.heading - fix.1.heading).0 as i16,
            };
            if earlier.push(step).is_err() {
                break;
            }
            last = fix;
        }
        Self { time, pose, certainty, source, earlier }
    }
}

/// The most robots in one [`Peers`].
pub const MAX_PEERS: usize = 8;

/// The other robots near this one, as many as there is room for: they are not to be mapped.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Peers {
    /// The moment of the newest pose, in the server's clock.
    pub time: Instant,
    /// The robots, nearest first.
    pub peers: Vec<Peer, MAX_PEERS>,
}

/// One of the other robots.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Peer {
    /// Which one.
    pub robot: RobotId,
    /// `base_link` in `map`.
    pub pose: Pose,
    /// How much older than the newest pose this one is, in units of 10 ms; 255 for 2.55 s and more.
    pub age: u8,
    /// Half its length, in millimetres.
    pub half_length: u16,
    /// Half its width, in millimetres.
    pub half_width: u16,
}

/// The most things in one [`Obstacles`].
pub const MAX_OBSTACLES: usize = 12;

/// What the cameras see near the robot that is no wall, newest state, as much as there is room for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Obstacles {
    /// The moment of the positions, in the server's clock.
    pub time: Instant,
    /// The things, nearest first.
    pub obstacles: Vec<Obstacle, MAX_OBSTACLES>,
}

/// A thing or a person.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Obstacle {
    /// The same thing keeps its number.
    pub number: u16,
    /// What it is.
    pub class: ObstacleClass,
    /// Its centre in `map`.
    pub x: Millimetres,
    /// Its centre in `map`.
    pub y: Millimetres,
    /// Along `map`'s x, in millimetres a second.
    pub velocity_x: i16,
    /// Along `map`'s y, in millimetres a second.
    pub velocity_y: i16,
    /// The radius of a circle around it, in millimetres.
    pub radius: u16,
}

/// What an obstacle is, by height and motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ObstacleClass {
    /// A person.
    Person,
    /// Likely to be moved.
    Movable,
    /// Part of the room.
    Fixed,
}

/// The most bytes of tiles in one [`Freshness`].
pub const MAX_FRESH_BYTES: usize = 32;

/// Which of the coverage tiles that the robot has acknowledged still said at `time` what the
/// cameras see.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Freshness {
    /// The moment, in the server's clock.
    pub time: Instant,
    /// The number of the [`Interest`](super::Interest) whose rectangle is meant.
    pub interest: u32,
    /// The first tile: they are counted row by row from the south-west of the rectangle.
    pub first: u16,
    /// Bit `i` of byte `n` is set if tile `first + 8 n + i` is confirmed.
    pub tiles: Vec<u8, MAX_FRESH_BYTES>,
}

/// The most points of one [`Path`].
pub const MAX_WAYPOINTS: usize = 16;

/// Where to drive; it replaces the path before. One point is a goal, none ends the drive.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Path {
    /// Counts the paths: of two, the one with the higher number holds.
    pub number: u32,
    /// The points in `map`, in order.
    pub waypoints: Vec<Waypoint, MAX_WAYPOINTS>,
}

/// A point of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Waypoint {
    /// In `map`.
    pub x: Millimetres,
    /// In `map`.
    pub y: Millimetres,
}

/// Stop, or drive again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stop {
    /// Counts: of two, the one with the higher number holds.
    pub number: u32,
    /// Whether to stand.
    pub stop: bool,
}

/// Asks for parameters, or sets one. Answered by a
/// [`ParameterReport`](super::ParameterReport).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParameterCommand {
    /// Given back in the report.
    pub number: u16,
    /// What to do.
    pub action: ParameterAction,
}

/// What to do with parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ParameterAction {
    /// Report all of them.
    List,
    /// Report this one.
    Get(u16),
    /// Set one, and report it.
    Set(ParameterValue),
}

/// The most tiles in one [`Stored`].
pub const MAX_STORED: usize = 8;

/// The server has these states of the robot's tiles on disk.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stored {
    /// The tiles and their states.
    pub tiles: Vec<(TileId, Stamp), MAX_STORED>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::Angle;

    #[test]
    fn repeated_fixes_read_back() {
        let pose =
            |x, y, heading| Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(heading) };
        let fixes = [
            (Instant(1_000_000), pose(100, -5, 10)),
            (Instant(900_000), pose(90, 5, 65_000)),
            (Instant(700_000), pose(-80, 0, 60_000)),
            (Instant(100_000), pose(0, 0, 0)),
            (Instant(50_000), pose(0, 0, 0)),
        ];
        let (newest, before) = (fixes[0], fixes[1..].iter().copied());
        let message = PoseFix::from_fixes(newest, before, Certainty::default(), FixSource::Camera);
        let read: std::vec::Vec<_> = message.fixes().collect();
        assert_eq!(read, fixes[..4]);
    }
}
