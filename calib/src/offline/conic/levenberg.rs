//! A bounded Levenberg-Marquardt minimiser over any state with a first-order local chart.

use crate::offline::conic::eigen;
use nalgebra::{SMatrix, SVector};

/// Cost, gradient and Gauss-Newton normal matrix at a state.
pub(crate) struct Linear<const N: usize> {
    pub(crate) cost: f64,
    pub(crate) gradient: SVector<f64, N>,
    pub(crate) normal: SMatrix<f64, N, N>,
}

/// A sum of squares over a state that is stepped through a local chart with `parameters() <= N` coordinates.
pub(crate) trait Problem<const N: usize> {
    type State: Clone;
    fn parameters(&self) -> usize;
    /// `None` where the state is inadmissible.
    fn linearise(&self, state: &Self::State) -> Option<Linear<N>>;
    fn cost(&self, state: &Self::State) -> Option<f64>;
    fn step(&self, state: &Self::State, d: &SVector<f64, N>) -> Self::State;
}

/// Result of a minimisation.
pub(crate) struct Minimum<S, const N: usize> {
    pub(crate) state: S,
    pub(crate) cost: f64,
    /// Gauss-Newton normal matrix at the minimum: its inverse times the noise variance is the covariance.
    pub(crate) normal: SMatrix<f64, N, N>,
    /// Whether the last step was negligible.
    pub(crate) converged: bool,
}

/// Minimises by at most `iterations` accepted steps of at most 12 trials each.
pub(crate) fn minimise<const N: usize, P: Problem<N>>(
    problem: &P,
    start: P::State,
    iterations: usize,
) -> Option<Minimum<P::State, N>> {
    let n = problem.parameters();
    let mut state = start;
    let mut at = problem.linearise(&state)?;
    let mut mu = 1e-4;
    let mut converged = false;
    for _ in 0..iterations {
        if !at.cost.is_finite() {
            return None;
        }
        let mut accepted = None;
        for _ in 0..12 {
            let trace = (0..n).map(|i| at.normal[(i, i)]).sum::<f64>();
            let mut damped = at.normal;
            for i in 0..n {
                damped[(i, i)] += mu * (at.normal[(i, i)] + 1e-15 * trace);
            }
            if let Some(l) = eigen::cholesky(&damped, n) {
                let d = -eigen::solve(&l, &at.gradient, n);
                let next = problem.step(&state, &d);
                // Close to the minimum the cost is flat to rounding: a step that does not raise it by more than that
                // is accepted.
                if let Some(cost) = problem.cost(&next)
                    && cost <= at.cost * (1.0 + 1e-14)
                {
                    accepted = Some((next, d.norm(), cost));
                    break;
                }
            }
            mu = (mu * 10.0).max(1e-9);
        }
        let Some((next, size, cost)) = accepted else {
            // No step lowers the cost. This is the minimum to rounding if the full step is negligible, or its
            // predicted gain is.
            converged = full_step(&at, n).is_some_and(|(size, gain)| size <= 1e-8 || gain <= 1e-9 * at.cost);
            break;
        };
        let small = size < 1e-11 || (at.cost - cost <= 1e-13 * at.cost && mu <= 1e-3);
        state = next;
        at = problem.linearise(&state)?;
        mu = (mu * 0.1).max(1e-12);
        if small {
            converged = true;
            break;
        }
    }
    at.cost.is_finite().then_some(Minimum { state, cost: at.cost, normal: at.normal, converged })
}

/// Length of the undamped step, and its predicted decrease of the cost.
fn full_step<const N: usize>(at: &Linear<N>, n: usize) -> Option<(f64, f64)> {
    let l = eigen::cholesky(&at.normal, n)?;
    let d = eigen::solve(&l, &at.gradient, n);
    Some((d.norm(), d.dot(&at.gradient)))
}
