//! A camera that captures frames: the static room is rendered once, moving parts are drawn into it.

use std::sync::Arc;

use image::{GrayImage, RgbImage};
use nalgebra::Isometry3;
use rand_chacha::ChaCha8Rng;

use super::{
    canvas::Canvas,
    noise::{PictureNoise, StereoNoise},
    paint,
    paint::Paint,
    pinhole::{Pinhole, Rectangle},
    scene::{Part, Scene},
};
use crate::{
    camera::{Calibration, CalibrationError, DepthImage, DepthNoise, Intrinsics, Lens, Picture},
    world::{
        mounting::Mounting,
        room::Room,
        scenario::{CameraConfig, DepthConfig},
        shapes::Prism,
    },
};

/// A depth sensor with a picture sensor beside it.
pub(in super::super) struct FrameCamera {
    /// The sensors as they were calibrated.
    calibration: Calibration,
    /// The sensors where they really are.
    truth: Calibration,
    config: CameraConfig,
    dice: ChaCha8Rng,
    /// Bytes per pixel of a picture.
    channels: usize,
    /// Created for the first frame.
    drawing: Option<Drawing>,
}

/// The images that a camera has rendered.
struct Drawing {
    depth: Imager,
    picture: Imager,
    depth_noise: StereoNoise,
    picture_noise: PictureNoise,
    /// The room that was rendered.
    room: Arc<Room>,
    /// The room's picture after the lens blur.
    still: Vec<u8>,
    /// The blurred picture of the room, to which moving parts are added while a frame is captured.
    soft: Vec<u8>,
}

impl FrameCamera {
    /// A camera with grey or colour pictures.
    pub(in super::super) fn new(
        config: &CameraConfig,
        in_colour: bool,
        dice: ChaCha8Rng,
    ) -> Result<Self, CalibrationError> {
        let mounting = Mounting::new(config);
        let (depth, picture) = (&config.depth, &config.picture);
        let fields = [config.horizontal_fov_deg, config.vertical_fov_deg];
        let depth = mounting.lens(0.0, intrinsics(depth.width, depth.height, fields))?;
        let fields = [picture.horizontal_fov_deg, picture.vertical_fov_deg];
        let picture =
            mounting.lens(picture.left_m, intrinsics(picture.width, picture.height, fields))?;
        let DepthConfig { baseline_m, noise_px, .. } = config.depth;
        let depth_noise = DepthNoise::stereo(depth.intrinsics().fx, baseline_m, noise_px)?;
        let calibration = Calibration { depth: Some(depth), depth_noise, picture: Some(picture) };
        Ok(Self {
            calibration,
            truth: calibration,
            config: config.clone(),
            dice,
            channels: if in_colour { 3 } else { 1 },
            drawing: None,
        })
    }

    /// The calibration of the sensors whose images are published.
    pub(in super::super) fn calibration(&self) -> Calibration {
        let depth = self.calibration.depth.filter(|_| self.has_depth());
        Calibration { depth, ..self.calibration }
    }

    /// The pose of the depth sensor as it was calibrated.
    pub(in super::super) fn stated_pose(&self) -> Option<&Isometry3<f64>> {
        self.calibration.pose()
    }

    /// Moves the camera to another pose of its depth sensor, of which its calibration knows nothing.
    pub(in super::super) fn stand(&mut self, pose: &Isometry3<f64>) {
        if self.truth.pose() == Some(pose) {
            return;
        }
        // A pose in a scenario is finite.
        if let Ok(truth) = self.calibration.at(*pose) {
            self.truth = truth;
            if let (Some(drawing), Some(depth), Some(picture)) =
                (&mut self.drawing, &truth.depth, &truth.picture)
            {
                drawing.stand(depth, picture);
            }
        }
    }

    /// Whether the depth images are published.
    pub(in super::super) fn has_depth(&self) -> bool {
        self.config.has_depth
    }

