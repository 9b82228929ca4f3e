//! A robot's chain of submaps: each view is placed in the current submap by matching.

use nalgebra::{Matrix3, Vector3};

use super::{
    cloud::Surfel,
    correlation::Window,
    refinement::{Refined, refine},
    rigid::{Measured, Motion, difference},
    submap::Submap,
    view::View,
};

/// A submap is complete after this distance in metres, or this number of views.
const LENGTH_M: f64 = 3.0;
const MOST_VIEWS: usize = 30;
/// Number of views of the old submap with which a new one begins, so that the next view overlaps.
const TAKEN_OVER: usize = 6;
/// Drift of the views within a submap that their matches do not show, in metres and radians.
const DRIFT: (f64, f64) = (0.03, 0.026);
/// Step of turns in a search, and the greatest window, in radians and metres.
const STEP_RAD: f64 = 0.0175;
const MOST: (f64, f64) = (0.8, 0.7);
/// Number of places that are refined, and their distance in metres.
const PLACES: (usize, f64) = (6, 0.1);
/// Minimum share of surfels in cells with a surface for a place to be refined; of a match's surfels on
/// surfaces, and their number.
const LEAST_SCORE: f64 = 0.3;
const LEAST_SHARE: f64 = 0.4;
const LEAST_MATCHED: usize = 12;

/// A chain of submaps.
#[derive(Debug, Default)]
pub(super) struct Chain {
    pub(super) views: Vec<View>,
    pub(super) submaps: Vec<Submap>,
    /// The motion from each anchor to the next.
    pub(super) steps: Vec<Measured>,
    /// The pose of the last view in the current submap.
    last: Option<Measured>,
    /// Number of views that were placed by odometry alone.
    pub(super) unmatched: usize,
}

impl Chain {
    /// Adds a view. Returns whether that completed a submap, and began a new one.
    pub(super) fn add(&mut self, view: View) -> bool {
        let index = self.views.len();
        let (Some(last), Some(before), Some(current)) =
            (&self.last, self.views.last(), self.submaps.last_mut())
        else {
            let mut submap = Submap::default();
            submap.add(index, Motion::identity(), &view);
            self.submaps.push(submap);
            self.views.push(view);
            self.last = Some(Measured::none());
            return false;
        };
        let step = driven(&before.reported, &view.reported);
        let predicted = last.then(&step);
        let found = locate(current, &view.surfels, &predicted);
        let is_matched = found.is_some();
        let placed = found.map_or(predicted, |Refined { motion, covariance, .. }| Measured {
            motion,
            covariance,
        });
        current.driven_m += step.motion.translation.vector.norm();
        current.add(index, placed.motion, &view);
        self.views.push(view);
        self.unmatched += usize::from(!is_matched);
        let is_complete =
            !is_matched || current.driven_m >= LENGTH_M || current.own_views().len() >= MOST_VIEWS;
        if is_complete {
            self.begin(placed, is_matched);
        } else {
            self.last = Some(placed);
        }
        is_complete
    }

    /// Completes the last submap.
    pub(super) fn finish(&mut self) {
        if let Some(last) = self.submaps.last_mut() {
            last.complete(&self.views);
        }
    }

    /// Completes the current submap, and begins one whose anchor is the pose of the last view. If that
    /// view matched the old submap, the new one takes over its newest views.
    fn begin(&mut self, anchor: Measured, is_matched: bool) {
        let Some(old) = self.submaps.last_mut() else { return };
        old.complete(&self.views);
        let count = if is_matched { TAKEN_OVER } else { 1 };
        let mut new = Submap::default();
        for placed in &old.views[old.views.len().saturating_sub(count)..] {
            let pose = anchor.motion.inv_mul(&placed.pose);
            new.add(placed.view, pose, &self.views[placed.view]);
        }
        new.taken_over = new.views.len();
        let drift = Vector3::new(DRIFT.0.powi(2), DRIFT.0.powi(2), DRIFT.1.powi(2));
        let covariance = anchor.covariance + Matrix3::from_diagonal(&drift);
        self.steps.push(Measured { motion: anchor.motion, covariance });
        self.submaps.push(new);
        self.last = Some(Measured::none());
    }
}

/// The motion between two poses that a robot reported. Four times as uncertain as wheels with encoders
/// ([`OdometryNoise`](ubimap_agent::locate::OdometryNoise)), as nothing is known about the wheels, and
/// more in the heading: that of the Intel log is off by 10 degrees after 3 m, and by 17 after 5 m.
pub(super) fn driven(from: &Motion, to: &Motion) -> Measured {
    let motion = from.inv_mul(to);
    let way = motion.translation.vector.norm();
    let turn = motion.rotation.angle().abs();
    let (position, heading) = (0.01 + 0.06 * way + 0.04 * turn, 0.02 + 0.12 * way + 0.15 * turn);
    let squares = Vector3::new(position * position, position * position, heading * heading);
    Measured { motion, covariance: Matrix3::from_diagonal(&squares) }
}

/// Places surfels in a submap, near a predicted pose.
fn locate(submap: &Submap, surfels: &[Surfel], predicted: &Measured) -> Option<Refined> {
    let spread = |axis: usize| predicted.covariance[(axis, axis)].sqrt();
    let window = Window {
        middle: predicted.motion,
        half_m: (0.05 + 3.0 * spread(0).max(spread(1))).min(MOST.0),
        half_rad: (0.02 + 3.0 * spread(2)).min(MOST.1),
        step_rad: STEP_RAD,
    };
    let hold = predicted.information();
    let places = submap.planes().search(surfels, &window, LEAST_SCORE, PLACES);
    let refined = places.iter().filter_map(|place| {
        let prior = Some((&predicted.motion, &hold));
        let refined = refine(&submap.cloud, surfels, &place.motion, prior)?;
        let off = difference(&predicted.motion, &refined.motion);
        let misfit = (refined.rms_m / 0.1).powi(2);
        let score = refined.matched as f64 * (1.0 - misfit) - 0.5 * off.dot(&(hold * off));
        Some((score, refined))
    });
    let (_, best) = refined.max_by(|one, other| one.0.total_cmp(&other.0))?;
    let is_enough =
        best.matched >= LEAST_MATCHED && best.matched as f64 >= LEAST_SHARE * surfels.len() as f64;
    is_enough.then_some(best)
}
