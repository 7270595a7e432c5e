//! The fit with free blur and shape, from an approximate position.

use super::Outline;
use super::band::Band;
use super::coverage::{MAX_BLUR_PX2, PointSpread};
use super::estimate::{
    CONVERGED_STEP_PX, DEFAULT_NOISE_VARIANCE, Estimate, SHIFT_MARGIN_PX, SLOPE_SIGMA_PER_PX, evaluate,
};
use super::grey::{Equations, FULL, Model, equations, residuals};
use super::sectors::{MAX_ROUNDS, flat_noise, initial_model_occluded, review};
use crate::image::ImageView;
use crate::math;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Prior of the shape: standard deviation of the relative stretch.
const SHAPE_SIGMA: f64 = 0.05;
/// Prior of the blur: standard deviation of its variance, px².
const BLUR_SIGMA_PX2: f64 = 4.0;
/// Rim error for which no sector is excluded, pixels of rim position.
const SECTOR_FLOOR_PX: f64 = 0.05;
/// Maximum number of steps in [`settle`] before the sectors are reviewed.
const MAX_STEPS: usize = 8;

/// Solves the normal equations; also returns the covariance of the shift for unit noise. `None` if the pixels do not
/// determine the unknowns.
fn solve<const N: usize>(
    matrix: SMatrix<f64, N, N>,
    right: &SVector<f64, N>,
) -> Option<(SVector<f64, N>, Matrix2<f64>)> {
    let factor = matrix.cholesky()?;
    let p = factor.solve(right);
    let mut unit = SMatrix::<f64, N, 2>::identity();
    factor.solve_mut(&mut unit);
    let c = Matrix2::new(unit[(0, 0)], unit[(0, 1)], unit[(1, 0)], unit[(1, 1)]);
    p.iter().chain(c.iter()).all(|v| v.is_finite()).then_some((p, c))
}

/// Estimates shift, blur and shape, starting from an outline at an approximate position. Sectors that do not fit are
/// excluded.
///
/// The work is bounded: [`MAX_STEPS`] steps, and two more for each of [`MAX_ROUNDS`] reviews.
pub(crate) fn settle(
    band: &mut Band,
    image: &ImageView<'_>,
    outline: &Outline,
    start: Vector2<f64>,
    psf: PointSpread,
    sign: f64,
) -> Option<Estimate> {
    let (mut outline, mut start) = (*outline, start);
    let mut total = [0.0_f64; 3];
    let expected = f64::from(psf.variance);
    band.gather(image, &outline, start, f64::from(psf.reach()) + 2.0 * SHIFT_MARGIN_PX);
    let (mut m, mut hidden) = initial_model_occluded(band, psf)?;
    let (mut left, mut rounds) = (MAX_STEPS, MAX_ROUNDS);
    let mut noise = DEFAULT_NOISE_VARIANCE;
    loop {
        let mut e: Equations<FULL> = equations(band, &m);
        let matrix = with_priors(&mut e, &m, expected, &total, noise);
        let (mut p, unit) = solve(matrix, &e.right)?;
        limit(&mut p, &m);
        m.add(p.as_slice());
        left = left.saturating_sub(1);
        let moved = math::sqrt(p[0] * p[0] + p[1] * p[1]);
        let stretched = p.fixed_rows::<3>(7).norm();
        let converged =
            moved < CONVERGED_STEP_PX && stretched < 0.01 && math::fabs(p[6]) < 0.1 * (f64::from(m.psf.variance) + 0.1);
        if !converged && left > 0 {
            // Gather the band around the new outline.
            let shape = m.stretch.map(f64::from);
            for (t, s) in total.iter_mut().zip(shape) {
                *t += s;
            }
            start += Vector2::new(f64::from(m.shift[0]), f64::from(m.shift[1]));
            outline = outline.stretched(&shape)?;
            band.gather(image, &outline, start, f64::from(m.psf.reach()) + SHIFT_MARGIN_PX);
            hidden.apply(band);
            (m.shift, m.stretch) = ([0.0; 2], [0.0; 3]);
            continue;
        }
        residuals(band, &m, &mut e);
        let flat = flat_noise(band);
        noise = flat.max(0.1);
        let next = review(band, &m, flat, hidden, SECTOR_FLOOR_PX);
        match next == hidden || rounds == 0 {
            false => {
                hidden = next;
                hidden.apply(band);
                rounds -= 1;
                left = 2;
            }
            true => {
                if f64::from(m.step()) * sign >= 0.0 {
                    return None;
                }
                for (t, s) in total.iter_mut().zip(m.stretch) {
                    *t += f64::from(s);
                }
                let mut estimate = evaluate(band, &m, &e, unit, start, flat, total);
                estimate.hidden = hidden;
                if next != hidden {
                    estimate.misfit_px = f64::INFINITY;
                }
                return Some(estimate);
            }
        }
    }
}

/// The normal matrix with the priors of blur, slope and shape, for the given noise (grey values squared).
fn with_priors(
    e: &mut Equations<FULL>,
    m: &Model,
    expected: f64,
    total: &[f64; 3],
    noise: f64,
) -> SMatrix<f64, FULL, FULL> {
    let mut matrix = e.matrix;
    let blur = noise / math::sq(BLUR_SIGMA_PX2);
    matrix[(6, 6)] += blur;
    e.right[6] += blur * (expected - f64::from(m.psf.variance));
    let slope = noise / math::sq(SLOPE_SIGMA_PER_PX);
    for (k, g) in m.slope.iter().enumerate() {
        matrix[(4 + k, 4 + k)] += slope;
        e.right[4 + k] -= slope * f64::from(*g);
    }
    let shape = noise / math::sq(SHAPE_SIGMA);
    for (k, t) in total.iter().enumerate() {
        matrix[(7 + k, 7 + k)] += shape;
        e.right[7 + k] -= shape * (t + f64::from(m.stretch[k]));
    }
    matrix
}

/// Limits a step to the range in which the model is nearly linear.
fn limit(p: &mut SVector<f64, FULL>, m: &Model) {
    let v = f64::from(m.psf.variance);
    let moved = math::sqrt(p[0] * p[0] + p[1] * p[1]);
    let stretched = p.fixed_rows::<3>(7).norm();
    let fraction = (1.0 / moved).min(0.1 / stretched).min(1.0);
    for k in [0, 1, 7, 8, 9] {
        p[k] *= fraction;
    }
    let next = (v + p[6]).clamp(0.4 * v - 0.02, 2.0 * v + 0.15).clamp(0.0, f64::from(MAX_BLUR_PX2));
    p[6] = next - v;
}
