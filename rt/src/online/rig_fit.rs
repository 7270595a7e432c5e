//! Estimates the error of the rig together with the gripper's pose.
//!
//! The pose is fitted to both views with the rig of the file. The residuals are noise and the effect of the rig's error
//! that the fitted pose has not absorbed. [`Evidence`] holds the normal equations of both, pose first, so that the pose
//! can be eliminated (what no motion of the gripper explains) or constrained by a prediction (see
//! [`super::rig_watch`]).

use super::pose::{self, MarkTable, PoseEstimate, PoseSettings};
use crate::geom::{Pose, RIG_UNKNOWNS, Rig, RigError, RigOffset, View};
use crate::gripper::Gripper;
use crate::math;
use nalgebra::{Matrix2, Matrix2x6, Matrix3x6, Matrix6, Point3, SMatrix, Vector6};

/// Pose (gripper-frame screw) and rig unknowns together.
pub const UNKNOWNS: usize = 6 + RIG_UNKNOWNS;

/// Symmetric matrix over pose and rig.
pub type Joint = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
/// Vector over pose and rig.
pub type JointVector = SMatrix<f64, UNKNOWNS, 1>;
/// Symmetric matrix over the rig's unknowns.
pub type RigMatrix = SMatrix<f64, RIG_UNKNOWNS, RIG_UNKNOWNS>;

/// Whitened error above which a mark is weighted down (Huber), standard deviations.
const HUBER: f64 = 2.5;

/// Normal equations of one pair of images at one pose.
#[derive(Clone, Copy, Debug)]
pub struct Evidence {
    /// Information about pose and rig.
    pub information: Joint,
    /// Right-hand side of the normal equations.
    pub score: JointVector,
    /// Weighted sum of squared errors.
    pub squares: f64,
    /// Sum of the observations' mean weights, 1/px².
    pub weight: f64,
    /// Sum of the marks' mean variances, px².
    pub variance_px2: f64,
    /// Number of observations: a mark in one view is one.
    pub points: usize,
}

impl Evidence {
    /// Accumulates the marks of `table`. The square of `floor_px`, the error of a mark that does not average out, is
    /// added to each covariance. With `explain`, a change of the unknowns, marks that it does not explain are weighted
    /// down. `None` if a mark is behind a camera or a value is not finite.
    pub fn gather(
        rig: &Rig,
        gripper: &Gripper,
        table: &MarkTable,
        pose: &Pose,
        floor_px: f64,
        explain: Option<&JointVector>,
    ) -> Option<Self> {
        let mut e = Self {
            information: Joint::zeros(),
            score: JointVector::zeros(),
            squares: 0.0,
            weight: 0.0,
            variance_px2: 0.0,
            points: 0,
        };
        let turn = pose.rotation.to_rotation_matrix();
        for view in View::BOTH {
            for (mark, seen) in gripper.marks.iter().zip(&table[view.index()]) {
                let Some(seen) = seen else { continue };
                let x = (pose * Point3::from(mark.position)).coords;
                let (p, point) = rig.project_with_jacobian(view, &x)?;
                let (_, jr) = rig.project_with_offset(view, &x)?;
                let m = &mark.position;
                let body = Matrix3x6::new(
                    1.0, 0.0, 0.0, 0.0, m.z, -m.y, //
                    0.0, 1.0, 0.0, -m.z, 0.0, m.x, //
                    0.0, 0.0, 1.0, m.y, -m.x, 0.0,
                );
                let jp: Matrix2x6<f64> = point * turn.matrix() * body;
                let w = (seen.covariance + Matrix2::identity() * math::sq(floor_px)).try_inverse()?;
                let d = seen.pixel - p;
                let mut j = SMatrix::<f64, 2, UNKNOWNS>::zeros();
                j.fixed_view_mut::<2, 6>(0, 0).copy_from(&jp);
                j.fixed_view_mut::<2, RIG_UNKNOWNS>(0, 6).copy_from(&jr);
                let w = match explain {
                    Some(change) => {
                        let left = d - j * change;
                        let z = math::sqrt(left.dot(&(w * left)).max(0.0));
                        w * (HUBER / z.max(HUBER))
                    }
                    None => w,
                };
                let wj = w * j;
                e.information += j.tr_mul(&wj);
                e.score += wj.tr_mul(&d);
                e.squares += d.dot(&(w * d));
                e.weight += 0.5 * w.trace();
                e.variance_px2 += 0.5 * seen.covariance.trace();
                e.points += 1;
            }
        }
        let finite = e.squares.is_finite() && e.score.iter().all(|v| v.is_finite());
        (finite && e.points > 0).then_some(e)
    }

