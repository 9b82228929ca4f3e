//! What became of the cameras' poses during a run.

use std::fmt;

use serde::Serialize;

/// A movement of a camera that was noticed.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CameraMove {
    /// The camera's index.
    pub camera: usize,
    /// "knocked", and out of use; "returned" into use; "drifted", and corrected; or "disputed", because it
    /// contradicts another camera.
    pub what: &'static str,
    /// When it was noticed, in seconds of the run.
    pub at_s: f64,
    /// How far it has moved since its pose was last known, in metres; `None` if that can't be told.
    pub shift_m: Option<f64>,
    /// The angle by which it has turned since, in degrees.
    pub turn_deg: Option<f64>,
    /// The pose found: x, y and z in metres, heading, tilt and roll in degrees; `None` unless it is known.
    pub pose: Option<[f64; 6]>,
}

impl CameraMove {
    /// The movement of a camera with this name.
    pub(super) fn write(&self, name: impl fmt::Display, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "camera {name}: {} at {:.1} s", self.what, self.at_s)?;
        if let (Some(metres), Some(degrees)) = (self.shift_m, self.turn_deg) {
            write!(f, ", by {:.1} cm and {degrees:.2} degrees", 100.0 * metres)?;
        }
        Ok(())
    }
}

impl fmt::Display for CameraMove {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.write(self.camera, f)
    }
}
