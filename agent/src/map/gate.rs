//! The gate (Aluckal II.C-D, "thresholding"): whether the robot has moved enough to map again.

use ubimap_protocol::units::{Angle, Millimetres, Pose};

/// Minimum motion of the robot since its last mapped scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gate {
    /// Distance in any direction.
    pub distance: Millimetres,
    /// Turn in either direction.
    pub turn: Angle,
    /// Whether the distance counts along x and along y by itself, as printed ("horizontal/vertical
    /// movement"), instead of in any direction: a motion along a diagonal of `map` may then be 1.4
    /// times as far.
    pub by_axis: bool,
}

impl Default for Gate {
    /// 3.5 cm or 5 degrees (Aluckal II.D).
    fn default() -> Self {
        Self { distance: Millimetres(35), turn: Angle(910), by_axis: false }
    }
}

impl Gate {
    /// Whether the robot, now at `now`, has moved far enough since its last mapped scan, taken at
    /// `mapped`; also true if no scan has been mapped.
    pub fn opens(&self, mapped: Option<Pose>, now: Pose) -> bool {
        let Some(mapped) = mapped else { return true };
        let square = |value: i32| i64::from(value) * i64::from(value);
        let (x, y) = (square((now.x - mapped.x).0), square((now.y - mapped.y).0));
        let moved = if self.by_axis { x.max(y) } else { x + y };
        moved > square(self.distance.0) || now.heading.distance(mapped.heading) > self.turn.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_thresholds() {
        let gate = Gate::default();
        let at = |x, y, degrees| {
            Some(Pose {
                x: Millimetres(x),
                y: Millimetres(y),
                heading: Angle::from_degrees(degrees),
            })
        };
        let opens = |now: Option<Pose>| gate.opens(at(0, 0, 179.0), now.unwrap());
        assert!(gate.opens(None, Pose::default()));
        assert!(!opens(at(35, 0, 179.0)));
        assert!(opens(at(25, -25, 179.0)));
        let by_axis = Gate { by_axis: true, ..gate };
        let opens_by_axis = |now: Option<Pose>| by_axis.opens(at(0, 0, 179.0), now.unwrap());
        assert!(!opens_by_axis(at(35, -35, 179.0)));
        assert!(opens_by_axis(at(0, -36, 179.0)) && opens_by_axis(at(0, 0, -175.9)));
        assert!(!opens(at(0, 0, -176.1)));
        assert!(opens(at(0, 0, -175.9)));
    }
}
