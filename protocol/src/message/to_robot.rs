//! Messages from the server to a robot.

use core::fmt;

use heapless::Vec;
use serde::{Deserialize, Deserializer, Serialize};

use super::{
    added,
    direction::{Body, ToRobot},
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

/// Accepts a hello, in a handshake frame: the session begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Welcome {
    /// The nonce of the hello that this answers.
    pub nonce: u32,
    /// The version that both sides speak from here on.
    pub version: u8,
    /// The session; never zero.
    pub session: SessionId,
    /// The largest frame that both sides can receive, in bytes on the wire.
    pub frame: u16,
    /// The server's epoch; fused and coverage tiles of any other epoch are invalid.
    pub server_epoch: u32,
    /// The lowest epoch that the robot has not yet used for its own tiles.
    pub first_epoch: u32,
    /// Whether the server confirms tiles that are on disk ([`Stored`]). If not, it stores none, and
    /// the robot may evict a tile as soon as its update is acknowledged.
    pub stores: bool,
    /// Whether the robot must move its tiles to `first_epoch` or above: the server has had no
    /// session with the robot since it booted, or another robot has used its number in the
    /// meantime.
    pub renumber: bool,
}

/// Rejects a hello, in a handshake frame, and names the reason.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refusal {
    /// The nonce of the hello.
    pub nonce: u32,
    /// The mismatch.
    pub reason: RefusalReason,
}

/// A mismatch between a robot and the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum RefusalReason {
    /// No common version; the server's range is given.
    Version {
        /// The server's oldest version.
        min: u8,
        /// The server's newest version.
        current: u8,
    },
    /// The maps' cells differ in size; the side of the server's cells is given.
    Resolution(Millimetres),
    /// The robot's maximum frame is too small; the minimum in bytes is given.
    Frame(u16),
    /// Another robot uses the number, and the server still receives its frames.
    NumberInUse,
    /// The server has no room for another robot.
    TooManyRobots,
}

impl fmt::Display for RefusalReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Version { min, current } => {
                write!(f, "the server supports protocol versions {min} to {current}")
            }
            Self::Resolution(side) => {
                write!(f, "the cells of the server's map are {} mm wide", side.0)
            }
            Self::Frame(bytes) => write!(f, "the maximum frame must be at least {bytes} bytes"),
            Self::NumberInUse => {
                f.write_str("another robot uses its number; give one of the two another number")
            }
            Self::TooManyRobots => f.write_str("the server has no room for another robot"),
        }
    }
}

/// Tells a robot, in a handshake frame, that the server has no session with it: the robot must say
/// hello. The body is empty.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reset;

/// A [`Reset`] on a sealed link: it names the frame that it answers, so that an old one is of no use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SealedReset {
    /// The first eight bytes of the tag of that frame, as a little-endian number.
    pub echo: u64,
}

impl Body<ToRobot> for SealedReset {
    const KIND: ToRobotKind = ToRobotKind::Reset;
}

/// Answers a time request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TimeReply {
    /// The nonce of the request.
    pub nonce: u16,
    /// When the request arrived, in the server's clock.
    pub received: Instant,
    /// When this reply left, in microseconds since `received`.
    pub held_micros: u32,
}

/// Maximum number of earlier fixes repeated in one message.
pub const MAX_EARLIER_FIXES: usize = 3;

/// A pose measured by the cameras or by map matching. Earlier fixes are repeated, so that no fix is
/// lost unless four frames in a row are.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PoseFix {
    /// The capture time of the newest camera frame, in the server's clock.
    pub time: Instant,
    /// `base_link` in `map` at that moment.
    pub pose: Pose,
    /// The standard deviations of the pose.
    pub certainty: Certainty,
    /// How it was measured.
    pub source: FixSource,
    /// The fixes before it, newest first.
    pub earlier: Vec<EarlierFix, MAX_EARLIER_FIXES>,
}

/// The standard deviations of a fix, for a diagonal covariance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Certainty {
    /// Standard deviation of x, in millimetres.
    pub x: u16,
    /// Standard deviation of y, in millimetres.
    pub y: u16,
    /// Standard deviation of the heading, in binary angle units.
    pub heading: u16,
}

/// The method by which a fix was measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum FixSource {
    /// A camera saw the robot's marker.
    #[default]
    Camera,
    /// The robot's observations were matched with the map, and it was followed by its odometry since.
    MapMatch,
}

/// An earlier fix, as differences to its successor: the next newer fix.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct EarlierFix {
    /// Time from this fix to its successor, in microseconds.
    pub before_micros: u32,
    /// The successor's x minus this fix's, in millimetres.
    pub dx: i32,
    /// The successor's y minus this fix's, in millimetres.
    pub dy: i32,
    /// The successor's heading minus this fix's, in binary angle units.
    pub turn: i16,
}

