//! Selects the missing motions: the information of each candidate motion is added to the information matrix, and the
//! motion with the largest error reduction is advised.

use super::bundle::{Model, State};
use super::predict::in_flange;
use super::rig_prior::{project, skew};
use super::solve::inverse_of;
use graspd_rt::geom::{Pose, Vec3, View};
use nalgebra::{DMatrix, Matrix2x6, Translation3, UnitQuaternion};

/// Candidate rotation about each tool axis, degrees: most wrists reach it with the marks still visible.
const TURN_DEG: f64 = 30.0;
/// Candidate translation along each tool axis, metres.
const TRAVEL_M: f64 = 0.15;
/// Maximum number of advised motions.
const MAX_MOTIONS: usize = 4;
/// Minimum fraction by which an advised motion has to reduce the error.
const MIN_REDUCTION: f64 = 0.1;
/// Minimum distance of a visible mark from the image border, pixels.
const IMAGE_MARGIN_PX: f64 = 10.0;

/// An advised motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Advice {
    /// Instruction for the operator.
    pub instruction: String,
    /// Standard deviation of the marks in the flange's frame before, metres.
    pub before_m: f64,
    /// The same after this motion is recorded.
    pub after_m: f64,
}

/// A candidate motion: instruction, and the moved flange relative to the current one, in both directions.
struct Motion {
    instruction: String,
    flange_from_moved: [Pose; 2],
}

/// Motions along and about the tool's axes. The pivot of a rotation is the centre of the marks, so that they stay in
/// the field of view.
fn candidates(s: &State) -> Vec<Motion> {
    let marks: Vec3 = s.marks.iter().sum::<Vec3>() / s.marks.len().max(1) as f64;
    let pivot = (s.x * nalgebra::Point3::from(marks)).coords;
    let mut out = Vec::new();
    for (axis, name) in [(Vec3::x_axis(), "x"), (Vec3::y_axis(), "y"), (Vec3::z_axis(), "z")] {
        let turn = |deg: f64| {
            let r = UnitQuaternion::from_axis_angle(&axis, deg.to_radians());
            Pose::from_parts(Translation3::from(pivot - r * pivot), r)
        };
        let instruction = if name == "z" {
            format!("turn about the tool's axis (flange z) by {TURN_DEG:.0} deg, both ways")
        } else {
            format!("tilt about the tool's {name} axis by {TURN_DEG:.0} deg, both ways")
        };
        out.push(Motion { instruction, flange_from_moved: [turn(TURN_DEG), turn(-TURN_DEG)] });
    }
    for (axis, name) in [(Vec3::x(), "x"), (Vec3::y(), "y"), (Vec3::z(), "z")] {
        let go = |d: f64| Pose::from_parts(Translation3::from(axis * d), UnitQuaternion::identity());
        let instruction = format!("move along the tool's {name} axis by {:.0} mm, both ways", TRAVEL_M * 1e3);
        out.push(Motion { instruction, flange_from_moved: [go(TRAVEL_M), go(-TRAVEL_M)] });
    }
    out
}

/// Motions that reduce the error of the marks in the flange frame to at most `tolerance_m`, best first; empty if it
/// already is.
pub(super) fn advise(
    model: &Model<'_>,
    s: &State,
    covariance: &DMatrix<f64>,
    noise: [f64; 3],
    tolerance_m: f64,
) -> Vec<Advice> {
    let mut out = Vec::new();
    let mut information = inverse_of(covariance).0;
    let mut now = in_flange(model, s, covariance);
    let Some(centre) = middle(model) else { return out };
    let mut left = candidates(s);
    while now > tolerance_m && out.len() < MAX_MOTIONS {
        let mut best: Option<(usize, f64, DMatrix<f64>)> = None;
        for (k, motion) in left.iter().enumerate() {
            let more = motion.flange_from_moved.iter().map(|m| of_pose(model, s, &(centre * m), noise));
            let with = more.fold(information.clone(), |sum, m| sum + m);
            let after = in_flange(model, s, &inverse_of(&with).0);
            if best.as_ref().is_none_or(|b| after < b.1) {
                best = Some((k, after, with));
            }
        }
        let Some((k, after, with)) = best else { break };
        if after > (1.0 - MIN_REDUCTION) * now {
            break;
        }
        out.push(Advice { instruction: left.remove(k).instruction, before_m: now, after_m: after });
        information = with;
        now = after;
    }
    out
}

