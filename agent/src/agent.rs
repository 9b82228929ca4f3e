//! The robot's surface: scans, odometry and bytes in; bytes out.
//!
//! Here is what an agent is made of and what it tells of itself. `scanning` is the way of a scan into
//! the map, `linking` the link with the server, whose messages `inbox` takes.

mod inbox;
mod linking;
mod scanning;

use ubimap_protocol::{
    frame::{DEFAULT_FRAME, SessionId},
    link::{ClockSync, Counters, Endpoint, Knocking},
    message::{EventCode, RefusalReason, ToServer},
    tile::Epoch,
    time::Instant,
    units::Pose,
};

use crate::{
    config::{Config, ConfigError, Memory},
    locate::Locator,
    map::{LocalMap, MAX_RADIUS, MIN_RESOLUTION, Pool, Selection, scratch_words},
    parameters::Answer,
    sense::{Beam, Steadiness, WaitingScans, fill_beams, remove_beams},
    share::{Commands, DistanceVectors, Events, FusedMap, Publisher},
    statistics::Statistics,
};

/// Reliable frames that may be under way.
const WINDOW: usize = 3;

/// What a reliable frame carries, to be told apart when it is acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Token {
    Tiles(u16),
    Event(EventCode),
    Other,
}

/// Bytes of an [`Agent`] that are its end of the link: the frames under way, the one that comes in
/// and the one that goes out, the handshake and the server's time. On the robot at most 4 KiB.
pub const LINK_STATE: usize = size_of::<Endpoint<ToServer, Token, WINDOW, DEFAULT_FRAME>>()
    + size_of::<Knocking>()
    + size_of::<ClockSync>();

#[cfg(target_pointer_width = "32")]
const _: () = assert!(LINK_STATE <= 4 * 1024);

/// The agent: the sans-IO core of a robot. See the crate's documentation for the law by which it
/// is driven.
#[derive(Debug)]
pub struct Agent<'b> {
    config: Config,
    beams: &'b mut [Beam],
    waiting: WaitingScans<'b>,
    steadiness: Steadiness,
    locator: Locator,
    selection: Selection,
    latest_pose: Option<(Instant, Pose)>,
    map: LocalMap<'b>,
    publisher: Publisher,
    fused: FusedMap<'b>,
    commands: Commands,
    vectors: DistanceVectors,
    events: Events,
    /// The poses of the newest scans are not known.
    lost: bool,
    /// The answer to the newest command about parameters, until it is sent.
    answer: Option<Answer>,
    link: Endpoint<ToServer, Token, WINDOW, DEFAULT_FRAME>,
    knocking: Knocking,
    clock: ClockSync,
    server_epoch: Option<u32>,
    /// When something of the session was last heard.
    heard: Instant,
    next_state: Instant,
    refusal: Option<RefusalReason>,
    statistics: Statistics,
}

impl<'b> Agent<'b> {
    /// An agent that has just booted.
    ///
    /// # Errors
    /// Every [`ConfigError`].
    // This, and others of an agent: not inlined, or what one needs of the stack lies under all others.
    #[inline(never)]
    pub fn new(config: Config, memory: Memory<'b>) -> Result<Self, ConfigError> {
        if config.resolution < MIN_RESOLUTION {
            return Err(ConfigError::Resolution);
        }
        let radius = i32::from(config.max_range) / config.resolution.0;
        if radius < 1 || radius as usize > MAX_RADIUS {
            return Err(ConfigError::Range);
        }
        let words = scratch_words(config.max_range, config.resolution);
        if memory.scratch.len() < words {
            return Err(ConfigError::Scratch(words));
        }
        if memory.beams.is_empty()
            || memory.own.is_empty()
            || memory.waiting.len() < memory.beams.len()
        {
            return Err(ConfigError::Memory);
        }
        point_beams(memory.beams, &config);
        let selection = Selection::new(config.policy, memory.beams);
        let map =
            LocalMap::new((&config).into(), memory.beams, memory.scratch, Pool::new(memory.own));
        let width = memory.beams.len();
        Ok(Self {
            config,
            beams: memory.beams,
            waiting: WaitingScans::new(memory.waiting, width),
            steadiness: Steadiness::new(config.steady),
            locator: Locator::new(
                config.pose_source,
                &config.odometry_noise,
                config.uncertainty_limit,
            ),
            selection,
            latest_pose: None,
            map,
            publisher: Publisher::new(config.hold),
            fused: FusedMap::new(memory.fused),
            commands: Commands::default(),
            vectors: DistanceVectors::new(config.vector_interval),
            events: Events::default(),
            lost: false,
            answer: None,
            link: Endpoint::new(),
            knocking: Knocking::new(config.boot_nonce),
            clock: ClockSync::default(),
            server_epoch: None,
            heard: Instant(0),
            next_state: Instant(0),
            refusal: None,
            statistics: Statistics::default(),
        })
    }

