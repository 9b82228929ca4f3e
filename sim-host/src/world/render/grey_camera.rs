//! The grey camera that a robot carries low above the floor (Ahmed 2.1).

use image::GrayImage;
use nalgebra::Isometry3;
use rand_chacha::ChaCha8Rng;

use super::{
    camera::Imager,
    noise::PictureNoise,
    pinhole::Pinhole,
    scene::{Part, Scene},
};
use crate::camera::{CalibrationError, Intrinsics, Lens};

/// A camera that moves: each picture is rendered from scratch, without lens distortion.
pub(in super::super) struct GreyCamera {
    intrinsics: Intrinsics,
    imager: Imager,
    noise: PictureNoise,
}

impl GreyCamera {
    /// `noise` is the standard deviation of a pixel, in grey levels.
    pub(in super::super) fn new(
        intrinsics: Intrinsics,
        noise: f64,
        dice: &mut ChaCha8Rng,
    ) -> Result<Self, CalibrationError> {
        let pinhole = Pinhole::new(&Lens::new(intrinsics, Isometry3::identity())?);
        let imager = Imager::new(pinhole, 1);
        Ok(Self { intrinsics, imager, noise: PictureNoise::new(noise, dice) })
    }

    /// The picture of a scene from a pose: the camera's optical frame in `map`. `None` if the pose is
    /// not finite.
    pub(in super::super) fn take(
        &mut self,
        scene: &Scene,
        pose: Isometry3<f64>,
        dice: &mut ChaCha8Rng,
    ) -> Option<GrayImage> {
        let imager = &mut self.imager;
        imager.pinhole = Pinhole::new(&Lens::new(self.intrinsics, pose).ok()?);
        let whole = imager.pinhole.whole();
        imager.draw_room(&scene.room, &whole);
        imager.canvas = imager.room.clone();
        let parts: &[Part] = &scene.moving;
        imager.draw(parts);
        let Intrinsics { width, height, .. } = self.intrinsics;
        let mut soft = vec![0; width as usize * height as usize];
        imager.canvas.blur(&whole, &mut soft);
        let bytes = self.noise.add(&soft, width as usize, dice);
        GrayImage::from_raw(width, height, bytes)
    }
}
