//! Ground that is left to explore.

use std::fmt;

use serde::Serialize;

/// Ground that no camera sees and no robot has seen.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct UnexploredGround {
    /// A place on its border: x and y in `map`, in metres.
    pub place: [f64; 2],
    /// At most the area that looking at it would reveal, as far as the robots' sensors reach, in square metres.
    pub area_m2: f64,
    /// Why it is left, as a sentence that starts with the ground.
    pub why: String,
}

/// "unexplored at 3.58 m, -0.12 m: no robot gets to where it would be seen".
impl fmt::Display for UnexploredGround {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { place: [x, y], why, .. } = self;
        write!(f, "unexplored at {x:.2} m, {y:.2} m: {why}")
    }
}
