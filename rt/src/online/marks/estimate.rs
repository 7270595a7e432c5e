//! Estimates a mark's shift from its predicted outline from the grey values around its rim.
//!
//! [`track`] is for a mark of known shape and blur: two evaluations of the pixels, six unknowns. [`track_occluded`]
//! excludes sectors of the rim that do not fit. `settle` fits blur and shape as well. Each of them compares its
//! residual with the noise of the flat pixels.

use super::Outline;
use super::band::Band;
use super::coverage::PointSpread;
use super::grey::{Equations, Model, PLAIN, equations, residuals};
use super::sectors::{Hidden, MAX_ROUNDS, flat_noise, initial_model, initial_model_occluded, review};
use crate::image::ImageView;
use crate::math;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Margin for the shift beyond the partly covered pixels, px.
pub(crate) const SHIFT_MARGIN_PX: f64 = 0.3;
/// Maximum shift that [`track`] follows, px: beyond, too many pixels of the band have a zero derivative.
const MAX_TRACK_SHIFT_PX: f64 = 0.6;
/// Step length below which the iteration has converged, px: the remaining error is less than 1 % of the step
/// (docs/TRACKER.md: a step of 0.3 px leaves 0.016 px).
pub(crate) const CONVERGED_STEP_PX: f64 = 0.05;
/// Maximum misfit with which [`track`] explains a mark, pixels of rim position: about the effect of rounding to integer
/// grey values at a contrast of a hundred.
pub(crate) const MAX_TRACKED_MISFIT_PX: f64 = 0.008;
/// Standard deviations by which the noise of the rim may exceed that of the flat pixels by chance: one mark in eighty
/// is fitted again without need.
const NOISE_SIGMAS: f64 = 2.5;
/// Prior of the relative slope of the illumination, 1/px (one sigma): 5 % over a disc of 10 px.
pub(crate) const SLOPE_SIGMA_PER_PX: f64 = 0.005;
/// Noise variance that scales the priors before the noise has been estimated, grey values squared.
pub(crate) const DEFAULT_NOISE_VARIANCE: f64 = 4.0;
/// Rim error for which no sector is excluded while shape and blur are fixed, pixels of rim position: a wrong shape is
/// not an occlusion.
const OCCLUSION_FLOOR_PX: f64 = 0.15;
/// Maximum noise variance of flat pixels relative to that of the rim. By chance, a hundred flat pixels exceed it once
/// in 10^9.
const MAX_FLAT_NOISE_RATIO: f64 = 2.5;
/// Standard deviation of flat pixels that is tolerated in addition, as a fraction of the step.
const FLAT_NOISE_FLOOR: f64 = 0.01;
/// Maximum standard deviation of flat pixels with which [`track`] assumes an unoccluded mark, as a fraction of the
/// step.
const MAX_TRACKED_NOISE: f64 = 0.05;

/// Result of a fit.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Estimate {
    /// Shift from the predicted centre, px.
    pub(crate) shift: Vector2<f64>,
    /// Covariance of the shift, px².
    pub(crate) covariance: Matrix2<f64>,
    /// Variance of the blur, px².
    pub(crate) variance: f64,
    /// Symmetric stretch (xx, xy, yy) of the outline.
    pub(crate) stretch: [f64; 3],
    /// Grey difference inside minus outside.
    pub(crate) step: f64,
    /// Error of the rim beyond noise, pixels of rim position.
    pub(crate) misfit_px: f64,
    /// Mean square of the rim residuals, weighted by their information about the shift, grey values squared.
    pub(crate) rim_noise: f64,
    /// Excluded sectors.
    pub(crate) hidden: Hidden,
    /// Fraction of the rim in use.
    pub(crate) fraction: f64,
    /// Standard deviation of the flat pixels, grey values.
    pub(crate) noise: f64,
}

impl Estimate {
    /// Whether noise explains the residual.
    pub(crate) fn explains(&self, limit_px: f64) -> bool {
        self.misfit_px <= limit_px && self.noise <= 0.25 * math::fabs(self.step)
    }
}

/// Estimates the shift of an unoccluded mark with the predicted shape and blur, starting at `start`.
///
/// `None` if the shift is out of range or the pixels do not determine it. `sign` is +1 for a dark mark, -1 for a light
/// one.
pub(crate) fn track(
    band: &mut Band,
    image: &ImageView<'_>,
    outline: &Outline,
    start: Vector2<f64>,
    psf: PointSpread,
    sign: f64,
) -> Option<Estimate> {
    band.gather(image, outline, start, f64::from(psf.reach()) + SHIFT_MARGIN_PX);
    let mut m = initial_model(band, psf)?;
    if f64::from(m.step()) * sign >= 0.0 {
        return None;
    }
    let (e, unit) = iterate(band, &mut m)?;
    let (pixels, squares) = e.flat;
    let noise = squares / (pixels - 3.0).max(1.0);
    let mut estimate = evaluate(band, &m, &e, unit, start, noise, [0.0; 3]);
    // Flat pixels that are noisier than the rim, or noisier than those of an unoccluded mark, contain something else.
    let step2 = math::sq(estimate.step);
    let flat = noise <= MAX_FLAT_NOISE_RATIO * estimate.rim_noise + math::sq(FLAT_NOISE_FLOOR) * step2;
    if !(flat && noise <= math::sq(MAX_TRACKED_NOISE) * step2) {
        estimate.misfit_px = f64::INFINITY;
    }
    Some(estimate)
}

