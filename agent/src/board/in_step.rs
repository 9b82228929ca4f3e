//! The three serial ports of an image that runs in step with a simulation (`ubimap simulate --in-step`): instead of
//! USARTs, they are the standard input and output of the emulator, by semihosting. The emulated core stands still,
//! and so does its clock, until the simulation has come to the robot's time and answered.

use core::iter;

use heapless::Vec;
use semihosting::{
    fs::File,
    io::{self, Read, Write},
    process,
};
use ubimap_protocol::time::Instant;

use super::serial::{DEVICE_QUEUES, SERVER_QUEUES, Serial};

/// Length of the longest message to the simulation: the time, and for each port a count and its queue.
const LONGEST: usize = 8 + 3 * 2 + SERVER_QUEUES[1] + 2 * DEVICE_QUEUES[1];

/// Bytes received at once.
const PART: usize = 128;

/// The simulation that the ports lead to.
pub(crate) struct Simulation {
    from: File,
    to: File,
    message: Vec<u8, LONGEST>,
}

impl Simulation {
    /// `None` if the emulator's standard input or output can't be opened.
    pub(super) fn open() -> Option<Self> {
        let from = File::open(c"/dev/stdin").ok()?;
        let to = File::create(c"/dev/stdout").ok()?;
        Some(Self { from, to, message: Vec::new() })
    }

    /// Sends the time and what the ports have to send, and receives what has arrived at them by then. Bytes that a
    /// port has no room for are lost, as on the chip. Ends the emulator if there is no simulation any more.
    pub(super) fn exchange(&mut self, ports: &mut [Serial; 3], now: Instant) {
        if self.send(ports, now).and_then(|()| self.receive(ports)).is_err() {
            process::exit(0);
        }
    }

    fn send(&mut self, ports: &mut [Serial; 3], now: Instant) -> io::Result<()> {
        let Self { to, message, .. } = self;
        message.clear();
        // The message is as long as all queues, so nothing is cut off.
        let _ = message.extend_from_slice(&now.micros().to_le_bytes());
        for port in ports {
            let count = port.unsent();
            let _ = message.extend_from_slice(&(count as u16).to_le_bytes());
            message.extend(iter::from_fn(|| port.send()).take(count));
        }
        to.write_all(message)
    }

    fn receive(&mut self, ports: &mut [Serial; 3]) -> io::Result<()> {
        let mut counts = [[0; 2]; 3];
        self.from.read_exact(counts.as_flattened_mut())?;
        for (port, count) in ports.iter_mut().zip(counts) {
            let mut left = usize::from(u16::from_le_bytes(count));
            let mut part = [0; PART];
            while left > 0 {
                let bytes = part.get_mut(..left.min(PART)).unwrap_or_default();
                self.from.read_exact(bytes)?;
                bytes.iter().for_each(|&byte| port.receive(byte));
                left -= bytes.len();
            }
        }
        Ok(())
    }
}
