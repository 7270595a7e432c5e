//! The least-squares fit of overlapping blurred steps to the slope across an edge.
//!
//! Every step contributes a Gaussian bell of the known blur width. The shading of the two surfaces beside the first
//! step contributes a constant slope on either side, blurred across the step.

use crate::offline::edges::slope::{REACH, SLOPES};
use nalgebra::{SMatrix, SVector};

/// Largest number of steps fitted to one slope profile.
pub(super) const MAX_STEPS: usize = 4;
/// Parameters of the fit: amplitude and position of every step, then the two shading slopes.
const PARAMETERS: usize = 2 * MAX_STEPS + 2;
/// Index of the first shading parameter.
const SHADING: usize = 2 * MAX_STEPS;
/// Largest number of Levenberg-Marquardt steps, accepted or not.
const MAX_ITERATIONS: usize = 25;
/// Largest change of a position in one iteration, pixels.
const MAX_POSITION_STEP_PX: f64 = 0.7;

/// Steps fitted to a slope profile.
pub(super) struct StepFit {
    /// Height of each step, grey levels.
    pub(super) amplitude: [f64; MAX_STEPS],
    /// Position of each step from the middle of the profile, pixels along the gradient.
    pub(super) position: [f64; MAX_STEPS],
    /// Number of steps in use.
    pub(super) count: usize,
    /// Slope of the shading on the dark and on the bright side of the first step, grey levels per pixel.
    pub(super) shading: [f64; 2],
    /// Prior weight of zero shading; `None` while the shading is held at zero.
    pub(super) shading_prior: Option<f64>,
    /// Slope that the fit leaves unexplained at every sample, grey levels per pixel.
    pub(super) residual: [f64; SLOPES],
    /// Variance of the first position for slope noise of unit variance.
    pub(super) variance: f64,
}

impl StepFit {
    fn is_shaded(&self) -> bool {
        self.shading_prior.is_some()
    }
}

/// Model terms at one sample: the bell of each step, and the blurred fraction of the first step's bright side.
#[derive(Clone, Copy)]
struct Sample {
    bells: [f64; MAX_STEPS],
    bright: f64,
}

/// Position of sample `i`, pixels.
fn position_of(i: usize) -> f64 {
    0.5 * (i as f64 - f64::from(REACH))
}

/// Fits amplitudes, positions and shading by Levenberg-Marquardt; `width` is the blur of a step in pixels.
///
/// `None` when a step leaves the profile or the normal matrix is singular.
pub(super) fn solve(slope: &[f64; SLOPES], width: f64, fit: &mut StepFit) -> Option<()> {
    let mut samples = [Sample { bells: [0.0; MAX_STEPS], bright: 0.0 }; SLOPES];
    let mut now = cost(slope, width, fit, &mut samples);
    let mut damp = 1e-4;
    for _ in 0..MAX_ITERATIONS {
        let (mut a, g) = normal_equations(width, fit, &samples);
        for k in 0..PARAMETERS {
            a[(k, k)] *= 1.0 + damp;
        }
        let step = a.cholesky()?.solve(&g);
        let before = (fit.amplitude, fit.position, fit.residual, fit.shading, samples);
        for k in 0..fit.count {
            fit.amplitude[k] += step[2 * k];
            fit.position[k] += step[2 * k + 1].clamp(-MAX_POSITION_STEP_PX, MAX_POSITION_STEP_PX);
        }
        for k in 0..2 {
            fit.shading[k] += step[SHADING + k];
        }
        if fit.position.iter().take(fit.count).any(|p| p.abs() > 0.5 * f64::from(REACH) + 1.0) {
            return None;
        }
        let next = cost(slope, width, fit, &mut samples);
        if next <= now {
            let small = (now - next) <= 1e-9 * now;
            now = next;
            damp = (damp * 0.2).max(1e-9);
            if small {
                break;
            }
        } else {
            (fit.amplitude, fit.position, fit.residual, fit.shading, samples) = before;
            damp *= 10.0;
            if damp > 1e4 {
                break;
            }
        }
    }
    fit.variance = normal_equations(width, fit, &samples).0.cholesky()?.inverse()[(1, 1)];
    Some(())
}

/// Sum of squared residuals with the shading prior. Stores the residuals in `fit` and the model terms in `samples`,
/// which the derivatives at the same state reuse.
fn cost(slope: &[f64; SLOPES], width: f64, fit: &mut StepFit, samples: &mut [Sample; SLOPES]) -> f64 {
    let unit = width * (2.0 * std::f64::consts::PI).sqrt();
    let mut sum = 0.0;
    for (i, (s, sample)) in slope.iter().zip(samples).enumerate() {
        let mut y = 0.0;
        for k in 0..fit.count {
            let z = (position_of(i) - fit.position[k]) / width;
            sample.bells[k] = (-0.5 * z * z).exp() / unit;
            y += fit.amplitude[k] * sample.bells[k];
        }
        if fit.is_shaded() {
            // The normal distribution function, by its tanh approximation: either side's shading ends at the first
            // step, blurred by the same lens.
            let z = (position_of(i) - fit.position[0]) / width;
            sample.bright = 0.5 + 0.5 * (0.797_885 * z + 0.035_68 * z * z * z).tanh();
            y += fit.shading[0] * (1.0 - sample.bright) + fit.shading[1] * sample.bright;
        }
        let r = s - y;
        fit.residual[i] = r;
        sum += r * r;
    }
    sum + fit.shading_prior.unwrap_or(0.0) * fit.shading.iter().map(|s| s * s).sum::<f64>()
}

/// Normal matrix (lower triangle) and gradient. Parameters that are not in use have a unit diagonal and do not move.
fn normal_equations(
    width: f64,
    fit: &StepFit,
    samples: &[Sample; SLOPES],
) -> (SMatrix<f64, PARAMETERS, PARAMETERS>, SVector<f64, PARAMETERS>) {
    let mut a = SMatrix::<f64, PARAMETERS, PARAMETERS>::zeros();
    let mut g = SVector::<f64, PARAMETERS>::zeros();
    let steps = 2 * fit.count;
    let uses = |k: usize| k < steps || (k >= SHADING && fit.is_shaded());
    let (mut used, mut count) = ([0usize; PARAMETERS], 0);
    for k in (0..PARAMETERS).filter(|k| uses(*k)) {
        used[count] = k;
        count += 1;
    }
    let used = &used[..count];
    for (i, (residual, sample)) in fit.residual.iter().zip(samples).enumerate() {
        let mut d = [0.0; PARAMETERS];
        for k in 0..fit.count {
            let z = (position_of(i) - fit.position[k]) / width;
            d[2 * k] = sample.bells[k];
            d[2 * k + 1] = fit.amplitude[k] * sample.bells[k] * z / width;
        }
        if fit.is_shaded() {
            d[1] += (fit.shading[0] - fit.shading[1]) * sample.bells[0];
            d[SHADING] = 1.0 - sample.bright;
            d[SHADING + 1] = sample.bright;
        }
        for (n, p) in used.iter().enumerate() {
            g[*p] += d[*p] * residual;
            for q in &used[n..] {
                a[(*q, *p)] += d[*q] * d[*p];
            }
        }
    }
    let size = a.diagonal().max();
    for k in 0..PARAMETERS {
        a[(k, k)] = if uses(k) { a[(k, k)] + 1e-12 * size } else { 1.0 };
    }
    if let Some(prior) = fit.shading_prior {
        for k in 0..2 {
            a[(SHADING + k, SHADING + k)] += prior;
            g[SHADING + k] -= prior * fit.shading[k];
        }
    }
    (a, g)
}
