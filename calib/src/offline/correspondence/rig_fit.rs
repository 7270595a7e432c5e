//! FIT

use crate::offline::correspondence::epipolar::{Match, epipolar_distance, fundamental};
use crate::offline::correspondence::rig_prior::{PARAMETERS, Phi, RigPrior};
use crate::offline::edges::lens::projection;
use graspd_rt::geom::{Rig, View};
use nalgebra::SMatrix;

/// Qualities of a rig that are weighed, as scales of the prior: from one as good as a pixel allows to one as bad as
/// stated.
const QUALITIES: [f64; 6] = [0.03, 0.06, 0.12, 0.25, 0.5, 1.0];
/// Scatters of right matches across their lines that are weighed, pixels: patches of a clean image, of a blurred or
/// compressed one.
const SCATTERS_PX: [f64; 3] = [0.1, 0.2, 0.4];
/// Weight of a match: spots come in groups that see one edge or one occlusion and are off together, so that two count
/// as one.
const WEIGHT: f64 = 0.5;
/// Part of the matches that is false beforehand.
const FALSE: f64 = 0.5;
/// A false match lies anywhere within so many pixels across its line: as far as the search climbs.
pub(super) const SPREAD_PX: f64 = 16.0;
/// Least standard deviation of a match, pixels: patches are not seen from the same side by both cameras.
const LEAST_SIGMA_PX: f64 = 0.1;

/// Distances of matches from their epipolar lines, as functions of the rig's error.
pub(super) struct Epipolar<'a> {
    rig: &'a Rig,
    prior: &'a RigPrior,
    matches: &'a [Match],
}

impl<'a> Epipolar<'a> {
    pub(super) fn new(rig: &'a Rig, prior: &'a RigPrior, matches: &'a [Match]) -> Self {
        Self { rig, prior, matches }
    }

    /// Signed distance of each right place from the left one's epipolar line, pixels.
    pub(super) fn residuals(&self, phi: &Phi) -> Vec<f64> {
        let rig = self.prior.corrected(self.rig, phi);
        let Some(f) = fundamental(&View::BOTH.map(|v| projection(&rig, v))) else {
            return vec![f64::INFINITY; self.matches.len()];
        };
        self.matches.iter().map(|m| epipolar_distance(&f, &m.at)).collect()
    }

    pub(super) fn slopes(&self, phi: &Phi) -> Vec<Phi> {
        const STEP: f64 = 0.05;
        let mut out = vec![Phi::zeros(); self.matches.len()];
        for i in 0..PARAMETERS {
            let mut d = Phi::zeros();
            d[i] = STEP;
            let (ahead, behind) = (self.residuals(&(phi + d)), self.residuals(&(phi - d)));
            for ((o, a), b) in out.iter_mut().zip(ahead).zip(behind) {
                o[i] = (a - b) / (2.0 * STEP);
            }
        }
        out
    }

    /// Mean and covariance of the error when the quality of the rig is itself unknown.
    ///
    /// The prior says how bad a rig may be; how good this one is, its visible part says: one calibration made all of
    /// it, so that a rig whose epipolar lines fit ten times better than the prior expects is ten times better in what
    /// cannot be seen. With the quality `q` as the scale of the prior, the evidence of the matches follows by
    /// Laplace's method; the answer is the mixture over [`QUALITIES`], each as likely as the other beforehand.
    pub(super) fn by_quality(&self, start: &Phi) -> Option<Mixture> {
        let (r, j) = (self.residuals(start), self.slopes(start));
        // Linear in the error from here on.
        let rows: Vec<Row> = r
            .iter()
            .zip(&j)
            .zip(self.matches)
            .map(|((r, j), m)| Row { residual: r - j.dot(start), slope: *j, sigma: m.sigma })
            .collect();
        let mut each: Vec<(f64, f64, Phi, SMatrix<f64, PARAMETERS, PARAMETERS>)> = Vec::new();
        for scatter in SCATTERS_PX {
            for q in QUALITIES {
                let starts = [*start, Phi::zeros()];
                let found = starts.iter().filter_map(|s| robust(&rows, s, scatter, q));
                let (log, mean, cov) = found.max_by(|a, b| a.0.total_cmp(&b.0))?;
                each.push((log, scatter, mean, cov));
            }
        }
        let most = each.iter().map(|e| e.0).fold(f64::NEG_INFINITY, f64::max);
        let total: f64 = each.iter().map(|e| (e.0 - most).exp()).sum();
        let exact: f64 = SCATTERS_PX.iter().map(|s| (right_or_false(&rows, &Phi::zeros(), *s) - most).exp()).sum();
        let log_odds = exact.ln() - (total / QUALITIES.len() as f64).ln();
        let share = |log: f64| (log - most).exp() / total;
        let mean: Phi = each.iter().map(|(l, _, m, _)| m * share(*l)).sum();
        let scatter = each.iter().map(|(l, s, _, _)| s * share(*l)).sum();
        let mut cov = SMatrix::<f64, PARAMETERS, PARAMETERS>::zeros();
        for (l, _, m, c) in &each {
            cov += (c + (m - mean) * (m - mean).transpose()) * share(*l);
        }
        mean.iter().chain(cov.iter()).all(|v| v.is_finite()).then_some(Mixture { mean, cov, scatter, log_odds })
    }

