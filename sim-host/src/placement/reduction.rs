//! Reduces a programme to a smaller one with the same optimum, or with an optimum that bounds it.
//!
//! For a cell `s` let `C(s)` be the candidates that cover it; for a candidate `c` let `f(c)` be the
//! cells that it covers. A placement `P` sees `s` with `|C(s) ∩ P|` cameras. `m_s` and `k_s` are
//! the lower and upper bounds of a cell. Each of the following rules keeps the optimum:
//!
//! 1. **Loose upper bounds.** `k_s >= |C(s)|` can't be violated, and is dropped.
//! 2. **Dominated cells.** Let `s` and `t` be required and `C(s) ⊆ C(t)`. Then `t` is seen by at
//!    least as many cameras as `s` in every placement. So if `m_s >= m_t`, the lower bound of `t`
//!    follows from that of `s` and is dropped; and if `k_t <= k_s`, the upper bound of `s` follows
//!    from that of `t` and is dropped. (For an optional `s` the second half holds as well, since upper
//!    bounds hold at every cell.) A required cell without bounds goes.
//! 3. **Equal cells.** Optional cells with the same `C(s)` and `m_s` are covered together: one of them
//!    stays, with the sum of their weights and the smaller `k_s`.
//! 4. **Dominated candidates.** A candidate `b` dominates `a` if `f(a) ⊆ f(b)` and no cell of
//!    `f(b) \ f(a)` has an upper bound; of candidates with equal `f` the first dominates the others.
//!    This is a strict partial order: its third condition is transitive because
//!    `f(c) \ f(a) = (f(c) \ f(b)) ∪ (f(b) \ f(a))` where `f(a) ⊆ f(b) ⊆ f(c)`. Let `m_a` be the
//!    greatest `m_s` of the cells of `f(a)`. **If `m_a` candidates or more dominate `a`, it goes.**
//!    *Proof.* Call a candidate that stays *good*. Of the dominators of `a`, sorted so that none
//!    comes after one that it dominates, the `i`-th has at most `i - 1` dominators, all before it
//!    (transitivity); and since `f` only grows along the order, the greatest `m` of its cells is
//!    `m_a` at least. So each of the first `m_a` is good. Let `P` be an optimal placement that contains `a`. If a good
//!    dominator `b` of `a` is not in `P`, replace `a` by `b`: no cell of `f(a)` changes, and the
//!    others that change are seen once more and have no upper bound. If all of the `m_a` good ones
//!    are in `P`, leave out `a`: each of its cells is still seen by `m_a` cameras. Both keep every
//!    constraint, cover no less, and use no more cameras; and both move `P` up the order, so that
//!    repeating them ends, at an optimal placement of good candidates alone.
//!    (With `m_a = 0` this says that who covers nothing that needs a camera is left out.)
//!
//! Rule 4 is where `k` matters: with an upper bound at every cell it removes duplicates alone,
//! because a dominated candidate may be what a crowded cell needs. So two reductions are made:
//! [`Reduction::exact`] keeps the upper bounds, and [`Reduction::relaxed`] drops them all before it
//! begins. What the second needs at least, or covers at most, bounds the programme itself, and it is
//! often a hundred times smaller.

use super::{
    incidence::Incidence,
    programme::{ANY_OVERLAP, Demand, Programme},
};

/// Rounds of the rules at most; each makes room for the next.
const ROUNDS: usize = 20;

/// A reduced programme, and where its cells and candidates come from.
#[derive(Clone, Debug)]
pub struct Reduction {
    /// The reduced programme.
    pub programme: Programme,
    /// For each of its candidates the index in the original programme, ascending.
    pub candidates: Vec<u32>,
}

impl Reduction {
    /// The reduction that keeps all constraints: its optimal placements are optimal for the
    /// programme itself.
    pub fn exact(programme: &Programme) -> Self {
        Reducer::new(programme, |demand| demand).reduce()
    }

