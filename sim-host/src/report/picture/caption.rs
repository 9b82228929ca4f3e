//! The caption below a picture: title, scale bar and legend.

use std::fmt;

use image::{Rgb, RgbImage};

use super::{
    marker::{MarkerKind, symbol},
    palette::{CAMERA, INK, PAPER, ROBOT},
    strokes::{LARGE, SMALL, edged_line, fill, size, write},
};

/// Space around a text, in pixels.
const GAP: u32 = 10;
const LINE: u32 = 24;
/// Side of a sample in the legend, in pixels.
const SAMPLE: u32 = 16;
/// Minimum width of a caption in pixels. If the picture is wider, the caption is as wide as the
/// picture.
const LEAST_WIDTH: u32 = 480;
/// Maximum length of the scale bar in pixels.
const LONGEST_BAR: f64 = 200.0;

/// The source and the time of a picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Caption {
    /// The name of the scenario, log or recording.
    pub subject: String,
    /// The seed of the run, if there was one.
    pub seed: Option<u64>,
    /// The time shown, in seconds since the start of the run, if there was a run.
    pub time_s: Option<f64>,
}

/// Formats as "room, seed 2, after 120.0 s".
impl fmt::Display for Caption {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.subject)?;
        if let Some(seed) = self.seed {
            write!(f, ", seed {seed}")?;
        }
        if let Some(time_s) = self.time_s {
            write!(f, ", after {time_s:.1} s")?;
        }
        Ok(())
    }
}

/// An entry of a legend: a sample and what it stands for.
pub(super) type Entry = (Sample, &'static str);

/// The symbol or colour in front of an entry of a legend.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Sample {
    /// A cell of this colour.
    Cell(Rgb<u8>),
    Marker(MarkerKind),
    Path,
    View,
}

/// A picture with its caption below it.
pub(super) fn with_caption(
    picture: &RgbImage,
    pixels_per_m: f64,
    title: &str,
    legend: &[Entry],
) -> RgbImage {
    let width = picture.width().max(LEAST_WIDTH);
    let lines = wrapped(legend, width);
    let height = picture.height() + GAP + LINE * (1 + lines.len() as u32) + GAP / 2;
    let mut image = RgbImage::from_pixel(width, height, PAPER);
    image::imageops::replace(&mut image, picture, 0, 0);
    let mut top = picture.height() + GAP;
    scale_bar(&mut image, pixels_per_m, top);
    write(&mut image, [GAP, top].map(i64::from), title, LARGE);
    for line in lines {
        top += LINE;
        let mut left = GAP;
        for entry in line {
            draw_sample(&mut image, entry.0, [left, top]);
            let at = [left + SAMPLE + GAP / 2, top + 2].map(i64::from);
            write(&mut image, at, entry.1, SMALL);
            left += width_of(entry);
        }
    }
    image
}

/// A picture with only a title below it.
pub(super) fn with_title(picture: &RgbImage, title: &str) -> RgbImage {
    let [width, height] = [picture.width(), picture.height() + LINE];
    let mut image = RgbImage::from_pixel(width, height, PAPER);
    image::imageops::replace(&mut image, picture, 0, 0);
    write(&mut image, [GAP, picture.height() + 3].map(i64::from), title, SMALL);
    image
}

/// Breaks the entries into lines of at most `width` pixels.
fn wrapped(legend: &[Entry], width: u32) -> Vec<Vec<&Entry>> {
    let mut lines: Vec<Vec<&Entry>> = Vec::new();
    let mut left = u32::MAX / 2;
    for entry in legend {
        if left + width_of(entry) > width {
            lines.push(Vec::new());
            left = GAP;
        }
        left += width_of(entry);
        if let Some(line) = lines.last_mut() {
            line.push(entry);
        }
    }
    lines
}

fn width_of((_, text): &Entry) -> u32 {
    SAMPLE + GAP / 2 + size(text, SMALL)[0] + 2 * GAP
}

