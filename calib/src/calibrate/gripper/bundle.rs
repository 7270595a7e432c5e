//! The likelihood of one hypothesis: objective, weights, and normal equations with analytic derivatives.

use super::data::Recording;
use super::rig_prior::{RigChange, RigPrior, moved, project, skew};
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View, exp_twist};
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix2x6, Matrix3, Matrix6, Vector6};
use std::f64::consts::TAU;

/// Standard deviations of the flange error of an outlier pose (the arm moved between image and joints, or the pose is
/// that of another tool point): metres and rad.
const OUTLIER_POSE_SIGMA: [f64; 2] = [0.1, 0.2];
/// Prior standard deviations of the gripper's pose on the flange: 1 m, any orientation (rad).
const GRIPPER_POSE_SIGMA: [f64; 2] = [1.0, std::f64::consts::PI];
/// Prior standard deviations of the rig's pose in the base frame: 10 m, any orientation (rad).
const RIG_POSE_SIGMA: [f64; 2] = [10.0, std::f64::consts::PI];

/// Number of unknowns of flange_from_gripper and base_from_left.
pub(super) const POSES: usize = 12;

/// One sighting in one view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row {
    pub(super) mark: usize,
    pub(super) view: View,
    pub(super) px: Pixel,
}

/// One hypothesis about the recording.
#[derive(Debug)]
pub(super) struct Model<'a> {
    pub(super) rec: &'a Recording,
    /// Sightings, one list per pose.
    pub(super) rows: Vec<Vec<Row>>,
    /// The rig's unknowns.
    pub(super) prior: RigPrior,
    /// Whether the marks are unknowns.
    pub(super) free_marks: bool,
    /// Area over which gross errors are uniformly distributed, pixels.
    area: f64,
}

/// Values of all unknowns.
#[derive(Clone, Debug)]
pub(super) struct State {
    /// `flange_from_gripper`.
    pub(super) x: Pose,
    /// `base_from_left`.
    pub(super) y: Pose,
    /// Marks in the gripper's frame, metres.
    pub(super) marks: Vec<Vec3>,
    /// Flange correction of each pose, reported from true flange.
    pub(super) flange: Vec<Pose>,
    /// The rig's unknowns, in standard deviations of the prior.
    pub(super) u: DVector<f64>,
}

/// Current standard deviations and outlier fractions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Scales {
    pub(super) px: f64,
    pub(super) flange_m: f64,
    pub(super) flange_rad: f64,
    pub(super) marks_m: f64,
    pub(super) outliers: f64,
    pub(super) outlier_poses: f64,
}

/// Normal equations: global block `h`, one block `a` per pose, coupling blocks `b`; the right-hand sides `g` and `c`
/// are the negative gradient.
#[derive(Debug)]
pub(super) struct Normal {
    pub(super) h: DMatrix<f64>,
    pub(super) g: DVector<f64>,
    pub(super) a: Vec<Matrix6<f64>>,
    pub(super) b: Vec<DMatrix<f64>>,
    pub(super) c: Vec<Vector6<f64>>,
    /// Inlier probability and squared residual (px²) of each row.
    pub(super) rows: Vec<Vec<(f64, f64)>>,
    /// Probability that the flange error of each pose is the arm's ordinary noise.
    pub(super) ordinary: Vec<f64>,
}

impl<'a> Model<'a> {
    pub(super) fn new(rec: &'a Recording, prior: RigPrior, free_marks: bool) -> Self {
        let rows = rec.poses.iter().map(|p| {
            let each = |view: View| {
                p.marks.iter().filter_map(move |s| s.px[view.index()].map(|px| Row { mark: s.mark, view, px }))
            };
            View::BOTH.into_iter().flat_map(each).collect()
        });
        let area = f64::from(rec.rig.left.width) * f64::from(rec.rig.left.height);
        Self { rec, rows: rows.collect(), prior, free_marks, area }
    }

