//! Robots, people and cameras on a picture.

use image::RgbImage;

use super::{
    canvas::Canvas,
    palette::{CAMERA, INK, PAPER, PERSON, ROBOT},
    strokes::{SMALL, dashed_line, edged_disc, edged_line, fill, size, stroke, write},
};

/// Default radius of robots and people, in metres.
const RADIUS_M: f64 = 0.2;
/// Minimum radius of a symbol, and the radius of a camera, in pixels.
const LEAST_RADIUS: f64 = 6.0;
const CAMERA_RADIUS: f64 = 11.0;
/// Half the width of a path, and of the edge of a view, in pixels.
const PATH: f64 = 1.3;
const VIEW: f64 = 0.8;
/// Step along the edge of a view, and the maximum length of a side of the view, in metres; longer
/// sides are not drawn.
const STEP_M: f64 = 0.05;
const LONGEST_SIDE_M: f64 = 1e3;

/// The kinds of markers, and how each is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MarkerKind {
    /// A robot: a green disc.
    Robot,
    /// A person: a violet disc.
    Person,
    /// A camera that looks along its heading: a yellow square, and before it the tip of an arrow.
    Camera,
    /// A camera that looks straight down: a yellow square.
    CameraDown,
    /// A camera that is out of use: a yellow cross.
    CameraOut,
}

/// A robot, a person or a camera to be drawn on a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Marker {
    /// Along `map`'s x, in metres.
    pub x_m: f64,
    /// Along `map`'s y, in metres.
    pub y_m: f64,
    /// Heading in radians, counter-clockwise from `map`'s x.
    pub heading_rad: f64,
    /// The kind of marker.
    pub kind: MarkerKind,
    /// Radius of a robot or a person, in metres.
    pub radius_m: f64,
    /// The text beside the marker; may be empty.
    pub label: String,
    /// The path driven or walked, in `map`, metres; may be empty.
    pub path: Vec<[f64; 2]>,
    /// The outline of the floor in its view, in `map`, metres; may be empty.
    pub view: Vec<[f64; 2]>,
}

impl Marker {
    /// A marker of the default size at a point of `map` in metres, with a heading in radians and no
    /// label, path or view.
    pub fn new(kind: MarkerKind, [x_m, y_m]: [f64; 2], heading_rad: f64) -> Self {
        let (label, path, view) = Default::default();
        Self { x_m, y_m, heading_rad, kind, radius_m: RADIUS_M, label, path, view }
    }
}

/// Draws markers: first views and paths, then symbols and labels.
pub(super) fn draw(canvas: &mut Canvas<'_>, markers: &[Marker]) {
    for marker in markers {
        for edge in edge_on_map(canvas, &marker.view) {
            dashed_line(&mut canvas.image, &edge, VIEW, CAMERA);
        }
    }
    for Marker { path, .. } in markers {
        let path: Vec<_> = path.iter().map(|&point| canvas.pixel(point)).collect();
        edged_line(&mut canvas.image, &path, PATH, ROBOT);
    }
    for marker in markers {
        let centre = canvas.pixel([marker.x_m, marker.y_m]);
        let angle = canvas.angle(marker.heading_rad);
        let radius = radius(canvas, marker);
        symbol(&mut canvas.image, marker.kind, centre, radius, angle);
    }
    for marker in markers.iter().filter(|marker| !marker.label.is_empty()) {
        let centre = canvas.pixel([marker.x_m, marker.y_m]);
        let radius = radius(canvas, marker);
        label(&mut canvas.image, &marker.label, centre, radius);
    }
}

/// The radius of a symbol in pixels.
fn radius(canvas: &Canvas<'_>, marker: &Marker) -> f64 {
    match marker.kind {
        MarkerKind::Robot | MarkerKind::Person => {
            (marker.radius_m * canvas.pixels_per_m()).max(LEAST_RADIUS)
        }
        MarkerKind::Camera | MarkerKind::CameraDown | MarkerKind::CameraOut => CAMERA_RADIUS,
    }
}

