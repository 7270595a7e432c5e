//! The start of the fit: hand-eye calibration in closed form, on the motions that most of the poses agree about.
//!
//! Between two rests the flange moves by A and the gripper, as the cameras see it, by B, and A X = X B with X =
//! `flange_from_gripper`. The rotation follows from the logarithms, α = R β (Park and Martin 1994); then, with a scale
//! s between the arm's lengths and the cameras' that shows a wrong unit, (R_A - 1) t = s R t_B - t_A is linear. Triples
//! of poses propose, the median distance of the marks over all poses decides, so that up to half of the poses may be
//! wrong. Where all turns share one axis, R is open about it: a fan of angles is tried, since translations may decide;
//! where nothing turns, they alone do.

use super::align::{Indices, median, rotation};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::{DMatrix, DVector, Matrix3, SymmetricEigen, Translation3, Unit, UnitQuaternion};

/// Triples of poses tried: one of three good ones among poses of which half are wrong is missed with (7/8)^200 = 3e-12.
const TRIES: usize = 200;
/// Turns about a second axis below this (root mean square, rad) are not told from the noise of a gripper seen by
/// cameras.
const LEAST_TURN: f64 = 0.017;
/// Angles of the fan about a common axis.
const FAN: usize = 24;
/// What is known of the gripper's place on the flange in the linear step: within 0.3 m, against a noise of one
/// millimetre.
const RIDGE: f64 = 1e-3 / 0.3;
/// Most pairs of poses in the final step.
const MOST_PAIRS: usize = 4000;
/// Poses further than this many medians from the consensus take no part in the final step.
const WITHIN: f64 = 4.0;
/// Poses further than this many medians start with a correction of their own; the likelihood decides.
const FAR: f64 = 8.0;

/// A rest: flange in the base, gripper in the left camera.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rest {
    /// Index in the recording.
    pub(super) pose: usize,
    pub(super) flange: Pose,
    pub(super) view: Pose,
}

/// A solution in closed form.
#[derive(Clone, Copy, Debug)]
pub(super) struct HandEye {
    /// `flange_from_gripper`.
    pub(super) x: Pose,
    /// `base_from_left`.
    pub(super) y: Pose,
    /// Lengths of the arm over lengths of the cameras.
    pub(super) scale: f64,
    /// Median over the poses of the marks' distance from where the solution puts them, in the arm's lengths, metres.
    pub(super) median_m: f64,
}

/// Solves; `marks` only weigh rotation against translation. `None` for fewer than two poses.
pub(super) fn solve(rests: &[Rest], marks: &[Vec3], free_scale: bool) -> Option<HandEye> {
    let n = rests.len();
    if n < 2 {
        return None;
    }
    let mut draw = Indices(7);
    let mut best: Option<HandEye> = None;
    let samples: Vec<Vec<usize>> =
        if n < 4 { vec![(0..n).collect()] } else { (0..TRIES).map(|_| draw.three(n).to_vec()).collect() };
    for sample in samples {
        let chosen: Vec<Rest> = sample.iter().map(|&i| rests[i]).collect();
        best = better(best, from_rests(&chosen, rests, marks, free_scale));
    }
    // The pose set of the consensus, enlarged and solved anew; it has to be at least as good.
    for _ in 0..3 {
        let now = best?;
        let good: Vec<Rest> =
            rests.iter().copied().filter(|r| now.distance(r, marks) <= WITHIN * now.median_m).collect();
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
    let stride = (n * (n.max(1) - 1) / 2).div_ceil(MOST_PAIRS).max(1);
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
    /// First flange correction of a rest: none for one of the consensus, what the cameras say for one that is far from
    /// it. Without it all sightings of such a rest would look like gross errors.
    pub(super) fn correction(&self, r: &Rest, marks: &[Vec3]) -> Pose {
        if self.distance(r, marks) <= FAR * self.median_m {
            return Pose::identity();
        }
        r.flange.inverse() * self.y * scaled(&r.view, self.scale) * self.x.inverse()
    }

    /// Root mean square distance of the marks at a rest between both ways around, metres of the arm.
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

/// Rotations that the motions allow: one, or a fan about the only axis of turning.
fn rotations(motions: &[(Pose, Pose)]) -> Option<Vec<UnitQuaternion<f64>>> {
    let logs: Vec<(Vec3, Vec3)> =
        motions.iter().map(|(a, b)| (b.rotation.scaled_axis(), a.rotation.scaled_axis())).collect();
    let spread = logs.iter().map(|(b, _)| b * b.transpose()).sum::<Matrix3<f64>>() / logs.len().max(1) as f64;
    let eigen = SymmetricEigen::new(spread);
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    let turn = |k: usize| eigen.eigenvalues[order[k]].max(0.0).sqrt();
    if turn(0) < LEAST_TURN {
        // Nothing turns: directions of travel are all there is.
        let r = rotation(motions.iter().map(|(a, b)| (b.translation.vector, a.translation.vector)))?;
        return Some(vec![r]);
    }
    if turn(1) >= LEAST_TURN {
        return Some(vec![rotation(logs.into_iter())?]);
    }
    let axis = Unit::new_normalize(eigen.eigenvectors.column(order[0]).into_owned());
    let first = rotation(logs.into_iter())?;
    let angle = |k: usize| UnitQuaternion::from_axis_angle(&axis, std::f64::consts::TAU * k as f64 / FAN as f64);
    Some((0..FAN).map(|k| first * angle(k)).collect())
}

/// Translation and scale for a rotation, by least squares with a weak hold on both.
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

/// Mean of poses: rotations by the mean of their matrices.
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
