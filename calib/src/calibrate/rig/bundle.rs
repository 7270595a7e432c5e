//! The joint robust fit of all target points of all pairs in both views, weighted by their covariances, and the
//! covariance of the estimate.
//!
//! The residual of a point has the covariance s² (C + t² I). C is the covariance from the detector, t is the part that
//! the detector cannot determine (print, paper, compression), and s is a common factor. The fit estimates s and t.
//! Tukey's biweight (an M-estimator) rejects gross errors: its weight is nearly 1 for residuals within the noise and 0
//! beyond its end. The fit rejects nothing else. The poses are eliminated (Schur complement), so that the cost grows
//! linearly with the number of pairs.

use super::Pair;
use super::parameters::{BEND, BENDING, SHARED, SharedStep, State, project, renormalised};
use crate::calibrate::target::{Seen, Target};
use graspd_rt::geom::{Pose, exp_twist};
use nalgebra::{Matrix2, Matrix6, SMatrix, Vector2, Vector6};

/// End of the biweight, standard deviations. One normal residual in 65 million points is beyond it.
pub const BIWEIGHT_END: f64 = 6.0;
/// Standard deviation of the bending of a board, as a fraction of its diagonal. A clamped sheet of glass has less,
/// cardboard more.
const BEND_SIGMA_FRACTION: f64 = 1e-3;
/// Maximum number of rounds. Each round estimates the noise and then takes a few steps of the fit.
const MAX_ROUNDS: usize = 12;
/// Maximum number of steps per round.
const MAX_STEPS: usize = 15;

/// Reduced normal matrix of the shared parameters.
pub type Shared = SMatrix<f64, SHARED, SHARED>;
type Mixed = SMatrix<f64, SHARED, 6>;

/// Noise model of the target points: covariance s² (C + t² I).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Common factor s.
    pub scale: f64,
    /// Floor t, the part that the detector cannot determine, pixels.
    pub floor_px: f64,
}

impl Noise {
    /// Inverse covariance of a point.
    pub fn weight(&self, seen: &Seen) -> Matrix2<f64> {
        let c = seen.covariance + Matrix2::identity() * (self.floor_px * self.floor_px);
        c.try_inverse().unwrap_or_else(Matrix2::identity) / (self.scale * self.scale)
    }
}

/// A residual: observed minus predicted position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual {
    /// Index of the target point.
    pub index: usize,
    /// The residual, pixels.
    pub r: Vector2<f64>,
    /// Its Mahalanobis length, standard deviations.
    pub sigmas: f64,
}

/// Inputs of a fit.
pub struct Problem<'a> {
    /// The target.
    pub target: &'a Target,
    /// The pairs.
    pub pairs: &'a [Pair],
    /// Whether each shared parameter is estimated; the others keep their values.
    pub free: [bool; SHARED],
}

/// Result of a fit.
#[derive(Clone, Debug)]
pub struct Fit {
    /// The estimate.
    pub state: State,
    /// The noise of the points.
    pub noise: Noise,
    /// Covariance of the shared parameters; rows of parameters that were not estimated are zero.
    pub covariance: Shared,
    /// Residuals of each pair, left and right.
    pub residuals: Vec<[Vec<Residual>; 2]>,
    /// Whether the last step was negligible.
    pub converged: bool,
}

impl Fit {
    /// Root mean square length of the residuals without gross errors, pixels; u and v are combined as in OpenCV.
    pub fn rms_px(&self) -> f64 {
        let all = || self.residuals.iter().flatten().flatten().filter(|r| r.sigmas < BIWEIGHT_END);
        (all().map(|r| r.r.norm_squared()).sum::<f64>() / all().count().max(1) as f64).sqrt()
    }

    /// Number of points rejected as gross errors, and number of all points.
    pub fn outliers(&self) -> (usize, usize) {
        let all = || self.residuals.iter().flatten().flatten();
        (all().filter(|r| r.sigmas >= BIWEIGHT_END).count(), all().count())
    }
}

