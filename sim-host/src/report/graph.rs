//! The graph of submaps of a run whose robots had only odometry.

use std::fmt;

use serde::Serialize;

use crate::mapping::submaps::GraphCounts;

/// What the graph of submaps was built from, and what holds it together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct GraphSummary {
    /// Distance vectors that the server received.
    pub vectors: u64,
    /// Of these, those that were placed by odometry alone, because they matched nothing.
    pub unmatched: u64,
    /// Submaps.
    pub submaps: u64,
    /// Matches of two submaps.
    pub matches: u64,
    /// Of these, the matches that agree with each other and hold the graph.
    pub consistent: u64,
}

impl GraphSummary {
    /// Whether the map may be drawn from the graph: at most one vector in four was placed by odometry
    /// alone. Otherwise most submaps hang together by odometry, and the robots' own maps show more.
    pub fn is_sound(&self) -> bool {
        4 * self.unmatched <= self.vectors
    }
}

impl From<GraphCounts> for GraphSummary {
    fn from(counts: GraphCounts) -> Self {
        Self {
            vectors: counts.views as u64,
            unmatched: counts.unmatched as u64,
            submaps: counts.submaps as u64,
            matches: counts.matches as u64,
            consistent: counts.consistent as u64,
        }
    }
}

impl fmt::Display for GraphSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { vectors, unmatched, submaps, matches, consistent } = self;
        writeln!(
            f,
            "graph: {vectors} distance vectors ({unmatched} placed by odometry alone) in {submaps} submaps; \
             {consistent} of {matches} matches between them are consistent"
        )
    }
}
