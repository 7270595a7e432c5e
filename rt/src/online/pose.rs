//! Estimates the gripper pose from the marks of one or both views: minimises the robust weighted reprojection error in
//! a bounded number of steps.
//!
//! The unknown is a small gripper-frame screw `xi = [v; ω]`, `left_from_gripper <- left_from_gripper * exp(xi)`. In
//! this frame the derivative of a mark's position does not depend on the pose, and the covariance is in the form that
//! the command side uses.

use super::MarkObservation;
use crate::geom::{Pixel, Pose, Rig, Twist, Vec3, View, exp_twist};
use crate::gripper::{Gripper, MAX_MARKS};
use crate::math;
use nalgebra::{Matrix2, Matrix2x6, Matrix3, Matrix3x6, Matrix6, Point3, Vector2, Vector6};

/// Marks by view and mark index, as [`super::Vision`] carries them.
pub type MarkTable = [[Option<MarkObservation>; MAX_MARKS]; 2];

/// Settings of the pose estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseSettings {
    /// Gauss-Newton steps of the robust stage. Default 10.
    pub steps: u32,
    /// Outlier gate: maximum distance of a mark from its prediction, in its standard deviations (scaled by the spread
    /// of all marks, if that is larger). Default 5.
    pub gate_sigmas: f64,
    /// A mark within this distance of its prediction is never dropped, pixels: a small calibration error of the rig
    /// moves all marks of a view, and none of them is an outlier. Default 0.5.
    pub gate_floor_px: f64,
}

impl Default for PoseSettings {
    fn default() -> Self {
        Self { steps: 10, gate_sigmas: 5.0, gate_floor_px: 0.5 }
    }
}

/// Why there is no pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseError {
    /// Too few marks to determine a pose. Minimum: three in stereo (two of them in both views), four in one view.
    TooFew,
    /// The marks do not determine all six degrees of freedom: collinear, or too close to each other.
    Degenerate,
    /// The iteration moved a mark behind a camera, or a value is not finite.
    Diverged,
}

/// A pose with its covariance and the observations in use.
#[derive(Clone, Copy, Debug)]
pub struct PoseEstimate {
    /// Gripper pose in the rig.
    pub left_from_gripper: Pose,
    /// Covariance as a small gripper-frame screw (m, rad), scaled up if the residuals exceed the
    /// covariances of the marks.
    pub covariance: Matrix6<f64>,
    /// Weighted root mean square reprojection error of the used marks, pixels.
    pub residual_px: f64,
    /// The observations in use, by view and mark; the others were missing or dropped as outliers.
    pub used: [[bool; MAX_MARKS]; 2],
}

impl PoseEstimate {
    /// Number of marks used in a view.
    pub fn used_in(&self, view: View) -> usize {
        self.used[view.index()].iter().filter(|u| **u).count()
    }

    /// Number of marks used in at least one view.
    pub fn distinct(&self) -> usize {
        let [l, r] = &self.used;
        l.iter().zip(r).filter(|(l, r)| **l || **r).count()
    }
}

/// Removes the observations that the estimate rejected; returns their number.
pub(crate) fn keep_used(table: &mut MarkTable, e: &PoseEstimate) -> u64 {
    let mut dropped = 0;
    for (marks, used) in table.iter_mut().zip(&e.used) {
        for (m, used) in marks.iter_mut().zip(used) {
            if m.is_some() && !used {
                *m = None;
                dropped += 1;
            }
        }
    }
    dropped
}

#[derive(Clone, Copy)]
struct Observation {
    view: View,
    mark: usize,
    point: Vec3,
    pixel: Pixel,
    information: Matrix2<f64>,
    weight: f64,
}

type Observations = heapless::Vec<Observation, { 2 * MAX_MARKS }>;

/// Error of one observation (measured minus predicted, pixels) and the derivative of its prediction with respect to the
/// gripper-frame screw. `None` if the mark is behind the camera or the error is not finite.
fn linearize(rig: &Rig, pose: &Pose, o: &Observation) -> Option<(Vector2<f64>, Matrix2x6<f64>)> {
    let view_from_gripper = rig.view_from_left(o.view) * pose;
    let x = (view_from_gripper * Point3::from(o.point)).coords;
    let (p, jx) = rig.camera(o.view).project_with_jacobian(&x)?;
    let m = &o.point;
    // d(point)/d(xi) = [I, -[m]x] in the gripper frame.
    let body = Matrix3x6::new(
        1.0, 0.0, 0.0, 0.0, m.z, -m.y, //
        0.0, 1.0, 0.0, -m.z, 0.0, m.x, //
        0.0, 0.0, 1.0, m.y, -m.x, 0.0,
    );
    let r = view_from_gripper.rotation.to_rotation_matrix();
    let e = o.pixel - p;
    (e.x.is_finite() && e.y.is_finite()).then(|| (e, jx * r.matrix() * body))
}

