//! The cameras of a deployment, each in a thread of its own. Of each camera only the newest frame waits.

use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread, time,
};

use ubimap_protocol::time::{Duration, Instant};

use super::{
    clock::Clock,
    sources::{LiveFrame, LiveSource},
};
use crate::{
    camera::{Frame, SenderClock},
    channel::wire::WireError,
};

/// Time without a frame after which a camera counts as away.
pub(super) const AWAY: Duration = Duration::from_secs(2);

/// A frame and its arrival, by the server's clock.
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
    /// Frames that were captured before one that has arrived already.
    pub(super) out_of_order: u64,
    /// When the last one arrived.
    pub(super) last: Option<Instant>,
    /// The time from its capture to its arrival.
    pub(super) age: Duration,
    /// The capture times of the newest picture and the newest depth image.
    captured: [Instant; 2],
    /// The sender's clock.
    pub(super) clock: Option<SenderClock>,
}

/// What a frame replaces if it still waits: the picture of a camera whose two sensors send one after the other
/// does not replace its depth image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Place {
    camera: usize,
    has_depth: bool,
}

#[derive(Debug, Default)]
struct Shelf {
    /// The newest frames, at most one for each place, in the order in which the places were filled: every
    /// camera has its turn, and frames that are not replaced are taken in order of arrival.
    waiting: VecDeque<(Place, Arrived)>,
    states: Vec<CameraState>,
}

/// The newest frames of the cameras.
#[derive(Debug)]
pub(super) struct Cameras {
    shelf: Mutex<Shelf>,
    filled: Condvar,
    taken: Condvar,
}

impl Cameras {
    /// The frames of this number of cameras.
    pub(super) fn new(count: usize) -> Self {
        let states = vec![CameraState::default(); count];
        let shelf = Mutex::new(Shelf { states, ..Shelf::default() });
        Self { shelf, filled: Condvar::new(), taken: Condvar::new() }
    }

    /// Starts a thread for each source.
    ///
    /// # Errors
    /// [`WireError::Io`] if none can be started.
    pub(super) fn start(
        self: &Arc<Self>,
        sources: Vec<Box<dyn LiveSource>>,
        clock: Clock,
    ) -> Result<(), WireError> {
        for mut source in sources {
            let all = Arc::clone(self);
            let work = move || {
                while let Some(frame) = source.next(&clock) {
                    all.put(frame);
                }
            };
            let spawned = thread::Builder::new().name("camera".into()).spawn(work);
            spawned.map_err(|reason| WireError::Io { name: "cameras".into(), reason })?;
        }
        Ok(())
    }

    fn shelf(&self) -> MutexGuard<'_, Shelf> {
        // Nothing is left half done by a panic.
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn put(&self, LiveFrame { frame, at, sender, waits }: LiveFrame) {
        let place = Place { camera: frame.camera, has_depth: frame.depth.is_some() };
        let fills = |(filled, _): &(Place, Arrived)| *filled == place;
        let mut shelf = self.shelf();
        if waits {
            let is_filled = |shelf: &mut Shelf| shelf.waiting.iter().any(fills);
            let waited = self.taken.wait_while(shelf, is_filled);
            shelf = waited.unwrap_or_else(PoisonError::into_inner);
        }
        let Shelf { waiting, states } = &mut *shelf;
        let Some(state) = states.get_mut(place.camera) else { return };
        state.frames += 1;
        let newest = &mut state.captured[usize::from(place.has_depth)];
        state.out_of_order += u64::from(frame.captured < *newest);
        *newest = frame.captured.max(*newest);
        (state.last, state.age) = (Some(at), at.since(frame.captured));
        state.clock = sender.or(state.clock);
        let arrived = Arrived { frame, at };
        match waiting.iter_mut().find(|waiting| fills(waiting)) {
            Some((_, stale)) => {
                *stale = arrived;
                state.skipped += 1;
            }
            None => waiting.push_back((place, arrived)),
        }
        drop(shelf);
        self.filled.notify_one();
    }

    /// Takes the frame whose place was filled first; waits up to `wait` for one.
    pub(super) fn take_within(&self, wait: time::Duration) -> Option<Arrived> {
        let is_empty = |shelf: &mut Shelf| shelf.waiting.is_empty();
        let waited = self.filled.wait_timeout_while(self.shelf(), wait, is_empty);
        let (mut shelf, _) = waited.unwrap_or_else(PoisonError::into_inner);
        let (_, arrived) = shelf.waiting.pop_front()?;
        drop(shelf);
        self.taken.notify_all();
        Some(arrived)
    }

    /// The state of each camera.
    pub(super) fn states(&self) -> Vec<CameraState> {
        self.shelf().states.clone()
    }
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use std::{
        io::{Read, Write},
        os::unix::net::UnixStream,
    };

    use super::*;
    use crate::{
        camera::{
            Calibration, DepthImage,
            stream::{self, StreamedFrame},
        },
        run::{
            deployment_file::{CameraSource, DeployedCamera},
            serve::sources,
        },
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
            calibration: Calibration::default(),
            is_placed: false,
        };
        let cameras = Arc::new(Cameras::new(1));
        let (sources, files) = sources::open(&[camera], false).unwrap();
        cameras.start(sources, Clock::new(1.0)).unwrap();
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
        drop(files);
        assert!(!path.exists(), "the socket is left behind");
    }

    fn frame(camera: usize, captured: u64, has_depth: bool, waits: bool) -> LiveFrame {
        let depth = has_depth.then(|| DepthImage::new(1, 1));
        let frame = Frame { camera, captured: Instant(captured), depth, picture: None };
        LiveFrame { frame, at: Instant(captured), sender: None, waits }
    }

    fn taken(cameras: &Cameras) -> Vec<u64> {
        let take = || cameras.take_within(time::Duration::ZERO);
        std::iter::from_fn(take).map(|it| it.frame.captured.micros()).collect()
    }

    #[test]
    fn frames_are_taken_in_order_and_a_picture_replaces_no_depth_image() {
        let cameras = Cameras::new(2);
        for (camera, captured, has_depth) in
            [(1, 1, true), (0, 2, true), (1, 3, false), (1, 4, true), (1, 5, false)]
        {
            cameras.put(frame(camera, captured, has_depth, false));
        }
        assert_eq!(taken(&cameras), [4, 2, 5]);
        let skipped: Vec<u64> = cameras.states().iter().map(|it| it.skipped).collect();
        assert_eq!(skipped, [0, 2]);
    }

    #[test]
    fn a_frame_that_waits_replaces_none() {
        let cameras = Arc::new(Cameras::new(1));
        cameras.put(frame(0, 1, true, true));
        let other = Arc::clone(&cameras);
        let putting = thread::spawn(move || other.put(frame(0, 2, true, true)));
        thread::sleep(time::Duration::from_millis(20));
        assert_eq!(cameras.states()[0].frames, 1, "the second one waits");
        // The second one may come at once.
        let first = cameras.take_within(time::Duration::ZERO).unwrap();
        assert_eq!(first.frame.captured.micros(), 1);
        putting.join().unwrap();
        assert_eq!(taken(&cameras), [2]);
        assert_eq!(cameras.states()[0].skipped, 0);
    }
}