/// The edge of a view in pixels. The parts in unknown cells (outside the map or behind walls) are
/// left out, so it may consist of several pieces.
fn edge_on_map(canvas: &Canvas<'_>, view: &[[f64; 2]]) -> Vec<Vec<[f64; 2]>> {
    let (mut pieces, mut piece) = (Vec::new(), Vec::new());
    let sides = view.iter().zip(view.iter().cycle().skip(1));
    for (from, to) in sides {
        let length_m = (to[0] - from[0]).hypot(to[1] - from[1]);
        let steps = if length_m < LONGEST_SIDE_M { (length_m / STEP_M).ceil() as u32 } else { 0 };
        for step in 0..steps {
            let part = f64::from(step) / f64::from(steps);
            let point = [0, 1].map(|axis| from[axis] + part * (to[axis] - from[axis]));
            if canvas.is_known(point) {
                piece.push(canvas.pixel(point));
            } else {
                pieces.push(std::mem::take(&mut piece));
            }
        }
    }
    pieces.push(piece);
    pieces.retain(|piece| piece.len() > 1);
    pieces
}

/// Draws the symbol of a kind of marker, with this radius in pixels. `angle` is its direction in
/// radians, counter-clockwise from the right.
pub(super) fn symbol(
    image: &mut RgbImage,
    kind: MarkerKind,
    centre: [f64; 2],
    radius: f64,
    angle: f64,
) {
    let at = |distance: f64, turn: f64| {
        let (sin, cos) = (angle + turn).sin_cos();
        [centre[0] + distance * cos, centre[1] - distance * sin]
    };
    match kind {
        MarkerKind::Robot | MarkerKind::Person => {
            let colour = if kind == MarkerKind::Robot { ROBOT } else { PERSON };
            edged_disc(image, centre, radius, colour);
            stroke(image, [centre, at(0.9 * radius, 0.0)], radius * 0.15, INK);
        }
        MarkerKind::Camera => {
            square(image, &|turn| at(0.6 * radius, turn), 0.2 * radius);
            // Longer than wide, so that no other corner seems to be the tip.
            let [left, right] = [0.75, -0.75].map(|turn| at(0.9 * radius, turn));
            let tip = at(2.0 * radius, 0.0);
            edged_line(image, &[left, tip, right], radius * 0.2, CAMERA);
        }
        MarkerKind::CameraOut => {
            for turn in [0.5, 1.5].map(|half| half * std::f64::consts::FRAC_PI_2) {
                edged_line(image, &[at(radius, turn), at(-radius, turn)], radius * 0.2, CAMERA);
            }
        }
        MarkerKind::CameraDown => {
            square(image, &|turn| at(0.9 * radius, turn), 0.2 * radius);
        }
    }
}

/// Draws a square; `corner` returns the corner at an angle.
fn square(image: &mut RgbImage, corner: &dyn Fn(f64) -> [f64; 2], width: f64) {
    let corners =
        [0.5, 1.5, 2.5, 3.5, 0.5].map(|quarter: f64| corner(quarter * std::f64::consts::FRAC_PI_2));
    edged_line(image, &corners, width, CAMERA);
}

/// Draws a text in a box beside a marker with this centre and radius in pixels. Nothing is drawn if
/// the centre is outside of the image.
fn label(image: &mut RgbImage, text: &str, centre: [f64; 2], radius: f64) {
    let [width, height] = size(text, SMALL);
    let [width, height] = [width + 3, height + 2];
    let [right, lower] = [image.width(), image.height()].map(f64::from);
    if !(0.0..right).contains(&centre[0]) || !(0.0..lower).contains(&centre[1]) {
        return;
    }
    let beside = centre[0] + 0.8 * radius;
    let x = if beside + f64::from(width) < right {
        beside
    } else {
        centre[0] - 0.8 * radius - f64::from(width)
    };
    let y = (centre[1] - 0.8 * radius - f64::from(height)).max(1.0);
    let [x, y] = [x, y].map(|it| it as i64);
    fill(image, [x - 1, y - 1], [width + 2, height + 2], INK);
    fill(image, [x, y], [width, height], PAPER);
    write(image, [x + 2, y + 1], text, SMALL);
}
