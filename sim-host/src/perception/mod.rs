//! Perception: from camera frames to cells, objects and robots.
//!
//! An [`Eye`] is one fixed depth camera: its [`RayTable`] is computed once, its [`Background`] is learnt
//! from the empty room, and the [`Evidence`] of each image gives cells and objects. [`Tracks`] follow the
//! objects over all cameras. The [`robots::Localiser`] localises robots by their [`markers`]. The
//! [`Observer`] combines both, and leaves out cameras that no longer stand where they should
//! ([`steadiness`]). A [`FloorPlane`] is found without a pose, for the calibration.

mod background;
mod cells;
mod changes;
mod depth_sigma;
mod detector;
mod evidence;
mod eye;
mod floor_plane;
mod footprint;
pub mod markers;
mod motion;
mod observer;
mod ray_table;
mod rising;
pub mod robots;
pub mod steadiness;
#[cfg(test)]
mod testing;
mod things;
mod tracks;

pub use background::Background;
pub use detector::{Detection, Detector};
pub use evidence::{Evidence, Figure};
pub use eye::{Eye, FrameError};
pub use floor_plane::{DepthSamples, FloorError, FloorPlane};
pub use footprint::Footprint;
pub use observer::Observer;
pub use ray_table::{RayTable, Survey};
pub use tracks::{Lying, Track, Tracks};
