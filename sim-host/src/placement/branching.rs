//! Branch and bound: decides whether a placement within a limit exists.
//!
//! The search is depth first. Each node first fixes the candidates that its decisions imply. It
//! then bounds the rest by a few subgradient steps, starting from the multipliers of the node
//! before, and fixes the candidates whose reduced cost alone would break the limit. It branches on
//! a candidate of the short required cell with the fewest free candidates; if no required cell is
//! short, on the candidate with the smallest reduced cost.

use super::{
    programme::{Goal, Programme},
    relaxation::{self, Fixed, Relaxation},
};

/// Maximum number of subgradient steps per node, and their length.
const STEPS: u32 = 20;
const STEP: f64 = 0.3;

/// The result of a search so far.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Not decided yet.
    Unfinished,
    /// A placement within the limit, ascending; the limit then requires a better one.
    Found(Vec<u32>),
    /// No placement is within the limit.
    Exhausted,
}

/// A decision on the way from the root to a node.
struct Decision {
    candidate: u32,
    /// Length of the trail before this decision.
    trail: usize,
    /// Whether this is the second side: the one with the candidate chosen has already been tried.
    is_second: bool,
}

/// A contradiction: no placement agrees with the decisions.
struct Contradiction;

/// A search that runs in slices.
pub(super) struct Branching<'p> {
    programme: &'p Programme,
    relaxation: Relaxation<'p>,
    /// For the fewest cameras: the maximum number of cameras of a placement. For the best coverage:
    /// the minimum covered optional weight.
    limit: u64,
    fixed: Vec<Fixed>,
    /// For each cell, the number of chosen candidates that cover it, and the number of those that
    /// are still free.
    inside: Vec<u32>,
    free: Vec<u32>,
    /// Number of candidates fixed as chosen.
    chosen: usize,
    /// The candidates fixed so far, in the order in which they were fixed.
    trail: Vec<u32>,
    decisions: Vec<Decision>,
    /// Cells whose bounds may imply further decisions.
    pending: Vec<u32>,
    is_begun: bool,
    is_done: bool,
}

impl<'p> Branching<'p> {
    /// A search for a placement with at most `limit` cameras, or with a covered optional weight of
    /// at least `limit`. `relaxation` must be of the same programme.
    pub(super) fn new(programme: &'p Programme, relaxation: Relaxation<'p>, limit: u64) -> Self {
        Self {
            programme,
            relaxation,
            limit,
            fixed: vec![Fixed::Free; programme.candidates()],
            inside: vec![0; programme.demands.len()],
            free: programme.covered_by.iter().map(|there| there.len() as u32).collect(),
            chosen: 0,
            trail: Vec::new(),
            decisions: Vec::new(),
            pending: (0..programme.demands.len() as u32).collect(),
            is_begun: false,
            is_done: false,
        }
    }

    /// The limit: see [`Branching::new`].
    pub(super) fn limit(&self) -> u64 {
        self.limit
    }

    /// The cost of a node, in visited matrix entries.
    pub(super) fn cost(&self) -> usize {
        self.relaxation.cost() * STEPS as usize
    }

    /// Raises the minimum weight; only for the best coverage.
    pub(super) fn raise_limit(&mut self, weight: u64) {
        self.limit = self.limit.max(weight);
    }

    /// Restarts the search with another limit.
    pub(super) fn begin_again(self, limit: u64) -> Self {
        Self::new(self.programme, self.relaxation, limit)
    }

    /// Visits at most `nodes` nodes.
    pub(super) fn run(&mut self, nodes: usize) -> Verdict {
        for _ in 0..nodes {
            if self.is_done {
                return Verdict::Exhausted;
            }
            let is_consistent = !self.is_begun || self.decide_next().is_ok();
            self.is_begun = true;
            if !is_consistent {
                continue;
            }
            if let Some(found) = self.look_at_node() {
                return Verdict::Found(found);
            }
        }
        if self.is_done { Verdict::Exhausted } else { Verdict::Unfinished }
    }

