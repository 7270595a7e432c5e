//! The rig's own error: its prior, what the two images of a pair say about it, and what stays unknown.
//!
//! A rig file is never exact. Its error is a vector `phi` of twelve numbers with a Gaussian prior: rotation and place
//! of the right camera, focal lengths (common and difference), principal points. In units of the prior's standard
//! deviations the prior is `N(0, I)`, and `P(phi) = P + sum_j phi_j dP_j` to first order: an error of a few tenths of
//! a degree leaves a second-order rest below 0.02 px.
//!
//! One pair of images determines the part of `phi` that moves matching points off each other's epipolar lines.
//! [`RigError::observe`] estimates it once for the pair from all matches, so that no contour has to be judged by a
//! rig that every other point contradicts. What the matches leave open (above all the vergence, which looks like
//! another depth) stays in [`RigError::modes`] and goes into every fit and covariance as an unknown of its own.
//! Derived in `docs/PAPER.md`, "The rig's error".

use crate::offline::edges::lens::projection;
use crate::offline::rim::cone::camera_centre;
use crate::offline::rim::model::Projection;
use graspd_rt::geom::{Rig, View};
use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector2, Vector3};

/// Number of parameters of a rig's error.
pub const PARAMETERS: usize = 12;

/// A rig's error in units of its prior's standard deviations: rotation (3), place of the right camera (3), focal
/// length common and difference, principal point left (2) and right (2).
pub type Phi = SVector<f64, PARAMETERS>;

/// Standard deviations of what a rig file may have wrong: the rig's stated quality, or the default of
/// [`graspd_rt::geom::RigError`].
///
/// The right camera may also stand elsewhere, along each axis by as large a part of the baseline as its rotation is
/// off in radians: the baseline's direction is known no better than the cameras' own.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RigPrior(pub graspd_rt::geom::RigError);

impl RigPrior {
    /// The same shape of error, scaled so that it displaces epipolar lines by `px` pixels (one standard deviation).
    /// Zero trusts the rig file.
    pub fn displacing(self, rig: &Rig, px: f64) -> Self {
        let own = RigError::prior(rig, &self).unknown_px();
        Self(self.0.scaled(if own > 0.0 { px / own } else { 0.0 }))
    }

    fn none() -> Self {
        Self(graspd_rt::geom::RigError::default().scaled(0.0))
    }

    /// The rig with an error of so many standard deviations put right.
    fn corrected(&self, rig: &Rig, phi: &Phi) -> Rig {
        let mut out = *rig;
        let turn = Vector3::new(phi[0], phi[1], phi[2]) * self.0.rotation_rad;
        out.right_from_left.rotation = UnitQuaternion::from_scaled_axis(turn) * rig.right_from_left.rotation;
        let baseline = rig.right_from_left.translation.vector.norm();
        // Turned about the right camera's own centre, which then moves.
        let centre = rig.centre(View::Right) + Vector3::new(phi[3], phi[4], phi[5]) * (self.0.rotation_rad * baseline);
        out.right_from_left.translation.vector = -(out.right_from_left.rotation * centre);
        let (common, half) = (self.0.focal * phi[6], self.0.focal_difference * phi[7]);
        for (camera, scale, at) in [(&mut out.left, common - half, 8), (&mut out.right, common + half, 10)] {
            camera.fx *= 1.0 + scale;
            camera.fy *= 1.0 + scale;
            camera.cx += self.0.principal_px * phi[at];
            camera.cy += self.0.principal_px * phi[at + 1];
        }
        out
    }
}

/// Two places of one point of the scene, ideal pixels, and how well the right one is known across its epipolar line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// In the left and the right image.
    pub at: [Vector2<f64>; 2],
    /// Standard deviation of the distance from the epipolar line, pixels.
    pub sigma: f64,
}

