//! The robot's surface: scans, odometry and bytes in; bytes out.

use ubimap_protocol::{
    frame::{DEFAULT_FRAME, Direction, MIN_VERSION, SessionId, VERSION},
    link::{ClockSync, Counters, Endpoint, Fill, Knocking, Received},
    message::{
        DistanceVector, EventCode, Hello, ParameterAction, ParameterCommand, Refusal,
        RefusalReason, State, ToServerKind, Welcome,
    },
    tile::Epoch,
    time::{Duration, Instant},
    units::{Angle, Pose},
};

use crate::{
    config::{Config, ConfigError, Memory},
    inbox::{Inbox, Knock},
    locate::{Located, Locator},
    map::{
        LocalMap, MAX_RADIUS, MIN_RESOLUTION, PeerMasks, Pool, Selected, Selection, Surround, View,
        scratch_words,
    },
    parameters::{Answer, carry_out, push_report},
    sense::{Beam, Columns, ScanError, Steadiness, WaitingScans, fill_beams, remove_beams},
    share::{Commands, DistanceVectors, Events, FusedMap, Publisher},
    statistics::Statistics,
};

/// Reliable frames that may be under way.
const WINDOW: usize = 3;
/// Between two states; what keeps an idle session alive.
const STATE_INTERVAL: Duration = Duration::from_secs(2);
/// By then the scans taken up to an event are in the map.
const HURRY: Duration = Duration::from_millis(300);

/// What a reliable frame carries, to be told apart when it is acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Token {
    Tiles(u16),
    Event(EventCode),
    Other,
}

