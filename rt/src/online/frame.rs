//! The stereo pair that the tracker takes, and the checks before it is searched.
//!
//! The tracker makes these checks because it also runs on recordings and in tests. On frames from shared memory, the
//! frame topic has already checked the bytes (`graspd_shm::frame::check`).

use crate::geom::{Rig, View};
use crate::image::ImageView;

/// A stereo pair, borrowed for one step of the tracker.
#[derive(Clone, Copy, Debug)]
pub struct StereoFrame<'a> {
    /// The left image.
    pub left: ImageView<'a>,
    /// The right image.
    pub right: ImageView<'a>,
    /// The publisher's sequence number.
    pub sequence: u64,
    /// Middle of the exposure of left and right, CLOCK_MONOTONIC nanoseconds.
    pub capture_ns: [u64; 2],
    /// The time now, CLOCK_MONOTONIC nanoseconds.
    pub now_ns: u64,
}

impl<'a> StereoFrame<'a> {
    /// The image of a view.
    pub fn image(&self, view: View) -> &ImageView<'a> {
        match view {
            View::Left => &self.left,
            View::Right => &self.right,
        }
    }
}

/// Limits of a stereo pair's time stamps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameLimits {
    /// Largest time between the exposures of left and right, nanoseconds. Default 5 ms.
    pub max_skew_ns: u64,
    /// Largest age of a capture, nanoseconds. Default 1 s.
    pub max_age_ns: u64,
    /// How far a stamp may be in the future, nanoseconds. Default 2 ms: two threads read the clock one after the other.
    pub max_ahead_ns: u64,
}

impl Default for FrameLimits {
    fn default() -> Self {
        Self { max_skew_ns: 5_000_000, max_age_ns: 1_000_000_000, max_ahead_ns: 2_000_000 }
    }
}

/// Why a stereo pair, or the pose found in it, was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameReject {
    /// Image size mismatch with the rig's camera.
    Size {
        /// The view.
        view: View,
        /// Width and height of the image.
        found: [u32; 2],
        /// Width and height of the calibration.
        expected: [u32; 2],
    },
    /// The sequence number repeats or goes back.
    Sequence {
        /// Last accepted number.
        last: u64,
        /// Number of this pair.
        got: u64,
    },
    /// A capture stamp is not later than the last accepted one of its view.
    NotLater {
        /// The view.
        view: View,
    },
    /// The exposures of left and right are too far apart in time.
    Skew {
        /// Time between the exposures, nanoseconds.
        ns: u64,
    },
    /// The pair is too old.
    Stale {
        /// Its age, nanoseconds.
        ns: u64,
    },
    /// A stamp is in the future.
    Future {
        /// How far, nanoseconds.
        ns: u64,
    },
    /// The marks were found farther from the last pose than the gripper can have moved.
    Jump {
        /// Distance, micrometres.
        um: u32,
        /// Rotation, milliradians.
        mrad: u32,
    },
}

/// Counters of refused and degraded frames since start, for telemetry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameFaults {
    /// Pairs accepted.
    pub accepted: u64,
    /// Pairs that never arrived, counted by gaps of the sequence number.
    pub skipped: u64,
    /// Pairs with an image size mismatch.
    pub size: u64,
    /// Pairs with a repeated or smaller sequence number.
    pub sequence: u64,
    /// Pairs whose stamps did not advance.
    pub not_later: u64,
    /// Pairs with too much time between the exposures.
    pub skew: u64,
    /// Pairs too old on arrival.
    pub stale: u64,
    /// Pairs stamped in the future.
    pub future: u64,
    /// Poses refused because the gripper cannot move that far.
    pub jump: u64,
    /// Pairs that were black, saturated or without contrast.
    pub exposure: u64,
    /// Pairs in which the marks were lost.
    pub lost: u64,
    /// Predictions by the joints that contradicted the last pose and were not used.
    pub prior: u64,
    /// Mark observations dropped as inconsistent with the other marks.
    pub outliers: u64,
    /// Consecutive refused pairs.
    pub in_a_row: u32,
}

impl FrameFaults {
    /// Counts one refusal.
    pub(crate) fn count(&mut self, reject: &FrameReject) {
        let n = match reject {
            FrameReject::Size { .. } => &mut self.size,
            FrameReject::Sequence { .. } => &mut self.sequence,
            FrameReject::NotLater { .. } => &mut self.not_later,
            FrameReject::Skew { .. } => &mut self.skew,
            FrameReject::Stale { .. } => &mut self.stale,
            FrameReject::Future { .. } => &mut self.future,
            FrameReject::Jump { .. } => &mut self.jump,
        };
        *n += 1;
        self.in_a_row = self.in_a_row.saturating_add(1);
    }
}

/// Sequence number and stamps of the last accepted pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LastFrame {
    pub(crate) sequence: u64,
    pub(crate) capture_ns: [u64; 2],
}

/// Compares a pair's sizes and stamps with the rig, the limits and the last accepted pair.
pub(crate) fn check(
    frame: &StereoFrame<'_>,
    rig: &Rig,
    limits: &FrameLimits,
    last: Option<&LastFrame>,
) -> Result<(), FrameReject> {
    for view in View::BOTH {
        let (image, camera) = (frame.image(view), rig.camera(view));
        let found = [image.width() as u32, image.height() as u32];
        let expected = [camera.width, camera.height];
        if found != expected {
            return Err(FrameReject::Size { view, found, expected });
        }
    }
    let [l, r] = frame.capture_ns;
    let ahead = l.max(r).saturating_sub(frame.now_ns);
    if ahead > limits.max_ahead_ns {
        return Err(FrameReject::Future { ns: ahead });
    }
    let age = frame.now_ns.saturating_sub(l.min(r));
    if age > limits.max_age_ns {
        return Err(FrameReject::Stale { ns: age });
    }
    let skew = l.abs_diff(r);
    if skew > limits.max_skew_ns {
        return Err(FrameReject::Skew { ns: skew });
    }
    if let Some(last) = last {
        if frame.sequence <= last.sequence {
            return Err(FrameReject::Sequence { last: last.sequence, got: frame.sequence });
        }
        for view in View::BOTH {
            let i = view.index();
            if frame.capture_ns[i] <= last.capture_ns[i] {
                return Err(FrameReject::NotLater { view });
            }
        }
    }
    Ok(())
}
