//! Finds a robot that has booted out of the cameras' view.

use ubimap_protocol::units::Pose;

use crate::mapping::{
    Match, Surfaces,
    submaps::{is_within, motion},
};

/// Distance (m) and angle (5 degrees) within which two views of a robot that has booted lead to one place.
const SAME: (f64, f64) = (0.15, 0.087);

/// Two views from poses that differ by less than this distance (m) and this angle (20 degrees) can be wrong in the same
/// way, and confirm nothing.
const ALIKE: (f64, f64) = (0.3, 0.349);

/// A robot that has booted, and does not know where.
#[derive(Clone, Copy, Debug)]
pub(super) struct Booted {
    /// Whether it stood when it was last heard of.
    stood: bool,
    /// The last pose found in any heading, and the one that the robot believed in then.
    last: Option<(Pose, Pose)>,
}

impl Booted {
    /// `stood` says whether the robot stood when it was last heard of.
    pub(super) fn new(stood: bool) -> Self {
        Self { stood, last: None }
    }

    /// Finds the robot's pose about the place where it believes to be: there, if it stood and sees what is to
    /// be seen from there; otherwise in any heading, if two different views in a row lead to one place.
    pub(super) fn find(
        &mut self,
        surfaces: &Surfaces,
        points: &[[f64; 2]],
        believed: Pose,
    ) -> Option<Match> {
        if let Some(found) =
            self.stood.then(|| surfaces.find_where_it_stood(points, believed)).flatten()
        {
            return Some(found);
        }
        let found = surfaces.find_in_any_heading(points, believed)?;
        let Some((seen, from)) = self.last else {
            self.last = Some((found.pose, believed));
            return None;
        };
        let moved = motion(from).inverse() * motion(believed);
        if is_within(&moved, ALIKE) {
            return None;
        }
        self.last = Some((found.pose, believed));
        let off = (motion(seen) * moved).inverse() * motion(found.pose);
        is_within(&off, SAME).then_some(found)
    }
}
