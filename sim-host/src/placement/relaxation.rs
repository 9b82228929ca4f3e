//! Bounds by Lagrangian relaxation.
//!
//! Each cell `s` gets a multiplier `lambda_s`: if positive, the price of a camera that the cell
//! lacks below `m`; if negative (only if there is a `k`), the price of a camera beyond `k`. With
//! prices in place of the constraints, each candidate can be decided on its own. Let `y_s` mean
//! "the optional cell `s` is covered" and let `W` be the requested weight. For the fewest cameras,
//! every placement has at least
//!
//! ```text
//! L(lambda) = sum_c min(0, 1 - sum_{s in f(c)} lambda_s)                 reduced costs
//!           + sum_{required s, lambda_s > 0} m_s lambda_s
//!           + sum_{s, lambda_s < 0} k_s lambda_s
//!           + max_{mu >= 0} mu W + sum_{optional s} min(0, m_s lambda_s - mu w_s)
//! ```
//!
//! cameras. For the best coverage with `N` cameras, the covered optional weight is at most `-L`,
//! with `1` replaced by `0`, `mu` by 1, `W` by 0, and only the `N` smallest reduced costs counted.
//! `L` is concave; its maximum is the value of the linear relaxation, and subgradient steps
//! approach it (Held, Wolfe and Crowder, "Validation of Subgradient Optimization", 1974). Every
//! value on the way is a valid bound. It is computed in integers, so that rounding can't make it
//! too good.

use super::programme::{ANY_OVERLAP, Demand, Goal, Programme};

/// One camera, or one unit of weight, in the units of multipliers.
pub(super) const ONE: i64 = 1 << 24;

/// Number of steps without a better bound after which the steps become shorter, and the factor.
const PATIENCE: u32 = 30;
const SHORTER: f64 = 0.7;
/// Weight of the previous direction in the next direction.
const DEFLECTION: f64 = 0.7;
/// Minimum length of a step, relative to the usual one; below it the bound has converged.
const SHORTEST: f64 = 1e-4;

/// Maximum multiplier, the price of 65,536 cameras: no sum of multipliers overflows.
const DEAREST: i64 = ONE << 16;

/// Whether a candidate has been fixed, and how.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Fixed {
    /// The candidate is free.
    #[default]
    Free,
    /// The candidate is chosen.
    In,
    /// The candidate is not chosen.
    Out,
}

/// The multipliers of a programme's cells, and the best bound that they have given.
pub(super) struct Relaxation<'p> {
    programme: &'p Programme,
    multipliers: Vec<i64>,
    /// The reduced cost of each candidate at the last evaluation.
    reduced_costs: Vec<i64>,
    /// For each cell, its number of cameras in the relaxed solution.
    overlap: Vec<i32>,
    /// For each optional cell, whether it is covered in the relaxed solution.
    is_counted: Vec<bool>,
    direction: Vec<f64>,
    order: Vec<u32>,
    best: Option<i64>,
    best_multipliers: Vec<i64>,
    step: f64,
    failures: u32,
}

impl<'p> Relaxation<'p> {
    /// Starts with multipliers for which no candidate has a negative reduced cost (dual feasible).
    pub(super) fn new(programme: &'p Programme) -> Self {
        let cells = programme.demands.len();
        let start = |cell: usize| {
            let Demand { is_required, weight, at_least, .. } = programme.demands[cell];
            match programme.goal {
                _ if at_least == 0 => 0,
                Goal::Best { .. } if !is_required => i64::from(weight) * ONE / 2,
                _ => {
                    let there = programme.covered_by.row(cell).iter();
                    let most = there.map(|&it| programme.covers.row(it as usize).len()).max();
                    ONE / most.unwrap_or(1).max(1) as i64
                }
            }
        };
        let multipliers: Vec<i64> = (0..cells).map(start).collect();
        Self {
            programme,
            best_multipliers: multipliers.clone(),
            multipliers,
            reduced_costs: vec![0; programme.candidates()],
            overlap: vec![0; cells],
            is_counted: vec![false; cells],
            direction: vec![0.0; cells],
            order: Vec::new(),
            best: None,
            step: 1.0,
            failures: 0,
        }
    }

    /// The best bound so far, rounded to a value that a placement can have: a lower bound of the
    /// number of cameras, or an upper bound of the covered optional weight. `None` before the first
    /// step.
    pub(super) fn bound(&self) -> Option<u64> {
        self.best.map(|value| round(self.programme.goal, value))
    }

