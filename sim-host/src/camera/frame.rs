//! A frame of a camera, and the door through which frames come.

use image::{GrayImage, ImageBuffer, Luma, RgbImage};
use ubimap_protocol::time::Instant;

use super::Calibration;

/// Depth along the optical axis, in millimetres for each pixel; zero where nothing came back.
pub type DepthImage = ImageBuffer<Luma<u16>, Vec<u16>>;

/// A picture.
#[derive(Clone, Debug, PartialEq)]
pub enum Picture {
    /// Of a grey camera.
    Grey(GrayImage),
    /// Of a colour camera.
    Colour(RgbImage),
}

/// What one camera captured at one moment.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Which camera, numbered from zero: the place of its [`Calibration`].
    pub camera: usize,
    /// When it was captured, in the server's clock.
    pub captured: Instant,
    /// What the depth sensor saw.
    pub depth: Option<DepthImage>,
    /// What the colour or grey sensor saw.
    pub picture: Option<Picture>,
}

/// A source of frames: simulated cameras, a recording, or real ones. Frames may arrive late, out of
/// order, or not at all.
pub trait FrameSource {
    /// The cameras.
    fn cameras(&self) -> &[Calibration];

    /// The next frame that has arrived by `now` (server's clock), in order of arrival.
    fn poll(&mut self, now: Instant) -> Option<Frame>;

    /// When the next frame will arrive, or `None` if there will be no more.
    fn next_arrival(&self) -> Option<Instant>;
}
