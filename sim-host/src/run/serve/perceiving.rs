//! Perception in a thread of its own: it takes the newest frame of each camera in turn, so that it looks
//! at fewer frames when it can't keep up.

use std::{
    sync::{Arc, Mutex, PoisonError, mpsc},
    thread, time,
};

use ubimap_protocol::{
    time::Instant,
    units::{Pose, RobotId},
};

use super::{
    cameras::{Arrived, Cameras},
    message::{Message, Perceived},
};
use crate::{
    camera::{Frame, Observation},
    channel::{intake::Feed, wire::WireError},
    perception::{Observer, robots::RegistryError},
    run::RunError,
};

/// How long the thread waits for a frame before it checks whether the server is still there.
const CHECK_INTERVAL: time::Duration = time::Duration::from_millis(200);

/// The poses that robots report themselves, for perception.
#[derive(Clone, Debug, Default)]
pub(super) struct Told(Arc<Mutex<Vec<(RobotId, Pose)>>>);

impl Told {
    pub(super) fn set(&self, poses: Vec<(RobotId, Pose)>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = poses;
    }

    fn get(&self) -> Vec<(RobotId, Pose)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Starts the thread, in which `observer` makes the observer: it can't be moved between threads. `numbers` are the observer's numbers of the cameras; `None` for one without a
/// pose, which is not looked at. The thread ends with the feed's queue.
///
/// # Errors
/// [`RunError::Registry`] of `observer`; [`RunError::Port`] if no thread can be started.
pub(super) fn start(
    cameras: Arc<Cameras>,
    observer: impl FnOnce() -> Result<Observer, RegistryError> + Send + 'static,
    numbers: Vec<Option<usize>>,
    told: Told,
    feed: Feed<Message>,
    began: time::Instant,
) -> Result<(), RunError> {
    let (made, is_made) = mpsc::channel();
    let work = move || {
        let mut observer = match observer() {
            Ok(observer) => observer,
            Err(error) => {
                // The starter waits for it.
                let _ = made.send(Err(error));
                return;
            }
        };
        if made.send(Ok(())).is_err() {
            return;
        }
        // The last known pose of each camera.
        let pose = |number| observer.standing(number).and_then(|(_, it)| it.pose().copied());
        let mut stood: Vec<_> = (0..numbers.len()).map(pose).collect();
        loop {
            let Some(Arrived { frame, at }) = cameras.take_within(CHECK_INTERVAL) else {
                if feed.send(Message::Idle) {
                    continue;
                }
                return;
            };
            let camera = frame.camera;
            let Some(number) = numbers.get(camera).copied().flatten() else { continue };
            let now = Instant(began.elapsed().as_micros() as u64);
            let frame = Frame { camera: number, ..frame };
            let (observation, fault) = observer.observe(&frame, now, told.get());
            let observation = Observation { camera, ..observation };
            let mut moves = Vec::new();
            while let Some((captured, number, change)) = observer.poll_change() {
                let now = observer.standing(number).and_then(|(_, it)| it.pose().copied());
                moves.push((captured, change, std::mem::replace(&mut stood[number], now)));
            }
            let events = std::iter::from_fn(|| observer.poll_event()).collect();
            let perceived = Perceived { observation, events, moves, fault, arrived: at };
            if !feed.send(Message::Perceived(Box::new(perceived))) {
                return;
            }
        }
    };
    let spawned = thread::Builder::new().name("perception".into()).spawn(work);
    spawned.map_err(|reason| WireError::Io { name: "perception".into(), reason })?;
    // The thread answers before it waits for anything.
    is_made.recv().map_or(Ok(()), |made| Ok(made?))
}
