//! Maps as pictures. North (`map`'s y) is up.
//!
//! | file | subject |
//! |---|---|
//! | `palette` | the colours, and which of them are too similar to be adjacent |
//! | `strokes` | lines, discs and text |
//! | `canvas` | a grid as pixels, and places of `map` on it |
//! | `marker` | robots, people and cameras |
//! | `caption` | title, scale bar and legend below a picture |
//! | `views` | the pictures themselves |
//!
//! Adjacent colours have a contrast of at least 3:1, also for colour-blind people. Only three
//! levels of luminance are possible with that contrast, so a black line separates cells of the same
//! level, and everything drawn over the cells has a black edge.

mod canvas;
mod caption;
mod marker;
mod palette;
mod strokes;
mod views;

use image::{
    RgbImage,
    codecs::png::{CompressionType, FilterType, PngEncoder},
};

pub use caption::Caption;
pub use marker::{Marker, MarkerKind};
pub use views::{
    Against, Moment, render, render_coverage, render_error, render_frames, render_overlap,
    render_volatility,
};

/// Encodes a picture as PNG. Flat colours compress best without filters.
pub fn png(image: &RgbImage) -> Result<Vec<u8>, image::ImageError> {
    let mut bytes = Vec::new();
    let encoder =
        PngEncoder::new_with_quality(&mut bytes, CompressionType::Best, FilterType::NoFilter);
    image.write_with_encoder(encoder)?;
    Ok(bytes)
}
