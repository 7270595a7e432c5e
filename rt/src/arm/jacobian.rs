//! Body Jacobian: joint rates to the gripper's velocity screw.

use super::{Dh, Joints, pose_from_ur};
use crate::geom::{Pose, Vec3};
use nalgebra::{Matrix6, Vector6};

impl Dh {
    /// Speed (m/s) of the point at `offset` in the flange frame (UR's pose: metres and rotation vector) at joint
    /// positions `q` (rad) and joint rates `qd` (rad/s).
    pub fn tool_speed(&self, q: &Joints, qd: &Joints, offset: &[f64; 6]) -> f64 {
        let xi = self.body_jacobian(q, &pose_from_ur(offset)) * Vector6::from_column_slice(qd);
        crate::math::sqrt(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2])
    }

    /// Body Jacobian at the gripper: `xi = J(q) qd`, where `xi = [v; w]` (m/s, rad/s) is the screw of the gripper
    /// relative to the base, of the point at the gripper's origin, expressed in the gripper frame.
    ///
    /// Column i is the screw of joint i alone: its axis `z` through `o` gives `w = R^T z`, `v = R^T (z x (p - o))`,
    /// with `R` and `p` the gripper's rotation and origin in the base. A test compares it with finite differences of
    /// [`Dh::gripper_motion`].
    pub fn body_jacobian(&self, q: &Joints, flange_from_gripper: &Pose) -> Matrix6<f64> {
        let frames = self.frames(q);
        let base_from_gripper = frames[6] * flange_from_gripper;
        let gripper_from_base = base_from_gripper.rotation.inverse();
        let p = base_from_gripper.translation.vector;
        let mut j = Matrix6::zeros();
        for (i, frame) in frames.iter().take(6).enumerate() {
            let z = frame.rotation * Vec3::z();
            let v = gripper_from_base * z.cross(&(p - frame.translation.vector));
            let w = gripper_from_base * z;
            j.set_column(i, &Vector6::new(v.x, v.y, v.z, w.x, w.y, w.z));
        }
        j
    }

    /// Speed of the gripper's origin, m/s, for joint rates `qd` at `q`.
    pub fn tcp_speed(&self, q: &Joints, qd: &Joints, flange_from_gripper: &Pose) -> f64 {
        let xi = self.body_jacobian(q, flange_from_gripper) * Vector6::from_column_slice(qd);
        crate::math::sqrt(xi[0] * xi[0] + xi[1] * xi[1] + xi[2] * xi[2])
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Model, READY};
    use super::*;
    use crate::geom::{Twist, exp_twist, log_pose};
    use crate::math;

    #[test]
    fn agrees_with_finite_differences_of_the_forward_kinematics() {
        let mount = exp_twist(&Twist::new(0.01, -0.02, 0.17, 0.1, -0.2, 1.5));
        for (n, model) in Model::ALL.into_iter().enumerate() {
            let mut dh = Dh::nominal(model);
            for i in 0..6 {
                // A calibrated unit: every entry off its nominal value.
                dh.a[i] += 5e-4 * math::sin(i as f64 + 1.0);
                dh.d[i] += 5e-4 * math::cos(2.0 * i as f64);
                dh.alpha[i] += 2e-3 * math::sin(3.0 * i as f64 + 0.4);
                dh.theta[i] += 2e-3 * math::cos(5.0 * i as f64);
            }
            for k in 0..40 {
                let q: Joints = core::array::from_fn(|i| 3.0 * math::sin((k * 7 + i * 3 + n) as f64 * 0.73));
                let j = dh.body_jacobian(&q, &mount);
                for i in 0..6 {
                    let h = 1e-6;
                    let (mut a, mut b) = (q, q);
                    a[i] -= h;
                    b[i] += h;
                    let num = log_pose(&dh.gripper_motion(&a, &b, &mount)) / (2.0 * h);
                    assert!((num - j.column(i)).norm() < 1e-7, "{model:?} joint {i}");
                }
            }
        }
    }

    #[test]
    fn tcp_speed_of_the_base_joint_is_the_lever_arm() {
        let dh = Dh::nominal(Model::Ur5e);
        let p = dh.base_from_flange(&READY).translation.vector;
        let lever = math::hypot(p.x, p.y);
        let s = dh.tcp_speed(&READY, &[0.5, 0.0, 0.0, 0.0, 0.0, 0.0], &Pose::identity());
        assert!((s - 0.5 * lever).abs() < 1e-12);
    }
}
