//! The server's end of a conversation with one robot.

use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    frame::MAX_FRAME,
    link::{Endpoint, Fill},
    message::{
        Certainty, Digests, DistanceVector, FixSource, Interest, MAX_DIGESTS, MAX_REQUESTS,
        MAX_STORED, ParameterReport, PoseFix, Request, State, Stored, TileDigest, TileUpdateHead,
        TimeReply, ToRobotKind, Writer,
    },
    tile::{Epoch, Layer, Publication, Stamp, Tile, TileEncoder, TileId, Version, tile_hash},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::command::Command;
use crate::mapping::FusedLayer;

/// Reliable frames under way to one robot.
const WINDOW: usize = 16;
/// What a fix of the cameras is taken to be good for, until they say it themselves.
const CAMERA_CERTAINTY: Certainty = Certainty { x: 20, y: 20, heading: 182 };
/// The token of frames in which no tile travels.
const NO_TILES: u16 = 0;
/// How often the states of a few tiles are told.
const DIGEST_INTERVAL: Duration = Duration::from_secs(10);
/// Changes of a fused tile are gathered this long.
const HOLD: Duration = Duration::from_secs(1);
/// The downlink's budget for tiles.
const BYTES_PER_SECOND: u64 = 2_000;

pub(super) type Link = Endpoint<u16, WINDOW, MAX_FRAME>;

/// One robot's session.
#[derive(Debug)]
pub(super) struct Session {
    pub(super) robot: RobotId,
    /// The nonce of the hello that it answers.
    pub(super) nonce: u32,
    pub(super) state: Option<State>,
    /// When something of it was last heard.
    pub(super) heard: Instant,
    interest: Option<Interest>,
    fused_tiles: u16,
    /// What the robot holds of the fused layer, and when each tile was last sent.
    published: BTreeMap<TileId, (Publication, Option<Instant>)>,
    frame: u16,
    /// Newest first.
    fixes: Vec<(Instant, Pose)>,
    fix_due: bool,
    times: Vec<(u16, Instant)>,
    /// Commands that have not been sent yet, in order.
    commands: VecDeque<Command>,
    /// The newest of each command that holds until it is replaced: a new session repeats them.
    standing: Vec<Command>,
    /// What the robot last reported of its parameters.
    pub(super) parameters: Option<ParameterReport>,
    /// The newest distance vector, and how many have come.
    pub(super) distance_vector: Option<DistanceVector>,
    pub(super) distance_vectors: u32,
    /// The tile whose digest was sent last, and when the next ones are due.
    digested: Option<TileId>,
    next_digests: Instant,
    /// States of the robot's tiles that are on disk, and of which it has not been told.
    stored: Vec<(TileId, Stamp)>,
    /// The last state of each tile that was put there.
    stored_last: BTreeMap<TileId, Stamp>,
    pub(super) time_requests: u32,
    /// Tiles of the robot's layer to ask for; no tile means all of them.
    requests: Vec<TileId>,
    budget: Budget,
}

impl Session {
    pub(super) fn new(robot: RobotId, nonce: u32, fused_tiles: u16, now: Instant) -> Self {
        Self {
            robot,
            nonce,
            state: None,
            heard: now,
            interest: None,
            fused_tiles,
            published: BTreeMap::new(),
            frame: 0,
            fixes: Vec::new(),
            fix_due: false,
            times: Vec::new(),
            commands: VecDeque::new(),
            standing: Vec::new(),
            parameters: None,
            distance_vector: None,
            distance_vectors: 0,
            digested: None,
            next_digests: now + DIGEST_INTERVAL,
            stored: Vec::new(),
            stored_last: BTreeMap::new(),
            time_requests: 0,
            requests: Vec::new(),
            budget: Budget { paid_until: now },
        }
    }

    /// A fix of this robot, later than all before.
    pub(super) fn fix(&mut self, moment: Instant, pose: Pose) {
        if self.fixes.first().is_some_and(|&(newest, _)| newest >= moment) {
            return;
        }
        self.fixes.insert(0, (moment, pose));
        self.fixes.truncate(1 + ubimap_protocol::message::MAX_EARLIER_FIXES);
        self.fix_due = true;
    }

    /// A command for the robot. One that has not been sent gives way to a newer one of its kind.
    pub(super) fn command(&mut self, command: Command) {
        self.commands.retain(|waiting| !waiting.is_replaced_by(&command));
        if command.stands() {
            self.standing.retain(|standing| !standing.is_replaced_by(&command));
            self.standing.push(command.clone());
        }
        if command.is_urgent() {
            self.commands.push_front(command);
        } else {
            self.commands.push_back(command);
        }
    }

