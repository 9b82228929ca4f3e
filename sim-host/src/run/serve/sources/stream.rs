//! Frames that another program sends to a socket.

use std::{
    io::{self, BufReader, Read},
    net::{SocketAddr, TcpListener},
    path::Path,
    thread, time,
};

use super::live_source::{LiveFrame, LiveSource};
use crate::{
    camera::{
        Frame, SenderClock,
        stream::{self, StreamedFrame},
    },
    channel::{socket_file::SocketFile, wire::WireError},
    run::serve::clock::Clock,
};

/// Time after which a silent sender's connection is closed.
const SILENT: time::Duration = time::Duration::from_secs(2);
/// Interval between looks for a connection.
const ACCEPT_INTERVAL: time::Duration = time::Duration::from_millis(50);

/// A socket that accepts one sender after the other. The sender's clock outlives connections.
pub(super) struct Stream<A, C> {
    camera: usize,
    name: String,
    accept: A,
    connection: Option<BufReader<C>>,
    clock: SenderClock,
}

impl<A, C> Stream<A, C> {
    fn new(camera: usize, name: &str, accept: A) -> Self {
        let clock = SenderClock::default();
        Self { camera, name: name.to_owned(), accept, connection: None, clock }
    }
}

impl<C: Read + Send, A: FnMut() -> io::Result<C> + Send> LiveSource for Stream<A, C> {
    fn next(&mut self, clock: &Clock) -> Option<LiveFrame> {
        loop {
            let Some(connection) = &mut self.connection else {
                match (self.accept)() {
                    Ok(connection) => {
                        log::info!("camera {}: connected", self.name);
                        self.connection = Some(BufReader::with_capacity(1 << 16, connection));
                    }
                    Err(_) => thread::sleep(ACCEPT_INTERVAL),
                }
                continue;
            };
            let StreamedFrame { captured, sent, depth, picture } = match stream::read(connection) {
                Ok(frame) => frame,
                Err(error) => {
                    log::warn!("camera {}: {error}; waiting for it to come back", self.name);
                    self.connection = None;
                    continue;
                }
            };
            let at = clock.now();
            if self.clock.heard(sent, at) {
                log::warn!("camera {}: its clock was set; its new time is followed", self.name);
            }
            // Nothing is captured after it was sent.
            let captured = self.clock.ours(captured).min(at);
            let frame = Frame { camera: self.camera, captured, depth, picture };
            return Some(LiveFrame { frame, at, sender: Some(self.clock), waits: false });
        }
    }
}

/// Listens to a TCP socket.
///
/// # Errors
/// [`WireError::Open`].
pub(super) fn tcp(
    camera: usize,
    name: &str,
    address: SocketAddr,
) -> Result<impl LiveSource + use<>, WireError> {
    let refuse =
        |error: io::Error| WireError::unbound(format!("camera {name}: stream:{address}"), &error);
    if !address.ip().is_loopback() {
        log::warn!("camera {name}: stream:{address}: whoever reaches it can send frames");
    }
    let listener = TcpListener::bind(address).map_err(refuse)?;
    Ok(Stream::new(camera, name, move || {
        let (connection, _) = listener.accept()?;
        connection.set_read_timeout(Some(SILENT))?;
        Ok(connection)
    }))
}

/// Listens to a Unix socket. Returns its file, too.
///
/// # Errors
/// [`WireError::Open`].
#[cfg(unix)]
pub(super) fn unix(
    camera: usize,
    name: &str,
    path: &Path,
) -> Result<(impl LiveSource + use<>, SocketFile), WireError> {
    let (listener, file) = crate::channel::unix_socket::listen(path)?;
    let stream = Stream::new(camera, name, move || {
        let (connection, _) = listener.accept()?;
        connection.set_read_timeout(Some(SILENT))?;
        Ok(connection)
    });
    Ok((stream, file))
}

/// Fails: there are no Unix sockets here.
///
/// # Errors
/// [`WireError::Open`].
#[cfg(not(unix))]
pub(super) fn unix(
    _: usize,
    _: &str,
    path: &Path,
) -> Result<(Stream<fn() -> io::Result<io::Empty>, io::Empty>, SocketFile), WireError> {
    let reason = "this system has no Unix sockets; give stream:HOST:PORT".to_owned();
    Err(WireError::Open { name: path.display().to_string(), reason })
}
