//! What the server says to a robot.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::{
    frame::SessionId,
    time::Instant,
    units::{Millimetres, Pose},
};

/// The kinds of messages to a robot. Kind 0 is [`Ack`](super::Ack).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ToRobotKind {
    /// [`Welcome`], in a handshake frame.
    Welcome = 1,
    /// [`TimeReply`].
    TimeReply = 2,
    /// A [`TileUpdateHead`](super::TileUpdateHead) and coded tiles of the server's layers.
    TileUpdate = 3,
    /// [`PoseFix`].
    PoseFix = 4,
    /// [`Refusal`], in a handshake frame.
    Refusal = 5,
    /// [`Request`](super::Request).
    Request = 6,
    /// In a handshake frame, without a body: the server has no session here, say hello.
    Reset = 7,
}

impl ToRobotKind {
    /// The kind of this number, or `None` for one that this version does not know.
    pub fn from_number(number: u8) -> Option<Self> {
        Some(match number {
            1 => Self::Welcome,
            2 => Self::TimeReply,
            3 => Self::TileUpdate,
            4 => Self::PoseFix,
            5 => Self::Refusal,
            6 => Self::Request,
            7 => Self::Reset,
            _ => return None,
        })
    }
}

/// Answers a hello: the session begins.
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

/// Answers a hello: why there can be no session.
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
    /// The fixes before it, newest first.
    pub earlier: Vec<EarlierFix, MAX_EARLIER_FIXES>,
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

    /// The message for these fixes, newest first, as many as it holds. Steps in time that it
    /// can't express (over an hour) end it. `None` if there is no fix.
    pub fn from_fixes(mut fixes: impl Iterator<Item = (Instant, Pose)>) -> Option<Self> {
        let (time, pose) = fixes.next()?;
        let mut earlier = Vec::new();
        let mut last = (time, pose);
        for fix in fixes {
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
        Some(Self { time, pose, earlier })
    }
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
        let message = PoseFix::from_fixes(fixes.into_iter()).unwrap();
        let read: std::vec::Vec<_> = message.fixes().collect();
        assert_eq!(read, fixes[..4]);
    }
}
