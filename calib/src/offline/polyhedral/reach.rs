//! Whether the arm can move the gripper to a handle along a straight approach.
//!
//! This needs the pose of the rig relative to the arm, which the on-line stage does not. It follows from the joint
//! angles and the observed gripper pose of the same moment, or is given.

use crate::offline::handle::setpoint::between;
use graspd_rt::arm::{Dh, Joints, Model, inverse, newton};
use graspd_rt::geom::Pose;

/// Steps in which the straight approach is followed.
const STEPS: usize = 10;
/// Largest motion of a joint within one step, radians: more is a jump to another branch, or a singularity.
const MAX_JOINT_STEP_RAD: f64 = 0.35;

/// An arm and its pose relative to the rig.
#[derive(Clone, Debug)]
pub struct Arm {
    model: Model,
    dh: Dh,
    joints: Joints,
    base_from_left: Pose,
    flange_from_gripper: Pose,
}

impl Arm {
    /// An arm whose joint angles (radians) and gripper pose in the left frame are known at one moment.
    pub fn seen(model: Model, joints: Joints, left_from_gripper: &Pose, flange_from_gripper: &Pose) -> Self {
        let dh = model.dh();
        let base_from_left = dh.base_from_gripper(&joints, flange_from_gripper) * left_from_gripper.inverse();
        Self { model, dh, joints, base_from_left, flange_from_gripper: *flange_from_gripper }
    }

    /// An arm whose base pose in the left frame is known. The inverse kinematics starts from `joints`, which selects
    /// its branch.
    pub fn placed(model: Model, joints: Joints, left_from_base: &Pose, flange_from_gripper: &Pose) -> Self {
        Self {
            model,
            dh: model.dh(),
            joints,
            base_from_left: left_from_base.inverse(),
            flange_from_gripper: *flange_from_gripper,
        }
    }

    fn flange(&self, left_from_gripper: &Pose) -> Pose {
        self.base_from_left * left_from_gripper * self.flange_from_gripper.inverse()
    }

    fn within_limits(&self, q: &Joints) -> bool {
        self.model.joints().iter().zip(q.iter()).all(|(r, v)| *v >= r.min && *v <= r.max)
    }

    /// Whether the gripper can move to `from` and on a straight line to `to` (poses in the left frame), within the
    /// joint limits and without changing the branch.
    pub fn follows(&self, from: &Pose, to: &Pose) -> bool {
        let Ok(mut q) = inverse(&self.dh, &self.flange(from), &self.joints) else { return false };
        if !self.within_limits(&q) {
            return false;
        }
        for k in 1..=STEPS {
            let pose = between(from, to, k as f64 / STEPS as f64);
            let Ok(next) = newton(&self.dh, &self.flange(&pose), &q) else { return false };
            let largest = next.iter().zip(q.iter()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            if !(largest <= MAX_JOINT_STEP_RAD && self.within_limits(&next)) {
                return false;
            }
            q = next;
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::geom::Vec3;
    use nalgebra::UnitQuaternion;

    #[test]
    fn near_poses_are_reached_and_far_ones_are_not() {
        let joints: Joints = [0.3, -1.4, 1.6, -1.7, -1.5, 0.2];
        let tool = Pose::translation(0.0, 0.0, 0.15);
        let now = Pose::from_parts(
            Vec3::new(0.1, 0.0, 1.3).into(),
            UnitQuaternion::from_scaled_axis(Vec3::new(0.3, 2.0, 0.1)),
        );
        let arm = Arm::seen(Model::Ur5e, joints, &now, &tool);
        let ahead = now * Pose::translation(0.0, 0.0, 0.08);
        assert!(arm.follows(&now, &ahead));
        // Two metres exceed the reach of a UR5e in any direction.
        for d in [Vec3::x(), Vec3::y(), Vec3::z(), -Vec3::z()] {
            assert!(!arm.follows(&(now * Pose::from(d * 2.0)), &ahead));
            assert!(!arm.follows(&now, &(now * Pose::from(d * 2.0))));
        }
        // The same arm, given by the pose of its base.
        let base = now * arm.dh.base_from_gripper(&joints, &tool).inverse();
        assert!(Arm::placed(Model::Ur5e, joints, &base, &tool).follows(&now, &ahead));
    }
}
