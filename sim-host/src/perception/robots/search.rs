//! Decides which regions of a picture to search for markers: around their expected positions, and
//! periodically the whole picture.

use nalgebra::Point3;
use ubimap_protocol::time::{Duration, Instant};

use crate::{
    camera::{Lens, Picture},
    perception::markers::{ImageRegion, Marker, Mount, Placement, TagDetector, detect_colours},
    timing::MARKER_LOST,
};

/// Interval at which a camera's whole picture is searched.
const EVERYWHERE: Duration = Duration::from_millis(500);
/// Radius of the search around a marker's expected position, in metres.
const REACH_M: f64 = 0.03;
/// Growth of that radius since the marker was last seen, in m/s.
const REACH_M_S: f64 = 1.0;
/// Maximum distance between two detections of the same marker, in pixels.
const SAME_PX: f64 = 2.0;
/// Half the diagonal of a tag with its margin, in units of its side.
const HALF_DIAGONAL: f64 = 0.9;

/// A marker that should be visible.
#[derive(Clone, Copy, Debug)]
pub(super) struct Expected {
    pub(super) mount: Mount,
    pub(super) placement: Placement,
    /// Time since the marker was last seen.
    pub(super) unseen: Duration,
}

/// Searches the pictures of all cameras for markers.
#[derive(Debug)]
pub(super) struct Search {
    tags: TagDetector,
    /// Whether to search for colour markers too.
    colours: bool,
    /// When each camera's whole picture is due to be searched.
    everywhere: Vec<Instant>,
}

impl Search {
    pub(super) fn new(cameras: usize, colours: bool) -> Self {
        Self {
            tags: TagDetector::default(),
            colours,
            everywhere: vec![Instant::default(); cameras],
        }
    }

    /// The markers found in a picture: near their expected positions, or anywhere if a search of
    /// the whole picture is due.
    pub(super) fn markers(
        &mut self,
        camera: usize,
        captured: Instant,
        picture: &Picture,
        lens: &Lens,
        expected: &[Expected],
    ) -> Vec<Marker> {
        let regions = match self.everywhere.get_mut(camera) {
            // The second condition holds after the clock was set back.
            Some(next) if *next <= captured || captured + EVERYWHERE < *next => {
                *next = captured + EVERYWHERE;
                vec![ImageRegion::all(picture)]
            }
            _ => merged(expected.iter().filter_map(|it| it.region(lens, picture)).collect()),
        };
        let mut markers = Vec::new();
        for region in regions {
            markers.extend(self.tags.detect(picture, region));
            if let Picture::Colour(image) = picture
                && self.colours
            {
                markers.extend(detect_colours(image, region));
            }
        }
        without_repeats(markers)
    }
}

impl Expected {
    fn region(&self, lens: &Lens, picture: &Picture) -> Option<ImageRegion> {
        if self.unseen > MARKER_LOST {
            return None;
        }
        let (sine, cosine) = libm::sincos(self.placement.heading_rad);
        let ([x, y], [ahead, left]) = (self.placement.position_m, self.mount.offset_m);
        let (x, y) = (x + cosine * ahead - sine * left, y + sine * ahead + cosine * left);
        let middle = Point3::new(x, y, self.mount.height_m);
        let depth = lens.pose().inverse_transform_point(&middle).z;
        let seconds = self.unseen.micros() as f64 / 1e6;
        let reach_m = HALF_DIAGONAL * self.mount.side_m + REACH_M + REACH_M_S * seconds;
        let focal = lens.intrinsics().fx.max(lens.intrinsics().fy);
        ImageRegion::about(lens.project(&middle)?, reach_m * focal / depth, picture)
    }
}

/// Merges overlapping regions if that reduces the number of pixels.
fn merged(mut regions: Vec<ImageRegion>) -> Vec<ImageRegion> {
    let mut merged: Vec<ImageRegion> = Vec::new();
    while let Some(region) = regions.pop() {
        let saves =
            |other: &ImageRegion| other.with(&region).pixels() <= other.pixels() + region.pixels();
        match merged.iter().position(saves) {
            // The merged region may overlap others, so it is checked again.
            Some(index) => regions.push(merged.swap_remove(index).with(&region)),
            None => merged.push(region),
        }
    }
    merged
}

/// Removes duplicates of markers that lie in two regions.
fn without_repeats(markers: Vec<Marker>) -> Vec<Marker> {
    let mut once: Vec<Marker> = Vec::with_capacity(markers.len());
    for marker in markers {
        let [column, row] = marker.middle();
        let is_same = |other: &Marker| {
            let [other_column, other_row] = other.middle();
            other.identifier == marker.identifier
                && libm::hypot(column - other_column, row - other_row) < SAME_PX
        };
        if !once.iter().any(is_same) {
            once.push(marker);
        }
    }
    once
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::perception::markers::Identifier;

    #[test]
    fn regions_are_merged_if_that_saves_pixels() {
        let square = |left, top| ImageRegion { left, top, width: 10, height: 10 };
        assert_eq!(
            merged(vec![square(0, 0), square(100, 0), square(0, 1), square(8, 8)]),
            [square(8, 8), square(100, 0), ImageRegion { height: 11, ..square(0, 0) }]
        );
    }

    #[test]
    fn a_marker_in_two_regions_is_one_and_two_with_one_number_are_two() {
        let at = |number, column: f64| Marker {
            identifier: Identifier::Tag(number),
            points: vec![[column, 3.0], [column + 20.0, 3.0]],
            noise_px: 0.1,
        };
        let found = vec![at(1, 5.0), at(2, 5.0), at(1, 5.3), at(1, 40.0)];
        assert_eq!(without_repeats(found), [at(1, 5.0), at(2, 5.0), at(1, 40.0)]);
    }
}
