//! The integer programme as written in the paper, for general solvers through [`good_lp`]: for
//! comparison with the own solver, and as a test oracle.

use good_lp::{
    Expression, ProblemVariables, ResolutionError, Solution as _, SolverModel, Variable,
    WithInitialSolution, WithTimeLimit, constraint, solvers::SolutionStatus, variable, variables,
};

use super::{
    programme::{ANY_OVERLAP, Goal, Programme},
    reduction::Reduction,
    solver::Solution,
};

/// A solver of integer programmes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MilpSolver {
    /// `microlp`, in Rust.
    Microlp,
    /// HiGHS, in C++.
    #[cfg(feature = "highs")]
    Highs,
}

/// How to solve an integer programme.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Milp {
    /// The solver.
    pub solver: MilpSolver,
    /// Time limit in seconds of real time.
    pub seconds: f64,
}

/// Why a solver failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the solver of integer programmes failed: {reason}")]
pub struct MilpError {
    /// The solver's message, on one line.
    pub reason: String,
}

/// Improves a known solution, or proves that it is optimal.
///
/// # Errors
/// If the solver fails. Running out of time is not a failure.
pub fn improve(programme: &Programme, known: Solution, milp: &Milp) -> Result<Solution, MilpError> {
    let reduction = Reduction::exact(programme);
    let start = known.chosen.iter().flatten();
    let start: Vec<u32> = start
        .filter_map(|candidate| reduction.candidates.binary_search(candidate).ok())
        .map(|place| place as u32)
        .collect();
    // The reductions may have removed candidates of the initial solution.
    let start = Some(start).filter(|start| reduction.programme.is_feasible(start));
    let model = Model::new(&reduction.programme);
    let answer = match milp.solver {
        MilpSolver::Microlp => model.solve(good_lp::microlp, start.as_deref(), milp.seconds),
        #[cfg(feature = "highs")]
        MilpSolver::Highs => model.solve(good_lp::highs, start.as_deref(), milp.seconds),
    };
    let (chosen, is_optimal) = match answer {
        Ok(answer) => answer,
        Err(ResolutionError::Infeasible) => {
            return Ok(Solution { is_infeasible: known.chosen.is_none(), ..known });
        }
        // The time limit is reached.
        Err(ResolutionError::Other(_)) => return Ok(known),
        Err(error) => {
            let reason = error.to_string().lines().collect::<Vec<_>>().join(" ");
            return Err(MilpError { reason });
        }
    };
    let chosen = reduction.original(&chosen);
    if !programme.is_feasible(&chosen) {
        return Ok(known);
    }
    let value = |chosen: &[u32]| match programme.goal {
        Goal::Fewest { .. } => chosen.len() as u64,
        Goal::Best { .. } => programme.tally(chosen).optional_weight,
    };
    let is_better = known.chosen.as_ref().is_none_or(|known| match programme.goal {
        Goal::Fewest { .. } => value(&chosen) < value(known),
        Goal::Best { .. } => value(&chosen) > value(known),
    });
    let bound = if is_optimal { value(&chosen) } else { known.bound };
    Ok(if is_better {
        Solution { chosen: Some(chosen), bound, is_infeasible: false }
    } else {
        Solution { bound, ..known }
    })
}

/// The programme's variables in [`good_lp`].
struct Model<'p> {
    programme: &'p Programme,
    variables: ProblemVariables,
    /// For each candidate, whether it is chosen.
    chosen: Vec<Variable>,
    /// For each optional cell, whether it is covered.
    covered: Vec<Option<Variable>>,
}

impl<'p> Model<'p> {
    fn new(programme: &'p Programme) -> Self {
        let mut variables = variables!();
        let chosen = variables.add_vector(variable().binary(), programme.candidates());
        let covered = programme
            .demands
            .iter()
            .map(|demand| (!demand.is_required).then(|| variables.add(variable().binary())));
        let covered = covered.collect();
        Self { programme, variables, chosen, covered }
    }

    /// Returns the candidates that a solver chooses, ascending, and whether the solver has proved
    /// that choice to be optimal.
    fn solve<S: SolverModel<Error = ResolutionError> + WithTimeLimit + WithInitialSolution>(
        self,
        solver: impl FnOnce(good_lp::variable::UnsolvedProblem) -> S,
        start: Option<&[u32]>,
        seconds: f64,
    ) -> Result<(Vec<u32>, bool), ResolutionError> {
        let Self { programme, variables, chosen, covered } = self;
        let weight: Expression = programme
            .demands
            .iter()
            .zip(&covered)
            .filter_map(|(demand, covered)| Some(f64::from(demand.weight) * (*covered)?))
            .sum();
        let cameras: Expression = chosen.iter().sum();
        let objective = match programme.goal {
            Goal::Fewest { .. } => cameras.clone(),
            Goal::Best { .. } => -weight.clone(),
        };
        let mut model = solver(variables.minimise(objective)).with_time_limit(seconds);
        model.add_constraint(match programme.goal {
            Goal::Fewest { weight: least } => constraint!(weight >= least as f64),
            Goal::Best { cameras: most } => constraint!(cameras <= most as f64),
        });
        for (cell, demand) in programme.demands.iter().enumerate() {
            let there = programme.covered_by.row(cell).iter();
            let overlap: Expression = there.map(|&it| chosen[it as usize]).sum();
            let least = f64::from(demand.at_least);
            match covered[cell] {
                Some(covered) => {
                    model.add_constraint(constraint!(overlap.clone() >= least * covered));
                }
                None if demand.at_least > 0 => {
                    model.add_constraint(constraint!(overlap.clone() >= least));
                }
                None => {}
            }
            if demand.at_most != ANY_OVERLAP {
                model.add_constraint(constraint!(overlap <= f64::from(demand.at_most)));
            }
        }
        if let Some(start) = start {
            let overlap = programme.overlap(start);
            let is_chosen = |it: usize| start.binary_search(&(it as u32)).is_ok();
            let cells = covered.iter().enumerate();
            let cells = cells.filter_map(|(cell, covered)| {
                let is_covered = overlap[cell] >= programme.demands[cell].at_least;
                Some(((*covered)?, f64::from(u8::from(is_covered))))
            });
            let candidates = chosen.iter().enumerate();
            let candidates =
                candidates.map(|(it, &variable)| (variable, f64::from(u8::from(is_chosen(it)))));
            model = model.with_initial_solution(candidates.chain(cells).collect::<Vec<_>>());
        }
        let solution = model.solve()?;
        let is_chosen = |it: &u32| solution.value(chosen[*it as usize]) > 0.5;
        let found = (0..chosen.len() as u32).filter(is_chosen).collect();
        Ok((found, matches!(solution.status(), SolutionStatus::Optimal)))
    }
}
