//! The integer programme of UbiSLAM's section 4.
//!
//! | paper | here |
//! |---|---|
//! | `S = {s_1 .. s_n}` | cells, numbered from zero; [`Programme::demands`] |
//! | `C = {c_1 .. c_n}` | candidates, numbered from zero |
//! | `f(c_i)` | [`Programme::covers`] |
//! | `P` | a sorted list of candidates |
//! | `m <= sum proj_cov(s_j) <= k` | [`Demand::at_least`], [`Demand::at_most`] |
//! | `f(C, S) = sum min(1, sum proj_cov)` | [`Tally::covered_weight`], with weights of one and `m` = 1 |
//!
//! In the paper the constraint must hold at every cell. Here a cell is either *required*, so that
//! the constraint must hold, or *optional*: then it counts as covered from `m` cameras on, and only
//! the upper bound `k` must hold.

use super::incidence::Incidence;

/// Stands for no upper bound on the overlap of a cell.
pub const ANY_OVERLAP: u16 = u16::MAX;

/// The requirements of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Demand {
    /// The cell counts as covered from this number of cameras on: the paper's `m`.
    pub at_least: u16,
    /// No more cameras than this may see the cell: the paper's `k`, or [`ANY_OVERLAP`].
    pub at_most: u16,
    /// Weight of the cell in the coverage.
    pub weight: u32,
    /// Whether the cell must be covered.
    pub is_required: bool,
}

/// The goal of a placement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Goal {
    /// As few cameras as possible that cover at least this weight of optional cells.
    Fewest {
        /// Minimum total weight of the covered optional cells.
        weight: u64,
    },
    /// The greatest covered weight with at most this number of cameras.
    Best {
        /// Maximum number of cameras.
        cameras: usize,
    },
}

/// The integer programme: which candidates to choose.
#[derive(Clone, Debug)]
pub struct Programme {
    /// The requirements of each cell.
    pub demands: Vec<Demand>,
    /// For each candidate the cells that it covers.
    pub covers: Incidence,
    /// For each cell the candidates that cover it: the transpose of `covers`.
    pub covered_by: Incidence,
    /// The goal of the optimisation.
    pub goal: Goal,
}

/// What a set of candidates achieves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Sum of the numbers of cameras that required cells lack.
    pub shortfall: u64,
    /// Sum of the numbers of cameras by which cells exceed `k`.
    pub excess: u64,
    /// Total weight of the covered cells, required or optional.
    pub covered_weight: u64,
    /// Total weight of the covered optional cells.
    pub optional_weight: u64,
}

impl Programme {
    /// A programme from the requirements of each cell and the cells that each candidate covers.
    pub fn new(demands: Vec<Demand>, covers: Incidence, goal: Goal) -> Self {
        let covered_by = covers.transpose(demands.len());
        Self { demands, covers, covered_by, goal }
    }

    /// Number of candidates.
    pub fn candidates(&self) -> usize {
        self.covers.rows()
    }

    /// Total weight of all cells.
    pub fn weight(&self) -> u64 {
        self.demands.iter().map(|demand| u64::from(demand.weight)).sum()
    }

    /// The number of chosen candidates that cover each cell.
    pub fn overlap(&self, chosen: &[u32]) -> Vec<u16> {
        let mut overlap = vec![0; self.demands.len()];
        for &candidate in chosen {
            for &cell in self.covers.row(candidate as usize) {
                overlap[cell as usize] += 1;
            }
        }
        overlap
    }

    /// Evaluates a set of candidates.
    pub fn tally(&self, chosen: &[u32]) -> Tally {
        let mut tally = Tally::default();
        for (demand, overlap) in self.demands.iter().zip(self.overlap(chosen)) {
            if overlap >= demand.at_least {
                tally.covered_weight += u64::from(demand.weight);
                if !demand.is_required {
                    tally.optional_weight += u64::from(demand.weight);
                }
            } else if demand.is_required {
                tally.shortfall += u64::from(demand.at_least - overlap);
            }
            tally.excess += u64::from(overlap.saturating_sub(demand.at_most));
        }
        tally
    }

    /// Whether a set of candidates satisfies every constraint.
    pub fn is_feasible(&self, chosen: &[u32]) -> bool {
        let tally = self.tally(chosen);
        let meets_goal = match self.goal {
            Goal::Fewest { weight } => tally.optional_weight >= weight,
            Goal::Best { cameras } => chosen.len() <= cameras,
        };
        tally.shortfall == 0 && tally.excess == 0 && meets_goal
    }
}
