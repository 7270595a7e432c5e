//! The fit of a rig's error to matches: redescending Gauss-Newton, then a mixture over the quality of the rig.

use crate::offline::correspondence::epipolar::{Match, epipolar_distance, fundamental};
use crate::offline::correspondence::rig_prior::{PARAMETERS, Phi, RigPrior};
use crate::offline::edges::lens::projection;
use graspd_rt::geom::{Rig, View};
use nalgebra::SMatrix;

/// Qualities of a rig that are compared, as scales of the prior: from a rig as good as a pixel allows to one as bad as
/// stated.
const QUALITIES: [f64; 6] = [0.03, 0.06, 0.12, 0.25, 0.5, 1.0];
/// Scatters of correct matches across their lines that are compared, pixels: patches of a clean, and of a blurred or
/// compressed image.
const SCATTERS_PX: [f64; 3] = [0.1, 0.2, 0.4];
/// Weight of a match: spots come in groups that share one edge or one occlusion and its error, so that two count as
/// one.
const WEIGHT: f64 = 0.5;
/// Prior probability that a match is false.
const P_FALSE: f64 = 0.5;
/// Range across its line over which a false match is uniform, pixels: the reach of the search.
pub(super) const SPREAD_PX: f64 = 16.0;
/// Smallest standard deviation of a match, pixels: the cameras do not see a patch from the same direction.
const MIN_SIGMA_PX: f64 = 0.1;

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

    /// Signed distance of each right point from the epipolar line of the left one, pixels.
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
    /// The prior states how bad a rig may be. The observable part of the error shows how good this rig is: all of it
    /// comes from one calibration, so that a rig whose epipolar lines fit ten times better than the prior expects is
    /// ten times better in its unobservable part. With the quality `q` as the scale of the prior, the evidence of the
    /// matches follows by Laplace's method. The result is the mixture over [`QUALITIES`], all equally likely a priori.
    pub(super) fn by_quality(&self, start: &Phi) -> Option<Mixture> {
        let (r, j) = (self.residuals(start), self.slopes(start));
        // The model is linear in the error from here on.
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
        let exact: f64 = SCATTERS_PX.iter().map(|s| (log_likelihood(&rows, &Phi::zeros(), *s) - most).exp()).sum();
        let log_odds = exact.ln() - (total / QUALITIES.len() as f64).ln();
        let weight = |log: f64| (log - most).exp() / total;
        let mean: Phi = each.iter().map(|(l, _, m, _)| m * weight(*l)).sum();
        let scatter = each.iter().map(|(l, s, _, _)| s * weight(*l)).sum();
        let mut cov = SMatrix::<f64, PARAMETERS, PARAMETERS>::zeros();
        for (l, _, m, c) in &each {
            cov += (c + (m - mean) * (m - mean).transpose()) * weight(*l);
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
            let w = weight(*r, m.sigma.max(MIN_SIGMA_PX));
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

/// Mean and covariance of the error, the scatter of correct matches in pixels, and the log odds of no error at all.
pub(super) struct Mixture {
    pub(super) mean: Phi,
    pub(super) cov: SMatrix<f64, PARAMETERS, PARAMETERS>,
    pub(super) scatter: f64,
    pub(super) log_odds: f64,
}

/// A match in the linear model: distance from its line at zero error, slope of the distance, and standard deviation of
/// the match.
struct Row {
    residual: f64,
    slope: Phi,
    sigma: f64,
}

/// Probability densities of a correct and of a false match at `t` standard deviations `s` from its line, each times
/// its prior.
fn densities(t: f64, s: f64) -> (f64, f64) {
    let root = (2.0 * std::f64::consts::PI).sqrt();
    ((1.0 - P_FALSE) / (s * root) * (-0.5 * t * t).exp(), P_FALSE / SPREAD_PX)
}

/// Log likelihood of the matches for an error.
fn log_likelihood(rows: &[Row], at: &Phi, scatter: f64) -> f64 {
    let each = rows.iter().map(|row| {
        let s = scatter.hypot(row.sigma);
        let (correct, wrong) = densities((row.residual + row.slope.dot(at)) / s, s);
        (correct + wrong).ln()
    });
    WEIGHT * each.sum::<f64>()
}

/// Maximum a posteriori for one scatter and one quality, with its log evidence. A match is correct with this scatter,
/// or false and uniform within [`SPREAD_PX`].
fn robust(rows: &[Row], start: &Phi, scatter: f64, q: f64) -> Option<(f64, Phi, SMatrix<f64, PARAMETERS, PARAMETERS>)> {
    let identity = SMatrix::<f64, PARAMETERS, PARAMETERS>::identity();
    let mut at = *start;
    let mut found = None;
    for _ in 0..12 {
        let (mut n, mut b, mut log) = (SMatrix::<f64, PARAMETERS, PARAMETERS>::zeros(), Phi::zeros(), 0.0);
        for Row { residual: r0, slope: j, sigma } in rows {
            let s = scatter.hypot(*sigma);
            let t = (r0 + j.dot(&at)) / s;
            let (correct, wrong) = densities(t, s);
            log += WEIGHT * (correct + wrong).ln();
            let w = WEIGHT * correct / (correct + wrong) / (s * s);
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
