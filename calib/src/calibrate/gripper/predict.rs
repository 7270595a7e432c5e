//! Predicted accuracy of the marks in the left camera, in the images and in the flange frame.

use super::bundle::{Model, POSES, State};
use super::rig_prior::{project, skew};
use graspd_rt::geom::{Pose, Vec3, View};
use nalgebra::{DMatrix, Matrix3, SMatrix};

/// Predicted standard deviations of the marks at poses without a measurement.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Prediction {
    /// Root mean square position error in the left camera's frame (length of the vector), metres.
    pub left_m: f64,
    /// Root mean square error in the images (length of the vector), pixels.
    pub px: f64,
    /// Root mean square error of the marks in the flange's frame (length of the vector), metres.
    pub flange_m: f64,
}

/// Root mean square over flange poses, all marks and both views.
pub(super) fn predict(model: &Model<'_>, s: &State, covariance: &DMatrix<f64>, flanges: &[Pose]) -> Prediction {
    let g = covariance.nrows();
    let rig = model.rig(s);
    let (mut m2, mut m_n, mut p2, mut p_n) = (0.0, 0.0, 0.0, 0.0);
    for flange in flanges {
        let left_from_gripper = s.y.inv_mul(flange) * s.x;
        let turn = *left_from_gripper.rotation.to_rotation_matrix().matrix();
        for (k, mark) in s.marks.iter().enumerate() {
            let at = (left_from_gripper * nalgebra::Point3::from(*mark)).coords;
            let mut j = DMatrix::<f64>::zeros(3, g);
            j.fixed_view_mut::<3, 6>(0, 0).copy_from(&screw(&turn, mark));
            j.fixed_view_mut::<3, 6>(0, 6).copy_from(&-screw(&Matrix3::identity(), &at));
            if model.free_marks {
                j.fixed_view_mut::<3, 3>(0, POSES + 3 * k).copy_from(&turn);
            }
            m2 += (&j * covariance * j.transpose()).trace();
            m_n += 1.0;
            for view in View::BOTH {
                let Some(p) = project(&rig, view, &at) else { continue };
                let mut jp = DMatrix::from_fn(2, 3, |r, c| p.by_point[(r, c)]) * &j;
                let unknowns = model.prior.unknowns();
                if unknowns > 0 {
                    let u = p.by_rig * &model.prior.factor;
                    jp.view_mut((0, g - unknowns), (2, unknowns)).copy_from(&u);
                }
                p2 += (&jp * covariance * jp.transpose()).trace();
                p_n += 1.0;
            }
        }
    }
    let root = |sum: f64, n: f64| if n > 0.0 { (sum / n).sqrt() } else { f64::INFINITY };
    Prediction { left_m: root(m2, m_n), px: root(p2, p_n), flange_m: in_flange(model, s, covariance) }
}

/// Root mean square of the marks' standard deviations in the flange's frame, metres.
pub(super) fn in_flange(model: &Model<'_>, s: &State, covariance: &DMatrix<f64>) -> f64 {
    let turn = *s.x.rotation.to_rotation_matrix().matrix();
    let mut sum = 0.0;
    for (k, mark) in s.marks.iter().enumerate() {
        let mut j = DMatrix::<f64>::zeros(3, covariance.nrows());
        j.fixed_view_mut::<3, 6>(0, 0).copy_from(&screw(&turn, mark));
        if model.free_marks {
            j.fixed_view_mut::<3, 3>(0, POSES + 3 * k).copy_from(&turn);
        }
        sum += (&j * covariance * j.transpose()).trace();
    }
    (sum / s.marks.len().max(1) as f64).sqrt()
}

/// Derivative of a point by a twist of its frame, in a frame rotated by `turn`.
fn screw(turn: &Matrix3<f64>, point: &Vec3) -> SMatrix<f64, 3, 6> {
    let mut j = SMatrix::<f64, 3, 6>::zeros();
    j.fixed_view_mut::<3, 3>(0, 0).copy_from(turn);
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&(-(turn * skew(point))));
    j
}
