//! Watches the vision results: which of them may be used, how old they are, and whether they agree with the joints.

use super::settings::WatchSettings;
use crate::arm::{Dh, Joints};
use crate::geom::{Pose, log_pose};
use crate::mode::{FaultCause, HoldCause};
use crate::online::predict::JointHistory;
use crate::online::rig_watch::RigHealth;
use crate::online::screw::{LawSettings, ViewMode};
use crate::online::{Vision, VisionStatus, mid_exposure_ns};

/// Images over which the motion of images and joints is compared.
const WINDOW: usize = 6;
/// How far a capture stamp may be in the future, ns.
const MAX_AHEAD_NS: u64 = 2_000_000;
/// Oldest capture that is used, ns.
const MAX_AGE_NS: u64 = 1_000_000_000;
/// Longest time between two images that counts for the frame period, ns.
const MAX_PERIOD_NS: u64 = 500_000_000;
/// Consecutive results with bad stamps, with skew or with jumps that stop the arm.
const MAX_REFUSED: u32 = 3;
/// Consecutive results without marks that hold the arm.
const MAX_LOST: u32 = 2;

/// Smallest number of marks in a view with which it contributes depth.
const MIN_VIEW_MARKS: u8 = 3;
/// Consecutive results with fewer marks in one view that hold the arm: 80 ms at 60 Hz, longer than a passing hand.
const MAX_ONE_VIEW_RESULTS: u32 = 5;

/// A vision result in use, with the joint positions at its captures.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    pub(super) vision: Vision,
    /// Joint positions at the middle of the two captures, rad.
    pub(super) q: Joints,
    /// Joint positions at the capture of each view, rad.
    pub(super) q_view: [Joints; 2],
}

impl Seen {
    pub(super) fn capture_ns(&self) -> u64 {
        mid_exposure_ns(self.vision.capture_ns)
    }
}

/// What is known of the images.
#[derive(Clone, Debug)]
pub(super) struct VisionWatch {
    settings: WatchSettings,
    law: LawSettings,
    seen: Option<Seen>,
    /// Poses and joint positions of the last images, newest at `at`.
    track: [Option<(Pose, Joints)>; WINDOW],
    at: usize,
    period_ns: u64,
    delay_ns: u64,
    bad_stamps: u32,
    skewed: u32,
    skew_ns: u64,
    lost: u32,
    jumps: u32,
    jump_m: f64,
    mismatches: u32,
    mismatch: (f64, f64),
    /// Consecutive results in which one view showed too few marks.
    one_view: u32,
    /// State of the rig by the newest result, refused ones included.
    rig: Option<RigHealth>,
    good_since_ns: Option<u64>,
}

/// Whether an offered vision result was used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Taken {
    Used,
    Refused,
}

impl VisionWatch {
    pub(super) fn new(settings: WatchSettings, law: LawSettings, period_ns: u64) -> Self {
        Self {
            settings,
            law,
            seen: None,
            track: [None; WINDOW],
            at: 0,
            period_ns,
            delay_ns: 0,
            bad_stamps: 0,
            skewed: 0,
            skew_ns: 0,
            lost: 0,
            jumps: 0,
            jump_m: 0.0,
            mismatches: 0,
            mismatch: (0.0, 0.0),
            one_view: 0,
            rig: None,
            good_since_ns: None,
        }
    }

    /// Takes a vision result. While the arm is driven, a result that jumps is refused; at rest it starts anew.
    pub(super) fn offer(
        &mut self,
        now_ns: u64,
        vision: &Vision,
        history: &JointHistory,
        dh: &Dh,
        mount: &Pose,
        driven: bool,
    ) -> Taken {
        self.rig = Some(vision.rig);
        let taken = self.judge(now_ns, vision, history, dh, mount, driven);
        match taken {
            Taken::Used => self.good_since_ns = self.good_since_ns.or(Some(now_ns)),
            Taken::Refused => self.good_since_ns = None,
        }
        taken
    }