/// What is known of a rig's error: the rig put right as far as it is known, and what stays unknown.
#[derive(Clone, Debug, PartialEq)]
pub struct RigError {
    /// The rig with the expected error put right.
    pub rig: Rig,
    /// Its projection matrices for ideal pixels.
    pub p: [Projection; 2],
    /// Change of both projection matrices by one standard deviation of each independent part of what is unknown.
    pub modes: Vec<[Projection; 2]>,
    /// The same parts as errors of the rig.
    parts: Vec<Phi>,
    prior: RigPrior,
    /// The rig file as it was given, in units of the modes, and the logarithm of the odds that it is right as it
    /// stands against the rest.
    given: Vec<f64>,
    /// See [`RigError::log_odds_given`].
    log_odds: f64,
    /// What the matches said.
    pub seen: Seen,
}

/// How a pair of images and a rig file agree.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Seen {
    /// Matches found, and those of them that agree on one rig.
    pub matches: usize,
    /// Matches that agree on one rig.
    pub agreeing: usize,
    /// Root mean square distance of the agreeing matches from the epipolar lines of the rig file, pixels.
    pub as_given_px: f64,
    /// The same for the rig put right.
    pub corrected_px: f64,
    /// Predicted by the prior, pixels.
    pub prior_px: f64,
}

/// Distance at which a rig works, in baselines.
const TYPICAL_DISTANCE: f64 = 3.0;
/// Fewest agreeing matches that say anything: as many as the six observable parts of the error, and as many again to
/// confirm them.
const LEAST_AGREEING: usize = 12;
/// Qualities of a rig that are weighed, as scales of the prior: from one as good as a pixel allows to one as bad as
/// stated.
const QUALITIES: [f64; 6] = [0.03, 0.06, 0.12, 0.25, 0.5, 1.0];
/// Widths of the redescending loss, pixels, from one that holds every rig of the prior to one of a few standard
/// deviations of a match.
const WIDTHS: [f64; 6] = [8.0, 4.0, 2.0, 1.2, 0.8, 0.6];
/// Scatters of right matches across their lines that are weighed, pixels: patches of a clean image, of a blurred or
/// compressed one.
const SCATTERS_PX: [f64; 3] = [0.1, 0.2, 0.4];
/// Weight of a match: spots come in groups that see one edge or one occlusion and are off together, so that two count
/// as one.
const WEIGHT: f64 = 0.5;
/// Part of the matches that is false beforehand.
const FALSE: f64 = 0.5;
/// A false match lies anywhere within so many pixels across its line: as far as the search climbs.
const SPREAD_PX: f64 = 16.0;
/// Least standard deviation of a match, pixels: patches are not seen from the same side by both cameras.
const LEAST_SIGMA_PX: f64 = 0.1;

impl RigError {
    /// A rig file believed to the letter.
    pub fn none(rig: &Rig) -> Self {
        let p = View::BOTH.map(|v| projection(rig, v));
        let prior = RigPrior::none();
        let (modes, parts, given) = (Vec::new(), Vec::new(), Vec::new());
        Self { rig: *rig, p, modes, parts, prior, given, log_odds: 0.0, seen: Seen::default() }
    }

    /// What the prior alone says.
    pub fn prior(rig: &Rig, prior: &RigPrior) -> Self {
        let found = Mixture { mean: Phi::zeros(), cov: SMatrix::identity(), scatter: 0.0, log_odds: 0.0 };
        Self::posterior(rig, prior, &found, Seen::default())
    }

    /// A rig with so many standard deviations of each mode put right and nothing left unknown.
    pub fn held(&self, modes: &[f64]) -> Self {
        let put_right = |k: usize| self.p[k] + self.modes.iter().zip(modes).map(|(m, v)| m[k] * *v).sum::<Projection>();
        Self { p: [put_right(0), put_right(1)], modes: Vec::new(), parts: Vec::new(), ..self.clone() }
    }

    /// The rig file as it was given, in units of the modes.
    pub fn given(&self) -> &[f64] {
        &self.given
    }

    /// Logarithm of the odds by the matches that the rig file is right as it stands, against an error of the prior's
    /// size or less; as likely as the other beforehand.
    pub fn log_odds_given(&self) -> f64 {
        self.log_odds
    }

