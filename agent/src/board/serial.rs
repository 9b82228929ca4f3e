//! A serial port as the main loop sees it: two queues.

use core::sync::atomic::AtomicU8;

use cortex_m::{
    asm,
    interrupt::{self as interrupts},
    peripheral::NVIC,
};

use super::{chip::Interrupt, ring::Ring};

/// Bytes between the main loop and the interrupt of a port.
pub(super) struct Queues {
    /// Received bytes waiting for the main loop.
    pub(super) received: Ring,
    /// Bytes waiting to be sent.
    pub(super) queued: Ring,
}

impl Queues {
    pub(super) const fn new(received: &'static [AtomicU8], queued: &'static [AtomicU8]) -> Self {
        Self { received: Ring::new(received), queued: Ring::new(queued) }
    }
}

/// A serial port. Its interrupt moves bytes between the hardware and two queues.
pub(crate) struct Serial {
    queues: &'static Queues,
    interrupt: Interrupt,
}

impl Serial {
    pub(super) fn new(queues: &'static Queues, interrupt: Interrupt) -> Self {
        Self { queues, interrupt }
    }

    /// Reads received bytes. Returns their number.
    pub(crate) fn read(&mut self, buffer: &mut [u8]) -> usize {
        let mut count = 0;
        for place in buffer {
            let Some(byte) = self.queues.received.take() else { break };
            *place = byte;
            count += 1;
        }
        if count > 0 {
            self.serve_soon();
        }
        count
    }

    /// Number of bytes that [`Serial::write`] accepts now.
    pub(crate) fn room(&self) -> usize {
        self.queues.queued.room()
    }

    /// Queues bytes to be sent. Returns the number of bytes queued, which is smaller than given if
    /// the queue is full.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> usize {
        let mut count = 0;
        for &byte in bytes {
            if !self.queues.queued.put(byte) {
                break;
            }
            count += 1;
        }
        self.serve_soon();
        count
    }

    /// Number of bytes that wait to be sent.
    #[cfg(feature = "in-step")]
    pub(super) fn unsent(&self) -> usize {
        self.queues.queued.len()
    }

    /// Takes the oldest of them.
    #[cfg(feature = "in-step")]
    pub(super) fn send(&mut self) -> Option<u8> {
        self.queues.queued.take()
    }

    /// Receives a byte. Without room for it, it is lost.
    #[cfg(feature = "in-step")]
    pub(super) fn receive(&mut self, byte: u8) {
        self.queues.received.put(byte);
    }

    /// Triggers the interrupt after the main loop has changed the queues.
    pub(super) fn serve_soon(&self) {
        // The main loop itself moves the bytes.
        if cfg!(feature = "in-step") {
            return;
        }
        NVIC::pend(self.interrupt);
        // It may have been masked because there was no room.
        #[cfg(feature = "rp2")]
        super::unmask(self.interrupt);
    }
}

/// Sizes of the queues of the port to the server, in bytes: 44 ms of received bytes at 115,200 baud,
/// and a frame of the link to be sent.
pub(super) const SERVER_QUEUES: [usize; 2] = [512, 256];

/// Sizes of the queues of a device's port: 22 ms of received bytes, several times what the main loop
/// takes at the most, and a command to be sent.
pub(super) const DEVICE_QUEUES: [usize; 2] = [256, 32];

/// Sleeps until bytes arrive at a port or the alarm fires, which is at most one millisecond.
pub(crate) fn wait(ports: &[Serial]) {
    // Interrupts are masked, so that none is handled between the check and the sleep; a pending one
    // still wakes the core.
    interrupts::free(|_| {
        if ports.iter().all(|port| port.queues.received.is_empty()) {
            asm::wfi();
        }
    });
}
