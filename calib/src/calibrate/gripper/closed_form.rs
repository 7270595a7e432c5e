//! Initial estimate of the fit: closed-form hand-eye calibration with a consensus over the poses.
//!
//! Between two rests the flange moves by A and the gripper, seen by the cameras, by B, and A X = X B with X =
//! `flange_from_gripper`. The rotation follows from the logarithms, α = R β (Park and Martin 1994). With a scale s
//! between the lengths of the arm and of the cameras, which reveals a wrong unit, (R_A - 1) t = s R t_B - t_A is
//! linear. Each triple of poses gives a candidate; the one with the smallest median distance of the marks over all
//! poses wins, so up to half of the poses may be wrong. If all rotations share one axis, R is undetermined about it: a
//! fan of angles is tried, because the translations may resolve it. Without any rotation, R follows from the
//! translations alone.

use super::align::{Indices, median, rotation};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::{DMatrix, DVector, Matrix3, SymmetricEigen, Translation3, Unit, UnitQuaternion};

/// Number of random triples of poses: with half of the poses wrong, the probability that no triple is entirely correct
/// is (7/8)^200 = 3e-12.
const TRIPLES: usize = 200;
/// Minimum rotation about an axis (root mean square, rad): smaller ones are within the noise of the camera poses.
const MIN_TURN_RAD: f64 = 0.017;
/// Number of angles of the fan about a common axis.
const FAN_ANGLES: usize = 24;
/// Prior of the gripper's position on the flange in the linear step: noise of 1 mm relative to a prior of 0.3 m.
const RIDGE: f64 = 1e-3 / 0.3;
/// Maximum number of pose pairs in the final step.
const MAX_PAIRS: usize = 4000;
/// Maximum distance of a pose from the consensus, in medians, in the final step.
const MAX_INLIER_MEDIANS: f64 = 4.0;
/// Maximum distance of a pose from the consensus, in medians, without an initial flange correction.
const MAX_UNCORRECTED_MEDIANS: f64 = 8.0;

/// A rest: flange pose in the base frame, gripper pose in the left camera.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rest {
    /// Index in the recording.
    pub(super) pose: usize,
    pub(super) flange: Pose,
    pub(super) view: Pose,
}

/// A closed-form solution.
#[derive(Clone, Copy, Debug)]
pub(super) struct HandEye {
    /// `flange_from_gripper`.
    pub(super) x: Pose,
    /// `base_from_left`.
    pub(super) y: Pose,
    /// Ratio of the arm's lengths to the cameras' lengths.
    pub(super) scale: f64,
    /// Median over the poses of the distance between predicted and seen marks, in the arm's lengths, metres.
    pub(super) median_m: f64,
}

/// Solves for X and Y; `marks` only set the relative weight of rotation and translation. `None` for fewer than two
/// poses.
pub(super) fn solve(rests: &[Rest], marks: &[Vec3], free_scale: bool) -> Option<HandEye> {
    let n = rests.len();
    if n < 2 {
        return None;
    }
    let mut draw = Indices(7);
    let mut best: Option<HandEye> = None;
    let samples: Vec<Vec<usize>> =
        if n < 4 { vec![(0..n).collect()] } else { (0..TRIPLES).map(|_| draw.three(n).to_vec()).collect() };
    for sample in samples {
        let chosen: Vec<Rest> = sample.iter().map(|&i| rests[i]).collect();
        best = better(best, from_rests(&chosen, rests, marks, free_scale));
    }
    // Solve again with all inliers of the consensus; the result is kept only if it is better.
    for _ in 0..3 {
        let now = best?;
        let good: Vec<Rest> =
            rests.iter().copied().filter(|r| now.distance(r, marks) <= MAX_INLIER_MEDIANS * now.median_m).collect();
        best = better(best, from_rests(&good, rests, marks, free_scale));
    }
    best
}

fn better(a: Option<HandEye>, b: Option<HandEye>) -> Option<HandEye> {
    match (a, b) {
        (Some(a), Some(b)) => Some(if b.median_m < a.median_m { b } else { a }),
        (a, b) => a.or(b),
    }
}

/// Relative motions (A, B) between the chosen rests.
fn motions(rests: &[Rest]) -> Vec<(Pose, Pose)> {
    let n = rests.len();
    let stride = (n * (n.max(1) - 1) / 2).div_ceil(MAX_PAIRS).max(1);
    let pairs = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).step_by(stride);
    pairs.map(|(i, j)| (rests[i].flange.inv_mul(&rests[j].flange), rests[i].view.inv_mul(&rests[j].view))).collect()
}

fn from_rests(chosen: &[Rest], all: &[Rest], marks: &[Vec3], free_scale: bool) -> Option<HandEye> {
    let motions = motions(chosen);
    let mut best = None;
    for r in rotations(&motions)? {
        let Some((t, scale)) = translation(&motions, &r, free_scale) else { continue };
        let x = Pose::from_parts(Translation3::from(t), r);
        let y = mean(chosen.iter().map(|c| c.flange * x * scaled(&c.view, scale).inverse()))?;
        let mut h = HandEye { x, y, scale, median_m: 0.0 };
        let mut d: Vec<f64> = all.iter().map(|r| h.distance(r, marks)).collect();
        h.median_m = median(&mut d);
        best = better(best, Some(h));
    }
    best
}

