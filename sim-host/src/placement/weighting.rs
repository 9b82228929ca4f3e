//! Local search for the fewest cameras when every cell is required.
//!
//! After Gao, Weise and Li, "An Efficient Local Search Heuristic with Row Weighting for the Unicost
//! Set Covering Problem" (EJOR 2015), extended to both sides of `m <= overlap <= k`: the longer a
//! cell's constraint is violated, the greater its weight. The paper keeps the gain of every
//! candidate up to date. Here gains are computed for a sample of the candidates of one cell at a
//! time, because a cell has hundreds of candidates if cameras may be tilted.

use std::cmp::Reverse;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{incidence::Incidence, programme::Programme, selection::Selection};

/// Number of candidates evaluated for one addition.
const SAMPLE: usize = 64;
/// One addition in this number may use a candidate that the reductions have removed.
const WILD: u32 = 4;
/// Maximum number of steps during which a removed candidate can't be added again.
const TENURE: u64 = 3;
/// Number of steps without any feasible set after which one more camera is allowed.
const HOPELESS: u64 = 5_000;

/// An anytime search: it runs in slices, and has a best result after each.
pub(super) struct RowWeighting<'p> {
    programme: &'p Programme,
    /// For each cell the candidates worth trying first.
    preferred: Incidence,
    selection: Selection<'p>,
    dice: ChaCha8Rng,
    /// Number of candidates that the search uses at present.
    target: usize,
    step: u64,
    /// For each candidate the step in which it was last added or removed.
    changed: Vec<u64>,
    /// For each candidate the step before which it can't be changed.
    tabu_until: Vec<u64>,
    best: Option<Vec<u32>>,
}

impl<'p> RowWeighting<'p> {
    /// A search that starts from a set of candidates, feasible or not. `is_preferred` says which
    /// candidates to try first.
    pub(super) fn new(
        programme: &'p Programme,
        is_preferred: &[bool],
        start: &[u32],
        seed: u64,
    ) -> Self {
        let preferred = programme.covered_by.iter().map(|candidates| {
            let preferred = candidates.iter().copied().filter(|it| is_preferred[*it as usize]);
            preferred.collect::<Vec<u32>>()
        });
        let mut search = Self {
            programme,
            preferred: Incidence::from_rows(preferred),
            selection: Selection::new(programme, 1),
            dice: ChaCha8Rng::seed_from_u64(seed),
            target: start.len(),
            step: 0,
            changed: vec![0; programme.candidates()],
            tabu_until: vec![0; programme.candidates()],
            best: None,
        };
        start.iter().for_each(|&candidate| search.selection.add(candidate));
        search.note();
        search
    }

    /// The smallest feasible set found so far, ascending.
    pub(super) fn best(&self) -> Option<&[u32]> {
        self.best.as_deref()
    }

    /// Makes `steps` exchanges.
    pub(super) fn run(&mut self, steps: usize) {
        for _ in 0..steps {
            self.exchange();
        }
    }

    fn exchange(&mut self) {
        self.step += 1;
        while self.selection.is_valid() {
            // Continues with one camera fewer.
            let Some(candidate) = self.pick_removed() else { return };
            self.remove(candidate);
            self.target = self.selection.chosen().len();
            self.note();
        }
        if let Some(candidate) = self.pick_removed() {
            self.remove(candidate);
            self.tabu_until[candidate as usize] =
                self.step + 2 + self.dice.random_range(0..=TENURE);
        }
        while self.selection.chosen().len() < self.target {
            let Some(candidate) = self.pick_added() else { break };
            self.selection.add(candidate);
            self.changed[candidate as usize] = self.step;
            self.tabu_until[candidate as usize] = self.step + 2;
            self.selection.weigh_violations();
        }
        self.note();
        if self.best.is_none() && self.step.is_multiple_of(HOPELESS) {
            self.target += 1;
        }
    }

    fn remove(&mut self, candidate: u32) {
        self.selection.remove(candidate);
        self.changed[candidate as usize] = self.step;
    }

    /// The chosen candidate with the smallest loss; among equals, the one that was changed first.
    fn pick_removed(&self) -> Option<u32> {
        let chosen = self.selection.chosen().iter().copied();
        let free = chosen.filter(|&it| self.tabu_until[it as usize] <= self.step);
        free.min_by_key(|&it| (self.selection.loss(it), self.changed[it as usize], it))
    }

    /// The best of a sample of the candidates that cover a random short cell.
    fn pick_added(&mut self) -> Option<u32> {
        let short = self.selection.short();
        if short.is_empty() {
            return None;
        }
        let cell = short[self.dice.random_range(0..short.len())] as usize;
        let preferred = self.preferred.row(cell);
        let is_wild = preferred.is_empty() || self.dice.random_range(0..WILD) == 0;
        let there = if is_wild { self.programme.covered_by.row(cell) } else { preferred };
        let (step, mut best) = (self.step, None);
        for index in 0..there.len().min(SAMPLE) {
            let random = there.len() > SAMPLE;
            let index = if random { self.dice.random_range(0..there.len()) } else { index };
            let it = there[index];
            if !self.selection.is_chosen(it) && self.tabu_until[it as usize] <= step {
                let key = (self.selection.gain(it), Reverse(self.changed[it as usize]), it);
                best = best.max(Some(key));
            }
        }
        best.map(|(.., candidate)| candidate)
    }

    /// Records the current set if it is feasible and the smallest so far.
    fn note(&mut self) {
        let count = self.selection.chosen().len();
        if self.selection.is_feasible() && self.best.as_ref().is_none_or(|it| count < it.len()) {
            self.best = Some(self.selection.sorted());
        }
    }
}
