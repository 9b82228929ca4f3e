//! Sends the frames of one camera, the newest first if the server does not keep up.

use std::{
    io::BufWriter,
    os::unix::net::UnixStream,
    path::PathBuf,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread, time,
};

use super::clock::WallClock;
use crate::{
    camera::{
        Frame,
        stream::{self, StreamedFrame},
    },
    channel::wire::WireError,
};

/// Interval between attempts to connect.
const RETRY: time::Duration = time::Duration::from_millis(300);
/// How long the server may hold up a frame.
const PATIENCE: time::Duration = time::Duration::from_secs(2);

#[derive(Debug, Default)]
struct Waiting {
    newest: Option<StreamedFrame>,
    sent: u64,
    dropped: u64,
}

/// The thread that sends.
#[derive(Debug)]
pub(super) struct Sender(Arc<(Mutex<Waiting>, Condvar)>);

fn locked(mutex: &Mutex<Waiting>) -> MutexGuard<'_, Waiting> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Sender {
    /// Starts a thread that connects to a socket as often as necessary. It ends with the process.
    ///
    /// # Errors
    /// [`WireError::Io`] if no thread can be started.
    pub(super) fn start(socket: PathBuf, clock: WallClock) -> Result<Self, WireError> {
        let shared = Arc::new((Mutex::new(Waiting::default()), Condvar::new()));
        let name = socket.display().to_string();
        let spawned = thread::Builder::new().name("camera-send".into()).spawn({
            let shared = Arc::clone(&shared);
            move || {
                loop {
                    match UnixStream::connect(&socket) {
                        Ok(connection) => {
                            log::info!("{}: the server takes frames", socket.display());
                            feed(&shared, connection, &clock);
                            log::info!(
                                "{}: the server has gone; waiting for it to come back",
                                socket.display()
                            );
                        }
                        Err(_) => thread::sleep(RETRY),
                    }
                }
            }
        });
        spawned.map_err(|reason| WireError::Io { name, reason })?;
        Ok(Self(shared))
    }

    /// Hands a frame over; one that still waits is dropped.
    pub(super) fn send(&self, frame: Frame, clock: &WallClock) {
        let age = clock.elapsed().saturating_sub(frame.captured.micros());
        let captured = clock.now().saturating_sub(age);
        let Frame { depth, picture, .. } = frame;
        let (waiting, ready) = &*self.0;
        let mut waiting = locked(waiting);
        let newest = StreamedFrame { captured, sent: 0, depth, picture };
        if waiting.newest.replace(newest).is_some() {
            waiting.dropped += 1;
        }
        ready.notify_one();
    }

    /// Numbers of frames sent and dropped.
    pub(super) fn counts(&self) -> (u64, u64) {
        let waiting = locked(&self.0.0);
        (waiting.sent, waiting.dropped)
    }
}

/// Sends frames on a connection until it ends.
fn feed(shared: &(Mutex<Waiting>, Condvar), connection: UnixStream, clock: &WallClock) {
    if connection.set_write_timeout(Some(PATIENCE)).is_err() {
        return;
    }
    let mut out = BufWriter::with_capacity(1 << 16, connection);
    loop {
        let waiting = shared.1.wait_while(locked(&shared.0), |waiting| waiting.newest.is_none());
        let newest = waiting.unwrap_or_else(PoisonError::into_inner).newest.take();
        let Some(frame) = newest else { continue };
        let frame = StreamedFrame { sent: clock.now(), ..frame };
        let written =
            stream::write(&mut out, &frame).and_then(|()| std::io::Write::flush(&mut out));
        if written.is_err() {
            return;
        }
        locked(&shared.0).sent += 1;
    }
}