    /// Takes over what an earlier session of the same robot left: commands that have not been sent,
    /// those that stand, and what was reported.
    pub(super) fn continue_from(&mut self, earlier: Self) {
        self.parameters = earlier.parameters;
        for command in earlier.standing.into_iter().chain(earlier.commands) {
            self.command(command);
        }
    }

    /// Whether something waits that must go before frames that are sent again: a pose, a stop.
    pub(super) fn is_urgent(&self) -> bool {
        self.fix_due || self.commands.front().is_some_and(Command::is_urgent)
    }

    pub(super) fn time_requested(&mut self, nonce: u16, now: Instant) {
        self.times.push((nonce, now));
        self.time_requests = self.time_requests.saturating_add(1);
    }

    /// A distance vector of the robot; they may overtake one another.
    pub(super) fn looked(&mut self, vector: DistanceVector) {
        self.distance_vectors = self.distance_vectors.saturating_add(1);
        if self.distance_vector.as_ref().is_none_or(|last| last.time < vector.time) {
            self.distance_vector = Some(vector);
        }
    }

    /// The robot's window has moved: it has dropped what lies outside.
    pub(super) fn interested(&mut self, interest: Interest) {
        let newer = self.interest.is_none_or(|now| now.number < interest.number);
        if !newer || interest.tiles() > u32::from(self.fused_tiles) {
            return;
        }
        // Of a window in between, of which nothing was heard, the robot has dropped tiles as well.
        let next = self.interest.is_none_or(|now| now.number.wrapping_add(1) == interest.number);
        self.published.retain(|&id, _| next && interest.contains(id));
        self.interest = Some(interest);
    }

    /// The robot could not read an update: that tile, and all that travelled with it, is sent
    /// whole.
    pub(super) fn requested(&mut self, request: &Request) {
        for id in &request.tiles {
            let Some((one, _)) = self.published.get(id).cloned() else { continue };
            for (publication, _) in self.published.values_mut() {
                if publication.travelled_with(&one) {
                    publication.forget();
                }
            }
        }
        if request.tiles.is_empty() {
            self.published.values_mut().for_each(|(publication, _)| publication.forget());
        }
    }

    pub(super) fn ask_for(&mut self, id: TileId) {
        if !self.requests.contains(&id) {
            self.requests.push(id);
        }
    }

    /// A state of a tile is on disk. The robot is told once in a session.
    pub(super) fn stored(&mut self, id: TileId, stamp: Stamp) {
        if self.stored_last.insert(id, stamp) != Some(stamp) {
            self.stored.push((id, stamp));
        }
    }

    pub(super) fn acknowledged(&mut self, frame: u16) {
        self.published.values_mut().for_each(|(publication, _)| {
            publication.acknowledge(frame);
        });
    }

    /// Puts what is due into a frame: what is urgent and stale soon first.
    pub(super) fn fill(
        &mut self,
        fused: &FusedLayer,
        epoch: Epoch,
        now: Instant,
        writer: &mut Writer<'_>,
        reliable: bool,
    ) -> Fill<u16> {
        if reliable
            && self.commands.front().is_some_and(Command::is_urgent)
            && self.commands.front().is_some_and(|command| command.write(writer))
        {
            self.commands.pop_front();
            return Fill::Reliable(NO_TILES);
        }
        let before = writer.len();
        if self.fix_due {
            // As many of the earlier ones as there is room for.
            self.fix_due = !(1..=self.fixes.len()).rev().any(|count| {
                let fix = PoseFix::from_fixes(
                    self.fixes.iter().take(count).copied(),
                    CAMERA_CERTAINTY,
                    FixSource::Camera,
                );
                fix.is_some_and(|fix| writer.push(ToRobotKind::PoseFix as u8, &fix))
            });
        }
        while let Some(&(nonce, received)) = self.times.first() {
            let held_micros = now.since(received).micros() as u32;
            let reply = TimeReply { nonce, received, held_micros };
            if !writer.push(ToRobotKind::TimeReply as u8, &reply) {
                break;
            }
            self.times.remove(0);
        }
        let news = self.commands.iter().position(|command| !command.is_reliable());
        if let Some(index) = news
            && self.commands[index].write(writer)
        {
            self.commands.remove(index);
        }
        if writer.len() > before || !reliable {
            return Fill::Datagram;
        }
        if self.commands.front().is_some_and(|command| command.write(writer)) {
            self.commands.pop_front();
            return Fill::Reliable(NO_TILES);
        }
        for count in (1..=self.stored.len().min(MAX_STORED)).rev() {
            let tiles = self.stored[..count].iter().copied().collect();
            if writer.push(ToRobotKind::Stored as u8, &Stored { tiles }) {
                self.stored.drain(..count);
                return Fill::Reliable(NO_TILES);
            }
        }
        for count in (1..=self.requests.len().min(MAX_REQUESTS)).rev() {
            let tiles = self.requests[..count].iter().copied().collect();
            if writer.push(ToRobotKind::Request as u8, &Request { layer: Layer::Robot, tiles }) {
                self.requests.drain(..count);
                return Fill::Reliable(NO_TILES);
            }
        }
        match self.fill_tile(fused, epoch, now, writer) {
            Some(frame) => Fill::Reliable(frame),
            None => {
                self.fill_digests(fused, epoch, now, writer);
                Fill::Datagram
            }
        }
    }