    /// The reduction of the programme without upper bounds: no placement of the programme itself is
    /// better than its optimum.
    pub fn relaxed(programme: &Programme) -> Self {
        Reducer::new(programme, |demand| Demand { at_most: ANY_OVERLAP, ..demand }).reduce()
    }

    /// Candidates of the reduced programme by their indices in the original one.
    pub fn original(&self, chosen: &[u32]) -> Vec<u32> {
        chosen.iter().map(|&candidate| self.candidates[candidate as usize]).collect()
    }
}

/// A programme while rules are applied to it.
struct Reducer<'p> {
    programme: &'p Programme,
    demands: Vec<Demand>,
    has_cell: Vec<bool>,
    has_candidate: Vec<bool>,
    /// The cells covered by each candidate, without the removed cells and candidates.
    covers: Incidence,
    covered_by: Incidence,
}

impl<'p> Reducer<'p> {
    fn new(programme: &'p Programme, change: impl Fn(Demand) -> Demand) -> Self {
        Self {
            programme,
            demands: programme.demands.iter().map(|&demand| change(demand)).collect(),
            has_cell: vec![true; programme.demands.len()],
            has_candidate: vec![true; programme.candidates()],
            covers: programme.covers.clone(),
            covered_by: programme.covered_by.clone(),
        }
    }

    fn reduce(mut self) -> Reduction {
        for _ in 0..ROUNDS {
            self.drop_loose_bounds();
            let cells = self.drop_cells();
            self.update();
            let candidates = self.drop_candidates();
            self.update();
            if cells + candidates == 0 {
                break;
            }
        }
        self.finish()
    }

    /// Rule 1.
    fn drop_loose_bounds(&mut self) {
        for (cell, demand) in self.demands.iter_mut().enumerate() {
            if usize::from(demand.at_most) >= self.covered_by.row(cell).len() {
                demand.at_most = ANY_OVERLAP;
            }
        }
    }

    /// Rules 2 and 3; returns the number of cells that go.
    fn drop_cells(&mut self) -> usize {
        for cell in 0..self.demands.len() {
            if !self.has_cell[cell] {
                continue;
            }
            // The bounds that follow from others are judged by those that are left: of two cells
            // with equal candidates one keeps its bounds.
            for superset in supersets(&self.covered_by, &self.covers, cell) {
                self.compare(cell, superset as usize);
            }
        }
        let mut dropped = 0;
        for (cell, has_cell) in self.has_cell.iter_mut().enumerate() {
            let Demand { at_least, at_most, weight, is_required } = self.demands[cell];
            let is_bound = (is_required && at_least > 0) || at_most != ANY_OVERLAP;
            if *has_cell && !is_bound && (is_required || weight == 0) {
                (*has_cell, dropped) = (false, dropped + 1);
            }
        }
        dropped
    }

    /// Drops what rules 2 and 3 allow for a cell and another one that all its candidates cover.
    fn compare(&mut self, cell: usize, other: usize) {
        let (inner, outer) = (self.demands[cell], self.demands[other]);
        let are_equal = self.covered_by.row(cell).len() == self.covered_by.row(other).len();
        let are_optional = !inner.is_required && !outer.is_required;
        if are_equal && are_optional && inner.at_least == outer.at_least {
            if cell < other {
                self.demands[cell].weight += outer.weight;
                self.demands[cell].at_most = inner.at_most.min(outer.at_most);
                self.demands[other] = Demand { weight: 0, at_most: ANY_OVERLAP, ..outer };
            }
            return;
        }
        if inner.is_required && outer.is_required && inner.at_least >= outer.at_least {
            self.demands[other].at_least = 0;
        }
        if outer.at_most != ANY_OVERLAP && outer.at_most <= inner.at_most {
            self.demands[cell].at_most = ANY_OVERLAP;
        }
    }

