//! Perception in a thread of its own: it takes the newest frame of each camera in turn, so that it looks
//! at fewer frames when it can't keep up.

use std::{
    sync::{Arc, mpsc},
    thread, time,
};

use super::{
    cameras::{Arrived, Cameras},
    message::{Message, Move, Perceived},
};
use crate::{
    camera::{Frame, Observation},
    channel::{intake::Feed, wire::WireError},
    perception::{Observer, robots::RegistryError},
    run::RunError,
};

/// How long the thread waits for a frame before it checks whether the server is still there.
const CHECK_INTERVAL: time::Duration = time::Duration::from_millis(200);

/// Starts the thread, in which `observer` makes the observer, which can't be moved between threads. `numbers`
/// are the observer's numbers of the cameras; `None` for one without a pose, which is not looked at. The
/// thread ends with the feed's queue.
///
/// It works as [`Deployment::frame`](crate::deployment::Deployment::frame) does: before each frame it asks the
/// core where the robots are, and the core has then processed all frames before. So the results depend on the
/// frames alone, and not on the threads' pace.
///
/// # Errors
/// [`RunError::Registry`] of `observer`; [`RunError::Port`] if no thread can be started.
pub(super) fn start(
    cameras: Arc<Cameras>,
    observer: impl FnOnce() -> Result<Observer, RegistryError> + Send + 'static,
    numbers: Vec<Option<usize>>,
    feed: Feed<Message>,
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
        // The cameras that are looked at, and the last known pose of each.
        let used: Vec<usize> =
            (0..numbers.len()).filter(|&camera| numbers[camera].is_some()).collect();
        let pose = |observer: &Observer, number| {
            observer.standing(number).and_then(|(_, it)| it.pose().copied())
        };
        let mut stood: Vec<_> = (0..used.len()).map(|number| pose(&observer, number)).collect();
        loop {
            let Some(Arrived { frame, at }) = cameras.take_within(CHECK_INTERVAL) else {
                if feed.send(Message::Idle) {
                    continue;
                }
                return;
            };
            let camera = frame.camera;
            let Some(number) = numbers.get(camera).copied().flatten() else { continue };
            let frame = Frame { camera: number, ..frame };
            let (answer, answered) = mpsc::channel();
            if !feed.send(Message::Whereabouts(frame.captured, answer)) {
                return;
            }
            let Ok(told) = answered.recv() else { return };
            let (observation, fault) = observer.observe(&frame, at, told);
            let observation = Observation { camera, ..observation };
            let mut moves = Vec::new();
            while let Some((captured, number, change)) = observer.poll_change() {
                let now = pose(&observer, number);
                let before = std::mem::replace(&mut stood[number], now);
                moves.push(Move { camera: used[number], captured, change, before });
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
