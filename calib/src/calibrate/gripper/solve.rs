//! Maximizes the likelihood of one hypothesis: Levenberg-Marquardt with the flange corrections eliminated, alternating
//! with the estimation of the standard deviations.

use super::bundle::{Model, Normal, POSES, Scales, State};
use super::data::{Noise, Sigma};
use super::error::GripperError;
use nalgebra::{DMatrix, DVector, Matrix6, SymmetricEigen, Vector6};
use std::f64::consts::TAU;

/// Degrees of freedom of the prior of a stated standard deviation: known to 10 %, since a variance estimated from n
/// values has the relative standard deviation sqrt(2 / n).
const STATED_FREEDOM: f64 = 50.0;
/// The same for a default: known to a factor of two or three.
const DEFAULT_FREEDOM: f64 = 1.0;
/// Initial flange standard deviation as a multiple of the larger of the stated and the default one.
const START_FACTOR: f64 = 3.0;
/// Weight of the stated outlier fraction, as a number of sightings.
const OUTLIER_COUNT: f64 = 50.0;
/// Weight of the prior fraction of outlier poses, as a number of poses.
const OUTLIER_POSE_COUNT: f64 = 20.0;
/// Prior fraction of outlier poses.
const OUTLIER_POSE_FRACTION: f64 = 0.01;
/// Minimum outlier fraction: a recording without outliers so far may still contain one.
const MIN_OUTLIER_FRACTION: f64 = 1e-3;
/// Annealing from a rough initial estimate: multiples of the pixel standard deviation.
const COOLING: [f64; 6] = [64.0, 32.0, 16.0, 8.0, 4.0, 2.0];
/// Maximum number of steps at each multiple.
const COOLING_STEPS: usize = 4;
/// Maximum number of steps between two estimates of the standard deviations.
const MAX_STEPS: usize = 8;
/// Maximum number of estimates of the standard deviations.
const MAX_ROUNDS: usize = 20;
/// Maximum relative change of the standard deviations at convergence.
const MAX_SCALE_CHANGE: f64 = 1e-3;
/// Maximum length of a negligible step, in posterior standard deviations.
const MAX_NEGLIGIBLE_STEP: f64 = 1e-4;
/// Minimum eigenvalue of the correlation-scaled information that double precision distinguishes from zero.
const MIN_EIGENVALUE: f64 = 1e-13;

/// Maximum of the likelihood of a hypothesis, with its curvature.
#[derive(Debug)]
pub(super) struct Fit {
    pub(super) state: State,
    pub(super) scales: Scales,
    /// Covariance of the global unknowns: flange_from_gripper (v, w), base_from_left (v, w), marks, the rig's.
    pub(super) covariance: DMatrix<f64>,
    /// Inlier probability and squared residual (px²) of each sighting.
    pub(super) rows: Vec<Vec<(f64, f64)>>,
    /// Probability of an ordinary flange error, for each pose.
    pub(super) ordinary: Vec<f64>,
    /// Logarithm of the evidence, up to a constant common to all hypotheses.
    pub(super) evidence: f64,
}

/// Initial standard deviations. Those of the flange start above any plausible value: with values that are too small the
/// flange corrections stay at zero, contain no information, and the estimate does not increase.
pub(super) fn first_scales(n: &Noise) -> Scales {
    let d = Noise::default();
    Scales {
        px: n.mark_px.value,
        flange_m: START_FACTOR * n.flange_m.value.max(d.flange_m.value),
        flange_rad: START_FACTOR * n.flange_rad.value.max(d.flange_rad.value),
        marks_m: n.marks_m.value.max(1e-9),
        outliers: n.outliers.max(MIN_OUTLIER_FRACTION),
        outlier_poses: OUTLIER_POSE_FRACTION,
    }
}

/// Fits a hypothesis; `rough` enables annealing from a rough initial estimate.
///
/// # Errors
/// The objective is not finite at the start, or the information about the flange corrections is not positive definite.
pub(super) fn fit(
    model: &Model<'_>,
    start: State,
    noise: &Noise,
    mut scales: Scales,
    rough: bool,
) -> Result<Fit, GripperError> {
    let mut state = start;
    if rough {
        for by in COOLING {
            let annealed = Scales { px: scales.px * by, ..scales };
            state = descend(model, state, &annealed, COOLING_STEPS)?.0;
        }
    }
    for _ in 0..MAX_ROUNDS {
        let (next, still) = descend(model, state, &scales, MAX_STEPS)?;
        state = next;
        let normal = model.normal(&state, &scales);
        let inverse = Inverse::of(&normal)?;
        let again = estimate(model, &state, &normal, &inverse, noise, &scales);
        let change = [
            again.px / scales.px,
            again.flange_m / scales.flange_m,
            again.flange_rad / scales.flange_rad,
            again.marks_m / scales.marks_m,
        ];
        scales = again;
        if still && change.iter().all(|c| (c - 1.0).abs() < MAX_SCALE_CHANGE) {
            break;
        }
    }
    let (state, _) = descend(model, state, &scales, MAX_STEPS)?;
    let normal = model.normal(&state, &scales);
    let inverse = Inverse::of(&normal)?;
    let evidence = evidence(model, &state, noise, &scales, &inverse);
    Ok(Fit { state, scales, covariance: inverse.global, rows: normal.rows, ordinary: normal.ordinary, evidence })
}

