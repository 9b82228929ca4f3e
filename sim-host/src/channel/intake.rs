//! The bytes from all ports in one queue, in order of arrival: a thread waits at each port, so that no
//! link waits for another, and one consumer handles everything.

use std::{
    net::{SocketAddr, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread,
    time::{Duration, Instant},
};

use super::{
    tcp::TcpListener,
    udp::UdpSocket,
    wire::{WireError, WireReader},
};

/// Capacity of the queue. Threads of a full queue wait, and the operating system holds or drops what
/// arrives meanwhile.
const QUEUED: usize = 1_024;

/// How often a thread checks whether its port was closed.
const CHECK_INTERVAL: Duration = Duration::from_millis(100);

/// Maximum number of bytes of an arrival.
const CHUNK: usize = 1_024;

/// A source of arrivals: a wire, a socket or a listener. Numbers are not reused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SourceId(usize);

/// Something that has arrived.
#[derive(Debug)]
pub enum Arrival<M> {
    /// Something from a port.
    Port {
        /// The port.
        source: SourceId,
        /// When.
        at: Instant,
        /// What.
        what: What,
    },
    /// A message of another thread of the program.
    Message(M),
}

/// The content of an arrival.
#[derive(Debug)]
pub enum What {
    /// Bytes from a wire.
    Bytes(Vec<u8>),
    /// A datagram and its sender.
    Datagram(SocketAddr, Vec<u8>),
    /// A connection to a listener.
    Connection(TcpStream, SocketAddr),
    /// The source has failed and delivers nothing more.
    Failed(WireError),
}

/// The queue. Other threads of the program put messages of the type `M` into it.
#[derive(Debug)]
pub struct Intake<M> {
    next_source: usize,
    feed: mpsc::SyncSender<Arrival<M>>,
    queue: mpsc::Receiver<Arrival<M>>,
}

/// Puts messages into an intake.
#[derive(Debug)]
pub struct Feed<M>(mpsc::SyncSender<Arrival<M>>);

impl<M> Clone for Feed<M> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<M> Feed<M> {
    /// Puts a message into the queue; waits while it is full. Returns whether the intake is still there.
    pub fn send(&self, message: M) -> bool {
        self.0.send(Arrival::Message(message)).is_ok()
    }
}

/// A thread that waits at a port. When this is dropped, the thread closes the port and ends.
#[derive(Debug)]
pub struct Listening {
    source: SourceId,
    closed: Arc<AtomicBool>,
    /// Becomes disconnected when the thread has closed the port.
    open: mpsc::Receiver<()>,
}

impl<M> Default for Intake<M> {
    fn default() -> Self {
        let (feed, queue) = mpsc::sync_channel(QUEUED);
        Self { next_source: 0, feed, queue }
    }
}

impl<M: Send + 'static> Intake<M> {
    /// Listens to a wire.
    ///
    /// # Errors
    /// [`WireError::Io`] if no thread can be started.
    pub fn wire(&mut self, mut reader: Box<dyn WireReader>) -> Result<Listening, WireError> {
        let mut buffer = vec![0; CHUNK];
        self.listen(move || {
            let count = reader.read_within(&mut buffer, CHECK_INTERVAL)?;
            Ok((count > 0).then(|| What::Bytes(buffer[..count].to_vec())))
        })
    }

    /// Listens to a UDP socket.
    ///
    /// # Errors
    /// [`WireError::Io`] if no thread can be started.
    pub fn udp(&mut self, socket: UdpSocket) -> Result<Listening, WireError> {
        self.listen(move || {
            let datagram = socket.receive_within(CHECK_INTERVAL)?;
            Ok(datagram.map(|(from, bytes)| What::Datagram(from, bytes)))
        })
    }

    /// Listens to a TCP listener.
    ///
    /// # Errors
    /// [`WireError::Io`] if no thread can be started.
    pub fn tcp(&mut self, listener: TcpListener) -> Result<Listening, WireError> {
        self.listen(move || {
            let connection = listener.accept_within(CHECK_INTERVAL)?;
            Ok(connection.map(|(stream, from)| What::Connection(stream, from)))
        })
    }

    /// What other threads put messages into this queue with.
    pub fn feed(&self) -> Feed<M> {
        Feed(self.feed.clone())
    }

    /// The oldest arrival; waits up to `wait` for one.
    pub fn next_within(&self, wait: Duration) -> Option<Arrival<M>> {
        // This end of the queue has a feed of its own, so it is never disconnected.
        self.queue.recv_timeout(wait).ok()
    }

    fn listen(
        &mut self,
        mut poll: impl FnMut() -> Result<Option<What>, WireError> + Send + 'static,
    ) -> Result<Listening, WireError> {
        let source = SourceId(self.next_source);
        self.next_source += 1;
        let closed = Arc::new(AtomicBool::new(false));
        let (alive, open) = mpsc::channel();
        let spawned = thread::Builder::new().name("wire-read".into()).spawn({
            let (feed, closed) = (self.feed.clone(), Arc::clone(&closed));
            move || {
                while !closed.load(Ordering::Relaxed) {
                    let what = match poll() {
                        Ok(None) => continue,
                        Ok(Some(what)) => what,
                        Err(error) => What::Failed(error),
                    };
                    let is_last = matches!(what, What::Failed(_));
                    let sent = feed.send(Arrival::Port { source, at: Instant::now(), what });
                    if is_last || sent.is_err() {
                        break;
                    }
                }
                // It owns the port.
                drop(poll);
                drop(alive);
            }
        });
        match spawned {
            Ok(_) => Ok(Listening { source, closed, open }),
            Err(reason) => Err(WireError::Io { name: "a thread for a port".into(), reason }),
        }
    }
}