/// Weight of the biweight at a length in standard deviations.
fn biweight(sigmas: f64) -> f64 {
    let t = 1.0 - (sigmas / BIWEIGHT_END).powi(2);
    if t > 0.0 { t * t } else { 0.0 }
}

/// Cost of the biweight; half the squared length near zero.
fn biweight_cost(sigmas: f64) -> f64 {
    let t = (1.0 - (sigmas / BIWEIGHT_END).powi(2)).max(0.0);
    BIWEIGHT_END * BIWEIGHT_END / 6.0 * (1.0 - t * t * t)
}

/// Normal equations of one pair.
struct PairNormal {
    pose: Matrix6<f64>,
    pose_gradient: Vector6<f64>,
    mixed: Mixed,
}

struct Normal {
    cost: f64,
    shared: Shared,
    gradient: SharedStep,
    pairs: Vec<PairNormal>,
}

/// Adds the points of one pair; `None` if a point is behind a camera.
fn add_pair(
    n: &mut Normal,
    problem: &Problem<'_>,
    state: &State,
    noise: &Noise,
    pair: &Pair,
    pose: &Pose,
) -> Option<PairNormal> {
    let mut out = PairNormal { pose: Matrix6::zeros(), pose_gradient: Vector6::zeros(), mixed: Mixed::zeros() };
    for (view, seen) in pair.seen.iter().enumerate() {
        for s in seen {
            let p = project(state, problem.target, pose, view, s.index)?;
            let r = s.at - p.at;
            let weight = noise.weight(s);
            let sigmas = r.dot(&(weight * r)).max(0.0).sqrt();
            n.cost += biweight_cost(sigmas);
            let weight = weight * biweight(sigmas);
            let wj = weight * p.shared;
            let wp = weight * p.pose;
            n.shared += p.shared.tr_mul(&wj);
            n.gradient += wj.tr_mul(&r);
            out.mixed += p.shared.tr_mul(&wp);
            out.pose += p.pose.tr_mul(&wp);
            out.pose_gradient += wp.tr_mul(&r);
        }
    }
    Some(out)
}

fn linearise(problem: &Problem<'_>, state: &State, noise: &Noise) -> Option<Normal> {
    let mut n = Normal { cost: 0.0, shared: Shared::zeros(), gradient: SharedStep::zeros(), pairs: Vec::new() };
    for (pair, pose) in problem.pairs.iter().zip(&state.left_from_board) {
        let p = add_pair(&mut n, problem, state, noise, pair, pose)?;
        n.pairs.push(p);
    }
    let sigma = BEND_SIGMA_FRACTION * problem.target.size().norm();
    for k in 0..BEND {
        let (at, value) = (BENDING + k, state.bend[k]);
        n.cost += 0.5 * (value / sigma).powi(2);
        n.shared[(at, at)] += 1.0 / (sigma * sigma);
        n.gradient[at] -= value / (sigma * sigma);
    }
    for (k, free) in problem.free.iter().enumerate() {
        if !free {
            n.shared.row_mut(k).fill(0.0);
            n.shared.column_mut(k).fill(0.0);
            n.shared[(k, k)] = 1.0;
            n.gradient[k] = 0.0;
            for p in &mut n.pairs {
                p.mixed.row_mut(k).fill(0.0);
            }
        }
    }
    Some(n)
}

/// The shared normal matrix and gradient with the poses eliminated, and the inverse pose matrices for
/// back-substitution.
fn reduce(n: &Normal, damping: f64) -> Option<(Shared, SharedStep, Vec<Matrix6<f64>>)> {
    let mut shared = n.shared;
    for k in 0..SHARED {
        shared[(k, k)] *= 1.0 + damping;
    }
    let mut gradient = n.gradient;
    let mut inverses = Vec::with_capacity(n.pairs.len());
    for p in &n.pairs {
        let mut a = p.pose;
        for k in 0..6 {
            // A view without points has no information about its pose; keep the pose unchanged.
            a[(k, k)] = a[(k, k)] * (1.0 + damping) + 1e-9;
        }
        let inverse = a.cholesky()?.inverse();
        let ei = p.mixed * inverse;
        shared -= ei * p.mixed.transpose();
        gradient -= ei * p.pose_gradient;
        inverses.push(inverse);
    }
    Some((shared, gradient, inverses))
}

