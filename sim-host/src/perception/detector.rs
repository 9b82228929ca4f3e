//! The interface of image detectors.

use std::fmt::Debug;

use crate::camera::{Lens, Picture, Thing};

/// Detects objects in pictures.
pub trait Detector: Debug + Send {
    /// The objects in a picture.
    fn detect(&mut self, picture: &Picture) -> Vec<Detection>;
}

/// An object detected in a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    /// The class of the object, such as "person".
    pub label: String,
    /// The upper left corner (column, row) of its bounding box.
    pub from: [f64; 2],
    /// The lower right corner (column, row) of its bounding box.
    pub to: [f64; 2],
}

/// Gives each thing the label of the smallest detection that contains its centre. `side_m` is the side of
/// a cell in metres.
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