impl PoseFix {
    /// The fixes in this message, newest first.
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

    /// A message with the newest fix and earlier ones, given newest first. It takes as many as fit,
    /// up to the first gap in time that `before_micros` cannot express (over an hour).
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

/// Maximum number of robots in one [`Peers`].
pub const MAX_PEERS: usize = 8;

/// The other robots near this one, as many as fit. The robot must not map them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Peers {
    /// The time of the newest pose, in the server's clock.
    pub time: Instant,
    /// The robots, nearest first.
    pub peers: Vec<Peer, MAX_PEERS>,
}

/// One of the other robots.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Peer {
    /// The other robot's number.
    pub robot: RobotId,
    /// `base_link` in `map`.
    pub pose: Pose,
    /// Age of this pose relative to the newest one, in units of 10 ms; 255 for 2.55 s and more.
    pub age: u8,
    /// Half the robot's length, in millimetres.
    pub half_length: u16,
    /// Half the robot's width, in millimetres.
    pub half_width: u16,
}

/// Maximum number of obstacles in one [`Obstacles`].
pub const MAX_OBSTACLES: usize = 12;

/// The obstacles other than walls that the cameras see near the robot now, as many as fit.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Obstacles {
    /// The time of the positions, in the server's clock.
    pub time: Instant,
    /// The obstacles, nearest first.
    pub obstacles: Vec<Obstacle, MAX_OBSTACLES>,
    /// The postures of the persons among them; absent in messages of earlier servers.
    #[serde(default, skip_serializing_if = "Postures::are_unknown")]
    pub postures: Postures,
}

impl Obstacles {
    /// A message with these obstacles and the posture of each, as many as it can hold. Only the
    /// postures of persons travel.
    pub fn with_postures(time: Instant, told: impl Iterator<Item = (Obstacle, Posture)>) -> Self {
        let (mut obstacles, mut postures, mut shift) = (Vec::new(), 0, 0);
        for (obstacle, posture) in told.take(MAX_OBSTACLES) {
            if obstacle.class == ObstacleClass::Person {
                postures |= (posture as u32) << shift;
                shift += 2;
            }
            // Holds as many as were taken.
            let _ = obstacles.push(obstacle);
        }
        Self { time, obstacles, postures: Postures(postures) }
    }

    /// The obstacles, nearest first, and the posture of each; unknown for all but persons.
    pub fn told(&self) -> impl Iterator<Item = (&Obstacle, Posture)> {
        let mut postures = self.postures.0;
        self.obstacles.iter().map(move |obstacle| {
            if obstacle.class != ObstacleClass::Person {
                return (obstacle, Posture::Unknown);
            }
            let posture = Posture::from_bits(postures);
            postures >>= 2;
            (obstacle, posture)
        })
    }
}

/// The postures of the persons in a list of obstacles: two bits for each person, in the order of the
/// list, the lowest first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Postures(pub u32);

impl<'de> Deserialize<'de> for Postures {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        added::deserialize(deserializer).map(|bits| Self(bits.unwrap_or_default()))
    }
}

impl Postures {
    /// Whether no posture is known; the field is then left out of the message.
    fn are_unknown(&self) -> bool {
        self.0 == 0
    }
}

/// The posture of a person, derived from the height.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Posture {
    /// Not known, or not a person.
    #[default]
    Unknown = 0,
    /// Upright.
    Standing = 1,
    /// On a seat, or crouching.
    Sitting = 2,
    /// On the floor.
    Lying = 3,
}

impl Posture {
    /// The posture in the lowest two bits.
    fn from_bits(bits: u32) -> Self {
        match bits & 3 {
            0 => Self::Unknown,
            1 => Self::Standing,
            2 => Self::Sitting,
            _ => Self::Lying,
        }
    }

    /// Whether the person sits or lies: such a person does not step aside.
    pub fn is_at_rest(self) -> bool {
        matches!(self, Self::Sitting | Self::Lying)
    }
}

/// An object or a person.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Obstacle {
    /// Identifies the obstacle while it is tracked.
    pub number: u16,
    /// The class of the obstacle.
    pub class: ObstacleClass,
    /// The x of its centre in `map`.
    pub x: Millimetres,
    /// The y of its centre in `map`.
    pub y: Millimetres,
    /// Velocity along `map`'s x, in mm/s.
    pub velocity_x: i16,
    /// Velocity along `map`'s y, in mm/s.
    pub velocity_y: i16,
    /// Radius of an enclosing circle, in millimetres.
    pub radius: u16,
}