    /// Number of global unknowns: poses, marks and rig.
    pub(super) fn globals(&self) -> usize {
        POSES + self.mark_unknowns() + self.prior.unknowns()
    }

    pub(super) fn mark_unknowns(&self) -> usize {
        if self.free_marks { 3 * self.rec.marks.len() } else { 0 }
    }

    /// The rig at a state.
    pub(super) fn rig(&self, s: &State) -> Rig {
        if self.prior.unknowns() == 0 {
            return self.rec.rig;
        }
        let d = &self.prior.factor * &s.u;
        moved(&self.rec.rig, &RigChange::from_column_slice(d.as_slice()))
    }

    /// Negative logarithm of the likelihood times the priors.
    pub(super) fn objective(&self, s: &State, k: &Scales) -> f64 {
        let rig = self.rig(s);
        let mut f = 0.0;
        for (i, rows) in self.rows.iter().enumerate() {
            let left_from_gripper = s.left_from_gripper(&self.rec.poses[i].base_from_flange, i);
            for r in rows {
                let x = left_from_gripper * nalgebra::Point3::from(s.marks[r.mark]);
                let r2 = rig.project(r.view, &x.coords).map_or(f64::INFINITY, |p| (p - r.px).norm_squared());
                f -= self.density(r2, k).ln();
            }
            f -= flange_density(&s.flange[i], k).1.ln_sum();
        }
        if self.free_marks {
            let d: f64 = s.marks.iter().zip(&self.rec.marks).map(|(a, b)| (a - b).norm_squared()).sum();
            let n = 3.0 * s.marks.len() as f64;
            f += 0.5 * d / (k.marks_m * k.marks_m) + n * k.marks_m.ln() + 0.5 * n * TAU.ln();
        }
        f + 0.5 * s.u.norm_squared() + 0.5 * s.u.len() as f64 * TAU.ln()
    }

    fn density(&self, r2: f64, k: &Scales) -> f64 {
        (1.0 - k.outliers) * normal2(r2, k.px) + k.outliers / self.area
    }

    /// Inlier probability of a sighting with this squared residual.
    fn inlier(&self, r2: f64, k: &Scales) -> f64 {
        (1.0 - k.outliers) * normal2(r2, k.px) / self.density(r2, k)
    }

    /// Normal equations at a state, with each sighting weighted by its inlier probability.
    pub(super) fn normal(&self, s: &State, k: &Scales) -> Normal {
        let (g, n) = (self.globals(), self.rows.len());
        let rig = self.rig(s);
        let mut out = Normal {
            h: DMatrix::zeros(g, g),
            g: DVector::zeros(g),
            a: vec![Matrix6::zeros(); n],
            b: Vec::with_capacity(n),
            c: vec![Vector6::zeros(); n],
            rows: Vec::with_capacity(n),
            ordinary: Vec::with_capacity(n),
        };
        for i in 0..n {
            self.add_pose(i, s, &rig, k, &mut out);
        }
        self.add_priors(s, k, &mut out);
        out
    }

