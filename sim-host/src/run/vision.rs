//! Grey cameras of simulated robots: their calibration, and how well they see.

use image::{Rgb, RgbImage};
use ubimap_agent::sense::{COLUMNS, FloorConfig, ScaleCurve, floor_distances, floor_readings};

use super::RunError;
use crate::{
    report::{ScaleRow, VisionBand, VisionSummary},
    world::{LookEvent, RangeSensor, pictures_of_a_board},
};

/// Distances of the object in Ahmed's table 1 (d_c), as multiples of the first.
const DISTANCES: [f64; 10] = [74.0, 83.0, 91.0, 100.0, 106.0, 119.0, 138.0, 170.0, 199.0, 254.0];
/// The depth of the first, in heights of the camera.
const FIRST: f64 = 2.0;
/// Ends of the distances for which errors are told, in heights of the camera: the near end of the
/// calibration, and steps of a quarter.
const BANDS: [f64; 6] = [2.0, 2.5, 3.1, 3.9, 4.9, 6.6];

/// The calibration of a robot's grey camera, as its owner would do it (Ahmed 2.3): ten pictures of a
/// board, ten distances, one fit.
pub(super) struct Calibrated {
    pub(super) curve: ScaleCurve,
    table: Vec<(u8, f32)>,
}

impl Calibrated {
    pub(super) fn of(sensor: &RangeSensor, seed: u64) -> Result<Self, RunError> {
        let depth_m = |there: f64| FIRST * sensor.height_m() * there / DISTANCES[0];
        let depths_m = DISTANCES.map(depth_m);
        let pictures = pictures_of_a_board(sensor, &depths_m, seed)?;
        let mut table: Vec<(u8, f32)> = Vec::new();
        for (picture, depth_m) in pictures.iter().zip(depths_m) {
            let seen = floor_distances(picture, FloorConfig::default());
            let pixels = seen.map_or(0, |distances| distances[COLUMNS / 2]);
            table.push((pixels, (depth_m * 1_000.0) as f32));
        }
        let curve = ScaleCurve::fit(&table).map_err(|error| RunError::Scale {
            name: "the grey camera's calibration".to_owned(),
            reason: error.to_string(),
        })?;
        Ok(Self { curve, table })
    }

    fn rows(&self) -> Vec<ScaleRow> {
        rows(&self.table, &self.curve)
    }
}

/// The rows of a table with their fit.
pub(super) fn rows(table: &[(u8, f32)], curve: &ScaleCurve) -> Vec<ScaleRow> {
    let row = |&(pixels, distance): &(u8, f32)| {
        let fitted = curve.distance(pixels).map_or(f64::NAN, f64::from);
        ScaleRow { pixels, distance: distance.into(), fitted }
    };
    table.iter().map(row).collect()
}

/// The errors in the pictures of a run.
pub(super) struct Vision {
    calibrated: Calibrated,
    /// Focal length in columns, height above the floor in metres.
    focal: f64,
    height_m: f64,
    pictures: u64,
    /// For each band of distances the errors of its columns in millimetres: in the camera's geometry,
    /// and in the paper's.
    errors: [Vec<[f32; 2]>; BANDS.len() - 1],
    /// The picture in which the most columns gave a distance, with that number.
    best: Option<(usize, Vec<u8>)>,
}

impl Vision {
    pub(super) fn new(calibrated: Calibrated, sensor: &RangeSensor) -> Self {
        Self {
            calibrated,
            focal: sensor.focal_px().unwrap_or(1.0),
            height_m: sensor.height_m(),
            pictures: 0,
            errors: Default::default(),
            best: None,
        }
    }

    /// The calibration of the cameras.
    pub(super) fn curve(&self) -> ScaleCurve {
        self.calibrated.curve
    }

    /// Compares the distances in a picture with the truth.
    pub(super) fn note(&mut self, look: &LookEvent) {
        let Ok(distances) = floor_distances(&look.picture, FloorConfig::default()) else { return };
        self.pictures += 1;
        let readings = floor_readings(&distances, &self.calibrated.curve);
        let measured = readings.iter().filter(|&&reading| reading > 0).count();
        if self.best.as_ref().is_none_or(|&(most, _)| measured > most) {
            self.best = Some((measured, look.picture.clone()));
        }
        let middle = (COLUMNS - 1) as f64 / 2.0;
        let half_view = (COLUMNS as f64 / 2.0 / self.focal).atan();
        for (column, (&reading, &depth)) in readings.iter().zip(&look.depths_mm).enumerate() {
            if reading == 0 || depth == 0 {
                continue;
            }
            let aside = (middle - column as f64) / self.focal;
            let (reading, depth) = (f64::from(reading), f64::from(depth));
            let truth = [depth, aside * depth];
            let off = |[x, y]: [f64; 2]| (x - truth[0]).hypot(y - truth[1]) as f32;
            let bearing = half_view * (middle - column as f64) / middle;
            let as_range = [reading * bearing.cos(), reading * bearing.sin()];
            let far = depth / 1_000.0 / self.height_m;
            let band = BANDS.windows(2).position(|ends| (ends[0]..ends[1]).contains(&far));
            if let Some(errors) = band.and_then(|band| self.errors.get_mut(band)) {
                errors.push([off([reading, aside * reading]), off(as_range)]);
            }
        }
    }

    /// One picture, its floor and its distance vector, side by side (Ahmed, figure 1 b to d).
    pub(super) fn picture(&self) -> Option<RgbImage> {
        let (_, picture) = self.best.as_ref()?;
        let distances = floor_distances(picture, FloorConfig::default()).ok()?;
        let (width, height) = (COLUMNS as u32, (picture.len() / COLUMNS) as u32);
        Some(RgbImage::from_fn(3 * width, height, |x, y| {
            let (column, above) = (x % width, height - y);
            let grey = picture[(y * width + column) as usize];
            let floor = u32::from(distances[column as usize]);
            match x / width {
                0 => Rgb([grey; 3]),
                1 => Rgb([if above <= floor { 255 } else { 40 }; 3]),
                _ if above.abs_diff(floor) <= 1 => Rgb([220, 30, 30]),
                _ => Rgb([grey; 3]),
            }
        }))
    }

    pub(super) fn summary(&self) -> VisionSummary {
        let bands = self.errors.iter().zip(BANDS.windows(2)).map(|(errors, ends)| {
            let part = |which: usize, share: f64| {
                let mut sorted: Vec<f32> = errors.iter().map(|error| error[which]).collect();
                sorted.sort_by(f32::total_cmp);
                let index = (sorted.len() as f64 * share) as usize;
                sorted.get(index).copied().map_or(0.0, f64::from)
            };
            VisionBand {
                from_m: ends[0] * self.height_m,
                to_m: ends[1] * self.height_m,
                columns: errors.len() as u64,
                median_mm: part(0, 0.5),
                ninth_mm: part(0, 0.9),
                as_ranges_mm: part(1, 0.5),
            }
        });
        VisionSummary {
            pictures: self.pictures,
            scale: self.calibrated.rows(),
            bands: bands.collect(),
        }
    }
}