    fn judge(&mut self, now: u64, v: &Vision, history: &JointHistory, dh: &Dh, mount: &Pose, driven: bool) -> Taken {
        let (early, late) = (v.capture_ns[0].min(v.capture_ns[1]), v.capture_ns[0].max(v.capture_ns[1]));
        let last = self.seen.map_or(0, |s| s.capture_ns());
        let capture = mid_exposure_ns(v.capture_ns);
        if late > now + MAX_AHEAD_NS || now.saturating_sub(early) > MAX_AGE_NS || (driven && capture <= last) {
            self.bad_stamps += 1;
            return Taken::Refused;
        }
        self.bad_stamps = 0;
        if late - early > self.settings.skew_ns.min(self.period_ns / 4) {
            self.skewed += 1;
            self.skew_ns = late - early;
            return Taken::Refused;
        }
        self.skewed = 0;
        let finite = finite_pose(&v.left_from_gripper) && v.residual_px.is_finite();
        if v.status == VisionStatus::Lost || !finite {
            self.lost += 1;
            return Taken::Refused;
        }
        let joints = [history.at(v.capture_ns[0]), history.at(v.capture_ns[1]), history.at(capture)];
        let [Some(left), Some(right), Some(q)] = joints else {
            // Without the joint positions at capture nothing can be predicted from it.
            self.lost += 1;
            return Taken::Refused;
        };
        self.lost = 0;
        if let Some(seen) = self.seen.filter(|_| driven) {
            let expected = seen.vision.left_from_gripper * dh.gripper_motion(&seen.q, &q, mount);
            let jump = self.law.size(&log_pose(&(expected.inverse() * v.left_from_gripper)));
            if !(jump <= self.settings.jump_m) {
                self.jumps += 1;
                self.jump_m = jump;
                return Taken::Refused;
            }
            let step = capture - last;
            if step < MAX_PERIOD_NS {
                self.period_ns = (self.period_ns * 15 + step) / 16;
            }
        }
        self.jumps = 0;
        let blind = self.law.views == ViewMode::Stereo && v.seen.iter().any(|s| *s < MIN_VIEW_MARKS);
        self.one_view = if blind { self.one_view.saturating_add(1) } else { 0 };
        let delay = now.saturating_sub(capture);
        self.delay_ns = if self.delay_ns == 0 { delay } else { (self.delay_ns * 15 + delay) / 16 };
        self.compare_motion(&v.left_from_gripper, &q, dh, mount, driven);
        self.seen = Some(Seen { vision: *v, q, q_view: [left, right] });
        Taken::Used
    }

    /// Compares the motion over the last images by images and by joints.
    fn compare_motion(&mut self, pose: &Pose, q: &Joints, dh: &Dh, mount: &Pose, driven: bool) {
        if !driven {
            self.track = [None; WINDOW];
            self.mismatches = 0;
        }
        self.at = (self.at + 1) % WINDOW;
        let oldest = self.track[self.at].or_else(|| (1..WINDOW).find_map(|k| self.track[(self.at + k) % WINDOW]));
        self.track[self.at] = Some((*pose, *q));
        let Some((pose0, q0)) = oldest else { return };
        let joints = dh.gripper_motion(&q0, q, mount);
        let seen = pose0.inverse() * pose;
        let (moved, off) = (self.law.size(&log_pose(&joints)), self.law.size(&log_pose(&(joints.inverse() * seen))));
        if off > self.settings.mismatch_m.max(self.settings.mismatch_share * moved) {
            self.mismatches += 1;
            self.mismatch = (moved, off);
        } else {
            self.mismatches = 0;
        }
    }

    pub(super) fn seen(&self) -> Option<&Seen> {
        self.seen.as_ref()
    }

    /// State of the rig by the marks; `None` before the first result.
    pub(super) fn rig(&self) -> Option<&RigHealth> {
        self.rig.as_ref()
    }

    /// Whether both views are configured and only one shows the marks.
    pub(super) fn one_view(&self) -> bool {
        self.one_view >= MAX_ONE_VIEW_RESULTS
    }