    /// Handles the current node: implications, leaf test and bound. Pushes the next decision, or
    /// backtracks. Returns a placement if the node is one.
    fn look_at_node(&mut self) -> Option<Vec<u32>> {
        if self.imply().is_err() || self.is_out_of_reach() {
            self.give_up();
            return None;
        }
        let mut found = self.take_leaf();
        // For the fewest cameras nothing better lies below a leaf; for the best coverage, more
        // cameras may cover more.
        let is_end = found.is_some() && matches!(self.programme.goal, Goal::Fewest { .. });
        if is_end || self.bound().is_err() || self.imply().is_err() {
            self.give_up();
            return found;
        }
        match self.branching_candidate() {
            Some(candidate) => {
                let trail = self.trail.len();
                self.decisions.push(Decision { candidate, trail, is_second: false });
            }
            None => {
                // The bound has fixed all remaining candidates.
                found = found.or_else(|| self.take_leaf());
                self.give_up();
            }
        }
        found
    }

    /// Returns the current node's placement, if it is one within the limit, and tightens the limit.
    fn take_leaf(&mut self) -> Option<Vec<u32>> {
        let found = self.leaf()?;
        self.limit = match self.programme.goal {
            Goal::Fewest { .. } => (found.len() as u64).saturating_sub(1),
            Goal::Best { .. } => self.programme.tally(&found).optional_weight + 1,
        };
        Some(found)
    }

    /// Carries out the decision on top of the stack.
    fn decide_next(&mut self) -> Result<(), Contradiction> {
        let Some(decision) = self.decisions.last() else {
            self.is_done = true;
            return Err(Contradiction);
        };
        let how = if decision.is_second { Fixed::Out } else { Fixed::In };
        let candidate = decision.candidate;
        let fixed = self.fix(candidate, how);
        if fixed.is_err() {
            self.give_up();
        }
        fixed
    }

    /// Backtracks to the last decision with an untried side, and tries that side.
    fn give_up(&mut self) {
        self.pending.clear();
        while let Some(mut decision) = self.decisions.pop() {
            while self.trail.len() > decision.trail {
                self.unfix();
            }
            if !decision.is_second {
                decision.is_second = true;
                self.decisions.push(decision);
                return;
            }
        }
        self.is_done = true;
    }

    fn fix(&mut self, candidate: u32, how: Fixed) -> Result<(), Contradiction> {
        self.fixed[candidate as usize] = how;
        self.trail.push(candidate);
        let is_in = how == Fixed::In;
        self.chosen += usize::from(is_in);
        for &cell in self.programme.covers.row(candidate as usize) {
            self.free[cell as usize] -= 1;
            self.inside[cell as usize] += u32::from(is_in);
            self.pending.push(cell);
        }
        if self.chosen > self.most_cameras() { Err(Contradiction) } else { Ok(()) }
    }

    fn most_cameras(&self) -> usize {
        match self.programme.goal {
            Goal::Fewest { .. } => self.limit as usize,
            Goal::Best { cameras } => cameras,
        }
    }

    fn unfix(&mut self) {
        let Some(candidate) = self.trail.pop() else { return };
        let was_in = self.fixed[candidate as usize] == Fixed::In;
        self.fixed[candidate as usize] = Fixed::Free;
        self.chosen -= usize::from(was_in);
        for &cell in self.programme.covers.row(candidate as usize) {
            self.free[cell as usize] += 1;
            self.inside[cell as usize] -= u32::from(was_in);
        }
    }

    /// Fixes the candidates that the bounds of the pending cells imply.
    fn imply(&mut self) -> Result<(), Contradiction> {
        while let Some(cell) = self.pending.pop() {
            let demand = self.programme.demands[cell as usize];
            let (inside, free) = (self.inside[cell as usize], self.free[cell as usize]);
            let least = if demand.is_required { u32::from(demand.at_least) } else { 0 };
            let most = u32::from(demand.at_most);
            if inside > most || inside + free < least {
                return Err(Contradiction);
            }
            if free == 0 {
                continue;
            }
            if inside == most {
                self.fix_all(cell, Fixed::Out)?;
            } else if inside + free == least {
                self.fix_all(cell, Fixed::In)?;
            }
        }
        Ok(())
    }

    /// Fixes the free candidates of a cell.
    fn fix_all(&mut self, cell: u32, how: Fixed) -> Result<(), Contradiction> {
        let programme = self.programme;
        for &candidate in programme.covered_by.row(cell as usize) {
            if self.fixed[candidate as usize] == Fixed::Free {
                self.fix(candidate, how)?;
            }
        }
        Ok(())
    }

