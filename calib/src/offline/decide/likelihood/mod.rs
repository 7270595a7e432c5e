//! The one likelihood by which every model of every set of contours is fitted, judged and compared.
//!
//! The distance of edge point `i` from the predicted outline is
//!
//! ```text
//! r_i(theta, phi) = e_i + B_i a,    e_i ~ N(0, kappa^2 sigma_i^2),    a ~ N(0, s^2),    phi ~ N(0, I)
//! ```
//!
//! `theta` is the shape, `phi` what is unknown of the rig
//! ([`RigError::modes`](crate::offline::correspondence::rig_error::RigError)), and `B a` the part of the edge error
//! that varies smoothly round a contour (blur, shading, a neighbouring edge), as a short Fourier series for each
//! contour. `kappa` and `s` are estimated with the rest, under a prior. Everything is linear at the optimum, so that
//! one normal matrix gives the estimate, the covariance of shape and rig together, chi-squared and the evidence
//! `p(points | model)` by Laplace's method. Derived in `docs/PAPER.md`, "One likelihood".

mod linear;
mod shape;
mod solve;

pub(in crate::offline) use shape::Shape;

use crate::offline::correspondence::rig_error::RigError;
use crate::offline::rim::model::{EdgePoint, Projection};
use linear::Linear;
use nalgebra::{DMatrix, DVector};
use solve::{NO_WAVES, Solved, Sums};

/// A point farther from the outline than this, in its own standard deviations, is somebody else's and costs as much.
pub(in crate::offline) const OUTLIER_SIGMAS: f64 = 4.5;
/// Gauss-Newton rounds at most, and the step, in standard deviations of the answer, from which it has converged.
const ROUNDS: usize = 14;
const CONVERGED: f64 = 0.05;

/// One contour's edge points.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Stretch {
    /// View, 0 or 1.
    pub(in crate::offline) view: usize,
    /// The points.
    pub(in crate::offline) points: Vec<EdgePoint>,
    /// Place of each round the contour, radians.
    pub(in crate::offline) place: Vec<f64>,
    /// Which of the shapes it belongs to.
    pub(in crate::offline) shape: usize,
}

/// A model at its optimum.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Fitted {
    /// The shapes.
    pub(in crate::offline) shapes: Vec<Shape>,
    /// Logarithm of the evidence, up to a constant of the points.
    pub(in crate::offline) log_evidence: f64,
    /// Squared residuals in their own covariance, priors included: chi-squared with about `dof` degrees of freedom
    /// for a right model.
    pub(in crate::offline) chi2: f64,
    /// Degrees of freedom.
    pub(in crate::offline) dof: f64,
    /// Noise of the points in units of their own sigmas.
    pub(in crate::offline) kappa: f64,
    /// Size of the smooth edge error, pixels.
    pub(in crate::offline) wave_px: f64,
    /// Expected rig error in units of the modes.
    pub(in crate::offline) phi: DVector<f64>,
    /// Covariance of the first shape (centre, normal in `frame_of`, shape; natural units) and of the rig's modes
    /// after it.
    pub(in crate::offline) cov: DMatrix<f64>,
    /// Number of the first shape's parameters.
    pub(in crate::offline) parameters: usize,
    /// Residual of each point with the estimated rig error put right, pixels, and whether it was used; in the
    /// stretches' order.
    pub(in crate::offline) residuals: Vec<(f64, bool)>,
}

/// A hypothesis about some contours: shapes, and whether the right contour is another one than the left.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Hypothesis {
    /// The shapes that the stretches belong to.
    pub(in crate::offline) shapes: Vec<Shape>,
    /// Standard deviation, pixels, of how far a contour of the right image lies from where the left one's shape puts
    /// it, across and in height over the epipolar lines. `None` if both are images of one shape.
    pub(in crate::offline) unrelated_px: Option<f64>,
}

impl Hypothesis {
    /// Number of parameters by which unrelated contours are displaced.
    fn displacements(&self) -> usize {
        if self.unrelated_px.is_some() { 2 * self.shapes.len() } else { 0 }
    }
}

