//! Where in a picture markers are looked for: about where they should be, and now and then
//! everywhere.

use nalgebra::Point3;
use ubimap_protocol::time::{Duration, Instant};

use crate::{
    camera::{Lens, Picture},
    perception::markers::{ImageRegion, Marker, Mount, Placement, TagDetector, detect_colours},
    timing::MARKER_LOST,
};

/// Between two searches of a camera's whole picture.
const EVERYWHERE: Duration = Duration::from_millis(500);
/// How far from its expected place a marker is looked for, in metres, and by how much more for each
/// second since it was last seen.
const REACH_M: f64 = 0.03;
const REACH_M_S: f64 = 1.0;
/// Two of one identifier are one marker if they are so near each other, in pixels.
const SAME_PX: f64 = 2.0;
/// Half of a tag's diagonal, with its margin, in parts of its side.
const HALF_DIAGONAL: f64 = 0.9;

/// A marker that should be in view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Expected {
    pub(super) mount: Mount,
    pub(super) placement: Placement,
    /// How long it has not been seen.
    pub(super) unseen: Duration,
}

/// Looks for the markers in the pictures of all cameras.
#[derive(Debug)]
pub(super) struct Search {
    tags: TagDetector,
    /// Whether colour markers are looked for as well.
    colours: bool,
    /// When each camera's whole picture is searched next.
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

    /// The markers in a picture.
    pub(super) fn markers(
        &mut self,
        camera: usize,
        captured: Instant,
        picture: &Picture,
        lens: &Lens,
        expected: &[Expected],
    ) -> Vec<Marker> {
        let regions = match self.everywhere.get_mut(camera) {
            // The second where the clock has been set back.
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

/// Windows that overlap are made one where that saves pixels.
fn merged(mut regions: Vec<ImageRegion>) -> Vec<ImageRegion> {
    let mut merged: Vec<ImageRegion> = Vec::new();
    while let Some(region) = regions.pop() {
        let saves =
            |other: &ImageRegion| other.with(&region).pixels() <= other.pixels() + region.pixels();
        match merged.iter().position(saves) {
            // What they make together may save more with others.
            Some(index) => regions.push(merged.swap_remove(index).with(&region)),
            None => merged.push(region),
        }
    }
    merged
}

/// A marker in two regions is one.
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
    fn windows_are_merged_where_that_saves_pixels() {
        let square = |left, top| ImageRegion { left, top, width: 10, height: 10 };
        assert_eq!(
            merged(vec![square(0, 0), square(100, 0), square(0, 1), square(8, 8)]),
            [square(8, 8), square(100, 0), ImageRegion { height: 11, ..square(0, 0) }]
        );
    }

    #[test]
    fn one_marker_in_two_windows_is_one_and_two_of_one_number_are_two() {
        let at = |number, column: f64| Marker {
            identifier: Identifier::Tag(number),
            points: vec![[column, 3.0], [column + 20.0, 3.0]],
            noise_px: 0.1,
        };
        let found = vec![at(1, 5.0), at(2, 5.0), at(1, 5.3), at(1, 40.0)];
        assert_eq!(without_repeats(found), [at(1, 5.0), at(2, 5.0), at(1, 40.0)]);
    }
}