/// Estimates the pose from `marks`, starting at `start` (within some tens of pixels and degrees of the truth).
///
/// With a good prediction and consistent marks, at most three plain Gauss-Newton steps are enough ([`track`]).
/// Otherwise the robust stage runs. The work is bounded: at most 30 robust steps (`settings.steps`), three plain steps
/// before and three after them, and `2 * MAX_MARKS` observations per step.
///
/// # Errors
/// [`PoseError`] if the marks do not determine a pose. A result is always finite.
pub fn estimate(
    rig: &Rig,
    gripper: &Gripper,
    marks: &MarkTable,
    start: &Pose,
    settings: &PoseSettings,
) -> Result<PoseEstimate, PoseError> {
    let mut all = gather(gripper, marks);
    enough(&all)?;
    if let Some(tracked) = track(rig, &all, start, settings) {
        return Ok(tracked);
    }
    let mut pose = *start;
    for step in 0..settings.steps.clamp(1, 30) {
        reweight(rig, &pose, &mut all, step >= 3, settings)?;
        let (h, g) = normal_equations(rig, &pose, &all)?;
        if advance(&mut pose, &h, &g)? && step >= 5 {
            break;
        }
    }
    // Reject outliers, then plain weighted least squares on the remaining marks: the covariance describes this
    // estimate.
    let scale = spread(rig, &pose, &all)?;
    let mut kept = Observations::new();
    for o in &all {
        let (e, _) = linearize(rig, &pose, o).ok_or(PoseError::Diverged)?;
        if !outlying(o, &e, scale, settings) {
            let _ = kept.push(Observation { weight: 1.0, ..*o });
        }
    }
    enough(&kept)?;
    for _ in 0..3 {
        let (h, g) = normal_equations(rig, &pose, &kept)?;
        if advance(&mut pose, &h, &g)? {
            break;
        }
    }
    finish(rig, pose, &kept)
}

/// Maximum number of plain steps before the robust stage.
const MAX_PLAIN_STEPS: usize = 3;
/// Length of a plain step below which the iteration has converged, m and rad: it changes no pixel by 1e-3.
const CONVERGED_STEP: (f64, f64) = (1e-6, 1e-6);

/// Pose of the gripper in one view, precomputed for the plain steps.
struct ViewPose {
    /// Rotation of the view from the gripper, row by row.
    r: Matrix3<f64>,
    t: Vec3,
}

/// Sums over the observations at one pose.
struct Sums {
    h: Matrix6<f64>,
    g: Vector6<f64>,
    /// Weighted sum of squared errors.
    chi2: f64,
    /// Sum of squared errors with the mean weight of each observation, and the sum of these weights.
    squares: f64,
    weights: f64,
    /// Maximum squared error, px².
    max_error2: f64,
}

/// Plain weighted Gauss-Newton from a prediction. `None` if it does not converge within [`MAX_PLAIN_STEPS`] or if the
/// error of a mark exceeds the floor of the outlier gate.
fn track(rig: &Rig, all: &Observations, start: &Pose, settings: &PoseSettings) -> Option<PoseEstimate> {
    let mut pose = *start;
    for _ in 0..MAX_PLAIN_STEPS {
        let s = sums(rig, &pose, all)?;
        let covariance = inverse(&s.h)?;
        let xi: Twist = covariance * s.g;
        let v2 = xi.fixed_rows::<3>(0).norm_squared();
        let w2 = xi.fixed_rows::<3>(3).norm_squared();
        if !(v2 < math::sq(0.05) && w2 < math::sq(0.1)) {
            return None;
        }
        pose *= exp_twist(&xi);
        if v2 > math::sq(CONVERGED_STEP.0) || w2 > math::sq(CONVERGED_STEP.1) {
            continue;
        }
        if s.max_error2 > math::sq(settings.gate_floor_px) {
            return None;
        }
        pose.rotation.renormalize();
        // The last step reduces the sum of squares by g·xi.
        let chi2 = (s.chi2 - s.g.dot(&xi)).max(0.0);
        let freedom = 2.0 * all.len() as f64 - 6.0;
        let factor = if freedom > 0.5 { (chi2 / freedom).max(1.0) } else { 1.0 };
        let mut used = [[false; MAX_MARKS]; 2];
        for o in all {
            if let Some(u) = used[o.view.index()].get_mut(o.mark) {
                *u = true;
            }
        }
        let residual_px = math::sqrt(s.squares / s.weights);
        let t = &pose.translation.vector;
        let finite = residual_px.is_finite() && t.iter().chain(pose.rotation.coords.iter()).all(|v| v.is_finite());
        return finite.then_some(PoseEstimate {
            left_from_gripper: pose,
            covariance: covariance * factor,
            residual_px,
            used,
        });
    }
    None
}