    fn add_pose(&self, i: usize, s: &State, rig: &Rig, k: &Scales, out: &mut Normal) {
        let (rows, g) = (&self.rows[i], self.globals());
        let mut global = DMatrix::<f64>::zeros(2 * rows.len(), g);
        let mut local = DMatrix::<f64>::zeros(2 * rows.len(), 6);
        let mut right = DVector::<f64>::zeros(2 * rows.len());
        let mut weights = Vec::with_capacity(rows.len());
        for (j, row) in rows.iter().enumerate() {
            let Some(d) = self.derivatives(i, row, s, rig) else {
                weights.push((0.0, f64::INFINITY));
                continue;
            };
            let r = row.px - d.px;
            let w = self.inlier(r.norm_squared(), k);
            weights.push((w, r.norm_squared()));
            let root = w.sqrt() / k.px;
            let at = 2 * j;
            global.fixed_view_mut::<2, 6>(at, 0).copy_from(&(d.x * root));
            global.fixed_view_mut::<2, 6>(at, 6).copy_from(&(d.y * root));
            if self.free_marks {
                global.fixed_view_mut::<2, 3>(at, POSES + 3 * row.mark).copy_from(&(d.mark * root));
            }
            if self.prior.unknowns() > 0 {
                let u = d.rig * &self.prior.factor * root;
                global.view_mut((at, g - self.prior.unknowns()), (2, self.prior.unknowns())).copy_from(&u);
            }
            local.fixed_view_mut::<2, 6>(at, 0).copy_from(&(d.flange * root));
            right[at] = r.x * root;
            right[at + 1] = r.y * root;
        }
        out.rows.push(weights);
        out.h.gemm_tr(1.0, &global, &global, 1.0);
        out.g.gemv_tr(1.0, &global, &right, 1.0);
        out.b.push(local.tr_mul(&global));
        let a = local.tr_mul(&local);
        out.a[i].copy_from(&a);
        out.c[i].copy_from(&local.tr_mul(&right));
    }

    fn add_priors(&self, s: &State, k: &Scales, out: &mut Normal) {
        for (i, e) in s.flange.iter().enumerate() {
            let (w, _) = flange_density(e, k);
            out.ordinary.push(w);
            let of = |near: f64, far: f64| w / (near * near) + (1.0 - w) / (far * far);
            let (it, ir) = (of(k.flange_m, OUTLIER_POSE_SIGMA[0]), of(k.flange_rad, OUTLIER_POSE_SIGMA[1]));
            let t = e.translation.vector;
            let r = e.rotation.scaled_axis();
            // The unknowns (v, w) are a twist in the axes of the corrected flange: d(t) = R v, d(r) = (1 + [r]x / 2) w.
            let turn = *e.rotation.to_rotation_matrix().matrix();
            let by = Matrix3::identity() + skew(&r) * 0.5;
            for m in 0..3 {
                out.a[i][(m, m)] += it;
            }
            let mut block = out.a[i].fixed_view_mut::<3, 3>(3, 3);
            block += by.transpose() * by * ir;
            let mut c = out.c[i].fixed_rows_mut::<3>(0);
            c -= turn.transpose() * t * it;
            let mut c = out.c[i].fixed_rows_mut::<3>(3);
            c -= by.transpose() * r * ir;
        }
        if self.free_marks {
            let info = 1.0 / (k.marks_m * k.marks_m);
            for (m, (a, b)) in s.marks.iter().zip(&self.rec.marks).enumerate() {
                for axis in 0..3 {
                    let at = POSES + 3 * m + axis;
                    out.h[(at, at)] += info;
                    out.g[at] -= (a - b)[axis] * info;
                }
            }
        }
        let first = self.globals() - self.prior.unknowns();
        for j in 0..self.prior.unknowns() {
            out.h[(first + j, first + j)] += 1.0;
            out.g[first + j] -= s.u[j];
        }
        // The priors of the poses have no gradient; they only keep the variance of unobserved directions finite.
        for j in 0..POSES {
            let sd = if j < 6 { GRIPPER_POSE_SIGMA } else { RIG_POSE_SIGMA }[(j % 6) / 3];
            out.h[(j, j)] += 1.0 / (sd * sd);
        }
    }

    fn derivatives(&self, i: usize, row: &Row, s: &State, rig: &Rig) -> Option<Derivatives> {
        let base_from_reported = &self.rec.poses[i].base_from_flange;
        let m = s.marks[row.mark];
        let in_flange = (s.x * nalgebra::Point3::from(m)).coords;
        let left_from_flange = s.y.inv_mul(base_from_reported) * s.flange[i];
        let in_left = (left_from_flange * nalgebra::Point3::from(in_flange)).coords;
        let p = project(rig, row.view, &in_left)?;
        let turn = *left_from_flange.rotation.to_rotation_matrix().matrix();
        let by_flange_point: Matrix2x3<f64> = p.by_point * turn;
        let by_mark: Matrix2x3<f64> = by_flange_point * s.x.rotation.to_rotation_matrix().matrix();
        Some(Derivatives {
            px: p.px,
            x: screw(&by_mark, &m),
            y: -screw(&p.by_point, &in_left),
            mark: by_mark,
            flange: screw(&by_flange_point, &in_flange),
            rig: p.by_rig,
        })
    }
}

