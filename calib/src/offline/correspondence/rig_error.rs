//! The error of the rig: its prior, the evidence from the two images of a pair, and the remaining uncertainty.
//!
//! A rig file is never exact. Its error is a vector `phi` of twelve numbers with a Gaussian prior: rotation and
//! position of the right camera, focal lengths (common and difference), principal points. In units of the prior's
//! standard deviations the prior is `N(0, I)`, and `P(phi) = P + sum_j phi_j dP_j` to first order: for an error of a
//! few tenths of a degree the second-order remainder is below 0.02 px.
//!
//! One pair of images determines the part of `phi` that moves matching points off each other's epipolar lines.
//! [`RigError::observe`] estimates it once for the pair from all matches, so that no contour is tested with a rig that
//! every other point contradicts. What the matches leave undetermined (above all the vergence, which looks like
//! another depth) stays in [`RigError::modes`] and enters every fit and covariance as unknown parameters. Derived in
//! `docs/PAPER.md`, "The rig's error".

use crate::offline::conic::eigen;
use crate::offline::correspondence::epipolar::{Match, epipolar_distance, fundamental};
use crate::offline::correspondence::rig_fit::{Epipolar, Mixture, SPREAD_PX};
use crate::offline::correspondence::rig_prior::{PARAMETERS, Phi, RigPrior, derivatives};
use crate::offline::edges::lens::projection;
use crate::offline::types::projection::{Projection, project};
use graspd_rt::geom::{Rig, View};
use nalgebra::{SMatrix, Vector3};

/// The estimated rig and its remaining uncertainty.
#[derive(Clone, Debug, PartialEq)]
pub struct RigError {
    /// The rig corrected by its expected error.
    pub rig: Rig,
    /// Its projection matrices for ideal pixels.
    pub p: [Projection; 2],
    /// Change of both projection matrices by one standard deviation of each independent mode of the remaining
    /// uncertainty.
    pub modes: Vec<[Projection; 2]>,
    /// The same modes as errors of the rig.
    parts: Vec<Phi>,
    prior: RigPrior,
    /// The rig file as given, in units of the modes.
    given: Vec<f64>,
    /// See [`RigError::log_odds_given`].
    log_odds: f64,
    /// How the matches and the rig file agree.
    pub agreement: Agreement,
}

/// Agreement between a pair of images and a rig file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Agreement {
    /// Number of matches.
    pub matches: usize,
    /// Number of matches that agree on one rig.
    pub agreeing: usize,
    /// Root mean square distance of the agreeing matches from the epipolar lines of the rig file, pixels.
    pub as_given_px: f64,
    /// The same for the corrected rig, pixels.
    pub corrected_px: f64,
    /// The same as predicted by the prior, pixels.
    pub prior_px: f64,
}

/// Typical working distance of a rig, in baselines.
const TYPICAL_DISTANCE: f64 = 3.0;
/// Smallest number of agreeing matches: one for each of the six observable parameters of the error, and as many again
/// to confirm them.
const MIN_AGREEING: usize = 12;
/// Widths of the redescending loss, pixels: from one that covers every rig of the prior to a few standard deviations
/// of a match.
const WIDTHS: [f64; 6] = [8.0, 4.0, 2.0, 1.2, 0.8, 0.6];

impl RigPrior {
    /// The same error, scaled so that it displaces epipolar lines by `px` pixels (one standard deviation). Zero trusts
    /// the rig file.
    pub fn displacing(self, rig: &Rig, px: f64) -> Self {
        let own = RigError::prior(rig, &self).unknown_px();
        Self(self.0.scaled(if own > 0.0 { px / own } else { 0.0 }))
    }
}

impl RigError {
    /// A rig file without error.
    pub fn exact(rig: &Rig) -> Self {
        let p = View::BOTH.map(|v| projection(rig, v));
        let prior = RigPrior::exact();
        let (modes, parts, given) = (Vec::new(), Vec::new(), Vec::new());
        Self { rig: *rig, p, modes, parts, prior, given, log_odds: 0.0, agreement: Agreement::default() }
    }

    /// The rig file under the prior alone.
    pub fn prior(rig: &Rig, prior: &RigPrior) -> Self {
        let found = Mixture { mean: Phi::zeros(), cov: SMatrix::identity(), scatter: 0.0, log_odds: 0.0 };
        Self::posterior(rig, prior, &found, Agreement::default())
    }

    /// The rig corrected by fixed modes (in standard deviations), with no remaining uncertainty.
    pub fn held(&self, modes: &[f64]) -> Self {
        let corrected = |k: usize| self.p[k] + self.modes.iter().zip(modes).map(|(m, v)| m[k] * *v).sum::<Projection>();
        Self { p: [corrected(0), corrected(1)], modes: Vec::new(), parts: Vec::new(), ..self.clone() }
    }

    /// The rig file as given, in units of the modes.
    pub fn given(&self) -> &[f64] {
        &self.given
    }

    /// Log odds, by the matches, that the rig file is exact against an error of the prior's size or less; both equally
    /// likely a priori.
    pub fn log_odds_given(&self) -> f64 {
        self.log_odds
    }

    /// The rig corrected by modes in standard deviations.
    pub fn corrected(&self, modes: &[f64]) -> Rig {
        let phi: Phi = self.parts.iter().zip(modes).map(|(part, v)| part * *v).sum();
        self.prior.corrected(&self.rig, &phi)
    }