/// The class of an obstacle, derived from its height and motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ObstacleClass {
    /// A person.
    Person,
    /// An object that is likely to be moved.
    Movable,
    /// Part of the room.
    Fixed,
}

/// Maximum length of the bit set in one [`Freshness`], in bytes.
pub const MAX_FRESH_BYTES: usize = 32;

/// Confirms that certain coverage tiles, as acknowledged by the robot, still matched the cameras'
/// view at `time`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Freshness {
    /// The time of the confirmation, in the server's clock.
    pub time: Instant,
    /// The number of the [`Interest`](super::Interest) whose rectangle is used.
    pub interest: u32,
    /// The number of the first tile; tiles are numbered row by row from the rectangle's south-west.
    pub first: u16,
    /// Bit `i` of byte `n` is set if tile `first + 8 n + i` is confirmed.
    pub tiles: Vec<u8, MAX_FRESH_BYTES>,
}

/// Maximum number of waypoints in one [`Path`].
pub const MAX_WAYPOINTS: usize = 16;

/// A path to drive; it replaces the previous one. A single point is a goal; an empty path ends the
/// drive.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Path {
    /// The number of the path: of two paths, the higher number wins.
    pub number: u32,
    /// The points in `map`, in order.
    pub waypoints: Vec<Waypoint, MAX_WAYPOINTS>,
}

/// A point of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Waypoint {
    /// Coordinate along `map`'s x axis.
    pub x: Millimetres,
    /// Coordinate along `map`'s y axis.
    pub y: Millimetres,
}

/// Stops the robot, or lets it drive again.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stop {
    /// The number of the command: of two, the higher number wins.
    pub number: u32,
    /// Whether to stop.
    pub stop: bool,
}

/// Asks for parameters, or sets one. Answered by a
/// [`ParameterReport`](super::ParameterReport).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParameterCommand {
    /// The number of the command, returned in the report.
    pub number: u16,
    /// The action.
    pub action: ParameterAction,
}

/// An action on parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ParameterAction {
    /// Report all of them.
    List,
    /// Report the parameter with this number.
    Get(u16),
    /// Set a parameter, and report it.
    Set(ParameterValue),
}

/// Maximum number of tiles in one [`Stored`].
pub const MAX_STORED: usize = 8;

/// Confirms that these states of the robot's tiles are on the server's disk.
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
    fn postures_of_persons_travel_in_two_bits_each_and_may_be_absent() {
        use super::super::{Message, Messages, Writer};
        let one = |class| Obstacle {
            number: 1,
            class,
            x: Millimetres(5),
            y: Millimetres(6),
            velocity_x: 0,
            velocity_y: 0,
            radius: 250,
        };
        let (person, thing) = (one(ObstacleClass::Person), one(ObstacleClass::Movable));
        let told = [
            (person, Posture::Sitting),
            (thing, Posture::Lying),
            (person, Posture::Unknown),
            (person, Posture::Standing),
            (person, Posture::Lying),
        ];
        let message = Obstacles::with_postures(Instant(9), told.into_iter());
        assert_eq!(message.postures, Postures(0b11_01_00_10));
        let expected =
            told.map(|(it, posture)| (it, if it == person { posture } else { Posture::Unknown }));
        let read: std::vec::Vec<_> = message.told().map(|(it, posture)| (*it, posture)).collect();
        assert_eq!(read, expected);

        let mut buffer = [0; 99];
        let mut written = |message: &Obstacles| {
            let mut writer = Writer::<ToRobot>::new(&mut buffer);
            assert!(writer.push(message));
            let len = writer.len();
            Messages::<ToRobot>::new(&buffer[..len]).next().unwrap().unwrap().body.to_vec()
        };
        let body = written(&message);
        let unknown = told.map(|(it, _)| (it, Posture::Unknown));
        let bare = Obstacles::with_postures(Instant(9), unknown.into_iter());
        let earlier = written(&bare);
        assert_eq!(body[..earlier.len()], earlier, "an earlier robot reads the same");
        assert_eq!(body[earlier.len()..], [0b1101_0010, 1], "a varint");
        let read = |body: &[u8]| {
            Message::<ToRobot>::new(ToRobotKind::Obstacles.into(), body).decode::<Obstacles>()
        };
        assert_eq!(read(&body), Ok(message));
        assert_eq!(read(&earlier), Ok(bare));
        // A body that ends within the field, or before one that was there from the beginning.
        for end in (0..body.len()).filter(|&end| end != earlier.len()) {
            assert!(read(&body[..end]).is_err(), "{end} bytes");
        }
    }

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
