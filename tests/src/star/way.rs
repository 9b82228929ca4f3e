//! One direction of a robot's channel, with arbitrary faults on frames.

use std::collections::BTreeSet;

use ubimap_protocol::{
    frame::{Direction, FrameKind, Header, MAX_FRAME, SessionId, cobs, is_sealed, open},
    time::Instant,
};
use ubimap_sim_host::channel::fault::{FaultWire, Faults};

/// Number of the first frames, and of the last ones, that are remembered for replays.
const REMEMBERED: usize = 40;

/// One direction of a robot's channel.
#[derive(Debug)]
pub struct Way {
    /// New frames go to the last wire; the others still deliver the frames that they hold.
    wires: Vec<FaultWire>,
    cut_until: Instant,
    remembered: Vec<Vec<u8>>,
    sent: usize,
    /// The frames of sessions sent so far, if repeated frames are to be dropped.
    once: Option<BTreeSet<Vec<u8>>>,
    direction: Direction,
    /// Total bytes sent, delivered or not.
    bytes: u64,
}

impl Way {
    pub(super) fn new(direction: Direction) -> Self {
        Self {
            wires: vec![FaultWire::new(Faults::default(), 0)],
            cut_until: Instant(0),
            remembered: Vec::new(),
            sent: 0,
            once: None,
            direction,
            bytes: 0,
        }
    }

    /// Changes the faults from now on.
    pub fn weather(&mut self, faults: Faults, seed: u64) {
        self.wires.retain(|wire| wire.next_delivery().is_some());
        self.wires.push(FaultWire::new(faults, seed));
    }

    /// Frames sent before `until` are lost.
    pub fn cut(&mut self, until: Instant) {
        self.cut_until = self.cut_until.max(until);
    }

    /// The remembered frames, or only those of handshakes.
    pub(super) fn remembered(&self, handshakes_only: bool) -> Vec<&[u8]> {
        let all = self.remembered.iter().map(Vec::as_slice);
        all.filter(|frame| !handshakes_only || is_handshake(frame, self.direction)).collect()
    }

    /// From now on repeated session frames are lost.
    pub fn drop_repeats(&mut self) {
        self.once = Some(BTreeSet::new());
    }

    /// Total bytes sent, delivered or not.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    pub(super) fn send(&mut self, now: Instant, frame: &[u8]) {
        self.bytes += frame.len() as u64;
        if self.sent < 2 * REMEMBERED {
            self.remembered.push(frame.to_vec());
        } else {
            self.remembered[REMEMBERED + self.sent % REMEMBERED] = frame.to_vec();
        }
        self.sent += 1;
        let repeated = self.once.as_mut().is_some_and(|seen| {
            !is_handshake(frame, self.direction) && !seen.insert(frame.to_vec())
        });
        if now < self.cut_until || repeated {
            return;
        }
        if let Some(wire) = self.wires.last_mut() {
            wire.send(now, frame);
        }
    }

    pub(super) fn poll(&mut self, now: Instant) -> Option<Vec<u8>> {
        self.wires.iter_mut().find_map(|wire| wire.poll(now))
    }

    pub(super) fn next_delivery(&self) -> Option<Instant> {
        self.wires.iter().filter_map(FaultWire::next_delivery).min()
    }

    pub(super) fn lose_all(&mut self) {
        for wire in &mut self.wires {
            while wire.poll(Instant(u64::MAX)).is_some() {}
        }
    }
}

fn is_handshake(frame: &[u8], direction: Direction) -> bool {
    let mut decoder = cobs::Decoder::<MAX_FRAME>::default();
    let Some(Ok(frame)) = decoder.next(&mut &*frame) else { return false };
    match is_sealed(frame) {
        true => Header::decode(frame).is_some_and(|(it, _)| it.kind == FrameKind::Handshake),
        false => open(SessionId::NONE, direction, frame).is_some(),
    }
}
