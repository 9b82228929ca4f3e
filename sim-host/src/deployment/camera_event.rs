//! Events about the cameras' poses.

use core::fmt;

use nalgebra::Isometry3;

use crate::{camera::Orientation, perception::steadiness::Change};

/// A camera has moved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraEvent {
    /// The camera's index.
    pub camera: usize,
    /// What happened.
    pub kind: CameraEventKind,
    /// How far it has moved since its pose was last known, in metres and radians; `None` if that can't be
    /// told yet.
    pub way: Option<[f64; 2]>,
    /// Its pose in `map`, if it is known.
    pub pose: Option<Isometry3<f64>>,
}

/// The kinds of [`CameraEvent`]s.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CameraEventKind {
    /// It was knocked and is out of use: it neither localises nor maps.
    Knocked,
    /// Its new pose is known, and it is in use again.
    Returned,
    /// It has drifted; its pose was corrected.
    Drifted,
    /// It and another camera contradict each other, and it can't be told which was knocked. Both stay in use.
    Disputed,
}

impl CameraEvent {
    /// The event of a change of a camera whose known pose was `before`.
    pub(super) fn new(camera: usize, change: &Change, before: Option<&Isometry3<f64>>) -> Self {
        let (kind, pose) = match *change {
            Change::Knocked { pose, .. } => (CameraEventKind::Knocked, pose),
            Change::Returned(pose) => (CameraEventKind::Returned, Some(pose)),
            Change::Drifted(pose) => (CameraEventKind::Drifted, Some(pose)),
            Change::Disputed => (CameraEventKind::Disputed, None),
        };
        let way = before.zip(pose).map(|(before, pose)| {
            let way = before.inv_mul(&pose);
            [way.translation.vector.norm(), way.rotation.angle()]
        });
        let pose = pose.filter(|_| kind != CameraEventKind::Knocked);
        Self { camera, kind, way, pose }
    }

    /// The log level of the event.
    pub fn level(&self) -> log::Level {
        match self.kind {
            CameraEventKind::Knocked | CameraEventKind::Returned | CameraEventKind::Disputed => {
                log::Level::Warn
            }
            CameraEventKind::Drifted => log::Level::Info,
        }
    }
}

impl fmt::Display for CameraEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let way = self.way.map_or("an unknown way".to_owned(), |[metres, radians]| {
            format!("{:.1} cm and {:.2} degrees", 100.0 * metres, radians.to_degrees())
        });
        let camera = self.camera;
        match self.kind {
            CameraEventKind::Knocked => write!(
                f,
                "camera {camera} was knocked by {way}: it is out of use until its new pose is known; clear \
                 its view, and let robots drive there"
            )?,
            CameraEventKind::Returned => {
                write!(f, "camera {camera} is in use again, after it was moved by {way}")?;
            }
            CameraEventKind::Drifted => write!(f, "camera {camera} has drifted by {way}")?,
            CameraEventKind::Disputed => write!(
                f,
                "camera {camera} sees robots elsewhere than its neighbour does, and their bare floors can't tell \
                 which of the two was knocked: calibrate both"
            )?,
        }
        let Some(pose) = self.pose else { return Ok(()) };
        let at = pose.translation.vector;
        let Orientation { heading_rad, tilt_rad, roll_rad } = Orientation::of(&pose.rotation);
        write!(
            f,
            ", to position_m = [{:.4}, {:.4}, {:.4}], heading_deg = {:.3}, tilt_deg = {:.3}, roll_deg = {:.3}",
            at.x,
            at.y,
            at.z,
            heading_rad.to_degrees(),
            tilt_rad.to_degrees(),
            roll_rad.to_degrees()
        )
    }
}