/// Normal equations and errors at a pose: like [`linearize`], with the terms common to a view computed once.
fn sums(rig: &Rig, pose: &Pose, all: &Observations) -> Option<Sums> {
    let view_poses = View::BOTH.map(|view| {
        let p = rig.view_from_left(view) * pose;
        ViewPose { r: *p.rotation.to_rotation_matrix().matrix(), t: p.translation.vector }
    });
    let mut s =
        Sums { h: Matrix6::zeros(), g: Vector6::zeros(), chi2: 0.0, squares: 0.0, weights: 0.0, max_error2: 0.0 };
    for o in all {
        let ViewPose { r, t } = &view_poses[o.view.index()];
        let m = &o.point;
        let (p, jx) = rig.camera(o.view).project_with_jacobian(&(r * m + t))?;
        let e = o.pixel - p;
        let j = jx * r;
        // d(point)/d(xi) = [I, -[m]x]: a row a of the derivative with respect to the point continues with m x a.
        let row = |k: usize| {
            let a = [j[(k, 0)], j[(k, 1)], j[(k, 2)]];
            [a[0], a[1], a[2], m.y * a[2] - m.z * a[1], m.z * a[0] - m.x * a[2], m.x * a[1] - m.y * a[0]]
        };
        let (u, v) = (row(0), row(1));
        let (wxx, wxy, wyy) = (o.information[(0, 0)], o.information[(0, 1)], o.information[(1, 1)]);
        let (ex, ey) = (wxx * e.x + wxy * e.y, wxy * e.x + wyy * e.y);
        for i in 0..6 {
            let (a, b) = (wxx * u[i] + wxy * v[i], wxy * u[i] + wyy * v[i]);
            for k in 0..=i {
                s.h[(i, k)] += a * u[k] + b * v[k];
            }
            s.g[i] += u[i] * ex + v[i] * ey;
        }
        let (e2, w) = (e.norm_squared(), 0.5 * (wxx + wyy));
        s.chi2 += e.x * ex + e.y * ey;
        s.squares += w * e2;
        s.weights += w;
        s.max_error2 = s.max_error2.max(e2);
    }
    for i in 0..6 {
        for k in 0..i {
            s.h[(k, i)] = s.h[(i, k)];
        }
    }
    s.chi2.is_finite().then_some(s)
}

fn gather(gripper: &Gripper, marks: &MarkTable) -> Observations {
    let mut all = Observations::new();
    for view in View::BOTH {
        for (mark, (m, seen)) in gripper.marks.iter().zip(&marks[view.index()]).enumerate() {
            let Some(seen) = seen else { continue };
            let finite = seen.pixel.iter().chain(seen.covariance.iter()).all(|v| v.is_finite());
            let positive = seen.covariance[(0, 0)] > 0.0 && seen.covariance.determinant() > 0.0;
            if let (true, true, Some(information)) = (finite, positive, seen.covariance.try_inverse()) {
                let o = Observation { view, mark, point: m.position, pixel: seen.pixel, information, weight: 1.0 };
                let _ = all.push(o);
            }
        }
    }
    all
}

fn enough(all: &Observations) -> Result<(), PoseError> {
    let count = |v: View| all.iter().filter(|o| o.view == v).count();
    let both = all
        .iter()
        .filter(|o| o.view == View::Left && all.iter().any(|r| r.view == View::Right && r.mark == o.mark))
        .count();
    let (l, r) = (count(View::Left), count(View::Right));
    let distinct = l + r - both;
    if l.max(r) >= 4 || (distinct >= 3 && both >= 2) || (distinct >= 4 && l + r >= 6) {
        Ok(())
    } else {
        Err(PoseError::TooFew)
    }
}

/// Whitened length of an error: its median is about 1.2 for a consistent covariance.
fn whitened(o: &Observation, e: &Vector2<f64>) -> f64 {
    math::sqrt((e.transpose() * o.information * e)[0].max(0.0))
}

/// Robust scale of the whitened errors, at least 1.
fn spread(rig: &Rig, pose: &Pose, all: &Observations) -> Result<f64, PoseError> {
    let mut z: heapless::Vec<f64, { 2 * MAX_MARKS }> = heapless::Vec::new();
    for o in all {
        let (e, _) = linearize(rig, pose, o).ok_or(PoseError::Diverged)?;
        let _ = z.push(whitened(o, &e));
    }
    z.sort_unstable_by(f64::total_cmp);
    // The median length of a two-dimensional unit normal is 1.177.
    Ok((z.get(z.len() / 2).copied().unwrap_or(0.0) / 1.177).max(1.0))
}

