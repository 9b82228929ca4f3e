//! Matches of submaps with each other, and which of them are consistent.

use super::{
    cloud::Surfel,
    consistency::largest_consistent,
    correlation::Window,
    pose_graph::Edge,
    refinement::{Refined, refine},
    rigid::{Measured, Motion, difference},
    submap::Submap,
};

/// Step of turns in a search, in radians.
const STEP_RAD: f64 = 0.015;
/// Number of surfels with which places are searched; all are refined.
const SEARCHED: usize = 300;
/// Minimum share of surfels in cells with a surface: two submaps overlap only in part.
const LEAST_SCORE: f64 = 0.35;
/// Number of places that are compared, and their distance in metres.
const PLACES: (usize, f64) = (4, 0.4);
/// Minimum share of surfels on surfaces among those that lie on surfaces or in free ground; their
/// number; and their share of the surfels of the smaller submap.
const LEAST_AGREEMENT: f64 = 0.93;
const LEAST_AGREEING: usize = 150;
const LEAST_OVERLAP: f64 = 0.67;
/// A rival place is as good if its agreement is at most this much less, and the number of agreeing
/// surfels at least this share.
const RIVAL: (f64, f64) = (0.1, 0.8);
/// Squared distance in standard deviations between two different places, and between measurements
/// that contradict each other: chi-squared with three degrees of freedom at 0.9999 and 0.999.
const ELSEWHERE: f64 = 21.1;
const CONTRADICT: f64 = 16.3;

/// A match of two submaps.
#[derive(Clone, Debug)]
pub(super) struct Loop {
    /// The submap in whose frame the motion is measured.
    pub(super) from: usize,
    /// The other submap.
    pub(super) to: usize,
    /// The anchor of `to` in the frame of `from`.
    pub(super) measured: Measured,
}

impl Loop {
    /// The edge of the graph.
    pub(super) fn edge(&self) -> Edge {
        Edge {
            from: self.from,
            to: self.to,
            motion: self.measured.motion,
            information: self.measured.information(),
            is_doubted: true,
        }
    }
}

/// Matches a complete submap with another, whose anchor is expected within `half_m` and `half_rad` of
/// `guess`. `None` unless they overlap, nearly everything agrees, and no other place fits as well.
pub(super) fn align(
    submap: &Submap,
    other: &Submap,
    guess: &Motion,
    (half_m, half_rad): (f64, f64),
) -> Option<Measured> {
    let surfels = other.cloud.surfels();
    let few: Vec<Surfel> =
        surfels.iter().step_by(surfels.len().div_ceil(SEARCHED).max(1)).copied().collect();
    let window = Window { middle: *guess, half_m, half_rad, step_rad: STEP_RAD };
    let places = submap.pyramid()?.search(&few, &window, LEAST_SCORE, PLACES);
    let mut fits: Vec<Fit> = places
        .iter()
        .filter_map(|place| {
            let refined = refine(&submap.cloud, surfels, &place.motion, None)?;
            Some(Fit::of(submap, other, refined))
        })
        .collect();
    fits.sort_by(|one, other| other.worth().total_cmp(&one.worth()));
    let (best, rivals) = fits.split_first()?;
    let smaller = surfels.len().min(submap.cloud.surfels().len()) as f64;
    if best.share < LEAST_AGREEMENT
        || best.agreeing < LEAST_AGREEING
        || (best.agreeing as f64) < LEAST_OVERLAP * smaller
    {
        return None;
    }
    let measured = Measured { motion: best.refined.motion, covariance: best.refined.covariance };
    let information = measured.information();
    let is_ambiguous = rivals.iter().any(|rival| {
        // Along an unconstrained direction, all places count as the same.
        let off = difference(&measured.motion, &rival.refined.motion);
        off.dot(&(information * off)) > ELSEWHERE
            && rival.share > best.share - RIVAL.0
            && rival.agreeing as f64 > RIVAL.1 * best.agreeing as f64
    });
    (!is_ambiguous).then_some(measured)
}

/// How well two submaps fit.
struct Fit {
    refined: Refined,
    /// The share of agreeing surfels among those that agree or contradict.
    share: f64,
    /// Number of agreeing surfels of both.
    agreeing: usize,
}

impl Fit {
    fn of(submap: &Submap, other: &Submap, refined: Refined) -> Self {
        let there = submap.agreement(other.cloud.surfels(), &refined.motion);
        let back = other.agreement(submap.cloud.surfels(), &refined.motion.inverse());
        let (agreeing, contradicting) = (there.0 + back.0, there.1 + back.1);
        let share = agreeing as f64 / (agreeing + contradicting).max(1) as f64;
        Self { refined, share, agreeing }
    }

    fn worth(&self) -> f64 {
        self.share * self.agreeing as f64
    }
}

/// The matches found, and which of them are consistent.
#[derive(Debug, Default)]
pub(super) struct Loops {
    pub(super) all: Vec<Loop>,
    /// The largest consistent set, as indices in rising order.
    pub(super) accepted: Vec<usize>,
    /// For each loop, whether it is consistent with each earlier one.
    consistent: Vec<Vec<bool>>,
    /// For each anchor, the way from each earlier one along the chain.
    ways: Vec<Vec<Measured>>,
}

impl Loops {
    /// Adds an anchor to the chain; `step` is the way from the one before.
    pub(super) fn extend(&mut self, step: Option<&Measured>) {
        let mut ways: Vec<Measured> = Vec::new();
        if let Some(step) = step {
            let last = self.ways.last().into_iter().flatten();
            ways.extend(last.map(|way| way.then(step)));
            ways.push(step.clone());
        }
        self.ways.push(ways);
    }

    /// Adds a match.
    pub(super) fn push(&mut self, found: Loop) {
        let row = self.all.iter().map(|other| self.are_consistent(&found, other)).collect();
        self.consistent.push(row);
        self.all.push(found);
    }

    /// Chooses the largest consistent set anew.
    pub(super) fn choose(&mut self) {
        let consistent = |one: usize, other: usize| self.consistent[one.max(other)][one.min(other)];
        self.accepted = largest_consistent(self.all.len(), &self.accepted, consistent);
    }

    /// Whether two matches and the chain between them form a loop that closes.
    fn are_consistent(&self, one: &Loop, other: &Loop) -> bool {
        let closed = one
            .measured
            .then(&self.way(one.to, other.to))
            .then(&other.measured.inverse())
            .then(&self.way(other.from, one.from));
        let off = difference(&Motion::identity(), &closed.motion);
        off.dot(&(closed.information() * off)) < CONTRADICT
    }

    /// The way from one anchor to another along the chain.
    fn way(&self, from: usize, to: usize) -> Measured {
        match from.cmp(&to) {
            core::cmp::Ordering::Less => self.ways[to][from].clone(),
            core::cmp::Ordering::Equal => Measured::none(),
            core::cmp::Ordering::Greater => self.ways[from][to].inverse(),
        }
    }
}