    /// Adds the states of the next few tiles that the robot should hold, now and then.
    fn fill_digests(
        &mut self,
        fused: &FusedLayer,
        epoch: Epoch,
        now: Instant,
        writer: &mut Writer<'_>,
    ) {
        let Some(interest) = self.interest.filter(|_| self.next_digests <= now) else { return };
        self.next_digests = now + DIGEST_INTERVAL;
        let level =
            fused.within(&interest).filter(|&(id, version, tile)| self.has(id, version, tile));
        let next = level.filter(|(id, ..)| Some(*id) > self.digested).take(MAX_DIGESTS);
        let tiles: heapless::Vec<TileDigest, MAX_DIGESTS> = next
            .map(|(id, version, tile)| TileDigest {
                id,
                stamp: Stamp { epoch, version },
                hash: tile_hash(tile),
            })
            .collect();
        self.digested = tiles.last().map(|digest| digest.id);
        if !tiles.is_empty() {
            let digests = Digests { layer: Layer::Fused, tiles };
            // What does not fit is told again in a later round.
            let _ = writer.push(ToRobotKind::Digests as u8, &digests);
        }
    }

    /// Adds tile updates, one tile in each message: the robot may have dropped one of them, and
    /// could then not read what follows it.
    fn fill_tile(
        &mut self,
        fused: &FusedLayer,
        epoch: Epoch,
        now: Instant,
        writer: &mut Writer<'_>,
    ) -> Option<u16> {
        if self.next_tile_time(fused)?.max(self.budget.ready_at()) > now {
            return None;
        }
        let frame = if self.frame == u16::MAX { NO_TILES + 1 } else { self.frame + 1 };
        let before = writer.len();
        let seconds = (now.micros() / 1_000_000) as u32;
        let interest = self.interest?;
        for (id, version, tile) in fused.within(&interest) {
            let (publication, last) = self.published.entry(id).or_default();
            let due = last.is_none_or(|last| last + HOLD <= now) || publication.has_parts_left();
            if !due || !has_more(publication, version, tile) {
                continue;
            }
            let first = writer.len() == before;
            let written = writer.push_with(ToRobotKind::TileUpdate as u8, |body| {
                let mut head = [0u8; 8];
                let head = TileUpdateHead { layer: Layer::Fused, seconds }.encode(&mut head)?;
                let (start, rest) = body.split_at_mut_checked(head.len())?;
                start.copy_from_slice(head);
                let mut encoder = TileEncoder::new(rest);
                let mut new = *tile;
                let mut trial = publication.clone();
                trial.push(&mut encoder, id, epoch, version, &mut new, frame).then_some(())?;
                if trial.has_parts_left() && !first {
                    // A tile is cut up only where it has a frame to itself.
                    return None;
                }
                *publication = trial;
                Some(head.len() + encoder.finish()?)
            });
            if !written {
                break;
            }
            *last = Some(now);
        }
        if writer.len() == before {
            return None;
        }
        self.budget.spend((writer.len() - before) as u64, now);
        self.frame = frame;
        Some(frame)
    }

    /// When the next tile is due, the budget aside.
    fn next_tile_time(&self, fused: &FusedLayer) -> Option<Instant> {
        let interest = self.interest?;
        fused
            .within(&interest)
            .filter_map(|(id, version, tile)| match self.published.get(&id) {
                None => Some(Instant(0)),
                Some((publication, last)) => {
                    let more = has_more(publication, version, tile);
                    let parts = publication.has_parts_left();
                    let due = last.filter(|_| !parts).map_or(Instant(0), |last| last + HOLD);
                    more.then_some(due)
                }
            })
            .min()
    }

    /// When there is something to send.
    pub(super) fn poll_timeout(
        &self,
        fused: &FusedLayer,
        reliable: bool,
        now: Instant,
    ) -> Option<Instant> {
        let news = self.commands.iter().any(|command| !command.is_reliable());
        if self.fix_due || !self.times.is_empty() || news {
            return Some(now);
        }
        if !reliable {
            return None;
        }
        if !(self.requests.is_empty() && self.commands.is_empty() && self.stored.is_empty()) {
            return Some(now);
        }
        let digests = self.interest.map(|_| self.next_digests);
        let tiles = self.next_tile_time(fused).map(|due| due.max(self.budget.ready_at()));
        digests.into_iter().chain(tiles).min()
    }

