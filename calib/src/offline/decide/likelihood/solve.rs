//! The solution of the linear model for one size of the edge noise and of the smooth edge error, and the search for
//! both sizes.

use super::linear::Linear;
use super::model::{OUTLIER_SIGMAS, Stretch, USUAL_WAVE_PX};
use nalgebra::{DMatrix, DVector, SMatrix, SVector};

/// Relative sizes of the waves of smooth edge error along a contour, by number of periods: slow ones displace entire
/// outlines and always exist, fast ones come from local shading.
const WAVES: [f64; 7] = [1.0, 1.0, 0.6, 0.4, 0.3, 0.3, 0.3];
/// Columns of a contour's waves: a constant, and a cosine and a sine for each period.
const COLUMNS: usize = 2 * WAVES.len() - 1;
/// Sizes of the smooth edge error that are compared, pixels.
const WAVE_PX: [f64; 7] = [0.02, 0.035, 0.06, 0.1, 0.18, 0.32, 0.6];
/// Spread of its size about [`USUAL_WAVE_PX`], natural logarithm: detected edges show 0.03 to 0.15 px.
const WAVE_SPREAD: f64 = 0.7;
/// No smooth edge error.
pub(super) const NO_WAVES: Option<f64> = None;
/// Weight of the prior `kappa = 1` (points scatter by their stated sigma), in points.
const NOISE_PRIOR_POINTS: f64 = 6.0;

/// Sums of the linear model over the points that are used, in units of their sigmas.
pub(super) struct Sums {
    normal: DMatrix<f64>,
    gradient: DVector<f64>,
    square: f64,
    /// Points used, and all.
    pub(super) used: usize,
    count: usize,
}

/// A contour's waves. No two contours share any, so that each block is eliminated separately.
struct Waves {
    normal: SMatrix<f64, COLUMNS, COLUMNS>,
    cross: DMatrix<f64>,
    gradient: SVector<f64, COLUMNS>,
}

/// The sums together with those of the waves.
pub(super) struct WavySums<'a> {
    sums: &'a Sums,
    waves: Vec<Waves>,
}

/// Solution for one size of the noise: step and inverse normal matrix of everything except the waves.
pub(super) struct Solved {
    pub(super) step: DVector<f64>,
    pub(super) inverse: DMatrix<f64>,
    pub(super) chi2: f64,
    pub(super) log_evidence: f64,
    pub(super) kappa: f64,
    /// Size of the smooth error, pixels, if any.
    pub(super) wave_px: Option<f64>,
}

impl Solved {
    /// Size of the step in standard deviations.
    pub(super) fn size(&self) -> f64 {
        (0..self.step.len()).map(|k| self.step[k].abs() / self.inverse[(k, k)].sqrt()).fold(0.0, f64::max)
    }
}

/// Result of eliminating the waves.
struct Reduced {
    /// Subtracted from the normal matrix and the gradient.
    normal: DMatrix<f64>,
    gradient: DVector<f64>,
    /// Subtracted from chi-squared.
    square: f64,
    log_det: f64,
    /// `B^-1` of each contour's block.
    inverse: Vec<SMatrix<f64, COLUMNS, COLUMNS>>,
}

impl Sums {
    pub(super) fn new(linear: &Linear, used: &[bool]) -> Self {
        let rows: Vec<usize> = used.iter().enumerate().filter(|(_, u)| **u).map(|(i, _)| i).collect();
        let scaled = DMatrix::from_fn(rows.len(), linear.columns.ncols(), |i, k| {
            linear.columns[(rows[i], k)] / linear.sigma[rows[i]]
        });
        let r = DVector::from_fn(rows.len(), |i, _| linear.points[rows[i]].residual / linear.sigma[rows[i]]);
        Self {
            normal: scaled.tr_mul(&scaled),
            gradient: scaled.tr_mul(&r),
            square: r.norm_squared(),
            used: rows.len(),
            count: used.len(),
        }
    }

    pub(super) fn with_waves(&self, linear: &Linear, stretches: &[Stretch], used: &[bool]) -> WavySums<'_> {
        let mut first = 0;
        let waves = stretches.iter().map(|s| {
            let rows = first..first + s.points.len();
            first = rows.end;
            Waves::new(linear, rows.zip(&s.parameter).filter(|(i, _)| used.get(*i).is_some_and(|u| *u)))
        });
        WavySums { waves: waves.collect(), sums: self }
    }

    /// The solution without waves.
    pub(super) fn solve(&self, linear: &Linear, wave_px: Option<f64>, kappa: f64) -> Option<Solved> {
        WavySums { sums: self, waves: Vec::new() }.solve(linear, wave_px, kappa)
    }
}

impl Waves {
    fn new<'a>(linear: &Linear, rows: impl Iterator<Item = (usize, &'a f64)>) -> Self {
        let width = linear.columns.ncols();
        let rows: Vec<(usize, SVector<f64, COLUMNS>)> =
            rows.map(|(i, t)| (i, waves_at(*t) / linear.sigma[i])).collect();
        let mut out =
            Self { normal: SMatrix::zeros(), cross: DMatrix::zeros(COLUMNS, width), gradient: SVector::zeros() };
        let scaled =
            DMatrix::from_fn(rows.len(), width, |n, k| linear.columns[(rows[n].0, k)] / linear.sigma[rows[n].0]);
        let own = DMatrix::from_fn(rows.len(), COLUMNS, |n, k| rows[n].1[k]);
        out.cross = own.tr_mul(&scaled);
        for (i, w) in &rows {
            out.normal += w * w.transpose();
            out.gradient += w * (linear.points[*i].residual / linear.sigma[*i]);
        }
        out
    }
}