/// Draws a sample with this upper left corner.
fn draw_sample(image: &mut RgbImage, sample: Sample, [left, top]: [u32; 2]) {
    let side = f64::from(SAMPLE);
    let at = |x: f64, y: f64| [f64::from(left) + x * side, f64::from(top) + y * side];
    match sample {
        Sample::Cell(colour) => {
            fill(image, [left, top].map(i64::from), [SAMPLE; 2], INK);
            fill(image, [left + 1, top + 1].map(i64::from), [SAMPLE - 2; 2], colour);
        }
        Sample::Marker(kind) => {
            // A camera's reaches ahead of its place.
            let (centre, radius) = match kind {
                MarkerKind::Camera => (at(0.2, 0.5), 0.4 * side),
                _ => (at(0.5, 0.5), 0.5 * side),
            };
            symbol(image, kind, centre, radius, 0.0);
        }
        Sample::Path => edged_line(image, &[at(0.1, 0.5), at(0.9, 0.5)], 1.3, ROBOT),
        Sample::View => {
            for [from, to] in [[0.0, 0.35], [0.65, 1.0]] {
                edged_line(image, &[at(from, 0.5), at(to, 0.5)], 0.8, CAMERA);
            }
        }
    }
}

/// Draws a scale bar of a round length at the right edge, with its length as text to the left of
/// it.
fn scale_bar(image: &mut RgbImage, pixels_per_m: f64, top: u32) {
    let Some(length_m) = round_length(LONGEST_BAR / pixels_per_m) else { return };
    let length = (length_m * pixels_per_m).round() as u32;
    let text = format!("{length_m} m");
    let right = image.width() - GAP;
    let [left, middle] = [right.saturating_sub(length), top + 8].map(i64::from);
    fill(image, [left, middle], [length, 3], INK);
    for tick in [left, i64::from(right) - 3] {
        fill(image, [tick, middle - 6], [3, 15], INK);
    }
    let [width, _] = size(&text, LARGE);
    write(image, [left - i64::from(width + GAP), top.into()], &text, LARGE);
}

/// The greatest number of the form 1, 2 or 5 times a power of ten that is at most `most_m`. `None`
/// if that is not positive and finite.
fn round_length(most_m: f64) -> Option<f64> {
    if !(most_m > 0.0 && most_m.is_finite()) {
        return None;
    }
    let power = most_m.log10().floor() as i32;
    // Divides for negative powers, because powers of 0.1 are not exact.
    let scaled = |digit: f64| {
        if power < 0 { digit / 10_f64.powi(-power) } else { digit * 10_f64.powi(power) }
    };
    [5.0, 2.0, 1.0].map(scaled).into_iter().find(|&length| length <= most_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scale_bar_has_a_round_length() {
        for (most, expected) in
            [(1.25, 1.0), (2.0, 2.0), (4.99, 2.0), (37.0, 20.0), (0.35, 0.2), (0.06, 0.05)]
        {
            assert_eq!(round_length(most), Some(expected));
        }
        assert_eq!([round_length(0.0), round_length(f64::NAN)], [None, None]);
    }

    #[test]
    fn a_scale_bar_is_as_long_as_it_says() {
        // At 160 pixels per metre, as in a room, the bar is one metre long.
        let picture = RgbImage::from_pixel(600, 10, INK);
        let image = with_caption(&picture, 160.0, "", &[]);
        let is_ink = |x: &u32| *image.get_pixel(*x, 10 + GAP + 9) == INK;
        // The text "1 m" is left of it, on the same rows.
        let bar = (425..600).filter(is_ink).count();
        assert_eq!(bar, 160);
    }

    #[test]
    fn a_caption_names_subject_seed_and_time() {
        let mut caption = Caption { subject: "room".into(), seed: Some(2), time_s: Some(120.04) };
        assert_eq!(caption.to_string(), "room, seed 2, after 120.0 s");
        caption.seed = None;
        assert_eq!(caption.to_string(), "room, after 120.0 s");
    }
}