    /// The rig with an error of so many standard deviations of each mode put right.
    pub fn corrected(&self, modes: &[f64]) -> Rig {
        let phi: Phi = self.parts.iter().zip(modes).map(|(part, v)| part * *v).sum();
        self.prior.corrected(&self.rig, &phi)
    }

    /// Root mean square of what is unknown, in units of the prior.
    pub fn spread(&self) -> f64 {
        (self.parts.iter().map(|p| p.norm_squared()).sum::<f64>() / PARAMETERS as f64).sqrt()
    }

    /// The same with left and right exchanged.
    pub fn exchanged(&self) -> Self {
        let swap = |m: &[Projection; 2]| [m[1], m[0]];
        Self { p: swap(&self.p), modes: self.modes.iter().map(swap).collect(), ..self.clone() }
    }

    /// Epipolar displacement by what is unknown of the rig, one standard deviation, pixels: in the middle of the left
    /// image, for a point at [`TYPICAL_DISTANCE`] baselines.
    pub fn unknown_px(&self) -> f64 {
        let at = Vector3::new(0.0, 0.0, TYPICAL_DISTANCE * self.rig.centre(View::Right).norm());
        let place = |p: &Projection| crate::offline::rim::cone::project(p, &at);
        let pixels = [place(&self.p[0]), place(&self.p[1])];
        let by_mode = |m: &[Projection; 2]| {
            fundamental(&[self.p[0] + m[0], self.p[1] + m[1]]).map_or(0.0, |f| epipolar_distance(&f, &pixels))
        };
        self.modes.iter().map(|m| by_mode(m).powi(2)).sum::<f64>().sqrt()
    }

    fn posterior(rig: &Rig, prior: &RigPrior, found: &Mixture, seen: Seen) -> Self {
        let corrected = prior.corrected(rig, &found.mean);
        let p = View::BOTH.map(|v| projection(&corrected, v));
        let by_phi = derivatives(&corrected, prior);
        let (values, vectors) = crate::offline::conic::eigen::symmetric(&found.cov);
        let mut parts: Vec<Phi> =
            (0..PARAMETERS).filter(|j| values[*j] > 0.0).map(|j| vectors.column(j) * values[j].sqrt()).collect();
        let mode = |part: &Phi| -> [Projection; 2] {
            [0, 1].map(|k| by_phi.iter().zip(part.iter()).map(|(d, v)| d[k] * *v).sum())
        };
        parts.retain(|part| mode(part).iter().any(|m| m.norm() > 0.0));
        let modes = parts.iter().map(mode).collect();
        let given = parts.iter().map(|part| -part.dot(&found.mean) / part.norm_squared()).collect();
        Self { rig: corrected, p, modes, parts, prior: *prior, given, log_odds: found.log_odds, seen }
    }

    /// What the prior and the matches of a pair of images say together: maximum a posteriori under a redescending
    /// loss that starts wide enough for every rig of the prior.
    pub fn observe(rig: &Rig, prior: &RigPrior, matches: &[Match]) -> Self {
        let mut seen = Seen { matches: matches.len(), ..Seen::default() };
        let model = Epipolar::new(rig, prior, matches);
        let zero = model.residuals(&Phi::zeros());
        let slopes = model.slopes(&Phi::zeros());
        seen.prior_px = {
            let sum: f64 = slopes.iter().map(|s| s.norm_squared()).sum();
            (sum / slopes.len().max(1) as f64).sqrt()
        };
        if *prior == RigPrior::none() || matches.len() < LEAST_AGREEING {
            return Self { seen, ..Self::prior(rig, prior) };
        }
        let mut phi = Phi::zeros();
        for width in WIDTHS {
            for _ in 0..6 {
                let Some((step, _)) = model.step(&phi, |r, s| {
                    let w = 1.0 / (1.0 + (r / width.max(3.0 * s)).powi(2));
                    w * w / (s * s)
                }) else {
                    return Self { seen, ..Self::prior(rig, prior) };
                };
                phi += step;
                if step.norm() < 1e-4 {
                    break;
                }
            }
        }
        let Some(found) = model.by_quality(&phi) else {
            return Self { seen, ..Self::prior(rig, prior) };
        };
        let r = model.residuals(&found.mean);
        let agree: Vec<bool> = r.iter().map(|r| r.abs() < 3.0 * found.scatter).collect();
        let rms = |r: &[f64]| {
            let kept: Vec<f64> = r.iter().zip(&agree).filter(|(_, a)| **a).map(|(r, _)| r * r).collect();
            (kept.iter().sum::<f64>() / kept.len().max(1) as f64).sqrt()
        };
        seen.agreeing = agree.iter().filter(|a| **a).count();
        (seen.as_given_px, seen.corrected_px) = (rms(&zero), rms(&r));
        if !seen.is_significant(3.0 * found.scatter) {
            return Self { seen, ..Self::prior(rig, prior) };
        }
        Self::posterior(rig, prior, &found, seen)
    }
}