    /// The depth image and picture of a scene, with noise drawn from `dice`.
    pub(in super::super) fn take(
        &mut self,
        scene: &Scene,
        dice: &mut ChaCha8Rng,
    ) -> Option<(DepthImage, Picture)> {
        Some(self.drawing(&scene.room)?.take(&scene.moving, dice))
    }

    /// The noise-free depths in metres, row by row.
    #[cfg(test)]
    pub(in super::super) fn exact_depth(&mut self, scene: &Scene) -> Vec<f32> {
        let drawing = self.drawing(&scene.room).unwrap();
        let drawn = drawing.depth.draw(&scene.moving);
        let depth = drawing.depth.canvas.depth.clone();
        drawing.depth.remove(&drawn);
        depth
    }

    /// The drawing of a room, rendered if necessary.
    fn drawing(&mut self, room: &Arc<Room>) -> Option<&mut Drawing> {
        let Calibration { depth: Some(depth), picture: Some(picture), .. } = &self.truth else {
            return None;
        };
        match &mut self.drawing {
            Some(drawing) => drawing.enter(room),
            None => {
                let focal = depth.intrinsics().fx;
                let mut drawing = Drawing {
                    depth: Imager::new(Pinhole::new(depth), 0),
                    picture: Imager::new(Pinhole::new(picture), self.channels),
                    depth_noise: StereoNoise::new(&self.config, focal, &mut self.dice),
                    picture_noise: PictureNoise::new(self.config.picture.noise, &mut self.dice),
                    room: room.clone(),
                    still: Vec::new(),
                    soft: Vec::new(),
                };
                drawing.redraw(|sensor| vec![sensor.pinhole.whole()]);
                self.drawing = Some(drawing);
            }
        }
        self.drawing.as_mut()
    }
}

impl Drawing {
    fn take(&mut self, moving: &[Part], dice: &mut ChaCha8Rng) -> (DepthImage, Picture) {
        let drawn = self.depth.draw(moving);
        let depth = self.depth_noise.image(&self.depth.canvas, self.depth.pinhole.width, dice);
        self.depth.remove(&drawn);

        let drawn = self.picture.draw(moving);
        let spread = drawn.iter().map(|drawn| drawn.grown().within(&self.picture.pinhole.whole()));
        let spread: Vec<Rectangle> = spread.collect();
        for rectangle in &spread {
            self.picture.canvas.blur(rectangle, &mut self.soft);
        }
        let Pinhole { width, height, .. } = self.picture.pinhole;
        let channels = self.picture.canvas.channels;
        let bytes = self.picture_noise.add(&self.soft, width * channels, dice);
        self.picture.remove(&drawn);
        for rectangle in &spread {
            for row in rectangle.top..rectangle.bottom {
                let from = (row * width + rectangle.left) * channels;
                let bytes = from..(row * width + rectangle.right) * channels;
                self.soft[bytes.clone()].copy_from_slice(&self.still[bytes]);
            }
        }
        let (width, height) = (width as u32, height as u32);
        let picture = if channels == 1 {
            Picture::Grey(GrayImage::from_raw(width, height, bytes).unwrap_or_default())
        } else {
            Picture::Colour(RgbImage::from_raw(width, height, bytes).unwrap_or_default())
        };
        (depth, picture)
    }

    /// Redraws the room as its sensors see it from another place.
    fn stand(&mut self, depth: &Lens, picture: &Lens) {
        self.depth.pinhole = Pinhole::new(depth);
        self.picture.pinhole = Pinhole::new(picture);
        self.redraw(|sensor| vec![sensor.pinhole.whole()]);
    }

    /// Redraws the regions where a new room differs from the last one.
    fn enter(&mut self, room: &Arc<Room>) {
        if Arc::ptr_eq(&self.room, room) {
            return;
        }
        let before = std::mem::replace(&mut self.room, room.clone());
        self.redraw(|sensor| sensor.changed(&before, room));
    }

