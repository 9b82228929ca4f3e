//! Frames of the simulated cameras: what their sensors would give.
//!
//! Upright prisms are drawn one after the other into an image of depths (`view`: which pixels,
//! `solid`: where their rays meet, `canvas`: the nearest wins). The room is drawn once for each
//! camera; for a frame what moves is drawn into a copy, `noise` is added, and the copy is mended
//! where something was drawn.

mod camera;
mod canvas;
mod noise;
mod paint;
mod solid;
mod view;

use std::sync::Arc;

use super::{room::Room, shapes::Prism};

pub(super) use camera::FrameCamera;
pub(super) use paint::Paint;

/// A part of something that is seen.
#[derive(Clone, Debug)]
pub(super) struct Part {
    pub(super) prism: Prism,
    pub(super) paint: Paint,
}

/// All that cameras can see at one moment.
pub(super) struct Scene {
    pub(super) room: Arc<Room>,
    pub(super) moving: Vec<Part>,
}
