//! The frames of a run written down, so that `ubimap watch` can play them again.

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

/// A folder that frames are written to.
#[derive(Debug)]
pub struct Recording {
    recorder: Recorder,
    fault: Option<LogError>,
}

impl Recording {
    /// Makes the folder, with all in it but the frames.
    ///
    /// # Errors
    /// [`RunError::Log`] if it can't be written to, or holds something already.
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

/// A stage whose frames are recorded as they come, if that is asked for.
#[derive(Debug)]
pub struct Recorded<S> {
    /// The stage.
    pub stage: S,
    /// Where its frames go.
    pub recording: Option<Recording>,
}

impl<S> Recorded<S> {
    /// The stage, when all is over.
    ///
    /// # Errors
    /// [`RunError::Log`] if a frame could not be written. The stage has ended with it.
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

    fn drive(&mut self, moment: Instant, robot: usize, command: DriveCommand) {
        self.stage.drive(moment, robot, command);
    }
}
