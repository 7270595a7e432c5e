//! Whether the arm can bring the gripper to a handle, straight in, for a rig whose place relative to it can be told for once.
//!
//! The on-line stage never needs that place. Reach does: it follows from the joints and the gripper's pose seen at the same moment.

use graspd_rt::arm::{Dh, Joints, Model, inverse, newton};
use graspd_rt::geom::Pose;

/// Pieces into which the straight way in is cut.
const PIECES: usize = 10;
/// Largest motion of a joint from one piece's end to the next, radians: more is a jump to another branch or a singularity.
const MOST_STEP: f64 = 0.35;

/// An arm with its rig.
#[derive(Clone, Debug)]
pub struct Arm {
    model: Model,
    dh: Dh,
    joints: Joints,
    base_from_left: Pose,
    flange_from_gripper: Pose,
}

impl Arm {
    /// An arm whose joints (rad) and whose gripper's pose in the left frame are known at one moment.
    pub fn seen(model: Model, joints: Joints, left_from_gripper: &Pose, flange_from_gripper: &Pose) -> Self {
        let dh = model.dh();
        let base_from_left = dh.base_from_gripper(&joints, flange_from_gripper) * left_from_gripper.inverse();
        Self { model, dh, joints, base_from_left, flange_from_gripper: *flange_from_gripper }
    }

    /// An arm whose base's place in the left frame is known; `joints` say which branch is preferred.
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

    fn within(&self, q: &Joints) -> bool {
        self.model.joints().iter().zip(q.iter()).all(|(r, v)| *v >= r.min && *v <= r.max)
    }

    /// Whether the gripper can go to `from` and straight on to `to` (poses in the left frame) inside the joints' ranges, on one branch.
    pub fn follows(&self, from: &Pose, to: &Pose) -> bool {
        let Ok(mut q) = inverse(&self.dh, &self.flange(from), &self.joints) else { return false };
        if !self.within(&q) {
            return false;
        }
        for k in 1..=PIECES {
            let pose = crate::offline::handle::setpoint::between(from, to, k as f64 / PIECES as f64);
            let Ok(next) = newton(&self.dh, &self.flange(&pose), &q) else { return false };
            let most = next.iter().zip(q.iter()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            if !(most <= MOST_STEP && self.within(&next)) {
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
    fn what_is_near_is_reached_and_what_is_far_is_not() {
        let joints: Joints = [0.3, -1.4, 1.6, -1.7, -1.5, 0.2];
        let tool = Pose::translation(0.0, 0.0, 0.15);
        let now = Pose::from_parts(
            Vec3::new(0.1, 0.0, 1.3).into(),
            UnitQuaternion::from_scaled_axis(Vec3::new(0.3, 2.0, 0.1)),
        );
        let arm = Arm::seen(Model::Ur5e, joints, &now, &tool);
        let ahead = now * Pose::translation(0.0, 0.0, 0.08);
        assert!(arm.follows(&now, &ahead));
        // Two metres away is out of a UR5e's reach whatever the direction; half of it is at its edge and the rest is not straight.
        for d in [Vec3::x(), Vec3::y(), Vec3::z(), -Vec3::z()] {
            assert!(!arm.follows(&(now * Pose::from(d * 2.0)), &ahead));
            assert!(!arm.follows(&now, &(now * Pose::from(d * 2.0))));
        }
        // The same arm told by its base.
        let base = now * arm.dh.base_from_gripper(&joints, &tool).inverse();
        assert!(Arm::placed(Model::Ur5e, joints, &base, &tool).follows(&now, &ahead));
    }
}