    /// Age of the image in use, ns; `u64::MAX` without one.
    pub(super) fn age_ns(&self, now_ns: u64) -> u64 {
        self.seen.map_or(u64::MAX, |s| now_ns.saturating_sub(s.capture_ns()))
    }

    /// Age at which the arm is stopped, ns.
    fn limit_ns(&self) -> u64 {
        (3 * self.period_ns).max(self.settings.frame_age_ns)
    }

    /// Fraction of the speed for the age of the image and the marks in it: 1 while fresh, 0 at the limit.
    pub(super) fn scale(&self, now_ns: u64) -> f64 {
        let (age, limit) = (self.age_ns(now_ns), self.limit_ns());
        // Fresh: at most two periods older than images usually are on arrival.
        let hold = (self.delay_ns + 2 * self.period_ns).min(limit * 3 / 4);
        let by_age = if age <= hold {
            1.0
        } else if age >= limit {
            0.0
        } else {
            (limit - age) as f64 / (limit - hold) as f64
        };
        let degraded = self.seen.is_some_and(|s| s.vision.status == VisionStatus::Degraded);
        if degraded || self.few_marks() { 0.5 * by_age } else { by_age }
    }

    /// Whether the loss of one more mark, which is one point in each view in use, would hold the arm.
    fn few_marks(&self) -> bool {
        let Some(seen) = &self.seen else { return false };
        let [left, right] = seen.vision.marks.each_ref().map(|view| view.iter().flatten().count());
        let (points, spare) = match self.law.views {
            ViewMode::Stereo => (left + right, 2),
            ViewMode::Left => (left, 1),
            ViewMode::Right => (right, 1),
            ViewMode::Best => (left.max(right), 1),
        };
        points < usize::from(self.law.min_points) + spare
    }

    /// Whether the newest result is fresh and shows the marks.
    pub(super) fn tracking(&self, now_ns: u64) -> bool {
        self.age_ns(now_ns) < self.limit_ns() && self.lost == 0
    }

    /// For how long every result has been usable, ns.
    pub(super) fn good_for_ns(&self, now_ns: u64) -> Option<u64> {
        self.good_since_ns.filter(|_| self.tracking(now_ns)).map(|t| now_ns.saturating_sub(t))
    }

    /// The fault that latches now.
    pub(super) fn fault(&self, now_ns: u64) -> Option<FaultCause> {
        let (age_ns, limit_ns) = (self.age_ns(now_ns), self.limit_ns());
        if self.bad_stamps >= MAX_REFUSED {
            return Some(FaultCause::FrameStamps { count: self.bad_stamps });
        }
        if self.jumps >= MAX_REFUSED {
            return Some(FaultCause::MarksJumped { jump_m: self.jump_m, limit_m: self.settings.jump_m });
        }
        if self.mismatches >= self.settings.mismatch_frames {
            let (joints_m, difference_m) = self.mismatch;
            return Some(FaultCause::MotionMismatch { joints_m, difference_m });
        }
        (age_ns >= limit_ns).then_some(FaultCause::FramesStale { age_ns, limit_ns })
    }

    /// The cause that stops the motion now without latching.
    pub(super) fn hold(&self) -> Option<HoldCause> {
        if self.lost >= MAX_LOST {
            return Some(HoldCause::MarksLost);
        }
        if self.rig.is_some_and(|r| r.suspicious) {
            return Some(HoldCause::CameraSuspect);
        }
        if let Some(seen) = self.seen.filter(|_| self.one_view()) {
            return Some(HoldCause::OneView { seen: seen.vision.seen });
        }
        (self.skewed >= MAX_REFUSED).then_some(HoldCause::Skew { skew_ns: self.skew_ns })
    }

    /// Forgets past events and the track.
    pub(super) fn clear_events(&mut self) {
        self.bad_stamps = 0;
        self.skewed = 0;
        self.lost = 0;
        self.jumps = 0;
        self.mismatches = 0;
        self.track = [None; WINDOW];
    }
}

fn finite_pose(p: &Pose) -> bool {
    p.translation.vector.iter().chain(p.rotation.quaternion().coords.iter()).all(|v| v.is_finite())
}
