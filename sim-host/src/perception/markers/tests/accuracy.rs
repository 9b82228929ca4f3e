//! Accuracy on rendered pictures.

use ubimap_protocol::units::RobotId;

use super::super::{
    rendering::{Paint, Plate, ceiling_camera, render_grey},
    *,
};
use crate::camera::Lens;

const HEIGHT_M: f64 = 0.3;
const SIDE_M: f64 = 0.1;

/// Errors over many poses.
#[derive(Default)]
struct Errors {
    position: Vec<f64>,
    heading_deg: Vec<f64>,
    /// Squared errors normalised by their covariance (NEES): three on average if the covariance is
    /// correct.
    normalised: Vec<f64>,
}

impl Errors {
    fn add(&mut self, found: &Placement, [x, y, heading]: [f64; 3]) {
        use std::f64::consts::{PI, TAU};
        let turn = (found.heading_rad - heading + PI).rem_euclid(TAU) - PI;
        let [dx, dy] = [found.position_m[0] - x, found.position_m[1] - y];
        self.position.push(dx.hypot(dy));
        self.heading_deg.push(turn.to_degrees());
        let error = nalgebra::Vector3::new(dx, dy, turn);
        let weighed = found.covariance.try_inverse().unwrap() * error;
        self.normalised.push(error.dot(&weighed));
    }

    fn rms(values: &[f64]) -> f64 {
        (values.iter().map(|it| it * it).sum::<f64>() / values.len() as f64).sqrt()
    }

    /// Root mean square errors in metres and in degrees, and the mean normalised error.
    fn summary(&self) -> (f64, f64, f64) {
        let mean = self.normalised.iter().sum::<f64>() / self.normalised.len() as f64;
        (Self::rms(&self.position), Self::rms(&self.heading_deg), mean)
    }
}

/// Poses in a disc, spread over positions and headings.
fn drive(middle: [f64; 2], radius: f64, poses: usize) -> impl Iterator<Item = [f64; 3]> {
    (0..poses).map(move |index| {
        // Steps by the golden angle cover the disc and all headings.
        let turn = 2.399_963 * index as f64;
        let distance = radius * ((index as f64 + 0.5) / poses as f64).sqrt();
        let heading = (turn * 3.7).rem_euclid(std::f64::consts::TAU);
        [middle[0] + distance * turn.cos(), middle[1] + distance * turn.sin(), heading]
    })
}

/// The errors of a tag's poses under a camera, and the sides of the tags in pixels.
fn measure(lens: &Lens, poses: impl Iterator<Item = [f64; 3]>) -> (Errors, Vec<f64>) {
    let mount = Mount::centred(RobotId(1), SIDE_M, HEIGHT_M);
    let mut detector = TagDetector::default();
    let (mut errors, mut sides) = (Errors::default(), Vec::new());
    for (seed, pose) in (0..).zip(poses) {
        let plate = Plate::level(Paint::Tag(3), SIDE_M, HEIGHT_M, pose);
        let picture = render_grey(lens, &[plate], 5.0, seed);
        let markers = detector.detect(&picture, ImageRegion::all(&picture));
        let [marker] = &markers[..] else { panic!("{pose:?}: {markers:?}") };
        assert_eq!(marker.identifier, Identifier::Tag(3));
        let found = locate(lens, marker, &mount.points(marker.identifier), HEIGHT_M).unwrap();
        errors.add(&found, pose);
        let [a, b] = [marker.points[0], marker.points[2]];
        sides.push((a[0] - b[0]).hypot(a[1] - b[1]) / 2f64.sqrt());
    }
    (errors, sides)
}

#[test]
fn a_tag_under_a_ceiling_camera_is_located_to_a_centimetre_and_half_a_degree() {
    let cameras = [
        ("straight down", ceiling_camera([0.0, 0.0, 2.8], 0.0, 0.0), [0.0, 0.0], 0.85),
        ("tilted", ceiling_camera([0.0, 0.0, 2.8], 0.7, 0.4), [1.9, 0.8], 1.2),
    ];
    for (name, lens, middle, radius) in cameras {
        let (errors, sides) = measure(&lens, drive(middle, radius, 25));
        let (position, heading, normalised) = errors.summary();
        let (least, most) =
            sides.iter().fold((f64::MAX, 0f64), |(a, b), &it| (a.min(it), b.max(it)));
        println!(
            "{name}: tags of {least:.0} to {most:.0} pixels: RMSE {:.1} mm, {heading:.2} degrees; \
             normalised {normalised:.2} of 3",
            1000.0 * position
        );
        assert!(position < 0.01 && heading < 0.5, "{name}");
    }
}
