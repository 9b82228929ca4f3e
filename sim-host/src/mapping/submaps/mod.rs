//! Submaps, and the graph of their poses: simultaneous localisation and mapping on the server, from
//! the distance vectors that robots send anyway.
//!
//! 1. A robot's [`View`]s are matched with its current [submap](Submap): all poses around the one
//!    that odometry predicts are compared with the submap's bit planes ([`Pyramid`]), and the best are
//!    [refined](refine). The robot's uncertainty relative to the submap's anchor grows with its
//!    odometry and shrinks with each match, so along a corridor it keeps growing.
//! 2. Every 3 m a new submap begins. The next view's pose relative to the old anchor is an edge of the
//!    [`PoseGraph`].
//! 3. A complete submap is matched with all that may overlap it, in a window as wide as the graph is
//!    uncertain. A match counts if nearly all surfaces that should agree do, in both directions, and
//!    if no other place fits as well.
//! 4. Only the largest set of [mutually consistent](largest_consistent) matches enters the graph, with
//!    robust weights. A match that later turns out to contradict the others leaves it again.
//! 5. At the end all views are registered with each other, and the columns of the sensor are calibrated.
//!
//! Everything is deterministic. Units are metres and radians.

mod bit_plane;
mod chain;
mod cloud;
mod columns;
mod consistency;
mod correlation;
mod drawing;
mod graph_mapper;
mod loops;
mod pose_graph;
mod refinement;
mod registration;
mod rigid;
mod sparse;
mod submap;
mod view;

pub use {
    bit_plane::{BitPlane, Shape},
    cloud::{Cloud, Surfel},
    consistency::largest_consistent,
    correlation::{Candidate, Pyramid, Window},
    drawing::draw,
    graph_mapper::{GraphCounts, GraphMapper},
    pose_graph::{Absolute, Edge, Iteration, PoseGraph},
    refinement::{Refined, refine},
    rigid::{Measured, Motion, difference, is_within, motion, pose, turned},
    submap::Submap,
    view::View,
};

#[cfg(test)]
mod tests;
