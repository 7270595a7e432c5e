//! Prediction of the gripper's pose from the capture of an image to now, by the arm's encoders.
//!
//! An image is tens of milliseconds old when its marks are known. The joints give the motion of the gripper since, in
//! its own frame; the pose of the rig relative to the robot cancels. The effect of an error in the arm model scales
//! with that short motion and vanishes at rest, so it does not change where the servo converges.

use crate::arm::{Dh, Joints};
use crate::geom::Pose;

/// Number of joint samples kept: half a second at 1000 Hz.
pub const HISTORY: usize = 512;

/// Recent joint positions by time.
#[derive(Clone, Debug)]
pub struct JointHistory {
    samples: [(u64, Joints); HISTORY],
    next: usize,
    len: usize,
}

impl Default for JointHistory {
    fn default() -> Self {
        Self { samples: [(0, [0.0; 6]); HISTORY], next: 0, len: 0 }
    }
}

impl JointHistory {
    /// Removes all samples.
    pub fn clear(&mut self) {
        self.len = 0;
        self.next = 0;
    }

    /// Adds joint positions `q` (rad) at `at_ns`. A sample that is not newer than the last one is ignored.
    pub fn push(&mut self, at_ns: u64, q: &Joints) {
        if self.len > 0 && at_ns <= self.newest().0 {
            return;
        }
        self.samples[self.next] = (at_ns, *q);
        self.next = (self.next + 1) % HISTORY;
        self.len = (self.len + 1).min(HISTORY);
    }

    /// Time of the newest sample, ns; 0 without samples.
    pub fn newest_ns(&self) -> u64 {
        if self.len == 0 { 0 } else { self.newest().0 }
    }

    fn newest(&self) -> &(u64, Joints) {
        &self.samples[(self.next + HISTORY - 1) % HISTORY]
    }

    /// The `age`-th newest sample; 0 is the newest.
    fn back(&self, age: usize) -> &(u64, Joints) {
        &self.samples[(self.next + 2 * HISTORY - 1 - age) % HISTORY]
    }

    /// Joint positions at `at_ns`, interpolated linearly between samples; the newest sample for a later time.
    ///
    /// `None` if the time is before the oldest sample, or there is none. A binary search of at most ten steps.
    pub fn at(&self, at_ns: u64) -> Option<Joints> {
        if self.len == 0 || at_ns < self.back(self.len - 1).0 {
            return None;
        }
        if at_ns >= self.newest().0 {
            return Some(self.newest().1);
        }
        // Invariant: back(lo) is later than at_ns, back(hi) is not.
        let (mut lo, mut hi) = (0, self.len - 1);
        while hi - lo > 1 {
            let mid = (lo + hi) / 2;
            if self.back(mid).0 > at_ns {
                lo = mid;
            } else {
                hi = mid;
            }
        }
        let ((t1, q1), (t0, q0)) = (self.back(lo), self.back(hi));
        let f = (at_ns - t0) as f64 / (t1 - t0) as f64;
        Some(core::array::from_fn(|i| q0[i] + f * (q1[i] - q0[i])))
    }
}

/// Gripper pose in the rig now, from its pose at capture and the joint positions at capture and now.
pub fn left_from_gripper_now(
    dh: &Dh,
    flange_from_gripper: &Pose,
    left_from_gripper_at_capture: &Pose,
    q_capture: &Joints,
    q_now: &Joints,
) -> Pose {
    left_from_gripper_at_capture * dh.gripper_motion(q_capture, q_now, flange_from_gripper)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolates_between_samples_within_its_bounds() {
        let mut h = JointHistory::default();
        assert_eq!(h.at(5), None);
        for k in 0..2000_u64 {
            h.push(1000 + k * 2, &[k as f64; 6]);
            h.push(900, &[-1.0; 6]);
        }
        let newest = 1000 + 1999 * 2;
        assert_eq!(h.at(newest), Some([1999.0; 6]));
        assert_eq!(h.at(newest + 50), Some([1999.0; 6]));
        assert_eq!(h.at(newest - 1), Some([1998.5; 6]));
        let oldest = newest - 2 * (HISTORY as u64 - 1);
        assert_eq!(h.at(oldest), Some([(1999 - (HISTORY - 1)) as f64; 6]));
        assert_eq!(h.at(oldest - 1), None);
        for back in 0..2 * (HISTORY as u64 - 1) {
            assert_eq!(h.at(newest - back), Some([1999.0 - back as f64 / 2.0; 6]), "{back}");
        }
        h.clear();
        assert_eq!(h.at(newest), None);
    }
}
