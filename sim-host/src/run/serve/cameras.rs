//! The cameras of a deployment, each in a thread of its own. Of each camera only the newest frame waits.

use std::{
    io::{self, Read},
    net::{SocketAddr, TcpListener},
    path::Path,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread, time,
};

use ubimap_protocol::time::{Duration, Instant};

use crate::{
    camera::{Frame, FrameSource, SenderClock, stream},
    channel::wire::WireError,
    recording::{Reading, RecordedFrames},
    run::deployment_file::{CameraSource, DeployedCamera},
};

/// Time after which a silent sender's connection is closed.
const SILENT: time::Duration = time::Duration::from_secs(2);
/// Interval between looks for a connection.
const ACCEPT_INTERVAL: time::Duration = time::Duration::from_millis(50);
/// Time without a frame after which a camera counts as away.
pub(super) const AWAY: Duration = Duration::from_secs(2);

/// A frame and its arrival, by the server's wall clock since its start.
#[derive(Debug)]
pub(super) struct Arrived {
    pub(super) frame: Frame,
    pub(super) at: Instant,
}

/// The state of a camera.
#[derive(Clone, Debug, Default)]
pub(super) struct CameraState {
    /// Frames that have arrived.
    pub(super) frames: u64,
    /// Frames that were replaced by newer ones before anybody looked at them.
    pub(super) skipped: u64,
    /// When the last one arrived.
    pub(super) last: Option<Instant>,
    /// The sender's clock.
    pub(super) clock: Option<SenderClock>,
}

#[derive(Debug, Default)]
struct Shelf {
    newest: Vec<Option<Arrived>>,
    states: Vec<CameraState>,
    /// The camera whose frame is taken first.
    next: usize,
}

/// The newest frame of each camera.
#[derive(Debug, Default)]
pub(super) struct Cameras {
    shelf: Mutex<Shelf>,
    filled: Condvar,
}

impl Cameras {
    /// Starts the threads of all cameras. Times count from `began`.
    ///
    /// # Errors
    /// [`WireError::Open`] if a socket can't be opened.
    pub(super) fn start(
        cameras: &[DeployedCamera],
        began: time::Instant,
    ) -> Result<Arc<Self>, WireError> {
        let all = Arc::new(Self::default());
        {
            let mut shelf = all.shelf();
            shelf.newest.resize_with(cameras.len(), || None);
            shelf.states.resize_with(cameras.len(), CameraState::default);
        }
        for (index, camera) in cameras.iter().enumerate() {
            let sink = Sink { all: Arc::clone(&all), index, began, name: camera.name.clone() };
            match &camera.source {
                CameraSource::Folder(folder, speed) => {
                    let frames =
                        RecordedFrames::open_with(std::slice::from_ref(folder), Reading::UNPLACED);
                    let refuse = |error: crate::recording::FramesError| WireError::Open {
                        name: camera.name.clone(),
                        reason: error.to_string(),
                    };
                    let (frames, speed) = (frames.map_err(refuse)?, *speed);
                    spawn(&camera.name, move || sink.play(frames, speed))?;
                }
                CameraSource::TcpStream(address) => listen_tcp(sink, *address)?,
                CameraSource::UnixStream(path) => listen_unix(sink, path)?,
            }
        }
        Ok(all)
    }

    fn shelf(&self) -> MutexGuard<'_, Shelf> {
        // Nothing is left half done by a panic: every change is one assignment.
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the newest frame of a camera, the cameras in turn; waits up to `wait` for one.
    pub(super) fn take_within(&self, wait: time::Duration) -> Option<Arrived> {
        let is_empty = |shelf: &mut Shelf| shelf.newest.iter().all(Option::is_none);
        let waited = self.filled.wait_timeout_while(self.shelf(), wait, is_empty);
        let (mut shelf, _) = waited.unwrap_or_else(PoisonError::into_inner);
        let count = shelf.newest.len();
        for turn in 0..count {
            let index = (shelf.next + turn) % count;
            if let Some(arrived) = shelf.newest[index].take() {
                shelf.next = index + 1;
                return Some(arrived);
            }
        }
        None
    }

    /// The state of each camera.
    pub(super) fn states(&self) -> Vec<CameraState> {
        self.shelf().states.clone()
    }
}

/// Where the thread of a camera puts its frames.
struct Sink {
    all: Arc<Cameras>,
    index: usize,
    began: time::Instant,
    name: String,
}

impl Sink {
    fn now(&self) -> Instant {
        Instant(self.began.elapsed().as_micros() as u64)
    }

    fn put(&self, frame: Frame, at: Instant, clock: Option<SenderClock>) {
        let mut shelf = self.all.shelf();
        let replaced = shelf.newest[self.index].replace(Arrived { frame, at });
        let state = &mut shelf.states[self.index];
        state.frames += 1;
        state.skipped += u64::from(replaced.is_some());
        state.last = Some(at);
        state.clock = clock.or(state.clock);
        drop(shelf);
        self.all.filled.notify_one();
    }

    /// Plays recorded frames at a multiple of real time.
    fn play(self, mut frames: RecordedFrames, speed: f64) {
        let began = self.now();
        let scaled = |moment: Instant| {
            began + Duration::from_micros((moment.micros() as f64 / speed).round() as u64)
        };
        while let Some(next) = frames.next_arrival() {
            let wait = scaled(next).since(self.now());
            thread::sleep(time::Duration::from_micros(wait.micros()));
            if let Some(frame) = frames.poll(next) {
                let captured = scaled(frame.captured);
                self.put(Frame { camera: self.index, captured, ..frame }, self.now(), None);
            }
        }
        match frames.take_fault() {
            Some(fault) => log::error!("camera {}: {fault}", self.name),
            None => log::info!("camera {}: its recording has ended", self.name),
        }
    }

