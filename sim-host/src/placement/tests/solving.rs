//! Compares the solver and its parts with exhaustive search.

use super::{
    super::{
        branching::{Branching, Verdict},
        milp::{Milp, MilpSolver, improve},
        programme::{Goal, Programme},
        reduction::Reduction,
        relaxation::{Fixed, Relaxation},
        solver::{Interim, Solution, solve},
    },
    programmes::{kinds, optimum, random, value},
};

const SEEDS: u64 = 400;

fn all(mut test: impl FnMut(&Programme, Option<u64>, &str)) {
    for kind in kinds() {
        for seed in 0..SEEDS {
            let programme = random(kind, seed);
            test(&programme, optimum(&programme), &format!("{kind:?}, seed {seed}"));
        }
    }
}

/// Whether a value is at least as good as another.
fn is_no_worse(goal: Goal, a: u64, b: u64) -> bool {
    match goal {
        Goal::Fewest { .. } => a <= b,
        Goal::Best { .. } => a >= b,
    }
}

#[test]
fn the_exact_reduction_keeps_the_optimum_and_the_relaxed_one_bounds_it() {
    let mut smaller = 0;
    all(|programme, truth, name| {
        let exact = Reduction::exact(programme);
        assert_eq!(optimum(&exact.programme), truth, "{name}");
        smaller += usize::from(exact.programme.candidates() < programme.candidates());
        let relaxed = optimum(&Reduction::relaxed(programme).programme);
        if let Some(truth) = truth {
            let relaxed = relaxed.unwrap_or_else(|| panic!("{name}: infeasible without bounds"));
            assert!(is_no_worse(programme.goal, relaxed, truth), "{name}");
        }
    });
    assert!(smaller > 1_000, "{smaller} programmes became smaller");
}

#[test]
fn every_relaxation_is_a_bound() {
    let mut tight = 0;
    all(|programme, truth, name| {
        let Some(truth) = truth else { return };
        let free = vec![Fixed::Free; programme.candidates()];
        let mut relaxation = Relaxation::new(programme);
        for _ in 0..300 {
            relaxation.step(&free, truth);
            let bound = relaxation.bound().unwrap_or_default();
            assert!(is_no_worse(programme.goal, bound, truth), "{name}: {bound} against {truth}");
        }
        tight += usize::from(relaxation.bound() == Some(truth));
    });
    assert!(tight > 1_700, "{tight} bounds were tight");
}

#[test]
fn branch_and_bound_alone_finds_the_optimum_and_proves_it() {
    all(|programme, truth, name| {
        let limit = match programme.goal {
            Goal::Fewest { .. } => programme.candidates() as u64,
            Goal::Best { .. } => 0,
        };
        let mut branching = Branching::new(programme, Relaxation::new(programme), limit);
        let mut best = None;
        loop {
            match branching.run(1) {
                Verdict::Unfinished => {}
                Verdict::Found(chosen) => {
                    assert!(programme.is_feasible(&chosen), "{name}");
                    best = Some(value(programme, &chosen));
                    if best == Some(0) && matches!(programme.goal, Goal::Fewest { .. }) {
                        break;
                    }
                }
                Verdict::Exhausted => break,
            }
        }
        assert_eq!(best, truth, "{name}");
    });
}

#[test]
fn the_solver_finds_the_optimum_and_proves_it() {
    all(|programme, truth, name| {
        let mut reports = 0;
        let mut last = Interim::default();
        let solution = solve(programme, 1, &mut |interim| {
            reports += 1;
            last = *interim;
            f64::from(reports) / 1e4
        });
        let Some(truth) = truth else {
            assert_eq!(solution.chosen, None, "{name}");
            assert!(solution.is_infeasible, "{name}");
            return;
        };
        let chosen = solution.chosen.unwrap_or_else(|| panic!("{name}: nothing found"));
        assert!(programme.is_feasible(&chosen), "{name}");
        assert_eq!(value(programme, &chosen), truth, "{name}");
        assert_eq!((solution.bound, last.bound), (truth, Some(truth)), "{name}");
        assert!(!solution.is_infeasible);
    });
}

#[test]
fn another_solver_agrees() {
    let mut solved = 0;
    for kind in kinds() {
        for seed in 0..25 {
            let programme = random(kind, seed);
            let name = format!("{kind:?}, seed {seed}");
            let unknown = Solution { bound: u64::MAX, ..Solution::default() };
            let milp = Milp { solver: MilpSolver::Microlp, seconds: 10.0 };
            let solution = improve(&programme, unknown, &milp).unwrap();
            let found = solution.chosen.as_ref().map(|chosen| value(&programme, chosen));
            assert_eq!(found, optimum(&programme), "{name}");
            assert_eq!(solution.is_infeasible, found.is_none(), "{name}");
            assert!(found.is_none_or(|found| found == solution.bound), "{name}");
            solved += usize::from(found.is_some());
        }
    }
    assert!(solved > 100, "{solved} had a solution");
}