    /// Information and score of the rig alone, with the pose eliminated: what no motion of the gripper explains.
    pub fn without_pose(&self) -> Option<(RigMatrix, RigOffset)> {
        let a: Matrix6<f64> = self.information.fixed_view::<6, 6>(0, 0).into_owned();
        let cross = self.information.fixed_view::<6, RIG_UNKNOWNS>(0, 6).into_owned();
        let b: Vector6<f64> = self.score.fixed_rows::<6>(0).into_owned();
        let rig: RigMatrix = self.information.fixed_view::<RIG_UNKNOWNS, RIG_UNKNOWNS>(6, 6).into_owned();
        let inverse = a.cholesky()?.inverse();
        let gain = inverse * cross;
        Some((rig - cross.tr_mul(&gain), self.score.fixed_rows::<RIG_UNKNOWNS>(6) - gain.tr_mul(&b)))
    }

    /// The most probable offset of the rig under its stated error, and the weighted rms of the remaining error, pixels.
    pub fn offset(&self, error: &RigError) -> Option<(RigOffset, f64)> {
        let (s, b) = self.without_pose()?;
        let explained_by_pose = {
            let a: Matrix6<f64> = self.information.fixed_view::<6, 6>(0, 0).into_owned();
            let g: Vector6<f64> = self.score.fixed_rows::<6>(0).into_owned();
            g.dot(&a.cholesky()?.solve(&g))
        };
        let offset = (s + prior(error)).cholesky()?.solve(&b);
        // Without the contribution of the prior.
        let explained_by_offset = 2.0 * b.dot(&offset) - offset.dot(&(s * offset));
        let left = (self.squares - explained_by_pose - explained_by_offset).max(0.0);
        Some((offset, math::sqrt(left / self.weight)))
    }

    /// Change of the fitted pose, as a gripper-frame screw, for an offset of the rig.
    pub fn pose_for(&self, offset: &RigOffset) -> Option<Vector6<f64>> {
        let a: Matrix6<f64> = self.information.fixed_view::<6, 6>(0, 0).into_owned();
        let cross = self.information.fixed_view::<6, RIG_UNKNOWNS>(0, 6).into_owned();
        Some(a.cholesky()?.inverse() * cross * offset)
    }
}

/// Information matrix of the stated error.
fn prior(error: &RigError) -> RigMatrix {
    RigMatrix::from_diagonal(&error.deviations().map(|d| 1.0 / math::sq(d.max(1e-12))))
}

/// Pose and rig offset fitted together, the offset constrained by the rig's stated error.
#[derive(Clone, Copy, Debug)]
pub struct RigFit {
    /// The pose in the rig that is displaced by `offset`.
    pub estimate: PoseEstimate,
    /// The most probable offset of the rig under its stated error.
    pub offset: RigOffset,
}

/// Fits pose and rig offset; `floor_px` is the error of a mark that does not average out. Two rounds of a robust pose
/// and a linear step of the offset, then the final pose.
pub fn fit(
    rig: &Rig,
    gripper: &Gripper,
    table: &MarkTable,
    start: &Pose,
    settings: &PoseSettings,
    error: &RigError,
    floor_px: f64,
) -> Option<RigFit> {
    let prior = prior(error);
    let mut offset = RigOffset::zeros();
    let mut pose = *start;
    for _ in 0..2 {
        let off = rig.offset(&offset);
        let e = pose::estimate(&off, gripper, table, &pose, settings).ok()?;
        pose = e.left_from_gripper;
        let mut used = *table;
        pose::keep_used(&mut used, &e);
        let (s, b) = Evidence::gather(&off, gripper, &used, &pose, floor_px, None)?.without_pose()?;
        offset += (s + prior).cholesky()?.solve(&(b - prior * offset));
    }
    let estimate = pose::estimate(&rig.offset(&offset), gripper, table, &pose, settings).ok()?;
    offset.iter().all(|v| v.is_finite()).then_some(RigFit { estimate, offset })
}
