//! Watches the images: what may be used, how old it is, and whether it agrees with the joints.

use super::settings::WatchSettings;
use crate::arm::{Dh, Joints};
use crate::geom::{Pose, log_pose};
use crate::mode::{FaultCause, HoldCause};
use crate::online::predict::JointHistory;
use crate::online::rig_watch::RigHealth;
use crate::online::screw::{LawSettings, ViewMode};
use crate::online::{Vision, VisionStatus};

/// Images over which motion is compared.
const WINDOW: usize = 6;

/// Marks in a view below which it adds no depth, and results in a row after which that is no passing hand (80 ms at 60 Hz).
const VIEW_MARKS: u8 = 3;
const ONE_VIEW_RESULTS: u32 = 5;

/// A vision result in use, and where the joints were when its images were taken.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    pub(super) vision: Vision,
    /// Joints at the middle of the two captures.
    pub(super) q: Joints,
    /// Joints at each eye's capture.
    pub(super) q_view: [Joints; 2],
}

impl Seen {
    pub(super) fn capture_ns(&self) -> u64 {
        middle(&self.vision.capture_ns)
    }
}

fn middle(c: &[u64; 2]) -> u64 {
    c[0] / 2 + c[1] / 2 + (c[0] & c[1] & 1)
}

/// The images as known now.
#[derive(Clone, Debug)]
pub(super) struct VisionWatch {
    settings: WatchSettings,
    law: LawSettings,
    seen: Option<Seen>,
    /// Pose and joints of the last images, newest at `at`.
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
    /// Results in a row in which one view showed next to nothing.
    one_view: u32,
    /// The rig as the newest result has it, refused ones included.
    rig: Option<RigHealth>,
    good_since_ns: Option<u64>,
}

/// What became of an offered vision result.
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

    /// Takes a vision result. While the arm is driven, one that jumps is refused; at rest it is a fresh start.
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
        let capture = middle(&v.capture_ns);
        if late > now + 2_000_000 || now.saturating_sub(early) > 1_000_000_000 || (driven && capture <= last) {
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
        let places = [history.at(v.capture_ns[0]), history.at(v.capture_ns[1]), history.at(capture)];
        let [Some(left), Some(right), Some(q)] = places else {
            // No joints are known for that instant: nothing can be predicted from it.
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
            if step < 500_000_000 {
                self.period_ns = (self.period_ns * 15 + step) / 16;
            }
        }
        self.jumps = 0;
        let blind = self.law.views == ViewMode::Stereo && v.seen.iter().any(|s| *s < VIEW_MARKS);
        self.one_view = if blind { self.one_view.saturating_add(1) } else { 0 };
        let delay = now.saturating_sub(capture);
        self.delay_ns = if self.delay_ns == 0 { delay } else { (self.delay_ns * 15 + delay) / 16 };
        self.compare_motion(&v.left_from_gripper, &q, dh, mount, driven);
        self.seen = Some(Seen { vision: *v, q, q_view: [left, right] });
        Taken::Used
    }

    /// Compares the motion over the last images with the joints' own.
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

    /// The rig as the marks show it; `None` before the first result.
    pub(super) fn rig(&self) -> Option<&RigHealth> {
        self.rig.as_ref()
    }

    /// Whether two views are to be used and only one shows the marks.
    pub(super) fn one_view(&self) -> bool {
        self.one_view >= ONE_VIEW_RESULTS
    }

    /// Age of the image in use, ns.
    pub(super) fn age_ns(&self, now_ns: u64) -> u64 {
        self.seen.map_or(u64::MAX, |s| now_ns.saturating_sub(s.capture_ns()))
    }

    /// Age at which the arm is stopped, ns.
    fn limit_ns(&self) -> u64 {
        (3 * self.period_ns).max(self.settings.frame_age_ns)
    }

    /// Speed share for the age of the image and the marks it shows: 1 while fresh, 0 at the limit.
    pub(super) fn scale(&self, now_ns: u64) -> f64 {
        let (age, limit) = (self.age_ns(now_ns), self.limit_ns());
        // Fresh is: two periods more than the images usually take to arrive.
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

    /// Whether the loss of one mark more would hold the arm (M01): one point of it in each view in use.
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

    /// Whether there is a fresh result to start from.
    pub(super) fn tracking(&self, now_ns: u64) -> bool {
        self.age_ns(now_ns) < self.limit_ns() && self.lost == 0
    }

    /// Since when every result has been usable.
    pub(super) fn good_for_ns(&self, now_ns: u64) -> Option<u64> {
        self.good_since_ns.filter(|_| self.tracking(now_ns)).map(|t| now_ns.saturating_sub(t))
    }

    /// What latches.
    pub(super) fn fault(&self, now_ns: u64) -> Option<FaultCause> {
        let (age_ns, limit_ns) = (self.age_ns(now_ns), self.limit_ns());
        if self.bad_stamps >= 3 {
            return Some(FaultCause::FrameStamps { count: self.bad_stamps });
        }
        if self.jumps >= 3 {
            return Some(FaultCause::MarksJumped { jump_m: self.jump_m, limit_m: self.settings.jump_m });
        }
        if self.mismatches >= self.settings.mismatch_frames {
            let (joints_m, difference_m) = self.mismatch;
            return Some(FaultCause::MotionMismatch { joints_m, difference_m });
        }
        (age_ns >= limit_ns).then_some(FaultCause::FramesStale { age_ns, limit_ns })
    }

    /// What holds.
    pub(super) fn hold(&self) -> Option<HoldCause> {
        if self.lost >= 2 {
            return Some(HoldCause::MarksLost);
        }
        if self.rig.is_some_and(|r| r.suspicious) {
            return Some(HoldCause::CameraSuspect);
        }
        if let Some(seen) = self.seen.filter(|_| self.one_view()) {
            return Some(HoldCause::OneView { seen: seen.vision.seen });
        }
        (self.skewed >= 3).then_some(HoldCause::Skew { skew_ns: self.skew_ns })
    }

    /// Forgets events, and the track behind them.
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
