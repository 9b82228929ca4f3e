//! Lines, discs and text on an image, in pixels from its upper left corner.

use std::convert::Infallible;

use embedded_graphics::{
    Drawable, Pixel,
    draw_target::DrawTarget,
    geometry::{OriginDimensions, Point, Size},
    mono_font::{MonoFont, MonoTextStyle, ascii},
    pixelcolor::Rgb888,
    prelude::RgbColor,
    text::{Baseline, Text},
};
use image::{Rgb, RgbImage};

use super::palette::INK;

/// The font of titles.
pub(super) const LARGE: &MonoFont<'_> = &ascii::FONT_9X18_BOLD;
/// The font of everything else.
pub(super) const SMALL: &MonoFont<'_> = &ascii::FONT_8X13;

/// The width of a black edge in pixels.
const EDGE: f64 = 1.2;
/// Length of a dash, and of a dash with its gap, in pixels.
const DASH: f64 = 6.0;
const DASH_AND_GAP: f64 = 16.0;
/// Maximum length of a dashed line in pixels: a longer one can't be part of a picture.
const LONGEST: f64 = 1e5;

/// Draws an anti-aliased stroke with round ends. A stroke of zero length is a disc.
pub(super) fn stroke(
    image: &mut RgbImage,
    [from, to]: [[f64; 2]; 2],
    half_width: f64,
    colour: Rgb<u8>,
) {
    let reach = half_width + 1.0;
    let range = |axis: usize, end: u32| {
        let least = from[axis].min(to[axis]) - reach;
        let most = from[axis].max(to[axis]) + reach;
        // NaN becomes zero, which gives an empty or a one-pixel range, in which nothing is drawn.
        least.clamp(0.0, f64::from(end)) as u32..most.ceil().clamp(0.0, f64::from(end)) as u32
    };
    let (columns, rows) = (range(0, image.width()), range(1, image.height()));
    for y in rows {
        for x in columns.clone() {
            let away = distance([f64::from(x) + 0.5, f64::from(y) + 0.5], from, to);
            let cover = (half_width + 0.5 - away).clamp(0.0, 1.0);
            if cover > 0.0 {
                let pixel = image.get_pixel_mut(x, y);
                for (old, new) in pixel.0.iter_mut().zip(colour.0) {
                    *old = (f64::from(*old) * (1.0 - cover) + f64::from(new) * cover).round() as u8;
                }
            }
        }
    }
}

/// Draws a line along points, with a black edge.
pub(super) fn edged_line(
    image: &mut RgbImage,
    points: &[[f64; 2]],
    half_width: f64,
    colour: Rgb<u8>,
) {
    // Draws the whole edge first, so that it does not cover the line.
    for (half_width, colour) in [(half_width + EDGE, INK), (half_width, colour)] {
        for step in points.windows(2) {
            stroke(image, [step[0], step[1]], half_width, colour);
        }
    }
}

/// Draws a dashed line along points, with a black edge.
pub(super) fn dashed_line(
    image: &mut RgbImage,
    points: &[[f64; 2]],
    half_width: f64,
    colour: Rgb<u8>,
) {
    let mut walked = 0.0;
    let mut dash: Vec<[f64; 2]> = Vec::new();
    for step in points.windows(2) {
        let [from, to] = [step[0], step[1]];
        let length = (to[0] - from[0]).hypot(to[1] - from[1]);
        if length.is_nan() || length > LONGEST {
            continue;
        }
        let pieces = length.ceil().max(1.0);
        for piece in 0..=pieces as usize {
            let part = piece as f64 / pieces;
            let is_drawn = (walked + part * length) % DASH_AND_GAP < DASH;
            if is_drawn {
                dash.push([0, 1].map(|axis| from[axis] + part * (to[axis] - from[axis])));
            } else if !dash.is_empty() {
                edged_line(image, &[dash[0], dash[dash.len() - 1]], half_width, colour);
                dash.clear();
            }
        }
        walked += length;
    }
    if let (Some(&first), Some(&last)) = (dash.first(), dash.last()) {
        edged_line(image, &[first, last], half_width, colour);
    }
}

/// Draws a disc with a black edge.
pub(super) fn edged_disc(image: &mut RgbImage, centre: [f64; 2], radius: f64, colour: Rgb<u8>) {
    stroke(image, [centre; 2], radius, INK);
    stroke(image, [centre; 2], radius - EDGE, colour);
}

/// Fills the part of a rectangle inside the image.
pub(super) fn fill(
    image: &mut RgbImage,
    [x, y]: [i64; 2],
    [width, height]: [u32; 2],
    colour: Rgb<u8>,
) {
    for row in y.max(0)..(y + i64::from(height)).min(image.height().into()) {
        for column in x.max(0)..(x + i64::from(width)).min(image.width().into()) {
            image.put_pixel(column as u32, row as u32, colour);
        }
    }
}

/// Draws black text with this upper left corner. ASCII only; other letters become question marks.
pub(super) fn write(image: &mut RgbImage, [x, y]: [i64; 2], text: &str, font: &MonoFont<'_>) {
    let style = MonoTextStyle::new(font, Rgb888::BLACK);
    let [x, y] = [x, y].map(|it| it.clamp(i32::MIN.into(), i32::MAX.into()) as i32);
    let text = Text::with_baseline(text, Point::new(x, y), style, Baseline::Top);
    // Drawing on an image can't fail.
    let Ok(_) = text.draw(&mut Pixels(image));
}

/// Width and height of a text in pixels.
pub(super) fn size(text: &str, font: &MonoFont<'_>) -> [u32; 2] {
    let letter = font.character_size;
    [(letter.width + font.character_spacing) * text.chars().count() as u32, letter.height]
}

/// Adapts an image to `embedded-graphics`.
struct Pixels<'i>(&'i mut RgbImage);

impl OriginDimensions for Pixels<'_> {
    fn size(&self) -> Size {
        Size::new(self.0.width(), self.0.height())
    }
}

impl DrawTarget for Pixels<'_> {
    type Color = Rgb888;
    type Error = Infallible;

    fn draw_iter<I>(&mut self, pixels: I) -> Result<(), Infallible>
    where
        I: IntoIterator<Item = Pixel<Rgb888>>,
    {
        for Pixel(Point { x, y }, colour) in pixels {
            let pixel = u32::try_from(x).ok().zip(u32::try_from(y).ok());
            if let Some(pixel) = pixel.and_then(|(x, y)| self.0.get_pixel_mut_checked(x, y)) {
                *pixel = Rgb([colour.r(), colour.g(), colour.b()]);
            }
        }
        Ok(())
    }
}

/// The distance from a point to the line segment between `from` and `to`.
fn distance(point: [f64; 2], from: [f64; 2], to: [f64; 2]) -> f64 {
    let (x, y) = (to[0] - from[0], to[1] - from[1]);
    let length_squared = x * x + y * y;
    let along = if length_squared > 0.0 {
        (((point[0] - from[0]) * x + (point[1] - from[1]) * y) / length_squared).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (point[0] - from[0] - along * x).hypot(point[1] - from[1] - along * y)
}
