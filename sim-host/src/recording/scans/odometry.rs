//! Arithmetic on planar poses (x and y in metres, heading in radians).

/// The pose `to` relative to `from`.
pub(super) fn relative(from: [f64; 3], to: [f64; 3]) -> [f64; 3] {
    let (sin, cos) = from[2].sin_cos();
    let (x, y) = (to[0] - from[0], to[1] - from[1]);
    [x * cos + y * sin, y * cos - x * sin, to[2] - from[2]]
}

/// The pose reached from `from` by `step`, given in the frame of `from`.
pub(super) fn compose(from: [f64; 3], step: [f64; 3]) -> [f64; 3] {
    let (sin, cos) = from[2].sin_cos();
    let [x, y, turn] = step;
    [from[0] + x * cos - y * sin, from[1] + x * sin + y * cos, from[2] + turn]
}