/// Solves with each parameter scaled by its own curvature, since focal lengths and k3 differ by orders of magnitude.
fn solve_scaled(a: &Shared, b: &SharedStep) -> Option<SharedStep> {
    let scale = SharedStep::from_fn(|k, _| 1.0 / a[(k, k)].max(1e-300).sqrt());
    let scaled = Shared::from_fn(|i, j| a[(i, j)] * scale[i] * scale[j]);
    Some(scaled.cholesky()?.solve(&b.component_mul(&scale)).component_mul(&scale))
}

fn stepped(state: &State, n: &Normal, d: &SharedStep, inverses: &[Matrix6<f64>]) -> State {
    let mut next = state.clone();
    next.stepped(d);
    for ((pose, p), inverse) in next.left_from_board.iter_mut().zip(&n.pairs).zip(inverses) {
        let twist: Vector6<f64> = inverse * (p.pose_gradient - p.mixed.tr_mul(d));
        *pose = renormalised(exp_twist(&twist) * *pose);
    }
    next
}

/// Minimises with fixed noise; returns the state and whether its last step was negligible.
fn minimise(problem: &Problem<'_>, mut state: State, noise: &Noise, steps: usize) -> Option<(State, bool)> {
    let mut at = linearise(problem, &state, noise)?;
    let mut damping = 1e-4;
    for _ in 0..steps {
        let mut accepted = None;
        for _ in 0..10 {
            let step = reduce(&at, damping).and_then(|(a, b, inv)| Some((solve_scaled(&a, &b)?, inv)));
            if let Some((d, inverses)) = step {
                let next = stepped(&state, &at, &d, &inverses);
                if let Some(n) = linearise(problem, &next, noise).filter(|n| n.cost <= at.cost * (1.0 + 1e-13)) {
                    accepted = Some((next, n));
                    break;
                }
            }
            damping = (damping * 10.0).max(1e-9);
        }
        let Some((next, n)) = accepted else { return Some((state, true)) };
        let gain = at.cost - n.cost;
        (state, at) = (next, n);
        damping *= 0.1;
        if gain < 1e-9 * at.cost {
            return Some((state, true));
        }
    }
    Some((state, false))
}

/// Residuals of a state.
pub fn residuals(target: &Target, pairs: &[Pair], state: &State, noise: &Noise) -> Option<Vec<[Vec<Residual>; 2]>> {
    pairs
        .iter()
        .zip(&state.left_from_board)
        .map(|(pair, pose)| {
            let view = |v: usize| -> Option<Vec<Residual>> {
                pair.seen[v]
                    .iter()
                    .map(|s| {
                        let r = s.at - project(state, target, pose, v, s.index)?.at;
                        Some(Residual { index: s.index, r, sigmas: r.dot(&(noise.weight(s) * r)).max(0.0).sqrt() })
                    })
                    .collect()
            };
            Some([view(0)?, view(1)?])
        })
        .collect()
}

/// Robust initial scale: the median length of two-dimensional normal residuals is 1.177 standard deviations.
fn median_scale(all: &[[Vec<Residual>; 2]]) -> f64 {
    let mut lengths: Vec<f64> = all.iter().flatten().flatten().map(|r| r.sigmas).collect();
    lengths.sort_by(f64::total_cmp);
    lengths.get(lengths.len() / 2).copied().unwrap_or(1.0) / 1.177
}