    /// Puts the frames of a connection, until it ends. The clock outlives connections.
    fn read(&self, mut connection: impl Read, clock: &mut SenderClock) {
        log::info!("camera {}: connected", self.name);
        let error = loop {
            let frame = match stream::read(&mut connection) {
                Ok(frame) => frame,
                Err(error) => break error,
            };
            let at = self.now();
            if clock.heard(frame.sent, at) {
                log::warn!("camera {}: its clock was set; its new time is followed", self.name);
            }
            // Nothing is captured after it was sent.
            let captured = clock.ours(frame.captured).min(at);
            let stream::StreamedFrame { depth, picture, .. } = frame;
            self.put(Frame { camera: self.index, captured, depth, picture }, at, Some(*clock));
        };
        log::warn!("camera {}: {error}; waiting for it to come back", self.name);
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), WireError> {
    let spawned = thread::Builder::new().name(format!("camera {name}")).spawn(work);
    spawned.map(drop).map_err(|reason| WireError::Io { name: name.to_owned(), reason })
}

/// Accepts one sender after the other.
fn listen<C: Read>(sink: Sink, accept: impl Fn() -> io::Result<C>) {
    let mut clock = SenderClock::default();
    loop {
        match accept() {
            Ok(connection) => {
                sink.read(io::BufReader::with_capacity(1 << 16, connection), &mut clock)
            }
            Err(_) => thread::sleep(ACCEPT_INTERVAL),
        }
    }
}

fn listen_tcp(sink: Sink, address: SocketAddr) -> Result<(), WireError> {
    let name = sink.name.clone();
    let refuse = |error: io::Error| WireError::Open {
        name: format!("camera {name}: stream:{address}"),
        reason: error.to_string(),
    };
    if !address.ip().is_loopback() {
        log::warn!("camera {name}: stream:{address}: whoever reaches it can send frames");
    }
    let listener = TcpListener::bind(address).map_err(refuse)?;
    spawn(&name, move || {
        listen(sink, || {
            let (connection, _) = listener.accept()?;
            connection.set_read_timeout(Some(SILENT))?;
            Ok(connection)
        });
    })
}

#[cfg(unix)]
fn listen_unix(sink: Sink, path: &Path) -> Result<(), WireError> {
    let name = sink.name.clone();
    let listener = crate::channel::unix_socket::listen(path)?;
    spawn(&name, move || {
        listen(sink, || {
            let (connection, _) = listener.accept()?;
            connection.set_read_timeout(Some(SILENT))?;
            Ok(connection)
        });
    })
}

#[cfg(not(unix))]
fn listen_unix(_: Sink, path: &Path) -> Result<(), WireError> {
    let reason = "this system has no Unix sockets; give stream:HOST:PORT".to_owned();
    Err(WireError::Open { name: path.display().to_string(), reason })
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use std::{io::Write, os::unix::net::UnixStream};

    use super::*;
    use crate::{
        camera::{Calibration, DepthImage, DepthNoise, stream::StreamedFrame},
        testing::Folder,
    };

    const WAIT: time::Duration = time::Duration::from_secs(10);

    fn wait_until(mut is_there: impl FnMut() -> bool) {
        let began = time::Instant::now();
        while !is_there() {
            assert!(began.elapsed() < WAIT);
            thread::sleep(time::Duration::from_millis(1));
        }
    }

    #[test]
    fn a_sender_that_comes_back_is_taken_up_and_only_its_newest_frame_waits() {
        let folder = Folder::new("cameras");
        let path = folder.path().join("north.sock");
        let camera = DeployedCamera {
            name: "north".into(),
            source: CameraSource::UnixStream(path.clone()),
            calibration: Calibration {
                depth: None,
                depth_noise: DepthNoise::default(),
                picture: None,
            },
            is_placed: false,
        };
        let cameras = Cameras::start(&[camera], time::Instant::now()).unwrap();
        // The second sender's clock is a day ahead of the first one's.
        for (life, clock) in [(1, 0), (2, 86_400_000_000)] {
            let mut sender = UnixStream::connect(&path).unwrap();
            for value in 1..=5 {
                let depth = Some(DepthImage::from_pixel(2, 2, image::Luma([value])));
                let (captured, sent) = (clock + 1_000_000, clock + 1_001_000);
                let frame = StreamedFrame { captured, sent, depth, picture: None };
                stream::write(&mut sender, &frame).unwrap();
            }
            wait_until(|| cameras.states()[0].frames == 5 * life);
            let Arrived { frame, at } = cameras.take_within(WAIT).unwrap();
            assert_eq!(frame.depth.unwrap().get_pixel(0, 0).0, [5]);
            assert!(frame.captured <= at && at.since(frame.captured).micros() < 1_000_000);
            assert!(cameras.take_within(time::Duration::ZERO).is_none());
            assert_eq!(cameras.states()[0].skipped, 4 * life);
        }
        assert_eq!(cameras.states()[0].clock.unwrap().jumps(), 1);

        let mut stranger = UnixStream::connect(&path).unwrap();
        stranger.write_all(&[b'x'; 40]).unwrap();
        stranger.set_read_timeout(Some(WAIT)).unwrap();
        assert_eq!(stranger.read(&mut [0]).unwrap(), 0, "it was not hung up on");
        assert_eq!(cameras.states()[0].frames, 10);
    }
}