    /// When to come back at the latest: then call [`Agent::timeout`], and [`Agent::poll_transmit`]
    /// until it has nothing.
    pub fn poll_timeout(&self) -> Instant {
        let expiry = self.waiting.oldest().map(|taken| taken + self.config.scan_deadline);
        let session = self.link.session() != SessionId::NONE;
        let timers = if session {
            let tiles = self.publisher.poll_timeout().filter(|_| self.link.can_send_reliable());
            [
                Some(self.clock.poll_timeout().min(self.publisher.digest_timeout())),
                Some(self.next_state),
                tiles,
                self.link.poll_timeout(),
                expiry,
            ]
        } else {
            [Some(self.knocking.poll_timeout()), None, None, None, expiry]
        };
        timers.into_iter().flatten().fold(self.map.poll_timeout(), Instant::min)
    }

    /// Does what is due at `now` and has nothing to do with sending.
    pub fn timeout(&mut self, now: Instant) {
        self.map.timeout(now, |id| self.fused.tile(id));
        self.map_waiting(now);
    }

    /// What has been counted.
    pub fn statistics(&self) -> Statistics {
        self.statistics
    }

    /// What the link has counted.
    pub fn link_counters(&self) -> Counters {
        self.link.counters()
    }

    /// The robot's own tiles.
    pub fn own_tiles(&self) -> &Pool<'b> {
        &self.map.pool
    }

    /// The server's tiles that the robot holds.
    pub fn fused_tiles(&self) -> &FusedMap<'b> {
        &self.fused
    }

    /// The newest pose known, and its moment in the server's clock (in the robot's, if odometry
    /// told it before the clocks agreed).
    pub fn pose(&self) -> Option<(Instant, Pose)> {
        self.latest_pose
    }

    /// `base_link` in `map` at a moment of the robot's clock as far as is known now, and the
    /// standard deviation of the position in millimetres. At most 13,000 instructions.
    pub fn pose_at(&self, moment: Instant) -> Option<(Pose, f32)> {
        let (pose, variances) = self.locator.best(moment)?;
        Some((pose, libm::sqrtf(variances.position)))
    }

    /// The newest reading of the odometry: `base_link` in `odom`.
    pub fn newest_odometry(&self) -> Option<Pose> {
        self.locator.newest_odometry()
    }

    /// The moment (robot's clock) at which the newest fix says where the robot was.
    pub fn newest_fix(&self) -> Option<Instant> {
        self.locator.newest_fix()
    }

    /// When something of a session was last heard, if ever.
    pub fn heard(&self) -> Option<Instant> {
        (self.statistics.sessions > 0).then_some(self.heard)
    }

    /// What each reading of a scan stands for.
    pub fn beams(&self) -> &[Beam] {
        self.beams
    }

    /// The configuration as it is now.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The server's time now, once the clocks agree.
    pub fn server_time(&mut self, now: Instant) -> Option<Instant> {
        self.clock.server_now(now)
    }

    /// What the server wants of the robot, and what it tells of its surroundings.
    pub fn commands(&self) -> &Commands {
        &self.commands
    }

    /// Why the server refuses a session, if it does.
    pub fn refusal(&self) -> Option<RefusalReason> {
        self.refusal
    }

    /// The epoch of the server with which the last session was begun.
    pub fn server_epoch(&self) -> Option<Epoch> {
        self.server_epoch.map(Epoch)
    }

    /// Whether there is a session.
    pub fn is_connected(&self) -> bool {
        self.link.session() != SessionId::NONE
    }

    /// Whether everything that the robot has mapped is on the server, as far as it knows, and no
    /// scan waits.
    pub fn is_idle(&self) -> bool {
        let told = self.map.pool.tiles().all(|tile| !tile.is_dirty());
        told && self.waiting.oldest().is_none() && self.fused.untold().is_none()
    }
}

/// Fills the table of the sensor's beams, without those that are never mapped.
fn point_beams(beams: &mut [Beam], config: &Config) {
    fill_beams(beams, config.sensor, config.mounting);
    config.removed.iter().flatten().for_each(|&removal| remove_beams(beams, removal));
}
