//! The colours of pictures, and the contrast between them.
//!
//! Contrast is defined as in WCAG 2 (by relative luminance), as the minimum over four kinds of
//! vision: normal, and without red, green or blue cones (after Machado, Oliveira and Fernandes,
//! 2009, severity 1).

use image::Rgb;

/// Lines, edges and text.
pub(super) const INK: Rgb<u8> = Rgb([0, 0, 0]);
/// The background of captions.
pub(super) const PAPER: Rgb<u8> = Rgb([255, 255, 255]);

/// Unknown cells.
pub(super) const UNKNOWN: Rgb<u8> = Rgb([118, 118, 118]);
/// Free floor.
pub(super) const FREE: Rgb<u8> = Rgb([240, 240, 240]);
/// Walls and furniture.
pub(super) const WALL: Rgb<u8> = INK;
/// Movable: occupied by something that is likely to move again.
pub(super) const MOVABLE: Rgb<u8> = Rgb([200, 88, 0]);
/// Floor in a camera's view now.
pub(super) const COVERED: Rgb<u8> = Rgb([200, 235, 250]);
/// Known floor that no camera sees now.
pub(super) const BLIND: Rgb<u8> = Rgb([140, 90, 190]);
/// Floor seen by one, two, three, and more cameras.
pub(super) const SEEN_BY: [Rgb<u8>; 4] =
    [Rgb([206, 226, 246]), Rgb([150, 192, 232]), Rgb([92, 148, 208]), Rgb([44, 104, 176])];
/// Floor that no camera sees.
pub(super) const UNSEEN: Rgb<u8> = Rgb([240, 170, 165]);
/// Floor that no camera could see from any place.
pub(super) const HIDDEN: Rgb<u8> = Rgb([160, 90, 130]);
/// Occupied on the map but not in the room.
pub(super) const EXTRA: Rgb<u8> = Rgb([200, 40, 150]);
/// Occupied in the room but not on the map.
pub(super) const MISSING: Rgb<u8> = Rgb([50, 105, 235]);

/// Cells that are expected to change within an hour, ten minutes, and two minutes.
pub(super) const VOLATILE: [Rgb<u8>; 3] =
    [Rgb([250, 225, 120]), Rgb([240, 150, 40]), Rgb([215, 60, 45])];

/// Robots and their paths.
pub(super) const ROBOT: Rgb<u8> = Rgb([80, 200, 110]);
/// People.
pub(super) const PERSON: Rgb<u8> = Rgb([200, 150, 255]);
/// Cameras and the edge of their view.
pub(super) const CAMERA: Rgb<u8> = Rgb([250, 205, 0]);

/// Minimum contrast between adjacent graphics (WCAG 2.2, criterion 1.4.11).
const LEAST_CONTRAST: f64 = 3.0;

/// A kind of vision, as a matrix on linear red, green and blue.
const EYES: [[[f64; 3]; 3]; 4] = [
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
];

/// Whether two different colours have too little contrast to be adjacent.
pub(super) fn are_alike(a: Rgb<u8>, b: Rgb<u8>) -> bool {
    a != b && contrast(a, b) < LEAST_CONTRAST
}

/// The minimum contrast between two colours over all kinds of vision, 1 to 21.
fn contrast(a: Rgb<u8>, b: Rgb<u8>) -> f64 {
    let of = |eyes: &[[f64; 3]; 3]| {
        let [a, b] = [a, b].map(|colour| luminance(colour, eyes) + 0.05);
        a.max(b) / a.min(b)
    };
    EYES.iter().map(of).fold(f64::INFINITY, f64::min)
}

/// WCAG's relative luminance of a colour for this kind of vision, 0 to 1.
fn luminance(colour: Rgb<u8>, eyes: &[[f64; 3]; 3]) -> f64 {
    let linear = colour.0.map(|value| {
        let value = f64::from(value) / 255.0;
        if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
    });
    let seen = eyes.map(|row| {
        let sum: f64 = row.iter().zip(linear).map(|(weight, value)| weight * value).sum();
        sum.clamp(0.0, 1.0)
    });
    0.2126 * seen[0] + 0.7152 * seen[1] + 0.0722 * seen[2]
}

/// All colours.
#[cfg(test)]
pub(super) const ALL: [Rgb<u8>; 21] = [
    INK,
    PAPER,
    UNKNOWN,
    FREE,
    MOVABLE,
    COVERED,
    BLIND,
    EXTRA,
    MISSING,
    ROBOT,
    PERSON,
    CAMERA,
    UNSEEN,
    HIDDEN,
    SEEN_BY[0],
    SEEN_BY[1],
    SEEN_BY[2],
    SEEN_BY[3],
    VOLATILE[0],
    VOLATILE[1],
    VOLATILE[2],
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contrast_is_that_of_the_standard() {
        assert!((contrast(INK, PAPER) - 21.0).abs() < 0.001);
        // Grey is the same for every kind of vision: (0.2159 + 0.05) / 0.05 for 50 % grey.
        assert!((contrast(Rgb([128; 3]), INK) - 5.318).abs() < 0.01);
        let usual = |a, b| {
            let [a, b] = [a, b].map(|it| luminance(Rgb(it), &EYES[0]) + 0.05);
            f64::max(a, b) / f64::min(a, b)
        };
        // The usual example: #777 on white has 4.48, pure red 4.0.
        assert!((usual([0x77; 3], [255; 3]) - 4.48).abs() < 0.01);
        assert!((usual([255, 0, 0], [255; 3]) - 4.0).abs() < 0.01);
        // Red looks darker without red cones.
        assert!(contrast(Rgb([255, 0, 0]), INK) < usual([255, 0, 0], [0; 3]));
    }

    #[test]
    fn every_colour_can_have_a_black_edge_and_the_levels_of_the_map_need_none() {
        for colour in ALL {
            assert!(!are_alike(colour, INK), "{colour:?}: {}", contrast(colour, INK));
        }
        for middle in [UNKNOWN, MOVABLE, EXTRA, MISSING] {
            assert!(!are_alike(middle, FREE), "{middle:?}: {}", contrast(middle, FREE));
        }
        for middle in [UNKNOWN, BLIND] {
            assert!(!are_alike(middle, COVERED), "{middle:?}: {}", contrast(middle, COVERED));
        }
    }

    #[test]
    fn what_must_not_be_taken_for_each_other_has_its_own_colour() {
        for (index, a) in ALL.into_iter().enumerate() {
            assert!(ALL.iter().skip(index + 1).all(|b| a != *b), "{a:?}");
        }
    }
}