    /// Root mean square of the remaining uncertainty, in units of the prior.
    pub fn spread(&self) -> f64 {
        (self.parts.iter().map(|p| p.norm_squared()).sum::<f64>() / PARAMETERS as f64).sqrt()
    }

    /// The same with left and right exchanged.
    pub fn exchanged(&self) -> Self {
        let swap = |m: &[Projection; 2]| [m[1], m[0]];
        Self { p: swap(&self.p), modes: self.modes.iter().map(swap).collect(), ..self.clone() }
    }

    /// Epipolar displacement by one standard deviation of the remaining uncertainty, pixels: in the middle of the left
    /// image, for a point at [`TYPICAL_DISTANCE`] baselines.
    pub fn unknown_px(&self) -> f64 {
        let at = Vector3::new(0.0, 0.0, TYPICAL_DISTANCE * self.rig.centre(View::Right).norm());
        let image = |p: &Projection| project(p, &at);
        let pixels = [image(&self.p[0]), image(&self.p[1])];
        let by_mode = |m: &[Projection; 2]| {
            fundamental(&[self.p[0] + m[0], self.p[1] + m[1]]).map_or(0.0, |f| epipolar_distance(&f, &pixels))
        };
        self.modes.iter().map(|m| by_mode(m).powi(2)).sum::<f64>().sqrt()
    }

    fn posterior(rig: &Rig, prior: &RigPrior, found: &Mixture, agreement: Agreement) -> Self {
        let corrected = prior.corrected(rig, &found.mean);
        let p = View::BOTH.map(|v| projection(&corrected, v));
        let by_phi = derivatives(&corrected, prior);
        let (values, vectors) = eigen::symmetric(&found.cov);
        let mut parts: Vec<Phi> =
            (0..PARAMETERS).filter(|j| values[*j] > 0.0).map(|j| vectors.column(j) * values[j].sqrt()).collect();
        let mode = |part: &Phi| -> [Projection; 2] {
            [0, 1].map(|k| by_phi.iter().zip(part.iter()).map(|(d, v)| d[k] * *v).sum())
        };
        parts.retain(|part| mode(part).iter().any(|m| m.norm() > 0.0));
        let modes = parts.iter().map(mode).collect();
        let given = parts.iter().map(|part| -part.dot(&found.mean) / part.norm_squared()).collect();
        Self { rig: corrected, p, modes, parts, prior: *prior, given, log_odds: found.log_odds, agreement }
    }

    /// The posterior of the error given the matches of a pair of images: maximum a posteriori under a redescending
    /// loss that starts wide enough for every rig of the prior. Falls back to the prior when too few matches agree.
    pub fn observe(rig: &Rig, prior: &RigPrior, matches: &[Match]) -> Self {
        let mut agreement = Agreement { matches: matches.len(), ..Agreement::default() };
        let model = Epipolar::new(rig, prior, matches);
        let zero = model.residuals(&Phi::zeros());
        let slopes = model.slopes(&Phi::zeros());
        agreement.prior_px = {
            let sum: f64 = slopes.iter().map(|s| s.norm_squared()).sum();
            (sum / slopes.len().max(1) as f64).sqrt()
        };
        if *prior == RigPrior::exact() || matches.len() < MIN_AGREEING {
            return Self { agreement, ..Self::prior(rig, prior) };
        }
        let mut phi = Phi::zeros();
        for width in WIDTHS {
            for _ in 0..6 {
                let Some((step, _)) = model.step(&phi, |r, s| {
                    let w = 1.0 / (1.0 + (r / width.max(3.0 * s)).powi(2));
                    w * w / (s * s)
                }) else {
                    return Self { agreement, ..Self::prior(rig, prior) };
                };
                phi += step;
                if step.norm() < 1e-4 {
                    break;
                }
            }
        }
        let Some(found) = model.by_quality(&phi) else {
            return Self { agreement, ..Self::prior(rig, prior) };
        };
        let r = model.residuals(&found.mean);
        let agree: Vec<bool> = r.iter().map(|r| r.abs() < 3.0 * found.scatter).collect();
        let rms = |r: &[f64]| {
            let kept: Vec<f64> = r.iter().zip(&agree).filter(|(_, a)| **a).map(|(r, _)| r * r).collect();
            (kept.iter().sum::<f64>() / kept.len().max(1) as f64).sqrt()
        };
        agreement.agreeing = agree.iter().filter(|a| **a).count();
        (agreement.as_given_px, agreement.corrected_px) = (rms(&zero), rms(&r));
        if !agreement.is_significant(3.0 * found.scatter) {
            return Self { agreement, ..Self::prior(rig, prior) };
        }
        Self::posterior(rig, prior, &found, agreement)
    }
}

impl Agreement {
    /// Whether more matches agree than by chance.
    ///
    /// A false match is uniform within [`SPREAD_PX`], so that it agrees with probability `p0`; the six observable
    /// parameters of the error can fit six of them. The threshold is four standard deviations of the binomial above
    /// that.
    fn is_significant(&self, gate_px: f64) -> bool {
        let n = self.matches as f64;
        let p0 = 2.0 * gate_px / SPREAD_PX;
        let by_chance = n * p0 + 4.0 * (n * p0 * (1.0 - p0)).sqrt();
        self.agreeing >= MIN_AGREEING && self.agreeing as f64 > by_chance + 6.0
    }
}