/// Like [`track`], for a mark that may be partly occluded: sectors that do not fit are excluded.
pub(crate) fn track_occluded(
    band: &mut Band,
    image: &ImageView<'_>,
    outline: &Outline,
    start: Vector2<f64>,
    psf: PointSpread,
    sign: f64,
) -> Option<Estimate> {
    band.gather(image, outline, start, f64::from(psf.reach()) + SHIFT_MARGIN_PX);
    let (mut m, mut hidden) = initial_model_occluded(band, psf)?;
    if f64::from(m.step()) * sign >= 0.0 {
        return None;
    }
    for round in 0..=MAX_ROUNDS {
        let (e, unit) = iterate(band, &mut m)?;
        let noise = flat_noise(band);
        let next = review(band, &m, noise, hidden, OCCLUSION_FLOOR_PX);
        if next == hidden || round == MAX_ROUNDS {
            let mut estimate = evaluate(band, &m, &e, unit, start, noise, [0.0; 3]);
            estimate.hidden = hidden;
            if next != hidden {
                estimate.misfit_px = f64::INFINITY;
            }
            return Some(estimate);
        }
        hidden = next;
        hidden.apply(band);
    }
    None
}

/// Gauss-Newton on the plain model: computes one normal matrix and iterates with it until the shift converges.
///
/// Returns the last equations and the covariance of the shift for unit noise (one grey value).
fn iterate(band: &mut Band, m: &mut Model) -> Option<(Equations<PLAIN>, Matrix2<f64>)> {
    let mut e: Equations<PLAIN> = equations(band, m);
    let slope = DEFAULT_NOISE_VARIANCE / math::sq(SLOPE_SIGMA_PER_PX);
    for k in [4, 5] {
        e.matrix[(k, k)] += slope;
    }
    let factor = e.matrix.cholesky()?;
    let mut step = factor.solve(&e.right);
    m.add(step.as_slice());
    let mut converged = false;
    for _ in 0..5 {
        if !(shift_length(m) <= MAX_TRACK_SHIFT_PX) {
            return None;
        }
        residuals(band, m, &mut e);
        for (k, g) in m.slope.iter().enumerate() {
            e.right[4 + k] -= slope * f64::from(*g);
        }
        let before = length(&step, m);
        step = factor.solve(&e.right);
        m.add(step.as_slice());
        converged = before < CONVERGED_STEP_PX || length(&step, m) < 0.02 * CONVERGED_STEP_PX;
        if converged {
            break;
        }
    }
    if !converged {
        return None;
    }
    let mut unit = SMatrix::<f64, PLAIN, 2>::identity();
    factor.solve_mut(&mut unit);
    let unit = Matrix2::new(unit[(0, 0)], unit[(0, 1)], unit[(1, 0)], unit[(1, 1)]);
    unit.iter().all(|v| v.is_finite()).then_some((e, unit))
}

/// Size of a step in pixels of rim position: its shift plus the equivalent of its change of the levels.
fn length(step: &SVector<f64, PLAIN>, m: &Model) -> f64 {
    let levels = math::fabs(step[2]) + math::fabs(step[3]);
    math::sqrt(step[0] * step[0] + step[1] * step[1]) + levels / f64::from(m.step().abs()).max(1.0)
}

fn shift_length(m: &Model) -> f64 {
    let [x, y] = m.shift.map(f64::from);
    math::sqrt(x * x + y * y)
}

/// Shift, covariance and misfit of a converged fit. `unit` is the covariance of the shift for unit noise.
pub(crate) fn evaluate<const N: usize>(
    band: &Band,
    m: &Model,
    e: &Equations<N>,
    unit: Matrix2<f64>,
    start: Vector2<f64>,
    noise: f64,
    stretch: [f64; 3],
) -> Estimate {
    let step = f64::from(m.step());
    // Noise seen by the shift: squared residuals weighted by the squared derivatives, over the effective number of
    // pixels. Two more are subtracted because the inverse has to be unbiased.
    let pixels = math::sq(e.weights) / e.weights2.max(1e-12);
    let freedom = (pixels - (PLAIN - 2) as f64).max(2.0);
    let rim = e.weighted_squares / e.weights.max(1e-12) * (pixels / freedom);
    let allowance = noise * (1.0 + NOISE_SIGMAS * math::sqrt(2.0 / freedom));
    let misfit_px = math::sqrt((rim - allowance).max(0.0)) / math::fabs(step).max(1e-9);
    let kept: f32 = band.rim.weight[..band.rim.len].iter().sum();
    Estimate {
        shift: start + Vector2::new(f64::from(m.shift[0]), f64::from(m.shift[1])),
        covariance: unit * rim,
        variance: f64::from(m.psf.variance),
        stretch,
        step,
        misfit_px,
        rim_noise: rim,
        hidden: Hidden::default(),
        fraction: f64::from(kept) / band.unclipped.max(1) as f64,
        noise: math::sqrt(noise),
    }
}