/// Bytes of an [`Agent`] that are its end of the link: the frames under way, the one that comes in
/// and the one that goes out, the handshake and the server's time. On the robot at most 4 KiB.
pub const LINK_STATE: usize = size_of::<Endpoint<Token, WINDOW, DEFAULT_FRAME>>()
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
    link: Endpoint<Token, WINDOW, DEFAULT_FRAME>,
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
    // This, and the others below: not inlined, or what one needs of the stack lies under all others.
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
            link: Endpoint::new(Direction::ToServer),
            knocking: Knocking::new(config.boot_nonce),
            clock: ClockSync::default(),
            server_epoch: None,
            heard: Instant(0),
            next_state: Instant(0),
            refusal: None,
            statistics: Statistics::default(),
        })
    }

    /// Takes a scan that was taken at `taken` (robot's clock): readings in millimetres, 0 where
    /// nothing came back. It is mapped as soon as its pose is known.
    ///
    /// # Errors
    /// Every [`ScanError`]; the scan is then not taken in.
    pub fn scan(
        &mut self,
        taken: Instant,
        readings: &[u16],
        now: Instant,
    ) -> Result<(), ScanError> {
        let speaks =
            self.link.session() != SessionId::NONE && self.vectors.is_due(taken, false, false);
        if !speaks
            && self.waiting.check(taken, readings).is_ok()
            && self.selection.stands(
                self.config.gate,
                self.latest_pose.map(|(_, pose)| pose),
                self.locator.newest_odometry(),
                readings,
            )
        {
            // There is nothing for which its pose would have to be known.
            self.statistics.scans = self.statistics.scans.wrapping_add(1);
            self.statistics.gated = self.statistics.gated.wrapping_add(1);
            return Ok(());
        }
        self.waiting.push(taken, readings).inspect_err(|error| {
            let code = match error {
                ScanError::Width { .. } => EventCode::SensorFault,
                ScanError::Backwards => EventCode::ClockBackwards,
                ScanError::Full => {
                    self.statistics.overflowed = self.statistics.overflowed.wrapping_add(1);
                    EventCode::ScanOverflow
                }
            };
            self.events.raise(code, now);
        })?;
        self.statistics.scans = self.statistics.scans.wrapping_add(1);
        self.map_waiting(now);
        Ok(())
    }

    /// Takes a reading of the odometry: `base_link` in `odom` at a moment of the robot's clock.
    pub fn odometry(&mut self, moment: Instant, pose: Pose, now: Instant) {
        self.steadiness.odometry(moment, pose);
        if self.locator.odometry(moment, pose).is_err() {
            let backwards = &mut self.statistics.odometry_backwards;
            *backwards = backwards.wrapping_add(1);
        }
        self.map_waiting(now);
    }

    /// Takes a reading of a gyroscope about the vertical, if the robot has one: how far it would
    /// turn in a second, either way.
    pub fn gyro(&mut self, moment: Instant, turn: Angle) {
        self.steadiness.gyro(moment, turn);
    }

    /// The robot was jolted at a moment of its clock: an accelerometer or a bumper says so. Scans
    /// of that moment are not mapped.
    pub fn jolt(&mut self, moment: Instant) {
        self.steadiness.jolt(moment);
    }

    /// Takes bytes from the server, in pieces of any size.
    pub fn receive(&mut self, mut bytes: &[u8], now: Instant) {
        while self.receive_frame(&mut bytes, now) {
            self.settle(now);
        }
        self.map_waiting(now);
    }

    /// Takes the next frame of some bytes; `false` if they are used up before its end.
    #[inline(never)]
    fn receive_frame(&mut self, bytes: &mut &[u8], now: Instant) -> bool {
        let Some(received) = self.link.receive(bytes, now) else { return false };
        match received {
            Received::Bad => {}
            Received::Handshake(message) => {
                // Copied: what follows changes the link that the body is borrowed from.
                match Knock::parse(message) {
                    Some(Knock::Welcome(welcome)) => self.welcomed(&welcome, now),
                    Some(Knock::Refusal(refusal)) => self.refused(&refusal, now),
                    Some(Knock::Reset) => self.reset(now),
                    None => {
                        self.statistics.malformed_messages =
                            self.statistics.malformed_messages.wrapping_add(1);
                    }
                }
            }
            Received::Session(messages) => {
                self.heard = now;
                let mut command = None;
                Inbox {
                    clock: &mut self.clock,
                    locator: &mut self.locator,
                    latest_pose: &mut self.latest_pose,
                    fused: &mut self.fused,
                    commands: &mut self.commands,
                    command: &mut command,
                    map: &mut self.map,
                    publisher: &mut self.publisher,
                    events: &mut self.events,
                    statistics: &mut self.statistics,
                }
                .take(messages, now);
                if let Some(command) = command {
                    self.configure(&command);
                }
            }
        }
        true
    }

    /// Writes the next frame that is due into `out`, which should have 250 bytes. Returns its
    /// length. Call it until it returns `None`.
    #[must_use]
    #[inline(never)]
    pub fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        if self.link.session() == SessionId::NONE {
            return self.knock(now, out);
        }
        let server_moment = self.latest_pose.map(|(moment, _)| moment);
        let pose = self.latest_pose.map(|(_, pose)| pose);
        let odometry = self.locator.newest_odometry();
        let cells_refused = self.statistics.cells_refused;
        let Self {
            config,
            link,
            clock,
            fused,
            map,
            publisher,
            next_state,
            events,
            answer,
            vectors,
            ..
        } = self;
        let sent = link.poll_transmit(now, out, false, |writer, reliable| {
            // What must not be sent again, for it would be stale then, goes apart.
            let before = writer.len();
            if let Some(request) = clock.poll_request(now) {
                // What finds no room is asked again.
                let _ = writer.push(ToServerKind::TimeRequest as u8, &request);
            }
            if *next_state <= now {
                *next_state = now + STATE_INTERVAL;
                let state = State { time: server_moment, pose, odometry, cells_refused };
                // The smallest frames have no room for all of it.
                let short = State { odometry: None, ..state };
                let shortest = State { pose: None, ..short };
                let kind = ToServerKind::State as u8;
                let _ = [state, short, shortest].iter().any(|state| writer.push(kind, state));
            }
            vectors.push(writer);
            let alone = writer.len() == before;
            publisher.push_digests(&map.pool, writer, alone, now);
            if writer.len() > before || !reliable {
                return Fill::Datagram;
            }
            let to_server = |moment| clock.to_server(moment);
            let push_event = |event: &_| writer.push(ToServerKind::Event as u8, event);
            if let Some(code) = events.send(to_server, push_event) {
                return Fill::Reliable(Token::Event(code));
            }
            if push_report(answer, config, writer) {
                return Fill::Reliable(Token::Other);
            }
            if let Some(interest) = fused.untold()
                && writer.push(ToServerKind::Interest as u8, &interest)
            {
                // Told as far as the window is concerned: the link sees to the rest.
                fused.told(interest.number);
                return Fill::Reliable(Token::Other);
            }
            if fused.push_request(writer) {
                return Fill::Reliable(Token::Other);
            }
            if let Some(frame) = publisher.fill(&mut map.pool, fused, writer, now) {
                return Fill::Reliable(Token::Tiles(frame));
            }
            Fill::Nothing
        })?;
        let bytes = sent.len as u64;
        self.statistics.bytes_sent = self.statistics.bytes_sent.wrapping_add(bytes);
        if matches!(sent.token, Some(Token::Tiles(_))) {
            self.statistics.bytes_sent_map = self.statistics.bytes_sent_map.wrapping_add(bytes);
        }
        Some(sent.len)
    }

    /// When to come back at the latest: then call [`Agent::poll_transmit`] until it has nothing.
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
        // There is always one of the first.
        timers.into_iter().fold(None, Instant::earlier).unwrap_or(Instant(u64::MAX))
    }

    /// Does what is due at `now` and has nothing to do with sending.
    pub fn timeout(&mut self, now: Instant) {
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

    /// Tells the server that something has happened; and where, and at once what the robot has seen
    /// by then, for somebody may have to decide what it is to do next.
    pub fn raise(&mut self, code: EventCode, now: Instant) {
        self.next_state = now;
        self.publisher.hurry(now + HURRY);
        self.events.raise(code, now);
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

    fn knock(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        if !self.knocking.poll(now) {
            return None;
        }
        let hello = Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: self.config.robot,
            nonce: self.knocking.nonce(),
            frame: DEFAULT_FRAME as u16,
            resolution: self.config.resolution,
            fused_tiles: self.fused.capacity().min(usize::from(u16::MAX)) as u16,
        };
        let len = self.link.handshake(ToServerKind::Hello as u8, &hello, out)?;
        self.statistics.bytes_sent = self.statistics.bytes_sent.wrapping_add(len as u64);
        Some(len)
    }

    fn welcomed(&mut self, welcome: &Welcome, now: Instant) {
        let stale = welcome.nonce != self.knocking.nonce() || self.is_connected();
        if stale || !(MIN_VERSION..=VERSION).contains(&welcome.version) {
            return;
        }
        self.refusal = None;
        self.heard = now;
        self.statistics.sessions = self.statistics.sessions.wrapping_add(1);
        let same_server =
            self.server_epoch.replace(welcome.server_epoch) == Some(welcome.server_epoch);
        self.link.begin(welcome.session, usize::from(welcome.frame));
        if !same_server {
            // Another life of the server has another clock: moments of the last one mean nothing.
            self.clock = ClockSync::default();
            self.commands.forget();
            self.latest_pose = None;
        }
        self.map.pool.begin_session(welcome.stores, same_server);
        self.map.pool.start_epochs_at(Epoch(welcome.first_epoch));
        self.publisher.begin_session(&mut self.map.pool, same_server, now);
        self.events.begin_session();
        if self.statistics.sessions == 1 {
            self.events.raise(EventCode::Started, now);
        }
        self.fused.begin_session(Epoch(welcome.server_epoch));
        self.vectors.begin_session();
        self.next_state = now;
    }

    fn refused(&mut self, refusal: &Refusal, now: Instant) {
        if refusal.nonce == self.knocking.nonce() && !self.is_connected() {
            self.refusal = Some(refusal.reason);
            self.knocking.refused(now);
        }
    }

    /// The server knows no session here. One who merely says so, while the session lives, is not
    /// believed.
    fn reset(&mut self, now: Instant) {
        if self.is_connected() && now.since(self.heard) > Duration::from_millis(300) {
            self.link.end();
            self.knocking.restart(now);
        }
    }

    /// Carries out a command about parameters.
    fn configure(&mut self, command: &ParameterCommand) {
        let Config { first_epoch, .. } = self.config;
        self.answer = Some(carry_out(command, &mut self.config));
        self.publisher.set_hold(self.config.hold);
        if let ParameterAction::Set(_) = command.action {
            // Whatever it was: commands are rare, and the table is soon filled.
            point_beams(self.beams, &self.config);
            self.map.configure((&self.config).into(), self.beams);
        }
        if self.config.first_epoch != first_epoch {
            self.map.pool.begin_anew(self.config.first_epoch);
            self.selection.begin_anew();
        }
    }

    /// Takes note of acknowledged frames.
    fn settle(&mut self, now: Instant) {
        while let Some(token) = self.link.poll_acknowledged() {
            match token {
                Token::Tiles(frame) => {
                    self.publisher.acknowledged(&mut self.map.pool, &self.fused, frame, now);
                }
                Token::Event(code) => self.events.acknowledged(code),
                Token::Other => {}
            }
        }
    }

    /// Maps the scans whose poses are known, and gives up those whose time is over.
    #[inline(never)]
    fn map_waiting(&mut self, now: Instant) {
        while let Some(taken) = self.waiting.oldest() {
            let last_chance = now >= taken + self.config.scan_deadline;
            let server_moment = self.clock.to_server(taken);
            let located = self.locator.at(taken, now, last_chance);
            if located == Located::NotYet {
                return;
            }
            let Some(readings) = self.waiting.pop() else { return };
            let (Located::At(pose) | Located::Unsure(pose)) = located else {
                self.statistics.expired = self.statistics.expired.wrapping_add(1);
                self.events.raise(EventCode::PoseLost, now);
                self.lost = true;
                continue;
            };
            if core::mem::take(&mut self.lost) {
                self.events.raise(EventCode::PoseFound, now);
            }
            let moment = server_moment.unwrap_or(taken);
            // One of much later was told before the clocks agreed, in the robot's.
            let is_newer = |(newest, _): (Instant, _)| {
                newest < moment || newest.since(moment) > Duration::from_secs(10)
            };
            if self.latest_pose.is_none_or(is_newer) {
                self.latest_pose = Some((moment, pose));
            }
            self.fused.follow(pose, self.config.resolution);
            let (unsure, shaken) =
                (located == Located::Unsure(pose), self.steadiness.is_shaken(taken));
            if unsure {
                self.statistics.unsure = self.statistics.unsure.wrapping_add(1);
            } else if shaken {
                self.statistics.shaken = self.statistics.shaken.wrapping_add(1);
            }
            if shaken {
                continue;
            }
            // What an unsure robot sees is not mapped, but may tell the server where it is.
            let selected = if unsure {
                Selected::Nothing
            } else {
                self.selection.select(self.config.gate, pose, readings)
            };
            let moves = unsure || matches!(selected, Selected::Moved(_));
            let blind = self.locator.is_blind(taken);
            let vector_time = server_moment.filter(|_| {
                self.link.session() != SessionId::NONE && self.vectors.is_due(taken, moves, blind)
            });
            // What is compared with the next scan is what the sensor said.
            let odometry = self.locator.newest_odometry();
            self.selection.mapped(pose, odometry, readings, &selected);
            // Mapping looks for what does not count where it must; what is never to be mapped is
            // taken out for certain.
            if vector_time.is_some() || self.config.validity.removes() {
                self.config.validity.clean(readings);
            }
            if self.config.removed.iter().any(Option::is_some) {
                // Amid a surface no beam would be asked.
                let beams = readings.iter_mut().zip(&*self.beams);
                beams
                    .filter(|(_, beam)| **beam == Beam::NONE)
                    .for_each(|(reading, _)| *reading = 0);
            }
            if let Some(time) = vector_time {
                let most = self.link.room().saturating_sub(DistanceVector::OVERHEAD);
                let columns = || Columns::of_scan(self.beams, readings, self.config.mounting, most);
                tell(&mut self.vectors, taken, time, pose, columns);
            }
            let part = match selected {
                Selected::Nothing => {
                    let gated = &mut self.statistics.gated;
                    *gated = gated.wrapping_add(u32::from(!unsure));
                    continue;
                }
                Selected::Moved(part) | Selected::Changed(part) => part,
            };
            let (fused, locator) = (&self.fused, &self.locator);
            let Config { max_range: range, resolution, peer_mask: mask, .. } = self.config;
            let view = View { pose, moment, range, resolution, mask };
            // Without the server's time they mean nothing.
            let peers = self.commands.peers().filter(|_| server_moment.is_some());
            let peers = PeerMasks::new(peers, &view, || locator.variances(taken));
            let around = |id| Surround { masked: peers.cells(id), ..fused.around(id, now) };
            let beams = self.beams.get(part.clone()).unwrap_or_default();
            let seen = readings.get(part).unwrap_or_default();
            let Some(mapped) = self.map.add(beams, seen, pose, around) else {
                self.statistics.expired = self.statistics.expired.wrapping_add(1);
                continue;
            };
            let count = &mut self.statistics;
            count.mapped = count.mapped.wrapping_add(1);
            count.pixels += mapped.pixels;
            count.cells_refused = count.cells_refused.wrapping_add(mapped.cells_refused);
            if mapped.cells_refused > 0 {
                self.events.raise(EventCode::PoolFull, now);
            }
            let seconds = server_moment.map(Instant::seconds);
            self.publisher.changed(now, seconds);
        }
    }
}

/// Takes the distance vector of a scan, to be sent. Apart from mapping, which needs the stack.
#[inline(never)]
fn tell(
    vectors: &mut DistanceVectors,
    taken: Instant,
    time: Instant,
    pose: Pose,
    columns: impl FnOnce() -> Option<Columns>,
) {
    let vector = columns().map(|Columns { first, step, distances }| DistanceVector {
        time,
        pose,
        first,
        step,
        distances,
    });
    vectors.take(taken, vector);
}

/// Fills the table of the sensor's beams, without those that are never mapped.
fn point_beams(beams: &mut [Beam], config: &Config) {
    fill_beams(beams, config.sensor, config.mounting);
    config.removed.iter().flatten().for_each(|&removal| remove_beams(beams, removal));
}
