//! The server's side of a session with one robot, with one file per subject.

mod budget;
mod fixes;
mod news;
mod orders;
mod publishing;
mod replies;
mod said;
mod tiles;

use ubimap_protocol::{
    frame::MAX_FRAME,
    link::{Endpoint, Fill, is_same_boot},
    message::{
        DistanceVector, Event, Hello, Interest, ParameterReport, PoseFix, Request, State, ToRobot,
        Writer,
    },
    tile::{Stamp, TileId},
    time::{Duration, Instant},
    units::RobotId,
};

use self::{
    budget::Budget,
    fixes::Fixes,
    news::News,
    orders::Orders,
    replies::Replies,
    said::Said,
    tiles::{NO_TILES, Tiles},
};
use super::{command::Command, snapshot::Snapshot};
use crate::{camera::Sighting, timing::ROBOT_UNREACHABLE};

/// Maximum number of reliable frames in flight to one robot.
const WINDOW: usize = 16;

pub(super) type Link = Endpoint<ToRobot, u16, WINDOW, MAX_FRAME>;

/// One robot's session.
#[derive(Debug)]
pub(super) struct Session {
    robot: RobotId,
    /// The nonce of the Hello that opened it.
    nonce: u32,
    /// When the last frame of the session was received, or when the session was opened.
    heard: Instant,
    /// Whether any frame of the session was received.
    is_heard: bool,
    /// The nonce of the robot's last session, before this one, in which a frame was received.
    earlier: Option<u32>,
    said: Said,
    fixes: Fixes,
    replies: Replies,
    orders: Orders,
    tiles: Tiles,
    news: News,
    budget: Budget,
}

/// Input.
impl Session {
    /// Opens the session that `hello` asks for. `last` is the robot's previous session.
    pub(super) fn new(hello: &Hello, last: Option<&Self>, now: Instant) -> Self {
        Self {
            robot: hello.robot,
            nonce: hello.nonce,
            heard: now,
            is_heard: false,
            earlier: last
                .and_then(|last| if last.is_heard { Some(last.nonce) } else { last.earlier }),
            said: Said::default(),
            fixes: Fixes::default(),
            replies: Replies::default(),
            orders: Orders::default(),
            tiles: Tiles::new(hello.fused_tiles, now),
            news: News::default(),
            budget: Budget::default(),
        }
    }

    /// Takes over commands and reports from an earlier session of the same robot.
    pub(super) fn continue_from(&mut self, earlier: Self) {
        self.said.continue_from(earlier.said);
        self.orders.continue_from(earlier.orders);
    }

    pub(super) fn robot(&self) -> RobotId {
        self.robot
    }

    /// Whether the session was opened by this Hello.
    pub(super) fn answers(&self, hello: &Hello) -> bool {
        self.robot == hello.robot && self.nonce == hello.nonce
    }

    /// Whether the robot has restarted since its previous session, or that was with another robot
    /// of the same number.
    pub(super) fn is_of_new_life(&self) -> bool {
        !self.earlier.is_some_and(|earlier| is_same_boot(self.nonce, earlier))
    }

    /// Records that a frame of the session was received.
    pub(super) fn hear(&mut self, now: Instant) {
        (self.heard, self.is_heard) = (now, true);
    }

    /// Time since the last frame of the session.
    pub(super) fn silent_for(&self, now: Instant) -> Duration {
        now.since(self.heard)
    }

    /// Whether the robot can be expected to follow a command.
    pub(super) fn is_reachable(&self, now: Instant) -> bool {
        self.silent_for(now) < ROBOT_UNREACHABLE
    }

    pub(super) fn state(&mut self, state: State) {
        self.said.add_state(state);
    }

    pub(super) fn event(&mut self, event: Event, received: Instant) {
        self.said.add_event(event, received);
    }

    pub(super) fn time_requested(&mut self, nonce: u16, received: Instant) {
        self.said.add_time_request();
        self.replies.time(nonce, received);
    }

    pub(super) fn parameters(&mut self, report: ParameterReport) {
        self.orders.answered(report.number);
        self.said.add_parameters(report);
    }

    pub(super) fn vector(&mut self, vector: DistanceVector) {
        self.said.add_vector(vector);
    }

    /// Moves the window of tiles that the robot wants.
    pub(super) fn interested(&mut self, interest: Interest) {
        self.tiles.move_window(interest);
    }

    /// Handles a robot's request for tiles of the server.
    pub(super) fn requested(&mut self, request: &Request) {
        self.tiles.requested(request);
    }

