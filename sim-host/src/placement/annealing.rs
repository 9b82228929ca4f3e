//! Simulated annealing by exchanges of cameras, for programmes in which not every cell must be
//! covered.
//!
//! The number of cameras stays the same: a random chosen candidate is replaced by one that covers a
//! random short cell (a cell that lacks cameras). Rounds cool geometrically; each is twice as long
//! as the one before, and starts from the best set so far.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    programme::{Goal, Programme},
    selection::Selection,
};

/// The temperatures at which a round begins and ends, as fractions of the average number of cells
/// that a camera of the initial set covers.
const HOT: f64 = 0.05;
const COLD: f64 = 0.003;
/// Exchanges of the first round.
const FIRST_ROUND: u64 = 20_000;
/// Initial weight of a required cell, relative to an optional one of weight one.
const REQUIRED: i64 = 4;

/// An anytime search: it runs in slices, and has a best result after each.
pub(super) struct Annealing<'p> {
    programme: &'p Programme,
    selection: Selection<'p>,
    dice: ChaCha8Rng,
    hot: f64,
    cold: f64,
    /// Number of exchanges of the current round, and the index of the next one.
    round: u64,
    step: u64,
    best: Option<Vec<u32>>,
    best_weight: u64,
}

impl<'p> Annealing<'p> {
    /// A search that starts from a set of candidates, feasible or not.
    pub(super) fn new(programme: &'p Programme, start: &[u32], seed: u64) -> Self {
        let weight = programme.weight().max(1) as f64 / programme.demands.len().max(1) as f64;
        let covered: usize =
            start.iter().map(|&candidate| programme.covers.row(candidate as usize).len()).sum();
        let each = weight * covered as f64 / start.len().max(1) as f64;
        let mut search = Self {
            programme,
            selection: Selection::new(programme, (REQUIRED as f64 * weight).ceil() as i64),
            dice: ChaCha8Rng::seed_from_u64(seed),
            hot: (HOT * each).max(1.0),
            cold: (COLD * each).max(0.1),
            round: FIRST_ROUND,
            step: 0,
            best: None,
            best_weight: 0,
        };
        start.iter().for_each(|&candidate| search.selection.add(candidate));
        search.note();
        search
    }

    /// The best feasible set found so far, ascending.
    pub(super) fn best(&self) -> Option<&[u32]> {
        self.best.as_deref()
    }

    /// Tries `steps` exchanges.
    pub(super) fn run(&mut self, steps: usize) {
        for _ in 0..steps {
            if self.step == self.round {
                self.begin_round();
            }
            let done = self.step as f64 / self.round as f64;
            let temperature = self.hot * libm::pow(self.cold / self.hot, done);
            self.step += 1;
            self.try_exchange(temperature);
        }
    }

    fn begin_round(&mut self) {
        (self.round, self.step) = (self.round * 2, 0);
        // Constraints that are still violated at the end of a round get more weight in the next
        // one.
        self.selection.weigh_violations();
        if let Some(best) = &self.best {
            self.selection.chosen().to_vec().into_iter().for_each(|it| self.selection.remove(it));
            best.iter().for_each(|&it| self.selection.add(it));
            self.drop_surplus();
        }
    }

    fn try_exchange(&mut self, temperature: f64) {
        let Some(old) = self.pick_chosen() else { return };
        let Some(new) = self.pick_new() else { return };
        let loss = self.selection.loss(old);
        self.selection.remove(old);
        let change = (self.selection.gain(new) - loss) as f64;
        if change >= 0.0 || self.dice.random::<f64>() < libm::exp(change / temperature) {
            self.selection.add(new);
            self.note();
        } else {
            self.selection.add(old);
        }
    }

    fn pick_chosen(&mut self) -> Option<u32> {
        let chosen = self.selection.chosen();
        (!chosen.is_empty()).then(|| chosen[self.dice.random_range(0..chosen.len())])
    }

    /// A random candidate that covers a random short cell and is not chosen.
    fn pick_new(&mut self) -> Option<u32> {
        let short = self.selection.short();
        if short.is_empty() {
            return None;
        }
        let cell = short[self.dice.random_range(0..short.len())] as usize;
        let there = self.programme.covered_by.row(cell);
        if there.is_empty() {
            return None;
        }
        let new = there[self.dice.random_range(0..there.len())];
        (!self.selection.is_chosen(new)).then_some(new)
    }

    /// Records the current set if it is the best so far. If the goal is the fewest cameras, the
    /// search goes on with one camera fewer.
    fn note(&mut self) {
        if !self.selection.is_feasible() {
            return;
        }
        let (count, weight) = (self.selection.chosen().len(), self.selection.optional_weight());
        let is_better = match (&self.best, self.programme.goal) {
            (None, _) => true,
            (Some(best), Goal::Fewest { .. }) => count < best.len(),
            (Some(_), Goal::Best { .. }) => weight > self.best_weight,
        };
        if is_better {
            self.best = Some(self.selection.sorted());
            self.best_weight = weight;
        }
        self.drop_surplus();
    }

    /// Removes the least useful candidates while the goal is still met.
    fn drop_surplus(&mut self) {
        if matches!(self.programme.goal, Goal::Best { .. }) {
            return;
        }
        while self.selection.is_feasible() {
            let chosen = self.selection.chosen().iter().copied();
            let Some(least) = chosen.min_by_key(|&it| (self.selection.loss(it), it)) else {
                return;
            };
            if self.best.as_ref().is_none_or(|best| self.selection.chosen().len() < best.len()) {
                self.best = Some(self.selection.sorted());
            }
            self.selection.remove(least);
        }
    }
}
