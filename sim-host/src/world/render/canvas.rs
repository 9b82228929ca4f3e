//! The image buffer of one sensor: a depth for each pixel and, for pictures, its light.

use parry2d_f64::glamx::{Vec2, Vec3};

use super::{
    super::{marker::Colour, room::Room},
    paint::{self, Paint},
    pinhole::{Pinhole, Rectangle},
    scene::Part,
    solid::{Face, Hit, Solid},
};

/// Rays per pixel in each direction where a marker is.
const RAYS: usize = 3;

/// An image that is being rendered.
#[derive(Clone)]
pub(super) struct Canvas {
    width: usize,
    /// Depth along the optical axis in metres; infinite where there is nothing.
    pub(super) depth: Vec<f32>,
    /// Bytes of light per pixel: none for a depth sensor, one for grey, three for colour.
    pub(super) channels: usize,
    pub(super) light: Vec<u8>,
}

impl Canvas {
    pub(super) fn new(pinhole: &Pinhole, channels: usize) -> Self {
        let pixels = pinhole.width * pinhole.height;
        Self {
            width: pinhole.width,
            depth: vec![f32::INFINITY; pixels],
            channels,
            light: vec![0; pixels * channels],
        }
    }

    /// Draws an empty room: floor and ceiling.
    pub(super) fn clear(&mut self, pinhole: &Pinhole, room: &Room, clip: &Rectangle) {
        let (ceiling, is_seamless) = (room.height(), room.is_seamless());
        for row in clip.top..clip.bottom {
            self.depth[row * self.width..][clip.left..clip.right].fill(f32::INFINITY);
        }
        let (floor, ceiling) = (-pinhole.eye.z as f32, (ceiling - pinhole.eye.z) as f32);
        self.each(pinhole, clip, |way, _| {
            let (height, face) =
                if way.z < 0.0 { (floor, Face::Top) } else { (ceiling, Face::Bottom) };
            let colour = move |point| match face {
                Face::Top => paint::floor(point, is_seamless),
                _ => paint::CEILING,
            };
            (way.z != 0.0).then(|| (Hit { at: height / way.z, face }, colour))
        });
    }

    /// Draws the unoccluded pixels of a part within `clip`.
    pub(super) fn draw(&mut self, pinhole: &Pinhole, part: &Part, clip: &Rectangle) {
        let solid = Solid::new(&part.prism, pinhole.eye);
        let eye = pinhole.eye.as_vec3();
        let pixel = 1.0 / pinhole.focal() as f32;
        self.each(pinhole, clip, |way, limit| {
            let hit = solid.hit(way, limit)?;
            let colour = move |point: Vec3| {
                if part.paint.is_fine(point, hit.face, hit.at * pixel) {
                    on_a_pixel(pinhole, &part.paint, eye, way, point.z)
                } else {
                    part.paint.colour(point, hit.face)
                }
            };
            Some((hit, colour))
        });
    }

    /// Casts a ray through each pixel. `cast` gets the ray's direction and the maximum depth, and returns
    /// the hit and a function for the colour there.
    fn each<C: FnOnce(Vec3) -> Colour>(
        &mut self,
        pinhole: &Pinhole,
        clip: &Rectangle,
        cast: impl Fn(Vec3, f32) -> Option<(Hit, C)>,
    ) {
        let eye = pinhole.eye.as_vec3();
        let half = Vec2::new(pinhole.width as f32, pinhole.height as f32) / 2.0;
        for row in clip.top..clip.bottom {
            for column in clip.left..clip.right {
                let way = pinhole.way(column as f32, row as f32);
                let index = row * self.width + column;
                let Some((hit, colour)) = cast(way, self.depth[index]) else { continue };
                self.depth[index] = hit.at;
                if self.channels == 0 {
                    continue;
                }
                let point = eye + way * hit.at;
                let aside = (Vec2::new(column as f32, row as f32) - half) / half.x;
                // Vignetting: the lens darkens the corners.
                let light = paint::light(point, hit.face) * (1.0 - 0.18 * aside.length_squared());
                let colour = colour(point);
                let bytes = &mut self.light[index * self.channels..][..self.channels];
                match bytes {
                    [grey] => *grey = (light * luminance(colour)) as u8,
                    _ => bytes
                        .iter_mut()
                        .zip(colour)
                        .for_each(|(byte, part)| *byte = (light * part) as u8),
                }
            }
        }
    }

    /// Copies a rectangle from another canvas of the same size.
    pub(super) fn restore(&mut self, from: &Self, rectangle: &Rectangle) {
        for row in rectangle.top..rectangle.bottom {
            let pixels = row * self.width + rectangle.left..row * self.width + rectangle.right;
            self.depth[pixels.clone()].copy_from_slice(&from.depth[pixels.clone()]);
            let bytes = pixels.start * self.channels..pixels.end * self.channels;
            self.light[bytes.clone()].copy_from_slice(&from.light[bytes]);
        }
    }

    /// Writes a rectangle of this picture with the blur of the lens: a 1-2-1 filter in both directions.
    pub(super) fn blur(&self, rectangle: &Rectangle, into: &mut [u8]) {
        let (stride, channels) = (self.width * self.channels, self.channels);
        let last = self.depth.len() / self.width - 1;
        let line = |row: usize| &self.light[row * stride..][..stride];
        let mut sums = vec![0_u16; stride + 2 * channels];
        for row in rectangle.top..rectangle.bottom {
            let (above, here, below) =
                (line(row.saturating_sub(1)), line(row), line((row + 1).min(last)));
            // One additional pixel on both sides; at the picture's edges the last one is repeated.
            let first = rectangle.left.saturating_sub(1) * channels;
            let end = (rectangle.right + 1).min(self.width) * channels;
            let within = &mut sums[first + channels..end + channels];
            let lines = above[first..end].iter().zip(&here[first..end]).zip(&below[first..end]);
            for (sum, ((above, here), below)) in within.iter_mut().zip(lines) {
                *sum = u16::from(*above) + 2 * u16::from(*here) + u16::from(*below);
            }
            sums.copy_within(channels..2 * channels, 0);
            sums.copy_within(stride..stride + channels, stride + channels);
            let bytes = rectangle.left * channels..rectangle.right * channels;
            let (left, middle, right) = (
                &sums[bytes.clone()],
                &sums[bytes.start + channels..bytes.end + channels],
                &sums[bytes.start + 2 * channels..bytes.end + 2 * channels],
            );
            let into = &mut into[row * stride..][bytes];
            for (((byte, left), middle), right) in into.iter_mut().zip(left).zip(middle).zip(right)
            {
                *byte = ((left + 2 * middle + right + 8) >> 4) as u8;
            }
        }
    }
}

/// The mean colour of a pixel on a robot's top.
fn on_a_pixel(pinhole: &Pinhole, paint: &Paint, eye: Vec3, way: Vec3, top: f32) -> Colour {
    let mut mean = [0.0; 3];
    for index in 0..RAYS * RAYS {
        let offset = |index: usize| (index as f32 + 0.5) / RAYS as f32 - 0.5;
        let way = way + pinhole.step(offset(index % RAYS), offset(index / RAYS));
        let point = eye + way * ((top - eye.z) / way.z);
        let colour = paint.colour(point, Face::Top);
        for (mean, part) in mean.iter_mut().zip(colour) {
            *mean += part / (RAYS * RAYS) as f32;
        }
    }
    mean
}

/// The luminance of a colour (ITU-R BT.601).
fn luminance([red, green, blue]: Colour) -> f32 {
    0.299 * red + 0.587 * green + 0.114 * blue
}
