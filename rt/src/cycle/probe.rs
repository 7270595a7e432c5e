//! The probe at the start of every motion: slowly, until the images show that the gripper goes where it is sent.
//!
//! Catches what no configuration check can: an inverted mounting, a wrong model, swapped cameras or a gain of the wrong sign.
//! It compares what was *intended* (the screws sent, added up) with what was *seen* (the pose from the images).

use super::settings::WatchSettings;
use crate::geom::{Pose, Twist, exp_twist, log_pose};
use crate::mode::FaultCause;
use crate::online::screw::LawSettings;

/// State of the probe.
#[derive(Clone, Copy, Debug)]
pub(super) struct Probe {
    start: Pose,
    /// Where the sent screws should have led, from `start`.
    intended: Pose,
    passed: bool,
    /// Distance to the goal at the last image, and how many images in a row it grew.
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

    /// Notes a screw (gripper frame) sent for `dt_s` seconds; `share` of it is let through by the controller.
    pub(super) fn note_sent(&mut self, screw: &Twist, share: f64, dt_s: f64) {
        if !self.passed {
            self.intended *= exp_twist(&(screw * (share * dt_s)));
        }
    }

    /// Judges by a new image: the pose it shows, the goal of the leg, and how far it lags (m, unit-scaled).
    pub(super) fn judge(
        &mut self,
        seen: &Pose,
        goal: &Pose,
        w: &WatchSettings,
        law: &LawSettings,
    ) -> Option<FaultCause> {
        let left_m = law.size(&log_pose(&(seen.inverse() * goal)));
        // 0.2 mm more than before is growth; noise alone is less.
        self.grew = if left_m > self.left_m + 2e-4 { self.grew + 1 } else { 0 };
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
        let (meant_m, moved_m) = (intended.norm(), moved.norm());
        // What was seen across the intended direction: a mounting turned about the approach is right along it only.
        let astray = (moved - intended * agreement).norm() / meant_m.max(1e-6);
        let fault = FaultCause::WrongWay { agreement, moved_m };
        if self.grew >= 10 {
            return Some(fault);
        }
        if meant_m >= w.probe_m {
            if agreement >= w.probe_agreement && agreement < 2.0 && astray < w.probe_agreement {
                self.passed = true;
                return None;
            }
            // The opposite of what was meant, or half of the way to the limit and still no agreement.
            if agreement < -0.3 || astray > 1.0 || meant_m >= w.probe_limit_m {
                return Some(fault);
            }
        }
        (moved_m >= w.probe_limit_m).then_some(fault)
    }
}