/// Maximum-likelihood noise for the residuals that are not gross errors.
fn likeliest_noise(problem: &Problem<'_>, all: &[[Vec<Residual>; 2]], parameters: usize) -> Noise {
    let seen = problem.pairs.iter().flat_map(|p| p.seen.iter().flatten());
    let good: Vec<(&Seen, Vector2<f64>)> = seen
        .zip(all.iter().flatten().flatten())
        .filter(|(_, r)| r.sigmas < BIWEIGHT_END)
        .map(|(s, r)| (s, r.r))
        .collect();
    let count = good.len().max(1) as f64;
    let freedom = (2.0 * count - parameters as f64).max(1.0) / (2.0 * count);
    let floors = std::iter::once(0.0).chain((0..24).map(|k| 0.005 * 1.25_f64.powi(k)));
    let of = |floor: f64| {
        let (mut squares, mut volume) = (0.0, 0.0);
        for (s, r) in &good {
            let c = s.covariance + Matrix2::identity() * (floor * floor);
            let inverse = c.try_inverse().unwrap_or_else(Matrix2::identity);
            squares += r.dot(&(inverse * r));
            volume += c.determinant().max(1e-30).ln();
        }
        let scale2 = (squares / (2.0 * count) / freedom).max(1e-12);
        (volume + 2.0 * count * scale2.ln(), Noise { scale: scale2.sqrt(), floor_px: floor })
    };
    floors.map(of).min_by(|a, b| a.0.total_cmp(&b.0)).map_or(Noise { scale: 1.0, floor_px: 0.1 }, |(_, n)| n)
}

/// Fits; `None` if the start is invalid (a point behind a camera) or a matrix is singular.
pub fn fit(problem: &Problem<'_>, start: State) -> Option<Fit> {
    let mut noise = Noise { scale: 1.0, floor_px: 0.1 };
    let mut state = start;
    let parameters = problem.free.iter().filter(|f| **f).count() + 6 * problem.pairs.len();
    let mut converged = false;
    let mut all = residuals(problem.target, problem.pairs, &state, &noise)?;
    for round in 0..MAX_ROUNDS {
        let before = noise;
        let rough = median_scale(&all) * noise.scale;
        // Far from the minimum the residuals are not noise: use their median as scale until most of them are within the
        // range of the biweight.
        noise = if round < 3 {
            Noise { scale: rough.max(1e-6), ..noise }
        } else {
            likeliest_noise(problem, &all, parameters)
        };
        (state, converged) = minimise(problem, state, &noise, MAX_STEPS)?;
        all = residuals(problem.target, problem.pairs, &state, &noise)?;
        let same = (noise.scale / before.scale - 1.0).abs() < 1e-3 && (noise.floor_px - before.floor_px).abs() < 1e-9;
        if round > 3 && same && converged {
            break;
        }
    }
    let n = linearise(problem, &state, &noise)?;
    let (information, _, _) = reduce(&n, 0.0)?;
    let covariance = covariance(&information, &problem.free)? * biweight_variance(&all, parameters);
    Some(Fit { state, noise, covariance, residuals: all, converged })
}

/// Factor from the inverse of the weighted normal matrix to the covariance of the robust estimate (Huber 1981):
/// E w E psi^2 / (E psi')^2, corrected for the degrees of freedom that the parameters consume.
fn biweight_variance(all: &[[Vec<Residual>; 2]], parameters: usize) -> f64 {
    let (mut w, mut square, mut slope, mut count) = (0.0, 0.0, 0.0, 1e-9);
    for r in all.iter().flatten().flatten() {
        let t = (r.sigmas / BIWEIGHT_END).powi(2).min(1.0);
        let b = (1.0 - t) * (1.0 - t);
        w += b;
        square += 0.5 * b * b * r.sigmas * r.sigmas;
        slope += b - 2.0 * t * (1.0 - t);
        count += 1.0;
    }
    let freedom = (1.0 - parameters as f64 / (2.0 * count)).max(0.1);
    let factor = (w / count) * (square / count / freedom) / (slope / count).powi(2).max(1e-9);
    if factor.is_finite() { factor } else { 1.0 }
}