impl Listening {
    /// The source.
    pub fn source(&self) -> SourceId {
        self.source
    }
}

impl Drop for Listening {
    fn drop(&mut self) {
        self.closed.store(true, Ordering::Relaxed);
        // So that the port can be opened again at once. The thread is not joined: it may wait for room in
        // a queue that nobody reads any more.
        let _ = self.open.recv_timeout(2 * CHECK_INTERVAL);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WAIT: Duration = Duration::from_secs(5);

    /// A wire on which a byte arrives after each pause, until it hangs up.
    struct Slow(Vec<Duration>);

    impl WireReader for Slow {
        fn read_within(&mut self, buffer: &mut [u8], _: Duration) -> Result<usize, WireError> {
            let Some(pause) = self.0.pop() else {
                return Err(WireError::HungUp { name: "slow".into() });
            };
            thread::sleep(pause);
            buffer[0] = 1;
            Ok(1)
        }
    }

    /// A port that counts as open until it is dropped.
    struct Open(#[expect(dead_code, reason = "it is dropped with the port")] Arc<()>);

    impl WireReader for Open {
        fn read_within(&mut self, _: &mut [u8], wait: Duration) -> Result<usize, WireError> {
            thread::sleep(wait);
            Ok(0)
        }
    }

    #[test]
    fn a_port_is_closed_once_nobody_listens() {
        let mut intake = Intake::<()>::default();
        let port = Arc::new(());
        let listening = intake.wire(Box::new(Open(Arc::clone(&port)))).unwrap();
        assert_eq!(Arc::strong_count(&port), 2);
        drop(listening);
        assert_eq!(Arc::strong_count(&port), 1);
    }

    #[test]
    fn a_slow_wire_holds_up_no_other() {
        let mut intake = Intake::<char>::default();
        let slow = intake.wire(Box::new(Slow(vec![Duration::from_secs(2)]))).unwrap();
        let quick = intake.wire(Box::new(Slow(vec![Duration::ZERO; 3]))).unwrap();
        let began = Instant::now();
        let next = || match intake.next_within(WAIT).unwrap() {
            Arrival::Port { source, what, .. } => (source, what),
            Arrival::Message(message) => panic!("{message}"),
        };
        for _ in 0..3 {
            let (source, what) = next();
            assert_eq!(source, quick.source());
            assert!(matches!(what, What::Bytes(bytes) if bytes == [1]));
        }
        assert!(matches!(next().1, What::Failed(WireError::HungUp { .. })));
        assert!(began.elapsed() < Duration::from_secs(1));
        assert_eq!(next().0, slow.source());
        assert!(intake.feed().send('m'));
        while !matches!(intake.next_within(WAIT), Some(Arrival::Message('m'))) {}
    }
}
