//! How small the picture of a tag may be.

use super::super::{
    rendering::{Paint, Plate, ceiling_camera, render_grey},
    *,
};

const HEIGHT_M: f64 = 2.9;
const ROBOT_M: f64 = 0.3;

/// Tags on robots at several distances from a camera that looks at them, in all headings. The side over the distance,
/// times the sine of the angle at which it is seen, is the height of its picture in focal lengths.
#[test]
fn tags_are_read_down_to_the_least_height() {
    let mut found_above = [0, 0];
    let mut rows = std::collections::BTreeMap::<u32, [u32; 2]>::new();
    // From 16 pixels down to 8.
    for index in 0..48_u32 {
        let away = 2.9 + 1.9 * f64::from(index) / 48.0;
        let heading = (2.399_963 * f64::from(index)).rem_euclid(std::f64::consts::TAU);
        let side = 0.1;
        let below = HEIGHT_M - ROBOT_M;
        let distance = away.hypot(below);
        let lens = ceiling_camera([0.0, 0.0, HEIGHT_M], (away / below).atan(), 0.0);
        let height_px = lens.intrinsics().fx * side / distance * (below / distance);
        let plate = Plate::level(Paint::Tag(3), side, ROBOT_M, [away, 0.0, heading]);
        let picture = render_grey(&lens, &[plate], 2.0, u64::from(index));
        let markers = TagDetector::default().detect(&picture, ImageRegion::all(&picture));
        let is_found = markers.iter().any(|it| it.identifier == Identifier::Tag(3));
        let row = rows.entry(height_px as u32).or_default();
        row[usize::from(is_found)] += 1;
        if height_px >= LEAST_HEIGHT_PX {
            found_above[usize::from(is_found)] += 1;
        }
    }
    println!("{rows:?}");
    // Above, all are found; some way below, none: the least height is not far too large.
    let [lost, found] =
        rows.range(..9).fold([0, 0], |sum, (_, row)| [sum[0] + row[0], sum[1] + row[1]]);
    assert!(found_above[1] > 15 && found_above[0] == 0, "{found_above:?}");
    assert!(lost > 2 * found, "{rows:?}");
}