impl Seen {
    /// Whether so many matches agree that chance is out of the question.
    ///
    /// A false match lies anywhere within [`SPREAD_PX`], so that it agrees with probability `p0`; the six observable
    /// parts of the error are free to please six of them. Four standard deviations of the binomial beyond that are
    /// asked for.
    fn is_significant(&self, gate_px: f64) -> bool {
        let n = self.matches as f64;
        let p0 = 2.0 * gate_px / SPREAD_PX;
        let by_chance = n * p0 + 4.0 * (n * p0 * (1.0 - p0)).sqrt();
        self.agreeing >= LEAST_AGREEING && self.agreeing as f64 > by_chance + 6.0
    }
}

/// Derivatives of both projection matrices by the error's parameters, in units of the prior.
fn derivatives(rig: &Rig, prior: &RigPrior) -> [[Projection; 2]; PARAMETERS] {
    const STEP: f64 = 0.05;
    std::array::from_fn(|i| {
        let mut d = Phi::zeros();
        d[i] = STEP;
        let (ahead, behind) = (prior.corrected(rig, &d), prior.corrected(rig, &-d));
        View::BOTH.map(|v| (projection(&ahead, v) - projection(&behind, v)) / (2.0 * STEP))
    })
}

/// Distances of matches from their epipolar lines, as functions of the rig's error.
struct Epipolar<'a> {
    rig: &'a Rig,
    prior: &'a RigPrior,
    matches: &'a [Match],
}

impl<'a> Epipolar<'a> {
    fn new(rig: &'a Rig, prior: &'a RigPrior, matches: &'a [Match]) -> Self {
        Self { rig, prior, matches }
    }

    /// Signed distance of each right place from the left one's epipolar line, pixels.
    fn residuals(&self, phi: &Phi) -> Vec<f64> {
        let rig = self.prior.corrected(self.rig, phi);
        let Some(f) = fundamental(&View::BOTH.map(|v| projection(&rig, v))) else {
            return vec![f64::INFINITY; self.matches.len()];
        };
        self.matches.iter().map(|m| epipolar_distance(&f, &m.at)).collect()
    }

    fn slopes(&self, phi: &Phi) -> Vec<Phi> {
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
    fn by_quality(&self, start: &Phi) -> Option<Mixture> {
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
    fn step(
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
struct Mixture {
    mean: Phi,
    cov: SMatrix<f64, PARAMETERS, PARAMETERS>,
    scatter: f64,
    log_odds: f64,
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

/// The fundamental matrix of two projections: left pixels to epipolar lines of the right image.
pub fn fundamental(p: &[Projection; 2]) -> Option<Matrix3<f64>> {
    let eye = camera_centre(&p[0])?;
    let epipole = p[1] * eye.push(1.0);
    let back = p[0].fixed_view::<3, 3>(0, 0).into_owned().try_inverse()?;
    Some(epipole.cross_matrix() * p[1].fixed_view::<3, 3>(0, 0) * back)
}

/// Signed distance of a right place from the epipolar line of a left one, pixels.
pub fn epipolar_distance(f: &Matrix3<f64>, at: &[Vector2<f64>; 2]) -> f64 {
    let l = f * at[0].push(1.0);
    (l.x * at[1].x + l.y * at[1].y + l.z) / l.x.hypot(l.y)
}
