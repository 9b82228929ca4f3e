//! Where in a picture markers are looked for: about where they should be, and now and then
//! everywhere.

use nalgebra::Point3;
use ubimap_protocol::time::{Duration, Instant};

use crate::{
    camera::{Lens, Picture},
    perception::markers::{Marker, Mount, Placement, TagDetector, Window, detect_colours},
};

/// Between two searches of a camera's whole picture.
const EVERYWHERE: Duration = Duration::from_millis(500);
/// A robot not seen for so long is looked for nowhere in particular.
const GIVEN_UP: Duration = Duration::from_secs(1);
/// How far from its expected place a marker is looked for, in metres, and by how much more for each
/// second since it was last seen.
const REACH_M: f64 = 0.05;
const REACH_M_S: f64 = 1.0;
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
        let windows = match self.everywhere.get_mut(camera) {
            // The second where the clock has been set back.
            Some(next) if *next <= captured || captured + EVERYWHERE < *next => {
                *next = captured + EVERYWHERE;
                vec![Window::all(picture)]
            }
            _ => apart(expected.iter().filter_map(|it| it.window(lens, picture)).collect()),
        };
        let mut markers = Vec::new();
        for window in windows {
            markers.extend(self.tags.detect(picture, window));
            if let Picture::Colour(image) = picture
                && self.colours
            {
                markers.extend(detect_colours(image, window));
            }
        }
        markers
    }
}

impl Expected {
    fn window(&self, lens: &Lens, picture: &Picture) -> Option<Window> {
        if self.unseen > GIVEN_UP {
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
        Window::about(lens.project(&middle)?, reach_m * focal / depth, picture)
    }
}

/// Windows that overlap are made one, so that no marker is found twice.
fn apart(mut windows: Vec<Window>) -> Vec<Window> {
    let mut apart: Vec<Window> = Vec::new();
    while let Some(window) = windows.pop() {
        match apart.iter().position(|other| other.overlaps(&window)) {
            // What they make together may overlap others.
            Some(index) => windows.push(apart.swap_remove(index).with(&window)),
            None => apart.push(window),
        }
    }
    apart
}