    /// Handles the acknowledgement of the frame with this token.
    pub(super) fn acknowledged(&mut self, frame: u16) {
        self.tiles.acknowledged(frame);
    }

    /// The robot's reports.
    pub(super) fn said(&self) -> &Said {
        &self.said
    }

    /// The robot's reports, for taking those that are read only once.
    pub(super) fn said_mut(&mut self) -> &mut Said {
        &mut self.said
    }
}

/// Output.
impl Session {
    /// Adds a camera fix.
    pub(super) fn fix(&mut self, moment: Instant, sighting: Sighting) {
        self.fixes.add(moment, sighting);
    }

    /// Adds a fix from a match with the map.
    pub(super) fn matched(&mut self, fix: PoseFix) {
        self.fixes.add_matched(fix);
    }

    /// Adds a command.
    pub(super) fn command(&mut self, command: Command) {
        self.orders.add(command);
    }

    /// Records that a state of one of the robot's tiles is on disk.
    pub(super) fn stored(&mut self, id: TileId, stamp: Stamp) {
        self.replies.stored(id, stamp);
    }

    /// Requests one of the robot's tiles. Returns false if too many requests wait.
    pub(super) fn ask_for(&mut self, id: TileId) -> bool {
        self.replies.missing(id)
    }

    /// Whether a message is waiting that must be sent before retransmissions: a fix or a Stop.
    pub(super) fn is_urgent(&self, now: Instant) -> bool {
        self.fixes.is_ready(now) || self.orders.is_urgent()
    }

    /// Fills a frame with due messages; urgent and short-lived ones come first. If `reliable` is
    /// false, only messages that need no acknowledgement are added.
    pub(super) fn fill(
        &mut self,
        snapshot: &Snapshot<'_>,
        now: Instant,
        writer: &mut Writer<'_, ToRobot>,
        reliable: bool,
    ) -> Fill<u16> {
        if reliable && self.orders.write_urgent(writer) {
            return Fill::Reliable(NO_TILES);
        }
        let before = writer.len();
        let is_affordable = self.budget.ready_at() <= now;
        self.write_newest(snapshot, now, writer, is_affordable);
        if writer.len() > before || !reliable {
            return Fill::Datagram;
        }
        if self.orders.write(writer) || self.replies.write_reliable(writer) {
            return Fill::Reliable(NO_TILES);
        }
        if is_affordable { self.tiles.write(snapshot, now, writer) } else { Fill::Nothing }
    }

    /// Adds messages that are superseded by newer ones, and are therefore never retransmitted.
    fn write_newest(
        &mut self,
        snapshot: &Snapshot<'_>,
        now: Instant,
        writer: &mut Writer<'_, ToRobot>,
        is_affordable: bool,
    ) {
        let before = writer.len();
        self.fixes.write(now, writer);
        self.replies.write_times(now, writer);
        if is_affordable {
            self.tiles.write_confirmation(snapshot, now, writer);
            let alone = writer.len() == before;
            self.news.fill(snapshot.surroundings, self.robot, now, writer, alone);
        }
    }

    /// Charges a sent frame of `bytes` bytes to the budget.
    pub(super) fn sent(&mut self, bytes: usize, now: Instant) {
        self.budget.spend(bytes as u64, now);
    }

    /// When the next frame is due. `reliable` says whether a reliable frame can be sent.
    pub(super) fn poll_timeout(
        &self,
        snapshot: &Snapshot<'_>,
        reliable: bool,
        now: Instant,
    ) -> Option<Instant> {
        if self.replies.has_times()
            || reliable && (self.orders.is_ready() || self.replies.has_reliable())
        {
            return Some(now);
        }
        let news = self.news.poll_timeout(snapshot.surroundings, self.robot);
        let tiles = self.tiles.poll_timeout(snapshot, reliable);
        let waiting = news.into_iter().chain(tiles).min();
        let affordable = waiting.map(|due| due.max(self.budget.ready_at()));
        affordable.into_iter().chain(self.fixes.poll_timeout(now)).min()
    }

    /// Number of messages waiting to be sent, without tiles and news.
    pub(super) fn waiting(&self) -> usize {
        self.fixes.waiting() + self.replies.waiting() + self.orders.waiting()
    }

    /// Number of peers and obstacles left out of messages, summed over all messages.
    pub(super) fn left_out(&self) -> u64 {
        self.news.left_out()
    }

    /// Whether the robot has acknowledged the newest state of every fused tile in its window.
    pub(super) fn is_level(&self, snapshot: &Snapshot<'_>) -> bool {
        self.tiles.is_level(snapshot)
    }
}

#[cfg(test)]
mod tests;