    /// Gauss-Newton step towards the maximum a posteriori for given weights, and the covariance there.
    pub(super) fn step(
        &self,
        phi: &Phi,
        mut weight: impl FnMut(f64, f64) -> f64,
    ) -> Option<(Phi, SMatrix<f64, PARAMETERS, PARAMETERS>)> {
        let (r, j) = (self.residuals(phi), self.slopes(phi));
        let mut normal = SMatrix::<f64, PARAMETERS, PARAMETERS>::identity();
        let mut gradient = *phi;
        for ((r, j), m) in r.iter().zip(&j).zip(self.matches) {
            let w = weight(*r, m.sigma.max(LEAST_SIGMA_PX));
            if r.is_finite() && w > 0.0 {
                normal += j * j.transpose() * w;
                gradient += j * (r * w);
            }
        }
        let cov = normal.cholesky()?.inverse();
        let step = -(cov * gradient);
        step.iter().all(|v| v.is_finite()).then_some((step, cov))
    }
}

/// Mean and covariance of the error, the scatter of right matches, pixels, and the logarithm of the odds of no error
/// at all.
pub(super) struct Mixture {
    pub(super) mean: Phi,
    pub(super) cov: SMatrix<f64, PARAMETERS, PARAMETERS>,
    pub(super) scatter: f64,
    pub(super) log_odds: f64,
}

/// A match in the linear model: distance from its line at zero error, the distance's slope, and what the match itself
/// is off by.
struct Row {
    residual: f64,
    slope: Phi,
    sigma: f64,
}

/// Probability densities of a match that is right, and of one that is false, where it lies `t` standard deviations
/// `s` from its line.
fn densities(t: f64, s: f64) -> (f64, f64) {
    let root = (2.0 * std::f64::consts::PI).sqrt();
    ((1.0 - FALSE) / (s * root) * (-0.5 * t * t).exp(), FALSE / SPREAD_PX)
}

/// Log likelihood of the matches for an error.
fn right_or_false(rows: &[Row], at: &Phi, scatter: f64) -> f64 {
    let each = rows.iter().map(|row| {
        let s = scatter.hypot(row.sigma);
        let (right, wrong) = densities((row.residual + row.slope.dot(at)) / s, s);
        (right + wrong).ln()
    });
    WEIGHT * each.sum::<f64>()
}

/// Maximum a posteriori for one scatter and one quality, with its log evidence: a match is right, and scatters so
/// much, or it is false and lies anywhere within [`SPREAD_PX`].
fn robust(rows: &[Row], start: &Phi, scatter: f64, q: f64) -> Option<(f64, Phi, SMatrix<f64, PARAMETERS, PARAMETERS>)> {
    let identity = SMatrix::<f64, PARAMETERS, PARAMETERS>::identity();
    let mut at = *start;
    let mut found = None;
    for _ in 0..12 {
        let (mut n, mut b, mut log) = (SMatrix::<f64, PARAMETERS, PARAMETERS>::zeros(), Phi::zeros(), 0.0);
        for Row { residual: r0, slope: j, sigma } in rows {
            let s = scatter.hypot(*sigma);
            let t = (r0 + j.dot(&at)) / s;
            let (right, wrong) = densities(t, s);
            log += WEIGHT * (right + wrong).ln();
            let w = WEIGHT * right / (right + wrong) / (s * s);
            if w > 1e-9 {
                n += j * j.transpose() * w;
                b -= j * (r0 * w);
            }
        }
        let solved = (n + identity * (q * q).recip()).cholesky()?;
        let log_det: f64 = (identity + n * (q * q)).cholesky()?.l().diagonal().iter().map(|v| v.ln()).sum();
        found = Some((log - 0.5 * at.norm_squared() / (q * q) - log_det, at, solved.inverse()));
        let next = solved.solve(&b);
        let moved = (next - at).norm();
        at = next;
        if moved < 1e-3 * q {
            break;
        }
    }
    found
}