/// Inverse of an information matrix; rows and columns of fixed parameters are zero.
pub fn covariance(information: &Shared, free: &[bool; SHARED]) -> Option<Shared> {
    let scale = SharedStep::from_fn(|k, _| 1.0 / information[(k, k)].max(1e-300).sqrt());
    let scaled = Shared::from_fn(|i, j| information[(i, j)] * scale[i] * scale[j]);
    let inverse = scaled.cholesky()?.inverse();
    Some(Shared::from_fn(|i, j| if free[i] && free[j] { inverse[(i, j)] * scale[i] * scale[j] } else { 0.0 }))
}

/// Information of a pair about the shared parameters with its pose eliminated. The points of the pair define the
/// weights; none should be an outlier.
pub fn pair_information(
    problem: &Problem<'_>,
    state: &State,
    noise: &Noise,
    pair: &Pair,
    pose: &Pose,
) -> Option<Shared> {
    let mut n = Normal { cost: 0.0, shared: Shared::zeros(), gradient: SharedStep::zeros(), pairs: Vec::new() };
    let p = add_pair(&mut n, problem, state, noise, pair, pose)?;
    let inverse = (p.pose + Matrix6::identity() * 1e-9).cholesky()?.inverse();
    let mut out = n.shared - p.mixed * inverse * p.mixed.transpose();
    for (k, free) in problem.free.iter().enumerate() {
        if !free {
            out.row_mut(k).fill(0.0);
            out.column_mut(k).fill(0.0);
        }
    }
    Some(out)
}

/// Pose of a board from the points of one or both views of a pair, with fixed calibration.
#[derive(Clone, Debug)]
pub struct PoseFit {
    /// Pose of the board in the left frame.
    pub pose: Pose,
    /// Twice the robust cost: chi squared if there are no gross errors.
    pub chi2: f64,
    /// Inverse covariance of the pose's twist.
    pub information: Matrix6<f64>,
}

/// Factors on the noise scale in the successive fits of a pose. A start with an error of a pixel is beyond the end of
/// the unscaled biweight.
const POSE_NOISE_FACTORS: [f64; 3] = [30.0, 5.0, 1.0];

/// Fits a pose with fixed calibration. A view of `pair` without points is not used.
pub fn fit_pose(target: &Target, state: &State, noise: &Noise, pair: &Pair, start: &Pose) -> Option<PoseFit> {
    let mut out = None;
    let mut pose = *start;
    for by in POSE_NOISE_FACTORS {
        let fit = fit_pose_at(target, state, &Noise { scale: noise.scale * by, ..*noise }, pair, &pose)?;
        pose = fit.pose;
        out = Some(fit);
    }
    out
}

/// Fits with one noise scale.
fn fit_pose_at(target: &Target, state: &State, noise: &Noise, pair: &Pair, start: &Pose) -> Option<PoseFit> {
    let problem = Problem { target, pairs: &[], free: [false; SHARED] };
    let at = |pose: &Pose| {
        let mut n = Normal { cost: 0.0, shared: Shared::zeros(), gradient: SharedStep::zeros(), pairs: Vec::new() };
        let p = add_pair(&mut n, &problem, state, noise, pair, pose)?;
        Some((n.cost, p))
    };
    let mut pose = *start;
    let (mut cost, mut p) = at(&pose)?;
    let mut damping = 1e-4;
    for _ in 0..40 {
        let mut a = p.pose;
        for k in 0..6 {
            a[(k, k)] = a[(k, k)] * (1.0 + damping) + 1e-9;
        }
        let step = a.cholesky()?.solve(&p.pose_gradient);
        let next = renormalised(exp_twist(&step) * pose);
        match at(&next).filter(|(c, _)| *c <= cost) {
            Some((c, n)) => {
                let gain = cost - c;
                (pose, cost, p) = (next, c, n);
                damping *= 0.1;
                if gain < 1e-10 * (1.0 + cost) {
                    break;
                }
            }
            None => {
                damping = (damping * 10.0).max(1e-9);
                if damping > 1e8 {
                    break;
                }
            }
        }
    }
    Some(PoseFit { pose, chi2: 2.0 * cost, information: p.pose })
}
