//! The solver: reductions, a greedy start, local search and bounds in turns, branch and bound.
//!
//! It owns no clock and no thread. Between short slices of work it reports to the caller, which
//! returns the fraction of the time that is spent. If the optimum is proved within the time, the
//! same programme and seed give the same placement.

use super::{
    annealing::Annealing,
    branching::{Branching, Verdict},
    greedy::greedy,
    programme::{ANY_OVERLAP, Goal, Programme},
    reduction::Reduction,
    relaxation::{Fixed, Relaxation},
    weighting::RowWeighting,
};

/// Approximate number of matrix entries visited per slice of work: a few milliseconds.
const SLICE: usize = 1_000_000;
/// After the bounds have converged, one slice in this number goes to branch and bound, and the
/// others to the search.
const BRANCHING: u64 = 2;
/// Maximum number of ones of a matrix for branch and bound: on a larger one it could visit only a
/// few nodes.
const MOST_ONES: usize = 1_000_000;

/// The progress of a solution.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Interim {
    /// Number of cameras of the best placement so far, if there is one.
    pub cameras: Option<usize>,
    /// Total weight of the optional cells that this placement covers.
    pub weight: u64,
    /// A proved bound: the minimum number of cameras, or the maximum optional weight, depending on
    /// the goal.
    pub bound: Option<u64>,
}

/// A solution of a programme.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Solution {
    /// The best placement found, ascending; `None` if none was found that keeps all constraints.
    pub chosen: Option<Vec<u32>>,
    /// A proved bound: the minimum number of cameras, or the maximum optional weight, depending on
    /// the goal.
    pub bound: u64,
    /// Whether it is proved that no placement satisfies all constraints.
    pub is_infeasible: bool,
}

/// Solves a programme. `report` is called with the progress and returns the fraction of the time
/// that is spent; from 1 on, the solver stops with its best solution.
pub fn solve(
    programme: &Programme,
    seed: u64,
    report: &mut dyn FnMut(&Interim) -> f64,
) -> Solution {
    let exact = Reduction::exact(programme);
    let relaxed = Reduction::relaxed(programme);
    let is_preferred: Vec<bool> =
        exact.candidates.iter().map(|it| relaxed.candidates.binary_search(it).is_ok()).collect();
    let mut solving = Solving::new(&exact.programme, &relaxed.programme, &is_preferred, seed);
    while !solving.is_done() && report(&solving.interim()) < 1.0 {
        solving.work();
    }
    report(&solving.interim());
    let bound = solving.bound.unwrap_or(match programme.goal {
        Goal::Fewest { .. } => 0,
        Goal::Best { .. } => u64::MAX,
    });
    Solution {
        chosen: solving.best.map(|chosen| exact.original(&chosen)),
        bound,
        is_infeasible: solving.is_infeasible,
    }
}

/// A programme that is being solved.
struct Solving<'p> {
    programme: &'p Programme,
    search: Search<'p>,
    /// The relaxations that have not converged: of the programme itself, and, improved first, of
    /// the programme without upper bounds, which is much smaller.
    relaxations: Vec<Relaxation<'p>>,
    /// Branch and bound, once all relaxations have converged.
    branching: Option<Branching<'p>>,
    free: Vec<Fixed>,
    best: Option<Vec<u32>>,
    weight: u64,
    bound: Option<u64>,
    is_infeasible: bool,
    slice: u64,
}

