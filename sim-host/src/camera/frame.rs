//! A camera's frame, and the trait of all sources of frames.

use image::{GrayImage, ImageBuffer, Luma, RgbImage};
use ubimap_protocol::time::Instant;

use super::Calibration;

/// Depth along the optical axis of each pixel, in millimetres; zero means no measurement.
pub type DepthImage = ImageBuffer<Luma<u16>, Vec<u16>>;

/// An image from a colour or grey sensor.
#[derive(Clone, Debug, PartialEq)]
pub enum Picture {
    /// A grey image.
    Grey(GrayImage),
    /// A colour image.
    Colour(RgbImage),
}

/// The images that one camera captured at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// The camera's index, from zero, in [`FrameSource::cameras`].
    pub camera: usize,
    /// When it was captured, in the server's clock.
    pub captured: Instant,
    /// The image of the depth sensor.
    pub depth: Option<DepthImage>,
    /// The image of the colour or grey sensor.
    pub picture: Option<Picture>,
}

/// A source of frames: simulated cameras, a recording, or real ones. Frames may arrive late, out of
/// order, or not at all.
pub trait FrameSource {
    /// The calibrations of the cameras, by index.
    fn cameras(&self) -> &[Calibration];

    /// The next frame that has arrived by `now` (server's clock), in order of arrival.
    fn poll(&mut self, now: Instant) -> Option<Frame>;

    /// When the next frame will arrive, or `None` if there will be no more.
    fn next_arrival(&self) -> Option<Instant>;
}
