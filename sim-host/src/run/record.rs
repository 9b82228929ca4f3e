//! Records the frames of a run for `ubimap watch`.

use std::path::Path;

use ubimap_agent::drive::DriveCommand;
use ubimap_protocol::time::Instant;

use super::{
    RunError,
    fleet::{Event, Stage},
    robots_file,
};
use crate::{
    camera::Calibration,
    deployment::registry::Registry,
    recording::{LogError, Recorder},
};

/// A folder for recorded frames.
#[derive(Debug)]
pub struct Recording {
    recorder: Recorder,
    fault: Option<LogError>,
}

impl Recording {
    /// Creates the folder with all its files except the frames.
    ///
    /// # Errors
    /// [`RunError::Log`] if it can't be written to or is not empty.
    pub fn create(
        folder: &Path,
        cameras: &[Calibration],
        registry: &Registry,
    ) -> Result<Self, RunError> {
        let recorder = Recorder::create(folder, cameras)?;
        robots_file::write(registry, folder)?;
        Ok(Self { recorder, fault: None })
    }
}

/// A stage whose frames are optionally recorded as they arrive.
#[derive(Debug)]
pub struct Recorded<S> {
    /// The stage.
    pub stage: S,
    /// The recording, if any.
    pub recording: Option<Recording>,
}

impl<S> Recorded<S> {
    /// Ends the recording and returns the stage.
    ///
    /// # Errors
    /// [`RunError::Log`] if a frame could not be written; the stage ended there.
    pub fn finish(self) -> Result<S, RunError> {
        match self.recording.and_then(|recording| recording.fault) {
            Some(fault) => Err(fault.into()),
            None => Ok(self.stage),
        }
    }
}

impl<S: Stage> Stage for Recorded<S> {
    fn next_event(&self) -> Option<Instant> {
        let has_failed = self.recording.as_ref().is_some_and(|it| it.fault.is_some());
        if has_failed { None } else { self.stage.next_event() }
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        let event = self.stage.poll(now);
        if let (Some(Event::Frame(frame)), Some(Recording { recorder, fault: fault @ None })) =
            (&event, &mut self.recording)
        {
            *fault = recorder.write(frame, now).err();
        }
        event
    }

    fn wheels(&mut self, now: Instant, robot: usize) -> Option<([f64; 2], bool)> {
        self.stage.wheels(now, robot)
    }

    fn drive(&mut self, moment: Instant, robot: usize, command: DriveCommand) {
        self.stage.drive(moment, robot, command);
    }
}