fn outlying(o: &Observation, e: &Vector2<f64>, scale: f64, settings: &PoseSettings) -> bool {
    let floor = settings.gate_floor_px;
    whitened(o, e) > settings.gate_sigmas * scale && e.norm_squared() > floor * floor
}

/// Weights for the next step: Huber in the early steps, Tukey (`late`) near convergence.
fn reweight(
    rig: &Rig,
    pose: &Pose,
    all: &mut Observations,
    late: bool,
    settings: &PoseSettings,
) -> Result<(), PoseError> {
    let scale = spread(rig, pose, all)?;
    for o in all.iter_mut() {
        let (e, _) = linearize(rig, pose, o).ok_or(PoseError::Diverged)?;
        let z = whitened(o, &e) / scale;
        o.weight = if late {
            let u = 1.0 - math::sq(z / settings.gate_sigmas);
            // Marks inside the gate keep a minimum weight, otherwise a small error of the rig could remove all of them.
            if outlying(o, &e, scale, settings) { 1e-6 } else { math::sq(u.max(0.1)) }
        } else if z <= 1.5 {
            1.0
        } else {
            1.5 / z
        };
    }
    Ok(())
}

fn normal_equations(rig: &Rig, pose: &Pose, all: &Observations) -> Result<(Matrix6<f64>, Vector6<f64>), PoseError> {
    let mut h = Matrix6::zeros();
    let mut g = Vector6::zeros();
    for o in all {
        let (e, j) = linearize(rig, pose, o).ok_or(PoseError::Diverged)?;
        let jw = j.transpose() * (o.information * o.weight);
        h += jw * j;
        g += jw * e;
    }
    Ok((h, g))
}

/// Inverse of a positive definite matrix; `None` if a pivot is at most 1e-10 of its diagonal element.
fn inverse(h: &Matrix6<f64>) -> Option<Matrix6<f64>> {
    let l = h.cholesky()?;
    for i in 0..6 {
        let pivot = math::sq(l.l_dirty()[(i, i)]);
        if !(pivot > 1e-10 * h[(i, i)]) {
            return None;
        }
    }
    let inv = l.inverse();
    inv.iter().all(|v| v.is_finite()).then_some(inv)
}

/// One damped step, limited in length; true if it is so short that the iteration has converged.
fn advance(pose: &mut Pose, h: &Matrix6<f64>, g: &Vector6<f64>) -> Result<bool, PoseError> {
    let mut damped = *h;
    for i in 0..6 {
        damped[(i, i)] *= 1.0 + 1e-7;
    }
    let mut xi: Twist = inverse(&damped).ok_or(PoseError::Degenerate)? * g;
    let v = math::sqrt(xi.fixed_rows::<3>(0).norm_squared());
    let w = math::sqrt(xi.fixed_rows::<3>(3).norm_squared());
    let longest = (v / 0.2).max(w / 0.4);
    if !longest.is_finite() {
        return Err(PoseError::Diverged);
    }
    if longest > 1.0 {
        xi /= longest;
    }
    *pose *= exp_twist(&xi);
    Ok(v < 1e-9 && w < 1e-8)
}

fn finish(rig: &Rig, mut pose: Pose, kept: &Observations) -> Result<PoseEstimate, PoseError> {
    pose.rotation.renormalize();
    let (h, _) = normal_equations(rig, &pose, kept)?;
    let covariance = inverse(&h).ok_or(PoseError::Degenerate)?;
    let (mut chi2, mut sum, mut weights) = (0.0, 0.0, 0.0);
    let mut used = [[false; MAX_MARKS]; 2];
    for o in kept {
        let (e, _) = linearize(rig, &pose, o).ok_or(PoseError::Diverged)?;
        chi2 += (e.transpose() * o.information * e)[0];
        let w = 0.5 * o.information.trace();
        sum += w * e.norm_squared();
        weights += w;
        if let Some(u) = used[o.view.index()].get_mut(o.mark) {
            *u = true;
        }
    }
    let freedom = 2.0 * kept.len() as f64 - 6.0;
    let factor = if freedom > 0.5 { (chi2 / freedom).max(1.0) } else { 1.0 };
    let residual_px = math::sqrt(sum / weights);
    let t = &pose.translation.vector;
    if !(residual_px.is_finite() && t.iter().chain(pose.rotation.coords.iter()).all(|v| v.is_finite())) {
        return Err(PoseError::Diverged);
    }
    Ok(PoseEstimate { left_from_gripper: pose, covariance: covariance * factor, residual_px, used })
}
