//! What robots with grey cameras measured.

use std::fmt;

use serde::Serialize;

/// The accuracy of grey cameras; only for simulations.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct VisionSummary {
    /// Number of pictures.
    pub pictures: u64,
    /// The calibration: as Ahmed's table 1, but in millimetres.
    pub scale: Vec<ScaleRow>,
    /// The errors by distance, from near to far.
    pub bands: Vec<VisionBand>,
}

/// A row of a scale table, with its fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ScaleRow {
    /// Pixels of free floor (d_r).
    pub pixels: u8,
    /// Distance to the object in the table's unit (d_c).
    pub distance: f64,
    /// The distance by the fitted curve.
    pub fitted: f64,
}

/// Errors of the boundaries at certain distances.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct VisionBand {
    /// The distances from the camera, in metres.
    pub from_m: f64,
    /// Their end.
    pub to_m: f64,
    /// Number of columns in which a boundary was measured.
    pub columns: u64,
    /// Median distance of a boundary's point from the true one, in millimetres.
    pub median_mm: f64,
    /// The distance that nine of ten points keep, in millimetres.
    pub ninth_mm: f64,
    /// The median if a distance is taken as a range along one of the bearings spread evenly over the field
    /// of view, as the paper does.
    pub as_ranges_mm: f64,
}

impl fmt::Display for VisionSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { pictures, bands, .. } = self;
        writeln!(
            f,
            "grey cameras: {pictures} pictures; a boundary's distance from its true place"
        )?;
        writeln!(f, "  from - to (m)  columns  median  9 of 10  median as ranges (mm)")?;
        for band in bands {
            writeln!(
                f,
                "  {:.2} - {:.2} {:>12} {:>7.0} {:>8.0} {:>17.0}",
                band.from_m,
                band.to_m,
                band.columns,
                band.median_mm,
                band.ninth_mm,
                band.as_ranges_mm
            )?;
        }
        Ok(())
    }
}