/// Takes at most `steps` steps downhill; also returns whether the last one was negligible.
fn descend(model: &Model<'_>, mut state: State, scales: &Scales, steps: usize) -> Result<(State, bool), GripperError> {
    let mut value = model.objective(&state, scales);
    if !value.is_finite() {
        return Err(GripperError::NotConverged("the likelihood is not finite at the initial estimate".into()));
    }
    let mut damping = 1e-6;
    for _ in 0..steps {
        let normal = model.normal(&state, scales);
        let mut moved = None;
        for _ in 0..12 {
            if let Some((global, local, length)) = step(&normal, damping) {
                let next = state.stepped(&global, &local, model);
                let f = model.objective(&next, scales);
                if f <= value + 1e-12 * value.abs() {
                    moved = Some((next, f, length));
                    break;
                }
            }
            damping = (damping * 10.0).max(1e-6);
            if damping > 1e9 {
                break;
            }
        }
        // No step decreases the objective: this is the minimum to rounding.
        let Some((next, f, length)) = moved else { return Ok((state, true)) };
        state = next;
        value = f;
        damping *= 0.1;
        if length < MAX_NEGLIGIBLE_STEP {
            return Ok((state, true));
        }
    }
    Ok((state, false))
}

/// A damped step: global part, local parts, and its length in posterior standard deviations.
fn step(n: &Normal, damping: f64) -> Option<(DVector<f64>, Vec<Vector6<f64>>, f64)> {
    let mut s = n.h.clone();
    let mut g = n.g.clone();
    for j in 0..s.nrows() {
        s[(j, j)] *= 1.0 + damping;
    }
    let mut inverses = Vec::with_capacity(n.a.len());
    for ((a, b), c) in n.a.iter().zip(&n.b).zip(&n.c) {
        let mut a = *a;
        for j in 0..6 {
            a[(j, j)] *= 1.0 + damping;
        }
        let inverse = a.cholesky()?.inverse();
        let ab = inverse * b;
        s.gemm_tr(-1.0, b, &ab, 1.0);
        g.gemv_tr(-1.0, &ab, c, 1.0);
        inverses.push(inverse);
    }
    let scale = DVector::from_fn(s.nrows(), |j, _| 1.0 / s[(j, j)].abs().sqrt().max(1e-150));
    let scaled = DMatrix::from_fn(s.nrows(), s.nrows(), |i, j| s[(i, j)] * scale[i] * scale[j]);
    let global = scaled.cholesky()?.solve(&g.component_mul(&scale)).component_mul(&scale);
    let length = g.dot(&global).abs().sqrt();
    let local = inverses.iter().zip(&n.b).zip(&n.c).map(|((a, b), c)| a * (c - b * &global)).collect();
    Some((global, local, length))
}

/// Inverse of the information: the global block, one block per pose, and the logarithm of the determinant.
struct Inverse {
    global: DMatrix<f64>,
    local: Vec<Matrix6<f64>>,
    log_det: f64,
}

impl Inverse {
    fn of(n: &Normal) -> Result<Self, GripperError> {
        let fail = || {
            GripperError::NotConverged("the information about the flange corrections is not positive definite".into())
        };
        let mut s = n.h.clone();
        let mut log_det = 0.0;
        let mut parts = Vec::with_capacity(n.a.len());
        for (a, b) in n.a.iter().zip(&n.b) {
            let chol = a.cholesky().ok_or_else(fail)?;
            log_det += 2.0 * chol.l_dirty().diagonal().map(f64::ln).sum();
            let inverse = chol.inverse();
            let ab = inverse * b;
            s.gemm_tr(-1.0, b, &ab, 1.0);
            parts.push((inverse, ab));
        }
        let (global, global_log_det) = inverse_of(&s);
        log_det += global_log_det;
        let local = parts.iter().map(|(inverse, ab)| {
            let through = ab * &global * ab.transpose();
            inverse + Matrix6::from_fn(|i, j| through[(i, j)])
        });
        let local = local.collect();
        Ok(Self { global, local, log_det })
    }
}

