//! The scripted server for measurements of a robot's stack. It has its own transmit buffer, and no
//! function is inlined, so that its stack does not count as the robot's.

use ubimap_protocol::{
    frame::{DEFAULT_FRAME, SessionId},
    link::{Answer, Endpoint, Fill, Received, Terms, answer},
    message::{
        Body, Certainty, Digests, FixSource, Freshness, Hello, Interest, Obstacle, ObstacleClass,
        Obstacles, ParameterAction, ParameterCommand, ParameterValue, Path, Peer, Peers, PoseFix,
        Postures, Request, Reset, Stop, Stored, TileDigest, TileUpdateHead, TimeReply, TimeRequest,
        ToRobot, ToRobotKind, ToServerMessage, Waypoint,
    },
    tile::{Epoch, Layer, Stamp, TILE_CELLS, Tile, TileEncoder, TileId, Version},
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};

use super::{BOUNDS, INTERVAL, pose};

/// Every 11th frame to the server is lost.
const LOST: u32 = 11;

/// The server's side of one link.
pub(super) struct Server {
    link: Endpoint<ToRobot, (), 3, DEFAULT_FRAME>,
    frame: [u8; DEFAULT_FRAME],
    heard: u32,
    /// The messages that are still to be answered.
    hello: Option<Hello>,
    request: Option<TimeRequest>,
    /// The server's epoch.
    epoch: u32,
    /// Number of tiles sent in this epoch, and the next cell to send of the current tile.
    sent: u32,
    next: u16,
}

impl Server {
    /// Creates a server without a session in `place`.
    #[inline(never)]
    pub(super) fn begin(place: &mut Option<Self>) -> &mut Self {
        place.get_or_insert_with(|| Self {
            link: Endpoint::new(),
            frame: [0; DEFAULT_FRAME],
            heard: 0,
            hello: None,
            request: None,
            epoch: 1,
            sent: 0,
            next: 0,
        })
    }

    /// Restarts the server in the next epoch.
    #[inline(never)]
    pub(super) fn forget(&mut self) {
        self.link.end();
        self.epoch += 1;
        (self.sent, self.next) = (0, 0);
    }

    /// The frame of a reset, if there is no session.
    #[inline(never)]
    pub(super) fn reset(&mut self) -> Option<&[u8]> {
        if self.link.session() != SessionId::NONE {
            return None;
        }
        let len = self.link.handshake(&Reset, &mut self.frame)?;
        self.frame.get(..len)
    }

    /// Processes a frame, unless it is lost.
    #[inline(never)]
    pub(super) fn hear(&mut self, mut bytes: &[u8], now: Instant) {
        self.heard += 1;
        if self.heard.is_multiple_of(LOST) {
            return;
        }
        while let Some(received) = self.link.receive(&mut bytes, now) {
            match received {
                Received::Handshake(message) => self.hello = message.decode().ok(),
                Received::Session(messages) => {
                    for message in messages.flatten() {
                        if let Some(ToServerMessage::TimeRequest(request)) = message.by_kind() {
                            self.request = request.decode().ok();
                        }
                    }
                }
                Received::Sealed(_) | Received::Stray(..) | Received::Bad(_) => {}
            }
        }
        while self.link.poll_acknowledged().is_some() {}
    }

    /// The reply to a hello, if there was one.
    #[inline(never)]
    pub(super) fn welcome(&mut self) -> Option<&[u8]> {
        let terms = Terms {
            resolution: BOUNDS.resolution,
            frame: DEFAULT_FRAME as u16,
            server_epoch: self.epoch,
            stores: self.epoch > 1,
        };
        let hello = self.hello.take()?;
        let session = SessionId(self.epoch);
        let Answer::Welcome(welcome) = answer(&hello, &terms, session, 1) else { return None };
        let len = self.link.handshake(&welcome, &mut self.frame)?;
        self.link.begin(welcome.session, DEFAULT_FRAME);
        self.frame.get(..len)
    }

    /// The reply to a time request, if there was one.
    #[inline(never)]
    pub(super) fn reply(&mut self, now: Instant) -> Option<&[u8]> {
        let nonce = self.request.take()?.nonce;
        let reply = TimeReply { nonce, received: now, held_micros: 0 };
        self.send(&reply, now)
    }