/// The recorded flange pose nearest to the mean position: a pose that the arm can reach.
fn middle(model: &Model<'_>) -> Option<Pose> {
    let poses = &model.rec.poses;
    let mean: Vec3 =
        poses.iter().map(|p| p.base_from_flange.translation.vector).sum::<Vec3>() / poses.len().max(1) as f64;
    let off = |p: &Pose| (p.translation.vector - mean).norm_squared();
    poses.iter().map(|p| p.base_from_flange).min_by(|a, b| off(a).total_cmp(&off(b)))
}

/// Information about the global unknowns from a rest at this flange pose, with its flange correction eliminated.
fn of_pose(model: &Model<'_>, s: &State, flange: &Pose, noise: [f64; 3]) -> DMatrix<f64> {
    let [px, flange_m, flange_rad] = noise;
    let g = model.globals();
    let rig = model.rig(s);
    let left_from_flange = s.y.inv_mul(flange);
    let turn = *left_from_flange.rotation.to_rotation_matrix().matrix();
    let mut global = DMatrix::<f64>::zeros(4 * s.marks.len(), g);
    let mut local = DMatrix::<f64>::zeros(4 * s.marks.len(), 6);
    let mut at = 0;
    for (k, mark) in s.marks.iter().enumerate() {
        let in_flange = (s.x * nalgebra::Point3::from(*mark)).coords;
        let in_left = (left_from_flange * nalgebra::Point3::from(in_flange)).coords;
        for view in View::BOTH {
            let Some(p) = project(&rig, view, &in_left) else { continue };
            if !rig.camera(view).contains(p.px, IMAGE_MARGIN_PX) {
                continue;
            }
            let by_flange = p.by_point * turn;
            let by_mark = by_flange * s.x.rotation.to_rotation_matrix().matrix();
            let screw = |by: &nalgebra::Matrix2x3<f64>, x: &Vec3| {
                let mut j = Matrix2x6::zeros();
                j.fixed_view_mut::<2, 3>(0, 0).copy_from(by);
                j.fixed_view_mut::<2, 3>(0, 3).copy_from(&(-(by * skew(x))));
                j / px
            };
            global.fixed_view_mut::<2, 6>(at, 0).copy_from(&screw(&by_mark, mark));
            global.fixed_view_mut::<2, 6>(at, 6).copy_from(&-screw(&p.by_point, &in_left));
            if model.free_marks {
                let j = by_mark / px;
                global.fixed_view_mut::<2, 3>(at, super::bundle::POSES + 3 * k).copy_from(&j);
            }
            let unknowns = model.prior.unknowns();
            if unknowns > 0 {
                let u = p.by_rig * &model.prior.factor / px;
                global.view_mut((at, g - unknowns), (2, unknowns)).copy_from(&u);
            }
            local.fixed_view_mut::<2, 6>(at, 0).copy_from(&screw(&by_flange, &in_flange));
            at += 2;
        }
    }
    let mut a = local.tr_mul(&local);
    for i in 0..6 {
        let sd = if i < 3 { flange_m } else { flange_rad };
        a[(i, i)] += 1.0 / (sd * sd);
    }
    let b = local.tr_mul(&global);
    let reduced = a.cholesky().map(|c| b.tr_mul(&c.solve(&b)));
    global.tr_mul(&global) - reduced.unwrap_or_else(|| DMatrix::zeros(g, g))
}
