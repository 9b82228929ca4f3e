//! A relay between a camera's sender and the server, which a test can cut.

use std::{
    io::{self, Read, Write},
    os::unix::net::{UnixListener, UnixStream},
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

/// How long a read waits before the relay looks whether it was cut.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);

/// A relay; its thread ends with the process.
pub struct StreamRelay(Arc<AtomicBool>);

impl StreamRelay {
    /// Listens at `camera`, and passes what arrives to the socket `server`.
    ///
    /// # Errors
    /// The socket can't be made.
    pub fn new(camera: &Path, server: &Path) -> io::Result<Self> {
        let listener = UnixListener::bind(camera)?;
        let is_cut = Arc::new(AtomicBool::new(false));
        let (shared, server) = (Arc::clone(&is_cut), server.to_owned());
        thread::spawn(move || {
            for sender in listener.incoming().flatten() {
                if let Ok(server) = UnixStream::connect(&server) {
                    // The connection ends when it is cut, or when either end hangs up.
                    let _ = pass(sender, server, &shared);
                }
            }
        });
        Ok(Self(is_cut))
    }

    /// Cuts the stream, or lets it through again.
    pub fn cut(&self, is_cut: bool) {
        self.0.store(is_cut, Ordering::Relaxed);
    }
}

fn pass(mut sender: UnixStream, mut server: UnixStream, is_cut: &AtomicBool) -> io::Result<()> {
    sender.set_read_timeout(Some(LOOK_INTERVAL))?;
    let mut buffer = vec![0; 1 << 16];
    while !is_cut.load(Ordering::Relaxed) {
        match sender.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(count) => server.write_all(&buffer[..count])?,
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
