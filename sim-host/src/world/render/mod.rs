//! Frames of the simulated cameras: what their sensors would give.
//!
//! Upright prisms are drawn one after the other into an image of depths (`pinhole`: which pixels,
//! `solid`: where their rays meet, `canvas`: the nearest wins). The room is drawn once for each
//! camera; for a frame what moves is drawn into a copy, `noise` is added, and the copy is mended
//! where something was drawn.

mod camera;
mod canvas;
mod noise;
mod paint;
mod pinhole;
mod scene;
mod solid;

pub(super) use camera::FrameCamera;
pub(super) use paint::Paint;
pub(super) use scene::{Part, Scene};
