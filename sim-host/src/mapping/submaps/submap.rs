//! A submap: what a robot saw while its pose was good relative to an anchor pose.

use nalgebra::Point2;

use super::{
    bit_plane::BitPlane,
    cloud::{Cloud, Surfel},
    correlation::{Pyramid, cell},
    refinement::{LAST_REACH_M, pair},
    rigid::Motion,
    view::View,
};

/// Side of the cells in which submaps are matched, in metres.
pub(super) const SIDE_M: f64 = 0.05;
/// Free ground ends this far before a surface, in metres: twice the reach of a match.
const MARGIN_M: f64 = 0.2;

/// A view within a submap.
#[derive(Clone, Debug)]
pub(super) struct Placed {
    /// The index of the view in its chain.
    pub(super) view: usize,
    /// The robot's pose in the frame of the anchor.
    pub(super) pose: Motion,
}

/// A submap, in the frame of its anchor.
#[derive(Clone, Debug, Default)]
pub struct Submap {
    /// The views drawn into it, in order of time; the first ones belong to the submap before.
    pub(super) views: Vec<Placed>,
    /// Number of views that belong to the submap before.
    pub(super) taken_over: usize,
    /// The surfaces.
    pub(super) cloud: Cloud,
    /// Distance driven in it, in metres.
    pub(super) driven_m: f64,
    /// Cells seen to be free.
    free: BitPlane,
    /// The planes for matching; made when the submap is complete.
    pyramid: Option<Pyramid>,
}

impl Submap {
    /// Draws a view.
    pub(super) fn add(&mut self, index: usize, pose: Motion, view: &View) {
        self.cloud.extend(view.surfels.iter().map(|surfel| surfel.moved(&pose)));
        self.views.push(Placed { view: index, pose });
    }

    /// The views that are drawn into no earlier submap.
    pub(super) fn own_views(&self) -> &[Placed] {
        self.views.get(self.taken_over..).unwrap_or_default()
    }

    /// Completes the submap, whose chain has these views.
    pub(super) fn complete(&mut self, views: &[View]) {
        let mut cells = Vec::new();
        for placed in &self.views {
            for surfel in &views[placed.view].surfels {
                let length = surfel.at.norm();
                let steps = ((length - MARGIN_M) / SIDE_M).max(0.0) as usize;
                cells.extend((0..steps).map(|step| {
                    let on_the_way = surfel.at * (step as f64 * SIDE_M / length);
                    cell((placed.pose * Point2::from(on_the_way)).coords, SIDE_M)
                }));
            }
        }
        cells.sort_unstable();
        cells.dedup();
        let surfaces: Vec<_> =
            self.cloud.surfels().iter().map(|surfel| cell(surfel.at, SIDE_M)).collect();
        let near = BitPlane::of(&surfaces).spread((-1, -1), (1, 1));
        cells.retain(|&it| !near.has(it));
        self.free = BitPlane::of(&cells);
        self.pyramid = Some(self.planes());
    }

    /// The planes of the surfaces.
    pub(super) fn planes(&self) -> Pyramid {
        Pyramid::of(self.cloud.surfels(), SIDE_M)
    }

    /// The planes of a complete submap.
    pub(super) fn pyramid(&self) -> Option<&Pyramid> {
        self.pyramid.as_ref()
    }

    /// Number of surfels that lie on surfaces of this submap after `motion`, and of those in its free
    /// ground.
    pub(super) fn agreement(&self, surfels: &[Surfel], motion: &Motion) -> (usize, usize) {
        let (mut agree, mut contradict) = (0, 0);
        for surfel in surfels {
            let there = surfel.moved(motion);
            if pair(&self.cloud, &there, LAST_REACH_M).is_some() {
                agree += 1;
            } else if self.free.has(cell(there.at, SIDE_M)) {
                contradict += 1;
            }
        }
        (agree, contradict)
    }
}