/// Part of each contour that a model has to explain: the rest is hidden or somebody else's.
const EXPLAINED: f64 = 0.5;

fn explains(stretches: &[Stretch], used: &[bool]) -> bool {
    let mut next = used.iter();
    stretches.iter().all(|s| {
        let kept = next.by_ref().take(s.points.len()).filter(|u| **u).count();
        kept as f64 >= EXPLAINED * s.points.len() as f64
    })
}

/// Fits a hypothesis to contours. `None` where it leads nowhere (a shape collapses, a point has no residual).
///
/// A rig file is right as it stands, or it has an error of which the images of the pair leave a part open; the
/// matches say which of both is the likelier ([`RigError::log_odds_given`]), and so do the contours. The evidence is
/// that of the mixture. The estimate is that of the likelier: an error that is not there would only let the noise of
/// matches and edges into directions that a good rig determines better. The covariance is that of the unknown rig,
/// taken about the estimate, since a rig that seems right may still be wrong where nothing shows it.
pub(in crate::offline) fn fit(hypothesis: &Hypothesis, stretches: &[Stretch], rig: &RigError) -> Option<Fitted> {
    let free = fit_rig(hypothesis, stretches, rig)?;
    let least_squares = || free.about(free.fitted.clone(), free.fitted.phi.clone());
    if rig.modes.is_empty() {
        return Some(least_squares());
    }
    let start = Hypothesis { shapes: free.fitted.shapes.clone(), ..hypothesis.clone() };
    let held = |phi: &[f64]| fit_rig(&start, stretches, &rig.held(phi)).map(|f| f.fitted);
    let Some(given) = held(rig.given()) else { return Some(least_squares()) };
    // Weights of both, whose sum is one.
    let odds = rig.log_odds_given();
    let by_odds = |log: f64| -(1.0 + log.exp()).ln();
    let (a, b) = (free.fitted.log_evidence + by_odds(odds), given.log_evidence + by_odds(-odds));
    let log_evidence = a.max(b) + (1.0 + (-(a - b).abs()).exp()).ln();
    let (estimate, phi) = if a < b {
        (given, DVector::from_column_slice(rig.given()))
    } else {
        // Smooth errors of the edges look like errors of the rig, so that the rig is estimated with the waves.
        let seen = &free.fitted.phi + free.step.rows(free.fitted.parameters, rig.modes.len());
        let Some(put_right) = held(seen.as_slice()) else { return Some(least_squares()) };
        (put_right, seen)
    };
    Some(Fitted { log_evidence, ..free.about(estimate, phi) })
}

/// A fit with everything unknown: its covariance about the solution with waves, which is a step away from the least
/// squares of the shapes.
struct Free {
    fitted: Fitted,
    step: DVector<f64>,
}

impl Free {
    /// Another estimate with this fit's covariance, taken about it.
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
    for round in 0..ROUNDS {
        let linear = Linear::new(hypothesis, &shapes, (&phi, &displaced), stretches, rig)?;
        let used = linear.used(kappa, round);
        let sums = Sums::new(&linear, &used);
        // The estimate is least squares without the waves; what they would move it by goes into its covariance. On
        // real edges, which have more to them than a few waves, it is the better of the two.
        let solved = sums.solve(&linear, NO_WAVES, kappa)?;
        kappa = solved.kappa;
        // Directions that hardly anything determines may creep on; the last round's answer is as good as the next
        // one's.
        if round + 1 == ROUNDS || round >= 2 && solved.size() < CONVERGED {
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
        residuals: linear.places.iter().map(|p| p.residual).zip(used.iter().copied()).collect(),
    };
    Free { fitted, step }
}

/// A view's projection with the expected error of the modes put right.
pub(in crate::offline) fn corrected(rig: &RigError, phi: &DVector<f64>, view: usize) -> Projection {
    let mut p = rig.p.get(view).copied().unwrap_or_default();
    for (mode, v) in rig.modes.iter().zip(phi.iter()) {
        p += mode.get(view).copied().unwrap_or_default() * *v;
    }
    p
}
