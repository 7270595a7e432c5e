//! The fit with blur and shape free, from roughly the right place.

use super::Outline;
use super::band::Band;
use super::coverage::{MAX_VARIANCE, Smear};
use super::estimate::{Estimate, ROOM, SETTLED, SLOPE_SIGMA, USUAL_NOISE, judged};
use super::grey::{Equations, Model, WHOLE, equations, residuals};
use super::sectors::{ROUNDS, begin_carefully, flat_noise, review};
use crate::image::ImageView;
use crate::math;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// How far the shape may be from the prediction before the data tell (one sigma of a relative stretch).
const SHAPE_SIGMA: f64 = 0.05;
/// How far the blur's variance may be from what is expected before the data tell, px² (one sigma).
const BLUR_SIGMA: f64 = 4.0;
/// Misfit that no sector is dropped for, pixels of the rim's position.
const SECTOR_FLOOR_PX: f64 = 0.05;
/// Looks at the pixels in [`settle`] before sectors are judged.
const LOOKS: usize = 8;

/// Solves with a factor at hand; `None` where the pixels fix nothing.
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

/// The shift with blur and shape fitted too, about an outline of roughly the right place, without sectors that do not
/// fit.
///
/// Work is bounded: [`LOOKS`] looks, and two more for each of [`ROUNDS`] reviews.
pub(crate) fn settle(
    band: &mut Band,
    image: &ImageView<'_>,
    outline: &Outline,
    start: Vector2<f64>,
    smear: Smear,
    sign: f64,
) -> Option<Estimate> {
    let (mut outline, mut start) = (*outline, start);
    let mut total = [0.0_f64; 3];
    let expected = f64::from(smear.variance);
    band.gather(image, &outline, start, f64::from(smear.reach()) + 2.0 * ROOM);
    let (mut m, mut hidden) = begin_carefully(band, smear)?;
    let (mut left, mut rounds) = (LOOKS, ROUNDS);
    let mut noise = USUAL_NOISE;
    loop {
        let mut e: Equations<WHOLE> = equations(band, &m);
        let matrix = with_priors(&mut e, &m, expected, &total, noise);
        let (mut p, unit) = solve(matrix, &e.right)?;
        limit(&mut p, &m);
        m.add(p.as_slice());
        left = left.saturating_sub(1);
        let moved = math::sqrt(p[0] * p[0] + p[1] * p[1]);
        let bent = p.fixed_rows::<3>(7).norm();
        let settled = moved < SETTLED && bent < 0.01 && math::fabs(p[6]) < 0.1 * (f64::from(m.smear.variance) + 0.1);
        if !settled && left > 0 {
            // The band follows.
            let shape = m.stretch.map(f64::from);
            for (t, s) in total.iter_mut().zip(shape) {
                *t += s;
            }
            start += Vector2::new(f64::from(m.shift[0]), f64::from(m.shift[1]));
            outline = outline.stretched(&shape)?;
            band.gather(image, &outline, start, f64::from(m.smear.reach()) + ROOM);
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
                let mut estimate = judged(band, &m, &e, unit, start, flat, total);
                estimate.hidden = hidden;
                if next != hidden {
                    estimate.misfit_px = f64::INFINITY;
                }
                return Some(estimate);
            }
        }
    }
}

/// The normal matrix with what is expected of blur and shape, at the given noise (grey values squared).
fn with_priors(
    e: &mut Equations<WHOLE>,
    m: &Model,
    expected: f64,
    total: &[f64; 3],
    noise: f64,
) -> SMatrix<f64, WHOLE, WHOLE> {
    let mut matrix = e.matrix;
    let blur = noise / math::sq(BLUR_SIGMA);
    matrix[(6, 6)] += blur;
    e.right[6] += blur * (expected - f64::from(m.smear.variance));
    let slope = noise / math::sq(SLOPE_SIGMA);
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

/// Keeps a step where the model is linear.
fn limit(p: &mut SVector<f64, WHOLE>, m: &Model) {
    let v = f64::from(m.smear.variance);
    let moved = math::sqrt(p[0] * p[0] + p[1] * p[1]);
    let bent = p.fixed_rows::<3>(7).norm();
    let share = (1.0 / moved).min(0.1 / bent).min(1.0);
    for k in [0, 1, 7, 8, 9] {
        p[k] *= share;
    }
    let next = (v + p[6]).clamp(0.4 * v - 0.02, 2.0 * v + 0.15).clamp(0.0, f64::from(MAX_VARIANCE));
    p[6] = next - v;
}