    /// Whether the bound proves that no placement exists: it requires more cameras than there are
    /// candidates, or a negative weight.
    pub(super) fn proves_infeasible(&self) -> bool {
        let most = match self.programme.goal {
            Goal::Fewest { .. } => self.programme.candidates() as i64 * ONE,
            Goal::Best { .. } => 0,
        };
        self.best.is_some_and(|value| value > most)
    }

    /// Number of candidates.
    pub(super) fn candidates(&self) -> usize {
        self.programme.candidates()
    }

    /// The cost of a step, in visited matrix entries.
    pub(super) fn cost(&self) -> usize {
        let Programme { demands, covers, .. } = self.programme;
        2 * covers.ones() + 8 * (demands.len() + covers.rows()) + 100
    }

    /// Whether the bound has converged.
    pub(super) fn has_converged(&self) -> bool {
        self.step < SHORTEST
    }

    /// The reduced cost of a candidate at the last evaluation, in units of [`ONE`].
    pub(super) fn reduced_cost(&self, candidate: u32) -> i64 {
        self.reduced_costs[candidate as usize]
    }

    /// The multiplier of a cell at the last evaluation, in units of [`ONE`].
    pub(super) fn multiplier(&self, cell: usize) -> i64 {
        self.multipliers[cell]
    }

    /// Makes a subgradient step towards `target`, the value of the best known placement, with some
    /// candidates fixed. Returns the bound with these fixed, in units of [`ONE`], from before the
    /// step.
    pub(super) fn step(&mut self, fixed: &[Fixed], target: u64) -> i64 {
        let value = self.evaluate(fixed);
        if self.best.is_none_or(|best| value > best + ONE / 10_000) {
            self.failures = 0;
        } else {
            self.failures += 1;
        }
        if self.best.is_none_or(|best| value > best) {
            self.best = Some(value);
            self.best_multipliers.copy_from_slice(&self.multipliers);
        }
        if self.failures > PATIENCE {
            self.step *= SHORTER;
            self.failures = 0;
            self.multipliers.copy_from_slice(&self.best_multipliers);
            self.direction.fill(0.0);
            self.evaluate(fixed);
        }
        let target = match self.programme.goal {
            Goal::Fewest { .. } => target as i64 * ONE,
            Goal::Best { .. } => -(target as i64 * ONE),
        };
        // Aims slightly beyond the target, so that the steps do not vanish as the bound approaches
        // it.
        self.move_multipliers((target - value).max(0) + ONE / 50);
        value
    }

    /// Restarts with steps of length `step` from the best multipliers so far, for another set of
    /// fixed candidates.
    pub(super) fn restart(&mut self, step: f64) {
        self.multipliers.copy_from_slice(&self.best_multipliers);
        self.forget(step);
    }

    /// Like `restart`, but from the current multipliers.
    pub(super) fn forget(&mut self, step: f64) {
        self.best = None;
        self.step = step;
        self.failures = 0;
        self.direction.fill(0.0);
    }

    /// Evaluates `L` at the current multipliers. Also updates the reduced costs and the relaxed
    /// solution.
    pub(super) fn evaluate(&mut self, fixed: &[Fixed]) -> i64 {
        let mut value = 0;
        for (&multiplier, demand) in self.multipliers.iter().zip(&self.programme.demands) {
            if multiplier < 0 {
                value += i64::from(demand.at_most) * multiplier;
            } else if demand.is_required {
                value += i64::from(demand.at_least) * multiplier;
            }
        }
        value += self.count_optional();
        let cost = match self.programme.goal {
            Goal::Fewest { .. } => ONE,
            Goal::Best { .. } => 0,
        };
        for (candidate, reduced) in self.reduced_costs.iter_mut().enumerate() {
            let cells = self.programme.covers.row(candidate).iter();
            *reduced = cost - cells.map(|&cell| self.multipliers[cell as usize]).sum::<i64>();
        }
        value + self.choose(fixed)
    }

