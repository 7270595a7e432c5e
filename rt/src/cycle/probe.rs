//! The probe at the start of every motion: the arm moves slowly until the images show that the gripper moves as
//! commanded.
//!
//! It detects what no check of the configuration can: an inverted mounting, a wrong model, swapped cameras or a gain of
//! the wrong sign. It compares the *commanded* motion (the sum of the screws sent) with the *seen* motion (the pose
//! from the images).

use super::settings::WatchSettings;
use crate::geom::{Pose, Twist, exp_twist, log_pose};
use crate::mode::FaultCause;
use crate::online::screw::LawSettings;

/// Increase of the distance to the goal that is growth and not noise, metres (unit-scaled).
const MIN_GROWTH_M: f64 = 2e-4;
/// Consecutive images with growth that are a fault.
const MAX_GROWING: u32 = 10;
/// Agreement below which the motion is opposite to the command.
const OPPOSITE: f64 = -0.3;
/// Agreement above which the motion is too large for the command.
const MAX_AGREEMENT: f64 = 2.0;

/// State of the probe.
#[derive(Clone, Copy, Debug)]
pub(super) struct Probe {
    start: Pose,
    /// Motion of the sent screws, from `start`.
    intended: Pose,
    passed: bool,
    /// Distance to the goal at the last image, and the number of consecutive images at which it grew.
    left_m: f64,
    grew: u32,
}

impl Probe {
    pub(super) fn new(left_from_gripper: &Pose) -> Self {
        Self { start: *left_from_gripper, intended: Pose::identity(), passed: false, left_m: f64::INFINITY, grew: 0 }
    }

    pub(super) fn passed(&self) -> bool {
        self.passed
    }

    /// Notes a screw (gripper frame) sent for `dt_s` seconds, of which the controller's slider lets the fraction
    /// `slider` through.
    pub(super) fn note_sent(&mut self, screw: &Twist, slider: f64, dt_s: f64) {
        if !self.passed {
            self.intended *= exp_twist(&(screw * (slider * dt_s)));
        }
    }

    /// Judges the motion by a new image: the gripper's pose `seen` in it and the goal of the leg.
    pub(super) fn judge(
        &mut self,
        seen: &Pose,
        goal: &Pose,
        w: &WatchSettings,
        law: &LawSettings,
    ) -> Option<FaultCause> {
        let left_m = law.size(&log_pose(&(seen.inverse() * goal)));
        self.grew = if left_m > self.left_m + MIN_GROWTH_M { self.grew + 1 } else { 0 };
        if left_m < self.left_m || self.grew > 0 {
            self.left_m = left_m;
        }
        if self.passed {
            return None;
        }
        let scaled = |p: &Pose| {
            let mut x = log_pose(p);
            for k in 3..6 {
                x[k] *= law.length_m;
            }
            x
        };
        let intended = scaled(&self.intended);
        let moved = scaled(&(self.start.inverse() * seen));
        let agreement = moved.dot(&intended) / intended.norm_squared().max(1e-12);
        let (commanded_m, moved_m) = (intended.norm(), moved.norm());
        // Motion across the commanded direction: a mounting turned about the approach is right only along it.
        let astray = (moved - intended * agreement).norm() / commanded_m.max(1e-6);
        let fault = FaultCause::WrongWay { agreement, moved_m };
        if self.grew >= MAX_GROWING {
            return Some(fault);
        }
        if commanded_m >= w.probe_m {
            if agreement >= w.probe_agreement && agreement < MAX_AGREEMENT && astray < w.probe_agreement {
                self.passed = true;
                return None;
            }
            if agreement < OPPOSITE || astray > 1.0 || commanded_m >= w.probe_limit_m {
                return Some(fault);
            }
        }
        (moved_m >= w.probe_limit_m).then_some(fault)
    }
}