    /// Whether the robot has acknowledged the newest state of every tile that it wants.
    pub(super) fn is_level(&self, fused: &FusedLayer) -> bool {
        let Some(interest) = self.interest else { return true };
        fused.within(&interest).all(|(id, version, tile)| self.has(id, version, tile))
    }

    /// Whether the robot has acknowledged this state of a tile.
    fn has(&self, id: TileId, version: Version, tile: &Tile) -> bool {
        self.published.get(&id).is_some_and(|(publication, _)| {
            publication.is_acknowledged()
                && publication.version() == version
                && publication.sent() == tile
        })
    }
}

/// Whether there is something to send of a tile now. One that has changed and changed back is
/// newer all the same.
fn has_more(publication: &Publication, version: Version, tile: &Tile) -> bool {
    let newer = publication.version() != version;
    publication.is_ready() && (newer || publication.differs(tile))
}

/// A rate of bytes, of which a second's worth may be saved up.
#[derive(Debug)]
struct Budget {
    /// Until when what has been sent is paid for.
    paid_until: Instant,
}

impl Budget {
    fn ready_at(&self) -> Instant {
        self.paid_until - Duration::from_secs(1)
    }

    fn spend(&mut self, bytes: u64, now: Instant) {
        let cost = Duration(bytes * 1_000_000 / BYTES_PER_SECOND);
        self.paid_until = self.paid_until.max(now) + cost;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::Cell;

    const ID: TileId = TileId { x: 1, y: 0 };

    fn window(number: u32, west: i16) -> Interest {
        let from = TileId { x: west, y: 0 };
        Interest { number, from, to: TileId { x: west + 1, y: 1 } }
    }

    /// Sends what is due, and has it acknowledged.
    fn tell(session: &mut Session, fused: &FusedLayer, now: Instant) {
        let mut buffer = [0u8; 200];
        let mut writer = Writer::new(&mut buffer);
        let filled = session.fill(fused, Epoch(1), now, &mut writer, true);
        let Fill::Reliable(frame) = filled else { panic!("{filled:?}") };
        session.acknowledged(frame);
        assert!(session.is_level(fused));
    }

    /// A session whose robot has the only fused tile.
    fn level(fused: &FusedLayer) -> Session {
        let mut session = Session::new(RobotId(1), 7, 4, Instant(0));
        session.interested(window(1, 0));
        tell(&mut session, fused, Instant(0));
        session
    }

    #[test]
    fn what_is_long_is_cut_to_a_small_frame() {
        let mut session = Session::new(RobotId(1), 7, 4, Instant(0));
        let far = Pose::from_metres(-900.0, 900.0, 3.0);
        (0..4).for_each(|hour| session.fix(Instant((hour + 1) * 3_600_000_000), far));
        (0..8).for_each(|x| session.ask_for(TileId { x: 30_000 + x, y: -30_000 }));
        let fused = FusedLayer::default();
        let mut frames = 0;
        while session.poll_timeout(&fused, true, Instant(0)).is_some() {
            let mut buffer = [0u8; 24];
            let mut writer = Writer::new(&mut buffer);
            let filled = session.fill(&fused, Epoch(1), Instant(0), &mut writer, true);
            assert!(!writer.is_empty(), "{filled:?} stands still");
            frames += 1;
        }
        assert_eq!(frames, 1 + 3, "one with a fix, and three tiles in each of the others");
    }

    #[test]
    fn a_tile_that_has_changed_back_is_sent_for_its_version() {
        let mut fused = FusedLayer::default();
        let (mut tile, mut other) = (Tile::UNKNOWN, Tile::UNKNOWN);
        tile.set(3, 3, Cell::Free);
        other.set(3, 3, Cell::Occupied);
        fused.set(ID, tile);
        let mut session = level(&fused);
        fused.set(ID, other);
        fused.set(ID, tile);
        tell(&mut session, &fused, Instant(0) + HOLD);
    }

    #[test]
    fn what_a_window_that_was_never_heard_of_left_out_is_sent_again() {
        let mut tile = Tile::UNKNOWN;
        tile.set(3, 3, Cell::Free);
        let mut fused = FusedLayer::default();
        fused.set(ID, tile);
        let mut session = level(&fused);
        session.interested(window(2, 1));
        assert!(session.is_level(&fused), "it has kept the tile");
        // The third window may have been elsewhere.
        session.interested(window(4, 0));
        assert!(!session.is_level(&fused));
        assert!(session.poll_timeout(&fused, true, Instant(0)).is_some());
    }
}
