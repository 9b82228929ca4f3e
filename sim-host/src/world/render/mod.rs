//! Renders the frames of simulated cameras.
//!
//! Upright prisms are drawn one by one into a depth buffer (`pinhole`: which pixels, `solid`: ray
//! intersections, `canvas`: the nearest wins). The static room is rendered once per camera. For each frame
//! the moving parts are drawn into a copy, `noise` is added, and the copy is restored where something
//! was drawn. A `grey_camera` on a robot renders all of each picture.

mod camera;
mod canvas;
mod grey_camera;
mod noise;
mod paint;
mod pinhole;
mod scene;
mod solid;

pub(super) use camera::FrameCamera;
pub(super) use grey_camera::GreyCamera;
pub(super) use paint::Paint;
pub(super) use scene::{Part, Scene};
