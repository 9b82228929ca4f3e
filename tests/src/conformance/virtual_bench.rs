//! A bench with a peer in the same process, in whose time nothing else happens.

use std::collections::VecDeque;

use ubimap_protocol::time::{Duration, Instant};
use ubimap_sim_host::conformance::{Bench, Gone};

/// An implementation in the same process. After every input, its frames are drained.
pub trait Peer {
    /// Takes bytes.
    fn receive(&mut self, bytes: &[u8], now: Instant);

    /// The next frame.
    fn poll_transmit(&mut self, now: Instant) -> Option<Vec<u8>>;

    /// When it has something to do.
    fn poll_timeout(&self, now: Instant) -> Option<Instant>;

    /// Does what is due.
    fn timeout(&mut self, now: Instant);
}

/// A bench with a peer, and a wire without delay.
#[derive(Debug)]
pub struct VirtualBench<P> {
    peer: P,
    now: Instant,
    sent: VecDeque<Vec<u8>>,
}

/// The step of time while something is due that can't be done yet.
const STEP: Duration = Duration::from_millis(2);

impl<P: Peer> VirtualBench<P> {
    /// A bench whose time is zero.
    pub fn new(peer: P) -> Self {
        Self { peer, now: Instant(0), sent: VecDeque::new() }
    }

    fn drain(&mut self) {
        while let Some(frame) = self.peer.poll_transmit(self.now) {
            self.sent.push_back(frame);
        }
    }
}

impl<P: Peer> Bench for VirtualBench<P> {
    fn now(&self) -> Instant {
        self.now
    }

    fn send(&mut self, wire: &[u8]) -> Result<(), Gone> {
        self.peer.receive(wire, self.now);
        self.drain();
        Ok(())
    }

    fn receive(&mut self, until: Instant) -> Result<Vec<u8>, Gone> {
        loop {
            if let Some(frame) = self.sent.pop_front() {
                return Ok(frame);
            }
            if self.now >= until {
                return Ok(Vec::new());
            }
            let due = self.peer.poll_timeout(self.now).unwrap_or(until);
            let due = if due > self.now { due } else { self.now + STEP };
            self.now = due.min(until);
            self.peer.timeout(self.now);
            self.drain();
        }
    }

    fn slack(&self) -> Duration {
        Duration::from_millis(2)
    }
}
