//! The fit of a hypothesis: Gauss-Newton under the likelihood, for the rig as given and with its error unknown.

use super::linear::Linear;
use super::model::{Fitted, Hypothesis, Stretch};
use super::shape::Shape;
use super::solve::{NO_WAVES, Solved, Sums};
use crate::offline::correspondence::rig_error::RigError;
use nalgebra::{DMatrix, DVector};

/// Largest number of Gauss-Newton iterations.
const MAX_ITERATIONS: usize = 14;
/// Step below which the fit has converged, standard deviations of the result.
const CONVERGED_SIGMAS: f64 = 0.05;

/// Smallest fraction of each contour that a model has to explain: the rest is hidden or belongs to something else.
const MIN_EXPLAINED: f64 = 0.5;

fn explains(stretches: &[Stretch], used: &[bool]) -> bool {
    let mut next = used.iter();
    stretches.iter().all(|s| {
        let kept = next.by_ref().take(s.points.len()).filter(|u| **u).count();
        kept as f64 >= MIN_EXPLAINED * s.points.len() as f64
    })
}

/// Fits a hypothesis to contours. `None` where the fit fails (a shape collapses, a point has no residual).
///
/// A rig file is exact, or it has an error that the images leave partly undetermined. The matches give the odds of the
/// two ([`RigError::log_odds_given`]), and so do the contours. The evidence is that of the mixture. The estimate is
/// that of the more likely case: an error that does not exist would only let the noise of matches and edges into
/// directions that a good rig determines better. The covariance is that of the unknown rig, taken about the estimate,
/// since a rig that seems exact may still be wrong in directions that are not observed.
pub(in crate::offline) fn fit(hypothesis: &Hypothesis, stretches: &[Stretch], rig: &RigError) -> Option<Fitted> {
    let free = fit_rig(hypothesis, stretches, rig)?;
    let least_squares = || free.about(free.fitted.clone(), free.fitted.phi.clone());
    if rig.modes.is_empty() {
        return Some(least_squares());
    }
    let start = Hypothesis { shapes: free.fitted.shapes.clone(), ..hypothesis.clone() };
    let held = |phi: &[f64]| fit_rig(&start, stretches, &rig.held(phi)).map(|f| f.fitted);
    let Some(given) = held(rig.given()) else { return Some(least_squares()) };
    // Log weights of both cases; the weights add up to one.
    let odds = rig.log_odds_given();
    let by_odds = |log: f64| -(1.0 + log.exp()).ln();
    let (a, b) = (free.fitted.log_evidence + by_odds(odds), given.log_evidence + by_odds(-odds));
    let log_evidence = a.max(b) + (1.0 + (-(a - b).abs()).exp()).ln();
    let (estimate, phi) = if a < b {
        (given, DVector::from_column_slice(rig.given()))
    } else {
        // Smooth errors of the edges look like errors of the rig, so that the rig is estimated together with the
        // waves.
        let seen = &free.fitted.phi + free.step.rows(free.fitted.parameters, rig.modes.len());
        let Some(corrected) = held(seen.as_slice()) else { return Some(least_squares()) };
        (corrected, seen)
    };
    Some(Fitted { log_evidence, ..free.about(estimate, phi) })
}

/// A fit with everything unknown. Its covariance is taken about the solution with waves, which is one step away from
/// the least squares of the shapes.
struct Free {
    fitted: Fitted,
    step: DVector<f64>,
}

impl Free {
    /// Another estimate with this fit's covariance, taken about that estimate.
    fn about(&self, estimate: Fitted, phi: DVector<f64>) -> Fitted {
        let free = &self.fitted;
        let by_shape = match (free.shapes.first(), estimate.shapes.first()) {
            (Some(from), Some(to)) => from.difference(to),
            _ => return estimate,
        };
        let by_rig = phi.iter().zip(free.phi.iter()).map(|(to, from)| to - from);
        let apart = DVector::from_iterator(free.cov.nrows(), by_shape.into_iter().take(free.parameters).chain(by_rig));
        let off = apart - &self.step;
        Fitted { cov: &free.cov + &off * off.transpose(), phi, ..estimate }
    }
}

fn fit_rig(hypothesis: &Hypothesis, stretches: &[Stretch], rig: &RigError) -> Option<Free> {
    let mut shapes = hypothesis.shapes.clone();
    let mut phi = DVector::<f64>::zeros(rig.modes.len());
    let mut displaced = vec![0.0; hypothesis.displacements()];
    let mut kappa = 1.0;
    for round in 0..MAX_ITERATIONS {
        let linear = Linear::new(hypothesis, &shapes, (&phi, &displaced), stretches, rig)?;
        let used = linear.used(kappa, round);
        let sums = Sums::new(&linear, &used);
        // The estimate is least squares without the waves; their effect on it goes into its covariance. On real edges,
        // whose errors have more components than a few waves, it is the better of the two.
        let solved = sums.solve(&linear, NO_WAVES, kappa)?;
        kappa = solved.kappa;
        // Directions that are hardly determined may converge slowly; the last iteration is as good as the next.
        if round + 1 == MAX_ITERATIONS || round >= 2 && solved.size() < CONVERGED_SIGMAS {
            if !explains(stretches, &used) {
                return None;
            }
            let best = sums.with_waves(&linear, stretches, &used).best_noise(&linear, kappa)?;
            return Some(result(&linear, shapes, phi, &best, &sums, &used));
        }
        linear.advance(&mut shapes, &solved.step)?;
        for (k, v) in phi.iter_mut().enumerate() {
            *v += solved.step[linear.rig + k];
        }
        for (k, v) in displaced.iter_mut().enumerate() {
            *v += solved.step[linear.rig + phi.len() + k];
        }
    }
    None
}

fn result(linear: &Linear, shapes: Vec<Shape>, phi: DVector<f64>, solved: &Solved, sums: &Sums, used: &[bool]) -> Free {
    let parameters = shapes.first().map_or(0, Shape::parameters);
    let pick: Vec<usize> = (0..parameters).chain(linear.rig..linear.rig + phi.len()).collect();
    let cov = DMatrix::from_fn(pick.len(), pick.len(), |i, j| {
        solved.inverse[(pick[i], pick[j])] * linear.unit[pick[i]] * linear.unit[pick[j]]
    });
    let step = DVector::from_fn(pick.len(), |i, _| solved.step[pick[i]] * linear.unit[pick[i]]);
    let fitted = Fitted {
        shapes,
        log_evidence: solved.log_evidence,
        chi2: solved.chi2,
        dof: (sums.used as f64 - parameters as f64).max(1.0),
        kappa: solved.kappa,
        wave_px: solved.wave_px.unwrap_or(0.0),
        phi,
        cov,
        parameters,
        residuals: linear.points.iter().map(|p| p.residual).zip(used.iter().copied()).collect(),
    };
    Free { fitted, step }
}
