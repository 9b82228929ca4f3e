//! Writes that never block: a peer that accepts no data can block a `write` to the operating system
//! beyond its timeout, so a separate thread writes from a bounded queue.

use std::{
    io::{ErrorKind, Write},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread,
    time::Duration,
};

use super::wire::{WireError, WireWriter};

/// Capacity of the queue, in writes of at most 250 bytes each.
const QUEUED_WRITES: usize = 64;

/// The write timeout that the stream of a queue should have. It decides how often the writer checks
/// whether the queue was dropped while its peer accepts no data, and how long a dropped queue waits
/// for queued bytes.
pub(super) const WRITE_TIMEOUT: Duration = Duration::from_millis(100);

/// The sending end of a byte stream.
#[derive(Debug)]
pub struct WriteQueue {
    name: String,
    /// `Some` until the queue is dropped.
    writes: Option<mpsc::SyncSender<Vec<u8>>>,
    closing: Arc<AtomicBool>,
    /// Becomes disconnected when the writer thread ends.
    writer: mpsc::Receiver<()>,
}

impl WriteQueue {
    /// Starts a thread that writes to `stream`, at most `chunk` bytes at once. `name` is the port's,
    /// for messages.
    ///
    /// # Errors
    /// [`WireError::Io`] if no thread can be started.
    pub(super) fn start(
        name: String,
        stream: impl Write + Send + 'static,
        chunk: usize,
    ) -> Result<Self, WireError> {
        let closing = Arc::new(AtomicBool::new(false));
        let (writes, queue) = mpsc::sync_channel(QUEUED_WRITES);
        let (alive, writer) = mpsc::channel();
        let spawned = thread::Builder::new().name("wire-write".into()).spawn({
            let closing = Arc::clone(&closing);
            move || {
                write_queued(stream, chunk, &queue, &closing);
                drop(alive);
            }
        });
        match spawned {
            Ok(_) => Ok(Self { name, writes: Some(writes), closing, writer }),
            Err(reason) => Err(WireError::Io { name, reason }),
        }
    }

    fn hung_up(&self) -> WireError {
        WireError::HungUp { name: self.name.clone() }
    }
}

impl WireWriter for WriteQueue {
    /// Bytes that are queued when the queue is dropped are still written if the peer accepts them
    /// before the write timeout.
    fn write(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        let Some(writes) = &self.writes else { return Err(self.hung_up()) };
        writes.try_send(bytes.to_vec()).map_err(|error| match error {
            mpsc::TrySendError::Full(_) => WireError::Stalled { name: self.name.clone() },
            mpsc::TrySendError::Disconnected(_) => self.hung_up(),
        })
    }
}

impl Drop for WriteQueue {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        self.writes = None;
        // The thread is not joined: a writer that is blocked in the operating system must not block
        // the owner of the port.
        let _ = self.writer.recv_timeout(WRITE_TIMEOUT);
    }
}

/// Writes queued bytes until the queue is dropped or the stream disconnected.
fn write_queued(
    mut stream: impl Write,
    chunk: usize,
    queue: &mpsc::Receiver<Vec<u8>>,
    closing: &AtomicBool,
) {
    for bytes in queue {
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            match stream.write(&rest[..rest.len().min(chunk)]) {
                Ok(0) => return,
                Ok(count) => rest = &rest[count..],
                Err(error) => match error.kind() {
                    ErrorKind::Interrupted => {}
                    ErrorKind::TimedOut | ErrorKind::WouldBlock => {
                        if closing.load(Ordering::Relaxed) {
                            return;
                        }
                    }
                    _ => return,
                },
            }
        }
    }
}