/// The local search that suits the programme.
enum Search<'p> {
    RowWeighting(Box<RowWeighting<'p>>),
    Annealing(Box<Annealing<'p>>),
}

impl<'p> Solving<'p> {
    fn new(
        programme: &'p Programme,
        relaxed: &'p Programme,
        is_preferred: &[bool],
        seed: u64,
    ) -> Self {
        let start = greedy(programme);
        let is_plain = matches!(programme.goal, Goal::Fewest { weight: 0 });
        let search = if is_plain {
            Search::RowWeighting(RowWeighting::new(programme, is_preferred, &start, seed).into())
        } else {
            Search::Annealing(Annealing::new(programme, &start, seed).into())
        };
        let candidates = programme.candidates().max(relaxed.candidates());
        let has_upper_bound = programme.demands.iter().any(|it| it.at_most != ANY_OVERLAP);
        let mut relaxations = vec![Relaxation::new(programme)];
        relaxations.extend(has_upper_bound.then(|| Relaxation::new(relaxed)));
        let mut solving = Self {
            programme,
            search,
            relaxations,
            branching: None,
            free: vec![Fixed::Free; candidates],
            best: None,
            weight: 0,
            bound: None,
            is_infeasible: false,
            slice: 0,
        };
        solving.take_best();
        solving
    }

    fn interim(&self) -> Interim {
        let cameras = self.best.as_ref().map(Vec::len);
        Interim { cameras, weight: self.weight, bound: self.bound }
    }

    /// Whether the best placement is proved to be optimal, or it is proved that there is none.
    fn is_done(&self) -> bool {
        if self.is_infeasible {
            return true;
        }
        let (Some(best), Some(bound)) = (&self.best, self.bound) else { return false };
        match self.programme.goal {
            Goal::Fewest { .. } => best.len() as u64 <= bound,
            Goal::Best { .. } => self.weight >= bound,
        }
    }

    /// Does one slice of work on the placement, and one on the bound.
    fn work(&mut self) {
        self.slice += 1;
        if !self.relaxations.is_empty() {
            self.sharpen_bound();
        } else if self.slice.is_multiple_of(BRANCHING) {
            self.branch();
        }
        if !self.is_done() {
            self.search();
            self.take_best();
        }
    }

    fn search(&mut self) {
        // Approximate number of matrix entries that an exchange visits.
        let each = self.programme.covers.ones() / self.programme.candidates().max(1) + 10;
        match &mut self.search {
            Search::RowWeighting(search) => search.run(1 + SLICE / (each * 64)),
            Search::Annealing(search) => search.run(1 + SLICE / (each * 8)),
        }
    }

    fn take_best(&mut self) {
        let best = match &self.search {
            Search::RowWeighting(search) => search.best(),
            Search::Annealing(search) => search.best(),
        };
        if let Some(best) = best.map(<[u32]>::to_vec) {
            self.offer(best);
        }
    }

    /// Takes a feasible placement if it is better than the best.
    fn offer(&mut self, chosen: Vec<u32>) {
        let weight = self.programme.tally(&chosen).optional_weight;
        let is_better = match (&self.best, self.programme.goal) {
            (None, _) => true,
            (Some(best), Goal::Fewest { .. }) => chosen.len() < best.len(),
            (Some(_), Goal::Best { .. }) => weight > self.weight,
        };
        if is_better {
            (self.best, self.weight) = (Some(chosen), weight);
        }
    }

    /// Makes subgradient steps.
    fn sharpen_bound(&mut self) {
        let target = match self.programme.goal {
            Goal::Fewest { .. } => self.best.as_ref().map_or(self.free.len(), Vec::len) as u64,
            Goal::Best { .. } => self.weight,
        };
        let Some(mut relaxation) = self.relaxations.pop() else { return };
        for _ in 0..=SLICE / relaxation.cost() {
            relaxation.step(&self.free[..relaxation.candidates()], target);
        }
        self.is_infeasible |= relaxation.proves_infeasible();
        relaxation.bound().into_iter().for_each(|bound| self.take_bound(bound));
        if !relaxation.has_converged() {
            self.relaxations.push(relaxation);
        } else if self.relaxations.is_empty() && self.programme.covers.ones() <= MOST_ONES {
            let limit = self.limit();
            self.branching = Some(Branching::new(self.programme, relaxation, limit));
        }
    }

    fn take_bound(&mut self, bound: u64) {
        self.bound = Some(match (self.bound, self.programme.goal) {
            (None, _) => bound,
            (Some(old), Goal::Fewest { .. }) => old.max(bound),
            (Some(old), Goal::Best { .. }) => old.min(bound),
        });
    }

    /// The limit for branch and bound. For the fewest cameras: as many as the bound, so that the
    /// search either finds such a placement or raises the bound by one. Otherwise: better than the
    /// best placement.
    fn limit(&self) -> u64 {
        match self.programme.goal {
            Goal::Best { .. } => self.best.as_ref().map_or(0, |_| self.weight + 1),
            // As long as there is no placement, the search must find out whether any exists.
            Goal::Fewest { .. } if self.best.is_none() => self.programme.candidates() as u64,
            Goal::Fewest { .. } => self.bound.unwrap_or(0),
        }
    }

    fn branch(&mut self) {
        let Some(mut branching) = self.branching.take() else { return };
        if let Goal::Best { .. } = self.programme.goal {
            branching.raise_limit(self.limit());
        }
        let nodes = SLICE / (branching.cost()) + 1;
        match branching.run(nodes) {
            Verdict::Unfinished => {}
            Verdict::Found(chosen) => self.offer(chosen),
            Verdict::Exhausted => {
                let Some(limit) = self.exhausted(branching.limit()) else { return };
                branching = branching.begin_again(limit);
            }
        }
        self.branching = Some(branching);
    }

    /// Handles the proof that nothing within `limit` exists. Returns the next limit.
    fn exhausted(&mut self, limit: u64) -> Option<u64> {
        match self.programme.goal {
            Goal::Best { .. } if self.best.is_none() => {
                self.is_infeasible = true;
                None
            }
            Goal::Best { .. } => {
                self.take_bound(self.weight);
                None
            }
            Goal::Fewest { .. } if limit >= self.programme.candidates() as u64 => {
                self.is_infeasible = self.best.is_none();
                None
            }
            Goal::Fewest { .. } => {
                self.take_bound(limit + 1);
                Some(self.limit().max(limit + 1))
            }
        }
    }
}