    /// Whether the remaining candidates and cameras can't reach the goal.
    fn is_out_of_reach(&self) -> bool {
        // The limit may have been lowered since the candidates were chosen.
        if self.chosen > self.most_cameras() {
            return true;
        }
        let is_full = self.chosen == self.most_cameras();
        let reach = |cell: usize| self.inside[cell] + if is_full { 0 } else { self.free[cell] };
        let mut required = self.programme.demands.iter().enumerate();
        if required.any(|(cell, it)| it.is_required && reach(cell) < u32::from(it.at_least)) {
            return true;
        }
        let least = match self.programme.goal {
            Goal::Fewest { weight } => weight,
            Goal::Best { .. } => self.limit,
        };
        self.optional_weight(reach) < least
    }

    /// The weight of the optional cells that are covered with this overlap.
    fn optional_weight(&self, overlap: impl Fn(usize) -> u32) -> u64 {
        let cells = self.programme.demands.iter().enumerate();
        let covered = cells.filter(|(cell, demand)| {
            !demand.is_required && overlap(*cell) >= u32::from(demand.at_least)
        });
        covered.map(|(_, demand)| u64::from(demand.weight)).sum()
    }

    /// The chosen candidates, if they are a placement within the limit.
    fn leaf(&self) -> Option<Vec<u32>> {
        let cells = self.programme.demands.iter().zip(&self.inside);
        let mut required = cells.filter(|(demand, _)| demand.is_required);
        if required.any(|(demand, &inside)| inside < u32::from(demand.at_least)) {
            return None;
        }
        let weight = self.optional_weight(|cell| self.inside[cell]);
        let least = match self.programme.goal {
            Goal::Fewest { weight } => weight,
            Goal::Best { .. } => self.limit,
        };
        let chosen = || {
            let all = 0..self.fixed.len() as u32;
            all.filter(|&it| self.fixed[it as usize] == Fixed::In).collect()
        };
        (weight >= least).then(chosen)
    }

    /// Bounds the node, and fixes candidates by their reduced costs.
    fn bound(&mut self) -> Result<(), Contradiction> {
        let goal = self.programme.goal;
        let target = match goal {
            Goal::Fewest { .. } => self.limit + 1,
            Goal::Best { .. } => self.limit,
        };
        self.relaxation.forget(STEP);
        for _ in 0..STEPS {
            let value = self.relaxation.step(&self.fixed, target);
            if self.is_broken(value) {
                return Err(Contradiction);
            }
        }
        if let Goal::Best { .. } = goal {
            return Ok(());
        }
        self.relaxation.restart(STEP);
        let value = self.relaxation.evaluate(&self.fixed);
        for candidate in 0..self.fixed.len() as u32 {
            if self.fixed[candidate as usize] != Fixed::Free {
                continue;
            }
            let cost = self.relaxation.reduced_cost(candidate);
            if self.is_broken(value + cost.abs()) {
                self.fix(candidate, if cost >= 0 { Fixed::Out } else { Fixed::In })?;
            }
        }
        Ok(())
    }

    /// Whether this value of the relaxation proves that no placement is within the limit.
    fn is_broken(&self, value: i64) -> bool {
        let bound = relaxation::round(self.programme.goal, value);
        match self.programme.goal {
            Goal::Fewest { .. } => bound > self.limit,
            Goal::Best { .. } => bound < self.limit,
        }
    }

    fn branching_candidate(&self) -> Option<u32> {
        let cells = self.programme.demands.iter().enumerate();
        let short = cells.filter(|(cell, demand)| {
            demand.is_required && self.inside[*cell] < u32::from(demand.at_least)
        });
        let tightest = short.min_by_key(|&(cell, _)| {
            (self.free[cell], std::cmp::Reverse(self.relaxation.multiplier(cell)))
        });
        let cheapest = |candidates: &mut dyn Iterator<Item = u32>| {
            candidates
                .filter(|&it| self.fixed[it as usize] == Fixed::Free)
                .min_by_key(|&it| (self.relaxation.reduced_cost(it), it))
        };
        match tightest {
            Some((cell, _)) => cheapest(&mut self.programme.covered_by.row(cell).iter().copied()),
            None => cheapest(&mut (0..self.fixed.len() as u32)),
        }
    }
}
