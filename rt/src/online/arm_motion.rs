//! The arm's own motion by its encoders, as the vision thread uses it: where the gripper was when a pair was exposed,
//! how far it moved between two instants, and whether it moved at all.

use super::predict::{JointHistory, left_from_gripper_now};
use crate::arm::{Dh, Joints};
use crate::geom::Pose;

/// Maximum age of the newest joint sample, relative to the exposure of a pair, with which the pair still gets a pose
/// from the encoders, ns: ten packages at 500 Hz. Older joints do not say where the arm was during the exposure.
const MAX_JOINT_AGE_NS: u64 = 20_000_000;
/// Time over which [`ArmMotion::moved_before`] compares the joints, ns.
const MOTION_WINDOW_NS: u64 = 100_000_000;
/// Minimum motion of a joint within [`MOTION_WINDOW_NS`] that has to change the image, rad: 10 mrad/s, 0.5 mm of the
/// gripper at 0.5 m.
const MIN_VISIBLE_MOTION_RAD: f64 = 1e-3;

/// Mid-exposure time of a stereo pair, ns: the mean of the two views' stamps, rounded down.
pub const fn mid_exposure_ns(capture_ns: [u64; 2]) -> u64 {
    let [left, right] = capture_ns;
    left.midpoint(right)
}

/// Joint history and kinematics of the arm.
#[derive(Clone, Debug)]
pub struct ArmMotion {
    history: JointHistory,
    dh: Dh,
    flange_from_gripper: Pose,
}

impl ArmMotion {
    /// An arm with these kinematics and no joint samples.
    pub fn new(dh: Dh, flange_from_gripper: Pose) -> Self {
        Self { history: JointHistory::default(), dh, flange_from_gripper }
    }

    /// Adds a joint sample (rad) taken at `at_ns`. A sample that is not newer than the last one is ignored.
    pub fn push(&mut self, at_ns: u64, q: &Joints) {
        self.history.push(at_ns, q);
    }

    /// Gripper in the robot's base at `at_ns`; `None` without joints of that time, or when the newest sample is more
    /// than 20 ms older.
    pub fn base_from_gripper(&self, at_ns: u64) -> Option<Pose> {
        if at_ns > self.history.newest_ns().saturating_add(MAX_JOINT_AGE_NS) {
            return None;
        }
        let q = self.history.at(at_ns)?;
        Some(self.dh.base_from_gripper(&q, &self.flange_from_gripper))
    }

    /// The pose at `to_ns` of a gripper that was at `left_from_gripper` at `from_ns`; `None` where the history does not
    /// reach back to either instant.
    pub fn carried(&self, left_from_gripper: &Pose, from_ns: u64, to_ns: u64) -> Option<Pose> {
        let (then, now) = (self.history.at(from_ns)?, self.history.at(to_ns)?);
        Some(left_from_gripper_now(&self.dh, &self.flange_from_gripper, left_from_gripper, &then, &now))
    }

    /// Whether a joint moved by more than 1 mrad in the 100 ms before `at_ns`; false where the history does not reach
    /// back that far.
    pub fn moved_before(&self, at_ns: u64) -> bool {
        let then_ns = at_ns.saturating_sub(MOTION_WINDOW_NS);
        let (Some(now), Some(then)) = (self.history.at(at_ns), self.history.at(then_ns)) else { return false };
        now.iter().zip(then).any(|(a, b)| (a - b).abs() > MIN_VISIBLE_MOTION_RAD)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arm::{Model, READY};

    const MS: u64 = 1_000_000;

    /// An arm whose first joint turns at `rate` (rad/s), with a sample every 2 ms from 1 s to 2 s.
    fn turning(rate: f64) -> ArmMotion {
        let mut arm = ArmMotion::new(Dh::nominal(Model::Ur5e), Pose::identity());
        for ms in (1000..=2000).step_by(2) {
            let mut q = READY;
            q[0] += rate * (ms as f64 - 1000.0) * 1e-3;
            arm.push(ms * MS, &q);
        }
        arm
    }

    #[test]
    fn mid_exposure_is_symmetric_and_does_not_overflow() {
        assert_eq!(mid_exposure_ns([10, 13]), 11);
        assert_eq!(mid_exposure_ns([13, 10]), 11);
        assert_eq!(mid_exposure_ns([u64::MAX, u64::MAX - 2]), u64::MAX - 1);
    }

    #[test]
    fn joints_older_than_the_bound_give_no_pose() {
        let arm = turning(0.1);
        assert!(arm.base_from_gripper(999 * MS).is_none());
        assert!(arm.base_from_gripper(1500 * MS).is_some());
        assert!(arm.base_from_gripper(2000 * MS + MAX_JOINT_AGE_NS).is_some());
        assert!(arm.base_from_gripper(2000 * MS + MAX_JOINT_AGE_NS + 1).is_none());
    }

    #[test]
    fn motion_is_seen_above_a_milliradian_in_a_tenth_of_a_second() {
        assert!(turning(0.0101).moved_before(2000 * MS));
        assert!(!turning(0.0099).moved_before(2000 * MS));
        // The history starts at 1 s.
        assert!(!turning(1.0).moved_before(1099 * MS));
        assert!(turning(1.0).moved_before(1100 * MS));
    }

    #[test]
    fn a_carried_pose_moves_as_the_base_sees_the_gripper_move() {
        let arm = turning(0.3);
        let left_from_base = Pose::translation(0.2, -0.1, 1.5);
        let at = |ns| left_from_base * arm.base_from_gripper(ns).unwrap();
        let carried = arm.carried(&at(1200 * MS), 1200 * MS, 1700 * MS).unwrap();
        let left = carried.inverse() * at(1700 * MS);
        assert!(left.translation.vector.norm() < 1e-12 && left.rotation.angle() < 1e-9, "{left}");
        assert!(arm.carried(&at(1200 * MS), 998 * MS, 1700 * MS).is_none());
    }
}
