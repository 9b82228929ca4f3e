//! Recorded frames, played by the server's clock.

use std::{path::PathBuf, thread};

use super::live_source::{LiveFrame, LiveSource};
use crate::{
    camera::{Frame, FrameSource},
    channel::wire::WireError,
    recording::{FramesError, Reading, RecordedFrames},
    run::serve::clock::Clock,
};

/// Plays the frames of one or more cameras. The zero of the recording's time is that of the server's clock.
#[derive(Debug)]
pub(super) struct Player {
    frames: RecordedFrames,
    /// The index in the deployment of each camera of the recording.
    cameras: Vec<usize>,
    every_frame: bool,
}

impl Player {
    /// Opens the folders of cameras with these indices, each the folder of one camera.
    ///
    /// # Errors
    /// [`WireError::Open`] if a folder can't be read, or their clocks differ.
    pub(super) fn open(
        folders: Vec<(usize, PathBuf)>,
        every_frame: bool,
    ) -> Result<Self, WireError> {
        let (cameras, folders): (Vec<usize>, Vec<PathBuf>) = folders.into_iter().unzip();
        let refuse = |error: FramesError| WireError::Open {
            name: "recorded cameras".into(),
            reason: error.to_string(),
        };
        let frames = RecordedFrames::open_with(&folders, Reading::UNPLACED).map_err(refuse)?;
        Ok(Self { frames, cameras, every_frame })
    }
}

impl LiveSource for Player {
    fn next(&mut self, clock: &Clock) -> Option<LiveFrame> {
        while let Some(next) = self.frames.next_arrival() {
            // Read before it is due, so that reading does not delay it.
            let frame = self.frames.poll(next);
            thread::sleep(clock.until(next));
            if let Some(frame) = frame
                && let Some(&camera) = self.cameras.get(frame.camera)
            {
                let frame = Frame { camera, ..frame };
                let (at, waits) = (clock.now(), self.every_frame);
                return Some(LiveFrame { frame, at, sender: None, waits });
            }
        }
        match self.frames.take_fault() {
            Some(fault) => log::error!("the recording ends early: {fault}"),
            None => log::info!("the recording has ended"),
        }
        None
    }
}