    /// Rule 4; returns the number of candidates that go.
    fn drop_candidates(&mut self) -> usize {
        let mut gone = Vec::new();
        for candidate in (0..self.has_candidate.len()).filter(|&it| self.has_candidate[it]) {
            let cells = self.covers.row(candidate);
            let most = cells.iter().map(|&cell| self.demands[cell as usize].at_least).max();
            let enough = usize::from(most.unwrap_or(0));
            if self.dominators(candidate).take(enough).count() == enough {
                gone.push(candidate);
            }
        }
        gone.iter().for_each(|&candidate| self.has_candidate[candidate] = false);
        gone.len()
    }

    fn dominators(&self, candidate: usize) -> impl Iterator<Item = u32> {
        let cells = self.covers.row(candidate);
        let dominates = move |other: &u32| {
            let others = self.covers.row(*other as usize);
            if others.len() == cells.len() {
                return (*other as usize) < candidate;
            }
            let is_new = |cell: &&u32| cells.binary_search(cell).is_err();
            let is_bound = |&cell: &u32| self.demands[cell as usize].at_most != ANY_OVERLAP;
            !others.iter().filter(is_new).any(is_bound)
        };
        supersets(&self.covers, &self.covered_by, candidate).into_iter().filter(dominates)
    }

    /// Takes what is gone out of the matrices.
    fn update(&mut self) {
        let rows = (0..self.has_candidate.len()).map(|candidate| {
            let cells =
                if self.has_candidate[candidate] { self.covers.row(candidate) } else { &[] };
            let left = cells.iter().copied().filter(|&cell| self.has_cell[cell as usize]);
            left.collect::<Vec<u32>>()
        });
        let covers = Incidence::from_rows(rows);
        self.covered_by = covers.transpose(self.demands.len());
        self.covers = covers;
    }

    fn finish(self) -> Reduction {
        let mut number = vec![u32::MAX; self.demands.len()];
        let mut demands = Vec::new();
        for (cell, &demand) in self.demands.iter().enumerate() {
            if self.has_cell[cell] {
                number[cell] = demands.len() as u32;
                demands.push(demand);
            }
        }
        let candidates: Vec<u32> = (0..self.has_candidate.len() as u32)
            .filter(|&candidate| self.has_candidate[candidate as usize])
            .collect();
        let renumbered = candidates.iter().map(|&candidate| {
            let cells = self.covers.row(candidate as usize).iter();
            cells.map(|&cell| number[cell as usize]).collect::<Vec<u32>>()
        });
        let covers = Incidence::from_rows(renumbered);
        let programme = Programme::new(demands, covers, self.programme.goal);
        Reduction { programme, candidates }
    }
}

/// The other rows of a matrix that have a one wherever this one has; none for an empty row.
fn supersets(matrix: &Incidence, transposed: &Incidence, row: usize) -> Vec<u32> {
    let mut columns: Vec<&[u32]> =
        matrix.row(row).iter().map(|&column| transposed.row(column as usize)).collect();
    columns.sort_unstable_by_key(|rows| rows.len());
    let Some((first, rest)) = columns.split_first() else { return Vec::new() };
    let is_large = |other: &u32| matrix.row(*other as usize).len() >= columns.len();
    let mut found: Vec<u32> =
        first.iter().copied().filter(|other| *other as usize != row && is_large(other)).collect();
    for rows in rest {
        if found.is_empty() {
            break;
        }
        intersect(&mut found, rows);
    }
    found
}

/// Keeps the numbers that another ascending list holds too.
fn intersect(numbers: &mut Vec<u32>, others: &[u32]) {
    if numbers.len() * 8 < others.len() {
        numbers.retain(|number| others.binary_search(number).is_ok());
        return;
    }
    let mut others = others.iter().copied().peekable();
    numbers.retain(|&number| {
        while others.next_if(|&other| other < number).is_some() {}
        others.peek() == Some(&number)
    });
}