/// Inverse and log-determinant of an information matrix, from the eigenvalues of its correlation form, which are
/// clamped to `MIN_EIGENVALUE`.
pub(super) fn inverse_of(s: &DMatrix<f64>) -> (DMatrix<f64>, f64) {
    let n = s.nrows();
    let d = DVector::from_fn(n, |j, _| s[(j, j)].abs().sqrt().max(1e-150));
    let scaled = DMatrix::from_fn(n, n, |i, j| 0.5 * (s[(i, j)] + s[(j, i)]) / (d[i] * d[j]));
    let eigen = SymmetricEigen::new(scaled);
    let values = eigen.eigenvalues.map(|v| v.max(MIN_EIGENVALUE));
    let half = DMatrix::from_fn(n, n, |i, j| eigen.eigenvectors[(i, j)] / (d[i] * values[j].sqrt()));
    let log_det = values.map(f64::ln).sum() + 2.0 * d.map(f64::ln).sum();
    (&half * half.transpose(), log_det)
}

/// Standard deviations estimated from the residuals and their priors: σ² = (Σ r² + ν σ0²) / (redundancy + ν).
fn estimate(model: &Model<'_>, s: &State, n: &Normal, inverse: &Inverse, noise: &Noise, k: &Scales) -> Scales {
    let g = &inverse.global;
    let (mut absorbed_t, mut absorbed_r, mut sum_t, mut sum_r, mut weight) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for ((c, e), w) in inverse.local.iter().zip(&s.flange).zip(&n.ordinary) {
        absorbed_t += w * c.fixed_view::<3, 3>(0, 0).trace() / (k.flange_m * k.flange_m);
        absorbed_r += w * c.fixed_view::<3, 3>(3, 3).trace() / (k.flange_rad * k.flange_rad);
        sum_t += w * e.translation.vector.norm_squared();
        sum_r += w * e.rotation.scaled_axis().norm_squared();
        weight += w;
    }
    let marks = model.mark_unknowns();
    let of_marks: f64 = (POSES..POSES + marks).map(|j| g[(j, j)]).sum();
    let absorbed_m = of_marks / (k.marks_m * k.marks_m);
    let absorbed_u: f64 = (POSES + marks..g.nrows()).map(|j| g[(j, j)]).sum();
    let sum_m: f64 = s.marks.iter().zip(&model.rec.marks).map(|(a, b)| (a - b).norm_squared()).sum();
    // The information about each unknown comes from its prior or from the pixels. The degrees of freedom that the
    // priors do not determine are used up by the pixels.
    let unknowns = (POSES + marks + s.u.len() + 6 * s.flange.len()) as f64;
    let spent = unknowns - absorbed_t - absorbed_r - absorbed_m - absorbed_u;
    let (mut sum_px, mut seen, mut all) = (0.0, 0.0, 0.0);
    for &(w, r2) in n.rows.iter().flatten() {
        all += 1.0;
        if w > 0.0 {
            seen += w;
            sum_px += w * r2;
        }
    }
    let ask = |sum: f64, redundancy: f64, prior: Sigma| {
        let nu = freedom(prior);
        ((sum + nu * prior.value * prior.value) / (redundancy.max(0.0) + nu)).sqrt()
    };
    let prior_outliers = noise.outliers.max(MIN_OUTLIER_FRACTION);
    Scales {
        px: ask(sum_px, 2.0 * seen - spent, noise.mark_px),
        flange_m: ask(sum_t, 3.0 * weight - absorbed_t, noise.flange_m),
        flange_rad: ask(sum_r, 3.0 * weight - absorbed_r, noise.flange_rad),
        marks_m: if marks > 0 { ask(sum_m, marks as f64 - absorbed_m, noise.marks_m) } else { k.marks_m },
        outliers: ((all - seen + OUTLIER_COUNT * prior_outliers) / (all + OUTLIER_COUNT))
            .clamp(MIN_OUTLIER_FRACTION, 0.5),
        outlier_poses: (s.flange.len() as f64 - weight + OUTLIER_POSE_COUNT * OUTLIER_POSE_FRACTION)
            / (s.flange.len() as f64 + OUTLIER_POSE_COUNT),
    }
}

fn freedom(s: Sigma) -> f64 {
    if s.stated { STATED_FREEDOM } else { DEFAULT_FREEDOM }
}

/// Logarithm of the evidence by Laplace's approximation, including the priors of the standard deviations.
fn evidence(model: &Model<'_>, s: &State, noise: &Noise, k: &Scales, inverse: &Inverse) -> f64 {
    let unknowns = (model.globals() + 6 * s.flange.len()) as f64;
    let prior_cost = |sigma: f64, prior: Sigma| {
        let ratio = sigma / prior.value;
        0.5 * freedom(prior) * (1.0 / (ratio * ratio) + 2.0 * ratio.ln())
    };
    let mut f = model.objective(s, k);
    f += prior_cost(k.px, noise.mark_px)
        + prior_cost(k.flange_m, noise.flange_m)
        + prior_cost(k.flange_rad, noise.flange_rad);
    if model.free_marks {
        f += prior_cost(k.marks_m, noise.marks_m);
    }
    -f + 0.5 * unknowns * TAU.ln() - 0.5 * inverse.log_det
}
