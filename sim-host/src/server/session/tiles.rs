//! Delivery of the server's tiles to one robot.

use ubimap_protocol::{
    link::Fill,
    message::{Interest, Request, ToRobot, Writer},
    tile::{Layer, TileId},
    time::{Duration, Instant},
};

use super::publishing::Publishing;
use crate::server::snapshot::Snapshot;

/// The token of frames without tiles.
pub(super) const NO_TILES: u16 = 0;
/// Time for which changes of a fused tile are gathered, so that one message carries many.
pub(super) const FUSED_HOLD: Duration = Duration::from_secs(1);
/// Time for which changes of a coverage tile are gathered; shorter, because robots need them
/// sooner.
const COVERAGE_HOLD: Duration = Duration::from_millis(500);
/// Minimum interval between bursts of frames with tiles. It limits the robot's acknowledgements,
/// since it must acknowledge each frame.
const BURST_INTERVAL: Duration = Duration::from_millis(400);

/// The tiles of the fused and the coverage layer in the robot's window.
#[derive(Debug)]
pub(super) struct Tiles {
    interest: Option<Interest>,
    /// Maximum number of tiles per layer in the robot's memory.
    capacity: u16,
    fused: Publishing,
    coverage: Publishing,
    /// The token of the newest frame with tiles.
    frame: u16,
    next_burst: Instant,
}

impl Tiles {
    /// Starts with a robot that holds no tiles and has room for `capacity` per layer.
    pub(super) fn new(capacity: u16, now: Instant) -> Self {
        Self {
            interest: None,
            capacity,
            fused: Publishing::new(Layer::Fused, FUSED_HOLD, now),
            coverage: Publishing::new(Layer::Coverage, COVERAGE_HOLD, now),
            frame: NO_TILES,
            next_burst: now,
        }
    }

    /// Moves the window. The robot has dropped the tiles outside of the new one.
    pub(super) fn move_window(&mut self, interest: Interest) {
        let newer = self.interest.is_none_or(|now| now.number < interest.number);
        if !newer || interest.tiles() > u32::from(self.capacity) {
            return;
        }
        // If a message with a window in between was lost, the robot may have dropped further tiles.
        let next = self.interest.is_none_or(|now| now.number.wrapping_add(1) == interest.number);
        self.fused.retain(|id: TileId| next && interest.contains(id));
        self.coverage.retain(|id: TileId| next && interest.contains(id));
        self.interest = Some(interest);
    }

    /// Handles a request for tiles of the server.
    pub(super) fn requested(&mut self, request: &Request) {
        match request.layer {
            Layer::Robot => {}
            Layer::Fused => self.fused.requested(request),
            Layer::Coverage => self.coverage.requested(request),
        }
    }

    /// Handles the acknowledgement of a frame, given by its token.
    pub(super) fn acknowledged(&mut self, frame: u16) {
        self.fused.acknowledged(frame);
        self.coverage.acknowledged(frame);
    }

    /// Adds the confirmation of coverage tiles to a frame, if due.
    pub(super) fn write_confirmation(
        &mut self,
        snapshot: &Snapshot<'_>,
        now: Instant,
        writer: &mut Writer<'_, ToRobot>,
    ) {
        if let Some(interest) = &self.interest {
            self.coverage.fill_confirmation(snapshot, interest, now, writer);
        }
    }

    /// Adds due tiles to an empty frame, or digests if no tile is due. The two layers take turns in
    /// going first.
    pub(super) fn write(
        &mut self,
        snapshot: &Snapshot<'_>,
        now: Instant,
        writer: &mut Writer<'_, ToRobot>,
    ) -> Fill<u16> {
        let Some(interest) = self.interest else { return Fill::Nothing };
        let empty = writer.len();
        let frame = if self.frame == u16::MAX { NO_TILES + 1 } else { self.frame + 1 };
        let mut all = true;
        let is_burst_due = self.next_burst <= now;
        for layer in self.in_turns().into_iter().filter(|_| is_burst_due) {
            all &= layer.fill(snapshot, &interest, now, frame, writer, empty);
        }
        if writer.len() > empty {
            self.next_burst = if all { now + BURST_INTERVAL } else { now };
            self.frame = frame;
            return Fill::Reliable(frame);
        }
        for layer in self.in_turns() {
            layer.fill_digests(snapshot, &interest, now, writer);
        }
        Fill::Datagram
    }

    fn in_turns(&mut self) -> [&mut Publishing; 2] {
        if self.frame.is_multiple_of(2) {
            [&mut self.fused, &mut self.coverage]
        } else {
            [&mut self.coverage, &mut self.fused]
        }
    }

    /// When the next message is due. Tiles and digests count only if a reliable frame can be sent.
    pub(super) fn poll_timeout(&self, snapshot: &Snapshot<'_>, reliable: bool) -> Option<Instant> {
        let interest = self.interest.as_ref()?;
        let confirmation = self.coverage.next_confirmation(snapshot, interest);
        let layers = [&self.fused, &self.coverage].into_iter().filter(|_| reliable);
        let due = layers.flat_map(|layer| {
            let tile = layer.next_tile(snapshot, interest);
            tile.map(|due| due.max(self.next_burst)).into_iter().chain([layer.next_digests()])
        });
        due.chain(confirmation).min()
    }

    /// Whether the robot has acknowledged the newest state of every fused tile in its window.
    pub(super) fn is_level(&self, snapshot: &Snapshot<'_>) -> bool {
        self.interest.as_ref().is_none_or(|interest| self.fused.is_level(snapshot, interest))
    }
}
