//! Forward kinematics by a Denavit-Hartenberg table, nominal or a unit's own.

use super::{Dh, Joints, Model};
use crate::geom::{Pose, Vec3};
use crate::math;
use nalgebra::{Quaternion, Translation3, UnitQuaternion};

impl Dh {
    /// The table of a model as designed.
    pub const fn nominal(model: Model) -> Self {
        model.dh()
    }

    /// Frame i in frame i-1 for joint `i` (0 to 5) at angle `q`.
    fn link(&self, i: usize, q: f64) -> Pose {
        let th = q + self.theta[i];
        let (s, c) = math::sin_cos(th);
        let (sh, ch) = math::sin_cos(0.5 * th);
        let (sa, ca) = math::sin_cos(0.5 * self.alpha[i]);
        // Rz(theta) * Rx(alpha) as one quaternion.
        let turn = Quaternion::new(ch * ca, ch * sa, sh * sa, sh * ca);
        Pose::from_parts(
            Translation3::new(self.a[i] * c, self.a[i] * s, self.d[i]),
            UnitQuaternion::new_unchecked(turn),
        )
    }

    /// The base frame and the six link frames, each in the base; the last is the flange.
    pub fn frames(&self, q: &Joints) -> [Pose; 7] {
        let mut out = [Pose::identity(); 7];
        for i in 0..6 {
            out[i + 1] = out[i] * self.link(i, q[i]);
        }
        out
    }

    /// Flange pose in the base at joint positions `q` (rad).
    pub fn base_from_flange(&self, q: &Joints) -> Pose {
        let mut p = Pose::identity();
        for (i, qi) in q.iter().enumerate() {
            p *= self.link(i, *qi);
        }
        p
    }

    /// Gripper pose in the base at joint positions `q` (rad).
    pub fn base_from_gripper(&self, q: &Joints, flange_from_gripper: &Pose) -> Pose {
        self.base_from_flange(q) * flange_from_gripper
    }

    /// Motion of the gripper between two sets of joint positions: its pose at `q_to` in its frame at `q_from`.
    ///
    /// The base cancels, so prediction needs nothing else of the arm. The effect of an error in the table scales with
    /// the motion and vanishes at rest.
    pub fn gripper_motion(&self, q_from: &Joints, q_to: &Joints, flange_from_gripper: &Pose) -> Pose {
        self.base_from_gripper(q_from, flange_from_gripper).inverse()
            * self.base_from_gripper(q_to, flange_from_gripper)
    }
}

/// Rotation vector (axis times angle, rad, length at most pi) of a pose, as in UR's `p[x,y,z,rx,ry,rz]`.
pub fn rotation_vector(pose: &Pose) -> Vec3 {
    let q = pose.rotation.quaternion();
    let (w, u) = if q.w < 0.0 { (-q.w, -Vec3::new(q.i, q.j, q.k)) } else { (q.w, Vec3::new(q.i, q.j, q.k)) };
    let s = math::sqrt(u.norm_squared());
    let scale = if s < 1e-12 { 2.0 } else { 2.0 * math::atan2(s, w) / s };
    u * scale
}

/// A pose from UR's six numbers: metres, then a rotation vector in rad.
pub fn pose_from_ur(p: &[f64; 6]) -> Pose {
    let r = Vec3::new(p[3], p[4], p[5]);
    let th = math::sqrt(r.norm_squared());
    let s = if th < 1e-9 { 0.5 } else { math::sin(0.5 * th) / th };
    let q = Quaternion::new(math::cos(0.5 * th), r.x * s, r.y * s, r.z * s);
    Pose::from_parts(Translation3::new(p[0], p[1], p[2]), UnitQuaternion::new_normalize(q))
}

/// UR's six numbers of a pose: metres, then a rotation vector in rad.
pub fn pose_to_ur(pose: &Pose) -> [f64; 6] {
    let (t, r) = (pose.translation.vector, rotation_vector(pose));
    [t.x, t.y, t.z, r.x, r.y, r.z]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ur_pose_round_trip() {
        for k in 0..500 {
            let f = |m: f64| math::sin(f64::from(k) * m + m);
            let p = [f(0.3), f(0.5), f(0.7), 1.8 * f(1.1), 1.8 * f(1.3), 1.8 * f(1.7)];
            let back = pose_to_ur(&pose_from_ur(&p));
            if math::sqrt(p[3] * p[3] + p[4] * p[4] + p[5] * p[5]) < 3.14 {
                for i in 0..6 {
                    assert!((back[i] - p[i]).abs() < 1e-9, "{k} {i}");
                }
            }
            assert!((pose_from_ur(&back).inverse() * pose_from_ur(&p)).rotation.angle() < 1e-7);
        }
    }

    #[test]
    fn at_zero_the_arm_is_stretched_along_minus_x() {
        // UR's drawing of the zero position of a UR5e: flange at (a2+a3, -(d4+d6), d1-d5).
        let p = Dh::nominal(Model::Ur5e).base_from_flange(&[0.0; 6]).translation.vector;
        assert!((p - Vec3::new(-0.8172, -(0.1333 + 0.0996), 0.1625 - 0.0997)).norm() < 1e-12);
    }

    #[test]
    fn equal_positions_give_no_motion_with_any_table() {
        let mut dh = Dh::nominal(Model::Ur10e);
        dh.a[2] += 0.01;
        dh.alpha[4] -= 0.02;
        let q = super::super::READY;
        let m = dh.gripper_motion(&q, &q, &Pose::translation(0.0, 0.02, 0.15));
        assert!(m.translation.vector.norm() < 1e-15 && m.rotation.angle() < 1e-7);
    }
}
