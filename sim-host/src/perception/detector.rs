//! The door for image detectors.

use std::fmt::Debug;

use crate::camera::{Lens, Picture, Thing};

/// Finds things in pictures.
pub trait Detector: Debug + Send {
    /// What a picture shows.
    fn detect(&mut self, picture: &Picture) -> Vec<Detection>;
}

/// Something in a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// What it is, such as "person".
    pub label: String,
    /// The upper left corner of the rectangle around it: column and row.
    pub from: [f64; 2],
    /// The lower right corner.
    pub to: [f64; 2],
}

/// Labels each thing with the smallest detection that has its middle in it. `side_m` is that of a
/// cell.
pub(super) fn label(things: &mut [Thing], detections: &[Detection], lens: &Lens, side_m: f64) {
    for thing in things {
        let sum = thing.cells.iter().fold([0.0, 0.0], |[x, y], cell| {
            [x + f64::from(cell.0) + 0.5, y + f64::from(cell.1) + 0.5]
        });
        let [x, y] = sum.map(|it| it * side_m / thing.cells.len().max(1) as f64);
        let middle = [x, y, f64::from(thing.top_mm) / 2_000.0].into();
        let Some([column, row]) = lens.project(&middle) else { continue };
        let area = |it: &&Detection| (it.to[0] - it.from[0]) * (it.to[1] - it.from[1]);
        thing.label = detections
            .iter()
            .filter(|it| (it.from[0]..=it.to[0]).contains(&column))
            .filter(|it| (it.from[1]..=it.to[1]).contains(&row))
            .min_by(|a, b| area(a).total_cmp(&area(b)))
            .map(|it| it.label.clone());
    }
}
