//! A journal of a [`Machine`](crate::Machine)'s inputs and outputs, from which a run can be repeated
//! bit by bit on another computer.
//!
//! A journal is a sequence of entries. Numbers are in LEB128: seven bits per byte, the lowest first;
//! the highest bit of a byte is set if another follows.
//!
//! | part of an entry | size |
//! |---|---|
//! | kind: 0, 1, 2 received by the server's, the sensor's, the wheels' port; 3 timeout; 4, 5, 6 transmitted by the three ports; 7 end | 1 byte |
//! | time since the entry before, or for the first one since boot, in microseconds | a number |
//! | kinds 0 to 2 and 4 to 6: the count of bytes (0 if there was nothing to transmit), then the bytes | a number, any |

use core::{error::Error, fmt};

use ubimap_protocol::time::{Duration, Instant};

use crate::Port;

/// Added to the kind of a port's entry for transmitted bytes.
const TRANSMITTED: u8 = 4;
const TIMEOUT: u8 = 3;
const END: u8 = 7;

/// The ports in the order of their kinds.
const PORTS: [Port; 3] = [Port::Server, Port::Sensor, Port::Wheels];

/// A call of a machine's method, with its result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Entry<'e> {
    /// [`Machine::receive`](crate::Machine::receive) with these bytes.
    Received(Port, &'e [u8]),
    /// [`Machine::timeout`](crate::Machine::timeout).
    Timeout,
    /// [`Machine::poll_transmit`](crate::Machine::poll_transmit), which wrote these bytes; empty if
    /// there was nothing to transmit.
    Transmitted(Port, &'e [u8]),
    /// The end of the journal.
    End,
}

/// Writes a journal.
#[derive(Clone, Copy, Debug, Default)]
pub struct Writer {
    last: Instant,
}

impl Writer {
    /// A writer of a new journal.
    pub const fn new() -> Self {
        Self { last: Instant(0) }
    }

    /// Passes the bytes of an entry to `put`, in pieces. `now` is the time given in the call of the
    /// machine's method, by the robot's clock.
    pub fn write(&mut self, now: Instant, entry: Entry<'_>, mut put: impl FnMut(&[u8])) {
        let (kind, bytes) = match entry {
            Entry::Received(port, bytes) => (port as u8, Some(bytes)),
            Entry::Timeout => (TIMEOUT, None),
            Entry::Transmitted(port, bytes) => (TRANSMITTED + port as u8, Some(bytes)),
            Entry::End => (END, None),
        };
        put(&[kind]);
        write_number(now.since(self.last).micros(), &mut put);
        self.last = now;
        if let Some(bytes) = bytes {
            write_number(bytes.len() as u64, &mut put);
            put(bytes);
        }
    }
}

fn write_number(mut number: u64, put: &mut impl FnMut(&[u8])) {
    while number >= 0x80 {
        put(&[number as u8 | 0x80]);
        number >>= 7;
    }
    put(&[number as u8]);
}

/// The journal is damaged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JournalError {
    /// The journal ends inside an entry.
    Incomplete,
    /// There is no entry of this kind.
    Kind(u8),
    /// A number is larger than 64 bits.
    Number,
    /// An entry has more bytes than the reader's buffer.
    TooLong {
        /// Number of bytes.
        count: u64,
    },
}

impl fmt::Display for JournalError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Incomplete => f.write_str("the journal ends inside an entry"),
            Self::Kind(kind) => write!(f, "the journal has an entry of the unknown kind {kind}"),
            Self::Number => f.write_str("the journal has a number of more than 64 bits"),
            Self::TooLong { count } => {
                write!(f, "the journal has an entry of {count} bytes, more than the buffer holds")
            }
        }
    }
}

impl Error for JournalError {}

/// Reads a journal byte by byte.
#[derive(Clone, Debug)]
pub struct Reader<F> {
    byte: F,
    last: Instant,
}

impl<F: FnMut() -> Option<u8>> Reader<F> {
    /// A reader of a journal; `byte` returns its next byte.
    pub fn new(byte: F) -> Self {
        Self { byte, last: Instant(0) }
    }

