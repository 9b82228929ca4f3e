//! A set of chosen candidates that keeps track of the effect of adding or removing one.

use super::{
    index_set::IndexSet,
    programme::{Demand, Goal, Programme},
};

/// Weight of a cell's violation or coverage in a search, per camera.
type Weight = i64;

/// A set of chosen candidates of a programme.
///
/// The *value* of a selection is the negative sum, over all cells, of the cell's search weight
/// times the number of cameras that it lacks below `m` or has beyond `k`.
///
/// Adding or removing a candidate visits each cell that it covers, and the few candidates chosen
/// there.
pub(super) struct Selection<'p> {
    programme: &'p Programme,
    chosen: IndexSet,
    /// For each cell the chosen candidates that cover it.
    coverers: Vec<Vec<u32>>,
    weights: Vec<Weight>,
    /// For each chosen candidate, how much the value falls if it is removed.
    losses: Vec<Weight>,
    short: IndexSet,
    crowded: IndexSet,
    required_short: usize,
    optional_weight: u64,
}

impl<'p> Selection<'p> {
    /// The empty selection. The search weight of a required cell is `required`; that of an optional
    /// cell is its weight in the programme.
    pub(super) fn new(programme: &'p Programme, required: Weight) -> Self {
        let cells = programme.demands.len();
        let weight = |demand: &Demand| {
            if demand.is_required { required } else { Weight::from(demand.weight) }
        };
        let mut selection = Self {
            programme,
            chosen: IndexSet::new(programme.candidates()),
            coverers: vec![Vec::new(); cells],
            weights: programme.demands.iter().map(weight).collect(),
            losses: vec![0; programme.candidates()],
            short: IndexSet::new(cells),
            crowded: IndexSet::new(cells),
            required_short: 0,
            optional_weight: 0,
        };
        for (cell, demand) in programme.demands.iter().enumerate() {
            if demand.at_least > 0 {
                selection.short.insert(cell as u32);
                selection.required_short += usize::from(demand.is_required);
            }
        }
        selection
    }

    /// The chosen candidates, in arbitrary order.
    pub(super) fn chosen(&self) -> &[u32] {
        self.chosen.members()
    }

    /// The chosen candidates, ascending.
    pub(super) fn sorted(&self) -> Vec<u32> {
        let mut chosen = self.chosen().to_vec();
        chosen.sort_unstable();
        chosen
    }

    /// Whether a candidate is chosen.
    pub(super) fn is_chosen(&self, candidate: u32) -> bool {
        self.chosen.contains(candidate)
    }

    /// Whether adding a candidate would violate an upper bound.
    pub(super) fn crowds(&self, candidate: u32) -> bool {
        self.programme.covers.row(candidate as usize).iter().any(|&cell| {
            let overlap = self.coverers[cell as usize].len() as u16;
            overlap >= self.programme.demands[cell as usize].at_most
        })
    }

    /// The cells that lack cameras, required or optional.
    pub(super) fn short(&self) -> &[u32] {
        self.short.members()
    }

    /// Total weight, by the programme, of the covered optional cells.
    pub(super) fn optional_weight(&self) -> u64 {
        self.optional_weight
    }

    /// Whether no cell violates its constraint.
    pub(super) fn is_valid(&self) -> bool {
        self.required_short == 0 && self.crowded.members().is_empty()
    }

    /// Whether no cell violates its constraint and the programme's goal is met.
    pub(super) fn is_feasible(&self) -> bool {
        self.is_valid()
            && match self.programme.goal {
                Goal::Fewest { weight } => self.optional_weight >= weight,
                Goal::Best { cameras } => self.chosen().len() <= cameras,
            }
    }

    /// How much the value rises if a candidate is added.
    pub(super) fn gain(&self, candidate: u32) -> Weight {
        let of_cell = |&cell: &u32| {
            let cell = cell as usize;
            let Demand { at_least, at_most, .. } = self.programme.demands[cell];
            let overlap = self.coverers[cell].len() as u16;
            let gain = Weight::from(overlap < at_least) - Weight::from(overlap >= at_most);
            self.weights[cell] * gain
        };
        self.programme.covers.row(candidate as usize).iter().map(of_cell).sum()
    }

    /// How much the value falls if a chosen candidate is removed.
    pub(super) fn loss(&self, candidate: u32) -> Weight {
        self.losses[candidate as usize]
    }

    /// Adds a candidate, which must not be chosen.
    pub(super) fn add(&mut self, candidate: u32) {
        self.chosen.insert(candidate);
        let mut loss = 0;
        let programme = self.programme;
        for &cell in programme.covers.row(candidate as usize) {
            let demand = programme.demands[cell as usize];
            let overlap = self.coverers[cell as usize].len() as u16 + 1;
            loss += self.change(cell, overlap - 1, overlap);
            self.coverers[cell as usize].push(candidate);
            if overlap == demand.at_least {
                self.short.remove(cell);
                self.count_covered(&demand, true);
            }
            if overlap > demand.at_most {
                self.crowded.insert(cell);
            }
        }
        self.losses[candidate as usize] = loss;
    }

    /// Removes a chosen candidate.
    pub(super) fn remove(&mut self, candidate: u32) {
        self.chosen.remove(candidate);
        let programme = self.programme;
        for &cell in programme.covers.row(candidate as usize) {
            let demand = programme.demands[cell as usize];
            let coverers = &mut self.coverers[cell as usize];
            let overlap = coverers.len() as u16;
            if let Some(place) = coverers.iter().position(|&it| it == candidate) {
                coverers.swap_remove(place);
            }
            self.change(cell, overlap, overlap - 1);
            if overlap == demand.at_least {
                self.short.insert(cell);
                self.count_covered(&demand, false);
            }
            if overlap - 1 == demand.at_most {
                self.crowded.remove(cell);
            }
        }
    }

    /// Adds one to the weight of each violated required cell and each cell with too many cameras.
    pub(super) fn weigh_violations(&mut self) {
        for &cell in self.short.members() {
            if self.programme.demands[cell as usize].is_required {
                self.weights[cell as usize] += 1;
                for &coverer in &self.coverers[cell as usize] {
                    self.losses[coverer as usize] += 1;
                }
            }
        }
        for &cell in self.crowded.members() {
            self.weights[cell as usize] += 1;
            for &coverer in &self.coverers[cell as usize] {
                self.losses[coverer as usize] -= 1;
            }
        }
    }

    /// Updates the losses of the candidates chosen at a cell for a change of its overlap. Returns
    /// what the cell now contributes to the loss of each.
    fn change(&mut self, cell: u32, before: u16, after: u16) -> Weight {
        let Demand { at_least, at_most, .. } = self.programme.demands[cell as usize];
        let weight = self.weights[cell as usize];
        let loss = |overlap: u16| {
            weight * (Weight::from(overlap <= at_least) - Weight::from(overlap > at_most))
        };
        let change = loss(after) - loss(before);
        if change != 0 {
            for &coverer in &self.coverers[cell as usize] {
                self.losses[coverer as usize] += change;
            }
        }
        loss(after)
    }

    fn count_covered(&mut self, demand: &Demand, is_covered: bool) {
        match (demand.is_required, is_covered) {
            (true, true) => self.required_short -= 1,
            (true, false) => self.required_short += 1,
            (false, true) => self.optional_weight += u64::from(demand.weight),
            (false, false) => self.optional_weight -= u64::from(demand.weight),
        }
    }
}
