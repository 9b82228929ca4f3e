//! The journal of a robot, written to a fourth port if the image is built with the feature `journal`.
//! It begins with the random number of the robot's configuration, four bytes, little-endian.

use ubimap_agent::journal::{Entry, Writer};
use ubimap_protocol::time::Instant;

use crate::board::JournalPort;

/// Writes a journal to a port.
pub(crate) struct Journal {
    writer: Writer,
}

impl Journal {
    /// Begins the journal.
    pub(crate) fn begin(port: &mut JournalPort, boot_nonce: u32) -> Self {
        port.write(&boot_nonce.to_le_bytes());
        Self { writer: Writer::new() }
    }

    /// Writes an entry.
    pub(crate) fn note(&mut self, port: &mut JournalPort, now: Instant, entry: Entry<'_>) {
        if JournalPort::IS_OPEN {
            self.writer.write(now, entry, |bytes| port.write(bytes));
        }
    }
}
