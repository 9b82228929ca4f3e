//! A small dense Levenberg-Marquardt solver (Marquardt 1963).
//!
//! The crate `levenberg-marquardt` (0.15) depends on an older nalgebra than this workspace, whose
//! matrices it would not accept; and it takes the whole Jacobian, of thousands of residuals, while a
//! few hundred parameters need only their normal equations.

use nalgebra::{DMatrix, DVector};

/// A sum of squares.
pub(super) trait LeastSquares {
    /// The parameters.
    type State: Clone;

    /// Half of the gradient and of the Gauss-Newton Hessian of the cost: `J^T r` and `J^T J`.
    fn normal_equations(&self, state: &Self::State) -> (DVector<f64>, DMatrix<f64>);

    /// The sum of squares.
    fn cost(&self, state: &Self::State) -> f64;

    /// The parameters after a step.
    fn moved(&self, state: &Self::State, step: &DVector<f64>) -> Self::State;
}

/// Maximum number of steps.
const STEPS: usize = 100;
/// Initial damping, relative to the diagonal of the Hessian.
const DAMPING: f64 = 1e-6;
/// Damping at which no step can lower the cost any more.
const MAX_DAMPING: f64 = 1e12;
/// Norm of a step (radians, metres) after which the minimum is reached.
const SMALL_STEP: f64 = 1e-13;
/// Relative decrease of the cost after which the minimum is reached.
const SMALL_DECREASE: f64 = 1e-15;

/// The parameters of a local minimum near `start`.
pub(super) fn minimise<P: LeastSquares>(problem: &P, start: &P::State) -> P::State {
    let mut state = start.clone();
    let mut cost = problem.cost(&state);
    let mut damping = DAMPING;
    for _ in 0..STEPS {
        let (gradient, hessian) = problem.normal_equations(&state);
        loop {
            if damping > MAX_DAMPING {
                return state;
            }
            let mut damped = hessian.clone();
            for index in 0..damped.nrows() {
                damped[(index, index)] *= 1.0 + damping;
            }
            let Some(cholesky) = damped.cholesky() else {
                damping *= 10.0;
                continue;
            };
            let step = -cholesky.solve(&gradient);
            let next = problem.moved(&state, &step);
            let next_cost = problem.cost(&next);
            if next_cost <= cost {
                let is_minimum =
                    step.norm() < SMALL_STEP || cost - next_cost <= SMALL_DECREASE * cost;
                (state, cost) = (next, next_cost);
                damping = (damping / 10.0).max(1e-15);
                if is_minimum {
                    return state;
                }
                break;
            }
            damping *= 10.0;
        }
    }
    state
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rosenbrock's valley: residuals 10 (y - x^2) and 1 - x.
    struct Valley;

    impl LeastSquares for Valley {
        type State = [f64; 2];

        fn normal_equations(&self, [x, y]: &[f64; 2]) -> (DVector<f64>, DMatrix<f64>) {
            let jacobian = DMatrix::from_row_slice(2, 2, &[-20.0 * x, 10.0, -1.0, 0.0]);
            let residuals = DVector::from_vec(vec![10.0 * (y - x * x), 1.0 - x]);
            (jacobian.transpose() * residuals, jacobian.transpose() * &jacobian)
        }

        fn cost(&self, [x, y]: &[f64; 2]) -> f64 {
            100.0 * (y - x * x).powi(2) + (1.0 - x).powi(2)
        }

        fn moved(&self, [x, y]: &[f64; 2], step: &DVector<f64>) -> [f64; 2] {
            [x + step[0], y + step[1]]
        }
    }

    #[test]
    fn the_bottom_of_a_curved_valley_is_found() {
        let [x, y] = minimise(&Valley, &[-1.2, 1.0]);
        assert!((x - 1.0).abs() < 1e-12 && (y - 1.0).abs() < 1e-12, "{x} {y}");
    }
}
