//! A bench with a wire and the wall clock.

use std::{thread, time};

use ubimap_protocol::{
    frame::MAX_FRAME,
    time::{Duration, Instant},
};

use crate::{
    channel::wire::{Wire, WireError},
    conformance::{Bench, Gone},
};

/// Pause before a write is tried again on a wire that accepts no data.
const STALLED: time::Duration = time::Duration::from_millis(5);
/// How often a write is tried.
const ATTEMPTS: u32 = 400;

/// A bench with a wire and the wall clock.
#[derive(Debug)]
pub(super) struct WireBench {
    wire: Wire,
    started: time::Instant,
    slack: Duration,
    buffer: Vec<u8>,
}

impl WireBench {
    pub(super) fn new(wire: Wire, slack: Duration) -> Self {
        Self { wire, started: time::Instant::now(), slack, buffer: vec![0; 2 * MAX_FRAME] }
    }
}

impl Bench for WireBench {
    fn now(&self) -> Instant {
        Instant(self.started.elapsed().as_micros() as u64)
    }

    fn send(&mut self, wire: &[u8]) -> Result<(), Gone> {
        for _ in 0..ATTEMPTS {
            match self.wire.writer.write(wire) {
                Ok(()) => return Ok(()),
                Err(WireError::Stalled { .. }) => thread::sleep(STALLED),
                Err(error) => return Err(Gone(error.to_string())),
            }
        }
        Err(Gone("the implementation accepts no data".into()))
    }

    fn receive(&mut self, until: Instant) -> Result<Vec<u8>, Gone> {
        loop {
            let wait = time::Duration::from_micros(until.since(self.now()).micros());
            let read = self.wire.reader.read_within(&mut self.buffer, wait);
            let count = read.map_err(|error| Gone(error.to_string()))?;
            if count > 0 || self.now() >= until {
                return Ok(self.buffer[..count].to_vec());
            }
        }
    }

    fn slack(&self) -> Duration {
        self.slack
    }
}