/// Derivatives of a pixel by all unknowns.
struct Derivatives {
    px: Pixel,
    x: Matrix2x6<f64>,
    y: Matrix2x6<f64>,
    mark: Matrix2x3<f64>,
    flange: Matrix2x6<f64>,
    rig: nalgebra::SMatrix<f64, 2, { super::rig_prior::RIG_PARAMETERS }>,
}

/// Derivative by a twist (v, w) of the frame in which `point` is given: the point moves by v + w x point.
fn screw(by_point: &Matrix2x3<f64>, point: &Vec3) -> Matrix2x6<f64> {
    let mut j = Matrix2x6::zeros();
    j.fixed_view_mut::<2, 3>(0, 0).copy_from(by_point);
    j.fixed_view_mut::<2, 3>(0, 3).copy_from(&(-(by_point * skew(point))));
    j
}

impl State {
    /// The gripper's pose in the left camera at pose `i`.
    pub(super) fn left_from_gripper(&self, base_from_reported: &Pose, i: usize) -> Pose {
        self.y.inv_mul(base_from_reported) * self.flange[i] * self.x
    }

    /// The state after a step.
    pub(super) fn stepped(&self, global: &DVector<f64>, local: &[Vector6<f64>], model: &Model<'_>) -> Self {
        let six = |at: usize| exp_twist(&Vector6::from_fn(|r, _| global[at + r]));
        let mut out = self.clone();
        out.x *= six(0);
        out.y *= six(6);
        if model.free_marks {
            for (k, m) in out.marks.iter_mut().enumerate() {
                *m += Vec3::from_fn(|r, _| global[POSES + 3 * k + r]);
            }
        }
        let first = model.globals() - model.prior.unknowns();
        (0..out.u.len()).for_each(|j| out.u[j] += global[first + j]);
        for (e, d) in out.flange.iter_mut().zip(local) {
            *e *= exp_twist(d);
        }
        for p in out.flange.iter_mut().chain([&mut out.x, &mut out.y]) {
            p.rotation.renormalize();
        }
        out
    }
}

fn normal2(r2: f64, sigma: f64) -> f64 {
    let v = sigma * sigma;
    (-0.5 * r2 / v).exp() / (TAU * v)
}

/// Logarithms of the two components of a flange error's density: ordinary noise and outlier.
#[derive(Clone, Copy, Debug)]
pub(super) struct TwoParts(f64, f64);

impl TwoParts {
    /// Logarithm of the sum.
    pub(super) fn ln_sum(self) -> f64 {
        let max = self.0.max(self.1);
        max + ((self.0 - max).exp() + (self.1 - max).exp()).ln()
    }
}

/// Probability that a flange error is the arm's ordinary noise, and the logarithms of both densities.
fn flange_density(e: &Pose, k: &Scales) -> (f64, TwoParts) {
    let (t2, r2) = (e.translation.vector.norm_squared(), e.rotation.scaled_axis().norm_squared());
    let log = |p: f64, t: f64, r: f64| p.ln() - 3.0 * (TAU * t * r).ln() - 0.5 * (t2 / (t * t) + r2 / (r * r));
    let parts = TwoParts(
        log(1.0 - k.outlier_poses, k.flange_m, k.flange_rad),
        log(k.outlier_poses, OUTLIER_POSE_SIGMA[0], OUTLIER_POSE_SIGMA[1]),
    );
    ((parts.0 - parts.ln_sum()).exp(), parts)
}