impl HandEye {
    /// Initial flange correction of a rest: identity for an inlier, the correction from the cameras for an outlier.
    /// Without it the fit would classify all sightings of such a rest as gross errors.
    pub(super) fn correction(&self, r: &Rest, marks: &[Vec3]) -> Pose {
        if self.distance(r, marks) <= MAX_UNCORRECTED_MEDIANS * self.median_m {
            return Pose::identity();
        }
        r.flange.inverse() * self.y * scaled(&r.view, self.scale) * self.x.inverse()
    }

    /// Root mean square distance at a rest between the marks predicted by the arm and those seen by the cameras, in the
    /// arm's lengths, metres.
    pub(super) fn distance(&self, r: &Rest, marks: &[Vec3]) -> f64 {
        let (around, direct) = (self.y.inv_mul(&r.flange) * self.x, scaled(&r.view, self.scale));
        let d = |m: &Vec3| {
            let p = nalgebra::Point3::from(m * self.scale);
            (around * p - direct * p).norm_squared()
        };
        (marks.iter().map(d).sum::<f64>() / marks.len().max(1) as f64).sqrt()
    }
}

fn scaled(p: &Pose, by: f64) -> Pose {
    Pose::from_parts(Translation3::from(p.translation.vector * by), p.rotation)
}

/// Candidate rotations: one, or a fan about the only rotation axis.
fn rotations(motions: &[(Pose, Pose)]) -> Option<Vec<UnitQuaternion<f64>>> {
    let logs: Vec<(Vec3, Vec3)> =
        motions.iter().map(|(a, b)| (b.rotation.scaled_axis(), a.rotation.scaled_axis())).collect();
    let spread = logs.iter().map(|(b, _)| b * b.transpose()).sum::<Matrix3<f64>>() / logs.len().max(1) as f64;
    let eigen = SymmetricEigen::new(spread);
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    let turn = |k: usize| eigen.eigenvalues[order[k]].max(0.0).sqrt();
    if turn(0) < MIN_TURN_RAD {
        // No rotation: only the directions of the translations are available.
        let r = rotation(motions.iter().map(|(a, b)| (b.translation.vector, a.translation.vector)))?;
        return Some(vec![r]);
    }
    if turn(1) >= MIN_TURN_RAD {
        return Some(vec![rotation(logs.into_iter())?]);
    }
    let axis = Unit::new_normalize(eigen.eigenvectors.column(order[0]).into_owned());
    let first = rotation(logs.into_iter())?;
    let angle = |k: usize| UnitQuaternion::from_axis_angle(&axis, std::f64::consts::TAU * k as f64 / FAN_ANGLES as f64);
    Some((0..FAN_ANGLES).map(|k| first * angle(k)).collect())
}

/// Translation and scale for a rotation, by least squares with weak regularization.
fn translation(motions: &[(Pose, Pose)], r: &UnitQuaternion<f64>, free_scale: bool) -> Option<(Vec3, f64)> {
    let columns = if free_scale { 4 } else { 3 };
    let mut h = DMatrix::<f64>::zeros(columns, columns);
    let mut g = DVector::<f64>::zeros(columns);
    for (a, b) in motions {
        let turn = a.rotation.to_rotation_matrix().matrix() - Matrix3::identity();
        let seen = r * b.translation.vector;
        let mut row = DMatrix::<f64>::zeros(3, columns);
        row.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
        let mut right = -a.translation.vector;
        if free_scale {
            row.set_column(3, &-seen);
        } else {
            right += seen;
        }
        h.gemm_tr(1.0, &row, &row, 1.0);
        g += row.tr_mul(&right);
    }
    for i in 0..3 {
        h[(i, i)] += RIDGE * RIDGE;
    }
    if free_scale {
        h[(3, 3)] += 1e-12;
        g[3] += 1e-12;
    }
    let s = h.cholesky()?.solve(&g);
    let scale = if free_scale { s[3] } else { 1.0 };
    (scale > 0.0 && scale.is_finite()).then(|| (Vec3::new(s[0], s[1], s[2]), scale))
}

/// Mean pose; the rotation is the projected mean of the rotation matrices.
fn mean(poses: impl Iterator<Item = Pose>) -> Option<Pose> {
    let (mut m, mut t, mut n) = (Matrix3::zeros(), Vec3::zeros(), 0.0);
    for p in poses {
        m += p.rotation.to_rotation_matrix().matrix();
        t += p.translation.vector;
        n += 1.0;
    }
    let r = rotation((0..3).map(|k| (Matrix3::identity().column(k).into_owned(), m.column(k).into_owned())))?;
    (n > 0.0).then(|| Pose::from_parts(Translation3::from(t / n), r))
}