    /// The frame of a message of this kind, to be sent after the robot's scan number `count`.
    #[inline(never)]
    pub(super) fn say(
        &mut self,
        kind: ToRobotKind,
        count: u64,
        pose: Pose,
        interest: Option<Interest>,
        now: Instant,
    ) -> Option<&[u8]> {
        let number = count as u32;
        let Pose { x, y, .. } = pose;
        let ids = || interest.into_iter().flat_map(|interest| interest.ids());
        let (time, epoch) = (now, Epoch(self.epoch));
        match kind {
            ToRobotKind::PoseFix => self.fix(count, now),
            ToRobotKind::TileUpdate => {
                let id = ids().nth(self.sent as usize / 2 % ids().count().max(1))?;
                self.tile(id, now)
            }
            ToRobotKind::Digests => {
                let mut tiles = heapless::Vec::new();
                for id in ids() {
                    let stamp = Stamp { epoch, version: Version(1) };
                    let _ = tiles.push(TileDigest { id, stamp, hash: number });
                }
                self.send(&Digests { layer: Layer::Fused, tiles }, now)
            }
            ToRobotKind::Freshness => {
                let mut tiles = heapless::Vec::new();
                tiles.resize(2, u8::MAX).ok()?;
                let interest = interest?.number;
                self.send(&Freshness { time, interest, first: 0, tiles }, now)
            }
            ToRobotKind::Request => {
                let tiles = heapless::Vec::new();
                self.send(&Request { layer: Layer::Robot, tiles }, now)
            }
            ToRobotKind::Stored => {
                let mut tiles = heapless::Vec::new();
                for id in ids() {
                    let _ = tiles.push((id, Stamp { epoch: Epoch(1), version: Version(number) }));
                }
                self.send(&Stored { tiles }, now)
            }
            ToRobotKind::Peers => {
                let mut peers = heapless::Vec::new();
                for robot in 2..10 {
                    let x = x + Millimetres(i32::from(robot) * 150);
                    let (half_length, half_width) = (150, 120);
                    let pose = Pose { x, ..pose };
                    let robot = RobotId(robot);
                    let _ = peers.push(Peer { robot, pose, age: 3, half_length, half_width });
                }
                self.send(&Peers { time, peers }, now)
            }
            ToRobotKind::Obstacles => {
                let mut obstacles = heapless::Vec::new();
                for number in 0..12 {
                    let class = ObstacleClass::Person;
                    let (velocity_x, velocity_y, radius) = (300, -300, 250);
                    let one = Obstacle { number, class, x, y, velocity_x, velocity_y, radius };
                    let _ = obstacles.push(one);
                }
                // Twelve persons, who stand, sit, lie, and again.
                let postures = Postures(0xe7_9e79);
                self.send(&Obstacles { time, obstacles, postures }, now)
            }
            ToRobotKind::Path => {
                let mut waypoints = heapless::Vec::new();
                waypoints.resize(16, Waypoint { x, y }).ok()?;
                self.send(&Path { number, waypoints }, now)
            }
            ToRobotKind::Parameter => {
                // Sets the sensor's mounting, or asks for all parameters.
                let set = ParameterAction::Set(ParameterValue { parameter: 1, value: 10 });
                let action = if count.is_multiple_of(2) { set } else { ParameterAction::List };
                self.send(&ParameterCommand { number: count as u16, action }, now)
            }
            ToRobotKind::Stop => self.send(&Stop { number, stop: false }, now),
            _ => None,
        }
    }

    /// A fix with its three predecessors; sometimes one that is half a second old.
    #[inline(never)]
    fn fix(&mut self, count: u64, now: Instant) -> Option<&[u8]> {
        let newest = if count.is_multiple_of(10) { count.saturating_sub(7) } else { count };
        let fix = |count| (Instant(count * INTERVAL.0), pose(count));
        let before = (newest.saturating_sub(3)..newest).rev().map(fix);
        let certainty = Certainty { x: 20, y: 20, heading: 182 };
        let fix = PoseFix::from_fixes(fix(newest), before, certainty, FixSource::Camera);
        self.send(&fix, now)
    }

    /// A part of a tile, three quarters of whose rows are noise: of the fused layer, then of the
    /// coverage layer.
    #[inline(never)]
    fn tile(&mut self, id: TileId, now: Instant) -> Option<&[u8]> {
        let mut tile = Tile::UNKNOWN;
        for (row, low) in (1u32..).zip(&mut tile.low).skip(8) {
            *low = row.wrapping_mul(0x9E37_79B9);
        }
        let layer = if self.sent.is_multiple_of(2) { Layer::Fused } else { Layer::Coverage };
        let stamp = Stamp { epoch: Epoch(self.epoch), version: Version(1 + self.sent) };
        let start = self.next;
        let mut end = None;
        let sent = self.link.poll_transmit(now, &mut self.frame, true, |writer, reliable| {
            let written = reliable
                && writer.push_with(&TileUpdateHead { layer, seconds: 9 }, |coded| {
                    let mut encoder = TileEncoder::new(coded);
                    end = encoder.push(id, stamp, None, start, &Tile::UNKNOWN, &tile);
                    encoder.finish()
                });
            if written { Fill::Reliable(()) } else { Fill::Nothing }
        })?;
        self.next = end.unwrap_or(start) % TILE_CELLS;
        self.sent += u32::from(self.next == 0);
        self.frame.get(..sent.len)
    }

    #[inline(never)]
    fn send(&mut self, message: &impl Body<ToRobot>, now: Instant) -> Option<&[u8]> {
        let sent = self.link.poll_transmit(now, &mut self.frame, true, |writer, _| {
            if writer.push(message) { Fill::Datagram } else { Fill::Nothing }
        })?;
        self.frame.get(..sent.len)
    }
}