    /// The optional cells' part of `L`.
    fn count_optional(&mut self) -> i64 {
        let price = |cell: usize, demand: &Demand| {
            i64::from(demand.at_least) * self.multipliers[cell].max(0)
        };
        let demands = &self.programme.demands;
        let mu = match self.programme.goal {
            Goal::Best { .. } => ONE,
            Goal::Fewest { weight: 0 } => 0,
            Goal::Fewest { weight } => {
                // The maximum is at the `mu` at which the cells that are cheapest per weight reach
                // the requested weight.
                let rate = |&cell: &u32| {
                    let demand = &demands[cell as usize];
                    price(cell as usize, demand) as f64 / f64::from(demand.weight.max(1))
                };
                let is_optional = |&cell: &u32| !demands[cell as usize].is_required;
                self.order.clear();
                self.order.extend((0..demands.len() as u32).filter(is_optional));
                self.order.sort_unstable_by(|a, b| rate(a).total_cmp(&rate(b)).then(a.cmp(b)));
                let mut reached = 0;
                let last = self.order.iter().find(|&&cell| {
                    reached += u64::from(demands[cell as usize].weight);
                    reached >= weight
                });
                // Any other `mu` would also give a valid bound.
                last.or(self.order.last()).map_or(0, |cell| rate(cell).ceil() as i64)
            }
        };
        let mut value = match self.programme.goal {
            Goal::Best { .. } => 0,
            Goal::Fewest { weight } => mu * weight as i64,
        };
        for (cell, demand) in demands.iter().enumerate().filter(|(_, demand)| !demand.is_required) {
            let part = price(cell, demand) - mu * i64::from(demand.weight);
            self.is_counted[cell] = part < 0;
            value += part.min(0);
        }
        value
    }

    /// The candidates' part of `L`. Also updates the overlap in the relaxed solution.
    fn choose(&mut self, fixed: &[Fixed]) -> i64 {
        self.overlap.fill(0);
        let mut value = 0;
        let mut taken = 0;
        self.order.clear();
        for (candidate, (&reduced, fixed)) in self.reduced_costs.iter().zip(fixed).enumerate() {
            match fixed {
                Fixed::Out => {}
                Fixed::In => {
                    value += reduced;
                    taken += 1;
                    for &cell in self.programme.covers.row(candidate) {
                        self.overlap[cell as usize] += 1;
                    }
                }
                Fixed::Free if reduced < 0 => self.order.push(candidate as u32),
                Fixed::Free => {}
            }
        }
        if let Goal::Best { cameras } = self.programme.goal {
            let left = cameras.saturating_sub(taken);
            if left < self.order.len() {
                let key = |&it: &u32| (self.reduced_costs[it as usize], it);
                if left > 0 {
                    self.order.select_nth_unstable_by_key(left - 1, key);
                }
                self.order.truncate(left);
            }
        }
        for &candidate in &self.order {
            value += self.reduced_costs[candidate as usize];
            for &cell in self.programme.covers.row(candidate as usize) {
                self.overlap[cell as usize] += 1;
            }
        }
        value
    }

    /// Moves the multipliers along the deflected subgradient, by a step that would close `gap` if
    /// `L` were linear.
    fn move_multipliers(&mut self, gap: i64) {
        let mut squared = 0.0;
        for (cell, demand) in self.programme.demands.iter().enumerate() {
            let overlap = self.overlap[cell];
            let counts = demand.is_required || self.is_counted[cell];
            let lacks = if counts { i32::from(demand.at_least) - overlap } else { -overlap };
            let has_too_many = i32::from(demand.at_most) - overlap;
            let slope = match self.multipliers[cell].signum() {
                1 => lacks,
                -1 => has_too_many,
                _ => lacks.max(0) + has_too_many.min(0),
            };
            let along = f64::from(slope) + DEFLECTION * self.direction[cell];
            self.direction[cell] = along;
            squared += along * along;
        }
        if squared == 0.0 {
            return;
        }
        let length = self.step * gap as f64 / squared;
        for (cell, multiplier) in self.multipliers.iter_mut().enumerate() {
            let moved = multiplier.saturating_add((length * self.direction[cell]) as i64);
            // Limits the multipliers: if no placement exists, they would rise forever.
            let moved = moved.clamp(-DEAREST, DEAREST);
            let has_bound = self.programme.demands[cell].at_most != ANY_OVERLAP;
            // At zero the multiplier changes from the constraint `m` to the constraint `k`, so it
            // stops there for one step.
            *multiplier = match multiplier.signum() {
                1 => moved.max(0),
                -1 => moved.min(0),
                _ if has_bound => moved,
                _ => moved.max(0),
            };
        }
    }
}

/// Rounds a value of `L` to a value that a placement can have: up for a number of cameras, down for
/// a weight.
pub(super) fn round(goal: Goal, value: i64) -> u64 {
    match goal {
        Goal::Fewest { .. } => (value.max(0) as u64).div_ceil(ONE as u64),
        Goal::Best { .. } => ((-value).max(0) / ONE) as u64,
    }
}