    /// The next entry, with the time of its call. Its bytes are written into `buffer`.
    ///
    /// # Errors
    /// [`JournalError`]. The rest of a damaged journal can't be read.
    pub fn entry<'b>(
        &mut self,
        buffer: &'b mut [u8],
    ) -> Result<(Instant, Entry<'b>), JournalError> {
        let kind = self.byte()?;
        let now = self.last + Duration(self.number()?);
        self.last = now;
        let port = PORTS.get(usize::from(kind & 3));
        let entry = match (kind, port) {
            (TIMEOUT, _) => Entry::Timeout,
            (END, _) => Entry::End,
            (0..TRANSMITTED, Some(&port)) => Entry::Received(port, self.bytes(buffer)?),
            (TRANSMITTED..END, Some(&port)) => Entry::Transmitted(port, self.bytes(buffer)?),
            _ => return Err(JournalError::Kind(kind)),
        };
        Ok((now, entry))
    }

    fn bytes<'b>(&mut self, buffer: &'b mut [u8]) -> Result<&'b [u8], JournalError> {
        let count = self.number()?;
        let bytes = usize::try_from(count).ok().and_then(|count| buffer.get_mut(..count));
        let bytes = bytes.ok_or(JournalError::TooLong { count })?;
        for byte in &mut *bytes {
            *byte = self.byte()?;
        }
        Ok(bytes)
    }

    fn number(&mut self) -> Result<u64, JournalError> {
        let mut number = 0;
        for shift in (0..u64::BITS).step_by(7) {
            let byte = self.byte()?;
            number |= u64::from(byte & 0x7F) << shift;
            if byte < 0x80 {
                return Ok(number);
            }
        }
        Err(JournalError::Number)
    }

    fn byte(&mut self) -> Result<u8, JournalError> {
        (self.byte)().ok_or(JournalError::Incomplete)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{vec, vec::Vec};

    fn written(entries: &[(u64, Entry<'_>)]) -> Vec<u8> {
        let (mut writer, mut journal) = (Writer::new(), vec![]);
        for &(now, entry) in entries {
            writer.write(Instant(now), entry, |bytes| journal.extend(bytes));
        }
        journal
    }

    fn read(journal: &[u8]) -> Result<Vec<(u64, std::string::String)>, JournalError> {
        let mut bytes = journal.iter().copied();
        let mut reader = Reader::new(|| bytes.next());
        let (mut entries, mut buffer) = (vec![], [0; 8]);
        loop {
            let (now, entry) = reader.entry(&mut buffer)?;
            entries.push((now.0, std::format!("{entry:?}")));
            if entry == Entry::End {
                return Ok(entries);
            }
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let entries = [
            (3, Entry::Received(Port::Server, &[1, 2, 3])),
            (3, Entry::Received(Port::Sensor, &[])),
            (200, Entry::Received(Port::Wheels, &[255; 8])),
            (70_000, Entry::Timeout),
            (1 << 40, Entry::Transmitted(Port::Server, &[])),
            (1 << 40, Entry::Transmitted(Port::Sensor, &[9])),
            (u64::MAX, Entry::Transmitted(Port::Wheels, &[4; 7])),
            (u64::MAX, Entry::End),
        ];
        let journal = written(&entries);
        assert_eq!(journal[..9], [0, 3, 3, 1, 2, 3, 1, 0, 0]);
        assert_eq!(journal[9..13], [2, 0xC5, 1, 8]);
        let told: Vec<_> = entries.map(|(now, entry)| (now, std::format!("{entry:?}"))).into();
        assert_eq!(read(&journal), Ok(told));
        for end in 0..journal.len() {
            assert_eq!(read(&journal[..end]), Err(JournalError::Incomplete), "{end}");
        }
    }

    #[test]
    fn a_damaged_journal_is_refused() {
        assert_eq!(read(&[8, 0]), Err(JournalError::Kind(8)));
        assert_eq!(read(&[200, 0]), Err(JournalError::Kind(200)));
        assert_eq!(read(&[0, 0, 9]), Err(JournalError::TooLong { count: 9 }));
        assert_eq!(read(&[[3].as_slice(), &[0x80; 10]].concat()), Err(JournalError::Number));
    }
}