/// The waves at a parameter of the contour.
fn waves_at(t: f64) -> SVector<f64, COLUMNS> {
    let mut out = SVector::zeros();
    for (w, weight) in WAVES.iter().enumerate() {
        let (sin, cos) = (w as f64 * t).sin_cos();
        if w == 0 {
            out[0] = *weight;
        } else {
            out[2 * w - 1] = weight * cos;
            out[2 * w] = weight * sin;
        }
    }
    out
}

impl WavySums<'_> {
    /// Eliminates waves of a given size for a noise `kappa` with square `k2`.
    fn reduced(&self, wave_px: f64, k2: f64) -> Option<Reduced> {
        let width = self.sums.gradient.len();
        let mut out = Reduced {
            normal: DMatrix::zeros(width, width),
            gradient: DVector::zeros(width),
            square: 0.0,
            log_det: 0.0,
            inverse: Vec::with_capacity(self.waves.len()),
        };
        for w in &self.waves {
            let factor = (w.normal / k2 + SMatrix::identity() * wave_px.powi(-2)).cholesky()?;
            out.log_det += 2.0 * factor.l_dirty().diagonal().iter().map(|v| v.ln()).sum::<f64>();
            let inverse = factor.inverse();
            let by = inverse * w.gradient / k2;
            out.normal += w.cross.tr_mul(&(inverse * &w.cross)) / (k2 * k2);
            out.gradient += w.cross.tr_mul(&by) / k2;
            out.square += w.gradient.dot(&by) / k2;
            out.inverse.push(inverse);
        }
        Some(out)
    }

    /// Solves the linear model for a size of the smooth error, with the noise of the points optimised from a start.
    fn solve(&self, linear: &Linear, wave_px: Option<f64>, start: f64) -> Option<Solved> {
        let sums = self.sums;
        let width = sums.gradient.len();
        let mut kappa = start;
        let mut best = None;
        let weight = wave_px.map_or(0.0, |w| w.powi(-2));
        for _ in 0..2 {
            let k2 = kappa * kappa;
            let reduced = self.reduced(wave_px.unwrap_or(1.0), k2)?;
            let mut m = &sums.normal / k2 - &reduced.normal;
            let mut g = &sums.gradient / k2 - &reduced.gradient;
            let mut prior = 0.0;
            for k in 0..width {
                m[(k, k)] += 1.0;
                g[k] += linear.offset[k];
                prior += linear.offset[k] * linear.offset[k];
            }
            let factor = m.cholesky()?;
            let log_det = 2.0 * factor.l_dirty().diagonal().iter().map(|v| v.ln()).sum::<f64>() + reduced.log_det;
            let inverse = factor.inverse();
            let step = -(&inverse * &g);
            let chi2 = sums.square / k2 - reduced.square + prior + g.dot(&step);
            // Contribution of the priors to chi-squared and to the degrees of freedom.
            let mut by_prior: f64 = (0..width).map(|k| (linear.offset[k] + step[k]).powi(2)).sum();
            let mut kept = inverse.trace();
            for (w, b) in self.waves.iter().zip(&reduced.inverse) {
                let bc = b * &w.cross / k2;
                let size = -(b * w.gradient / k2 + &bc * &step);
                by_prior += weight * size.norm_squared();
                kept += weight * (b.trace() + bc.tr_mul(&bc).component_mul(&inverse).sum());
            }
            let taken = (width + COLUMNS * self.waves.len()) as f64 - kept;
            let data = (chi2 - by_prior) * k2;
            let free = (sums.used as f64 - taken).max(1.0);
            let lost = (sums.count - sums.used) as f64 * OUTLIER_SIGMAS * OUTLIER_SIGMAS;
            let log_size = wave_px.map_or(0.0, |w| -0.5 * ((w / USUAL_WAVE_PX).ln() / WAVE_SPREAD).powi(2));
            let log_noise = -0.5 * NOISE_PRIOR_POINTS * (1.0 / k2 - 1.0 + k2.ln());
            let log_waves = wave_px.map_or(0.0, |w| -w.ln() * (COLUMNS * self.waves.len()) as f64);
            let log_evidence = -0.5 * (chi2 + lost) - 0.5 * log_det + log_waves - sums.count as f64 * kappa.ln()
                + log_size
                + log_noise;
            best = Some(Solved { step, inverse, chi2, log_evidence, kappa, wave_px });
            let next = ((data.max(0.0) + NOISE_PRIOR_POINTS) / (free + NOISE_PRIOR_POINTS)).sqrt();
            if (next / kappa - 1.0).abs() < 0.02 {
                break;
            }
            kappa = next.clamp(0.3, 100.0);
        }
        best
    }

    /// Solves for the size of the smooth error with the largest evidence: hill climbing from the usual size, since the
    /// evidence has one maximum.
    pub(super) fn best_noise(&self, linear: &Linear, kappa: f64) -> Option<Solved> {
        let usual = WAVE_PX.iter().position(|w| *w >= USUAL_WAVE_PX)?;
        let size = |at: usize| WAVE_PX.get(at).copied();
        let mut best = self.solve(linear, size(usual), kappa)?;
        for up in [true, false] {
            let mut at = usual;
            while let Some(next) = if up { Some(at + 1) } else { at.checked_sub(1) }.filter(|k| *k < WAVE_PX.len()) {
                let there = self.solve(linear, size(next), best.kappa)?;
                if there.log_evidence <= best.log_evidence {
                    break;
                }
                (at, best) = (next, there);
            }
            if at != usual {
                break;
            }
        }
        Some(best)
    }
}