    /// Redraws the room within the rectangles of each sensor.
    fn redraw(&mut self, within: impl Fn(&Imager) -> Vec<Rectangle>) {
        for sensor in [&mut self.depth, &mut self.picture] {
            for rectangle in within(sensor) {
                sensor.draw_room(&self.room, &rectangle);
            }
            sensor.canvas = sensor.room.clone();
        }
        let Imager { pinhole, room, .. } = &self.picture;
        self.still.resize(pinhole.width * pinhole.height * room.channels, 0);
        room.blur(&pinhole.whole(), &mut self.still);
        self.soft.clone_from(&self.still);
    }
}

/// The intrinsics of a pinhole from its horizontal and vertical fields of view.
fn intrinsics(width: u32, height: u32, [across, down]: [f64; 2]) -> Intrinsics {
    let level = Intrinsics::pinhole(width, height, across.to_radians());
    Intrinsics { fy: Intrinsics::pinhole(height, width, down.to_radians()).fx, ..level }
}

/// One of a camera's sensors.
pub(super) struct Imager {
    pub(super) pinhole: Pinhole,
    /// The static room.
    pub(super) room: Canvas,
    /// The room, with moving parts while a frame is captured.
    pub(super) canvas: Canvas,
}

impl Imager {
    pub(super) fn new(pinhole: Pinhole, channels: usize) -> Self {
        let canvas = Canvas::new(&pinhole, channels);
        Self { pinhole, room: canvas.clone(), canvas }
    }

    pub(super) fn draw_room(&mut self, room: &Room, clip: &Rectangle) {
        self.room.clear(&self.pinhole, room, clip);
        for (prism, key) in room.prisms().iter().zip(room.keys()) {
            let bounds = self.pinhole.bounds(prism).within(clip);
            if !bounds.is_empty() {
                let part = Part { prism: prism.clone(), paint: paint_of(key, room.shade()) };
                self.room.draw(&self.pinhole, &part, &bounds);
            }
        }
    }

    /// The regions where two rooms look different.
    fn changed(&self, before: &Room, after: &Room) -> Vec<Rectangle> {
        let same = |a: &Prism, b: &Prism| {
            (a.bottom, a.top) == (b.bottom, b.top) && a.footprint.rim() == b.footprint.rim()
        };
        let pairs = before.prisms().iter().zip(after.prisms());
        pairs
            .filter(|(a, b)| !same(a, b))
            .flat_map(|(a, b)| [self.pinhole.bounds(a), self.pinhole.bounds(b)])
            .filter(|bounds| !bounds.is_empty())
            .collect()
    }

    /// Draws moving parts and returns their regions.
    pub(super) fn draw(&mut self, parts: &[Part]) -> Vec<Rectangle> {
        let bounds = parts.iter().map(|part| self.pinhole.bounds(&part.prism));
        let bounds: Vec<Rectangle> = bounds.collect();
        for (part, bounds) in parts.iter().zip(&bounds).filter(|(_, bounds)| !bounds.is_empty()) {
            self.canvas.draw(&self.pinhole, part, bounds);
        }
        bounds.into_iter().filter(|bounds| !bounds.is_empty()).collect()
    }

    /// Restores the room in the drawn regions.
    fn remove(&mut self, drawn: &[Rectangle]) {
        for rectangle in drawn {
            self.canvas.restore(&self.room, rectangle);
        }
    }
}

/// The paint of the part of a room with this scenario key.
fn paint_of(key: &str, shade: Option<f64>) -> Paint {
    if let Some(shade) = shade {
        return Paint::grey(shade as f32);
    }
    if key.starts_with("room.") {
        return paint::WALL;
    }
    // Each piece of furniture gets a number from its key.
    let number = key.bytes().fold(1_u32, |sum, byte| sum.wrapping_mul(31) + u32::from(byte));
    Paint::numbered(number)
}
