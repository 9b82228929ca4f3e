//! Small random programmes, and their optima by exhaustive search.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::{
    incidence::Incidence,
    programme::{ANY_OVERLAP, Demand, Goal, Programme},
};

/// The features that a random programme may have.
#[derive(Clone, Copy, Debug)]
pub(super) struct Kind {
    pub(super) has_optional: bool,
    pub(super) has_upper: bool,
    pub(super) most_least: u16,
    pub(super) is_best: bool,
}

/// All kinds.
pub(super) fn kinds() -> impl Iterator<Item = Kind> {
    (0..16).map(|bits: u32| Kind {
        has_optional: bits & 1 != 0,
        has_upper: bits & 2 != 0,
        most_least: if bits & 4 != 0 { 2 } else { 1 },
        is_best: bits & 8 != 0,
    })
}

/// A programme with up to 11 candidates. Neighbouring cells are covered by similar candidates, as
/// cells of a floor are, so that some dominate others.
pub(super) fn random(kind: Kind, seed: u64) -> Programme {
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let cells = dice.random_range(1..=12usize);
    let candidates = dice.random_range(1..=11usize);
    let rows = (0..candidates).map(|_| {
        let first = dice.random_range(0..cells);
        let length = dice.random_range(0..=cells / 2 + 1);
        let row = (first..(first + length).min(cells)).filter(|_| dice.random_range(0..6) != 0);
        row.map(|cell| cell as u32).collect::<Vec<u32>>()
    });
    let covers = Incidence::from_rows(rows.collect::<Vec<_>>());
    let demands: Vec<Demand> = (0..cells)
        .map(|_| {
            let at_least = dice.random_range(1..=kind.most_least);
            let at_most = if kind.has_upper && dice.random_range(0..2) == 0 {
                dice.random_range(at_least..=at_least + 1)
            } else {
                ANY_OVERLAP
            };
            let is_required = !kind.has_optional || dice.random_range(0..3) == 0;
            Demand { at_least, at_most, weight: dice.random_range(1..=3), is_required }
        })
        .collect();
    let optional = demands.iter().filter(|it| !it.is_required);
    let optional: u64 = optional.map(|it| u64::from(it.weight)).sum();
    let goal = if kind.is_best {
        Goal::Best { cameras: dice.random_range(0..=4) }
    } else {
        Goal::Fewest { weight: dice.random_range(0..=optional) }
    };
    Programme::new(demands, covers, goal)
}

/// The optimal value by exhaustive search: the number of cameras, or the covered optional weight.
pub(super) fn optimum(programme: &Programme) -> Option<u64> {
    let all = 0..1u32 << programme.candidates();
    let values = all.filter_map(|bits| {
        let chosen: Vec<u32> =
            (0..programme.candidates() as u32).filter(|it| bits & 1 << it != 0).collect();
        programme.is_feasible(&chosen).then(|| value(programme, &chosen))
    });
    match programme.goal {
        Goal::Fewest { .. } => values.min(),
        Goal::Best { .. } => values.max(),
    }
}

/// The value of a placement for the programme's goal.
pub(super) fn value(programme: &Programme, chosen: &[u32]) -> u64 {
    match programme.goal {
        Goal::Fewest { .. } => chosen.len() as u64,
        Goal::Best { .. } => programme.tally(chosen).optional_weight,
    }
}
