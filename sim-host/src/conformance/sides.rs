//! What the runner remembers as a server, and as a robot.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::{Hello, Welcome},
    tile::TileId,
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::followed::Followed;

/// The server's clock at the start of the bench's: 1,000 s.
const AHEAD: Duration = Duration::from_secs(1_000);

/// The runner as a server.
#[derive(Debug)]
pub(super) struct ServerSide {
    /// Its epoch in the next session.
    pub(super) epoch: u32,
    pub(super) sessions: u32,
    /// The highest epoch of the robot's tiles, plus one.
    pub(super) first_epoch: u32,
    /// What the robot has published.
    pub(super) followed: Followed,
    /// The last Hello.
    pub(super) hello: Option<Hello>,
}

impl Default for ServerSide {
    fn default() -> Self {
        Self {
            epoch: 0x00C0_FFEE,
            sessions: 0x5E55_1000,
            first_epoch: 1,
            followed: Followed::default(),
            hello: None,
        }
    }
}

impl ServerSide {
    /// The server's time.
    pub(super) fn time(&self, now: Instant) -> Instant {
        now + AHEAD
    }
}

/// The runner as a robot.
#[derive(Debug)]
pub(super) struct RobotSide {
    pub(super) robot: RobotId,
    pub(super) resolution: Millimetres,
    pub(super) nonce: u32,
    /// The Welcome of the session.
    pub(super) welcome: Option<Welcome>,
    pub(super) interests: u32,
    pub(super) versions: BTreeMap<(TileId, u32), u32>,
    /// What the server has published.
    pub(super) followed: Followed,
}

impl Default for RobotSide {
    fn default() -> Self {
        Self {
            robot: RobotId(65_000),
            resolution: Millimetres(50),
            nonce: 0x1357_9BDF,
            welcome: None,
            interests: 0,
            versions: BTreeMap::new(),
            followed: Followed::default(),
        }
    }
}
