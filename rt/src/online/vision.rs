//! The result of tracking one stereo pair, which the vision thread passes to the command thread.

use super::observation::{MarkObservation, RigHealth};
use crate::geom::Pose;
use crate::gripper::MAX_MARKS;
use nalgebra::Matrix6;

/// Whether a [`Vision`] may be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VisionStatus {
    /// The marks are not found yet, or lost: they must be acquired before anything may move.
    Lost,
    /// Tracking, with fewer marks than are needed for full speed.
    Degraded,
    /// Tracking.
    Tracking,
}

/// Result of tracking one stereo pair.
#[derive(Clone, Copy, Debug)]
pub struct Vision {
    /// Sequence number of the pair, from the publisher.
    pub sequence: u64,
    /// Middle of the exposure of left and right, CLOCK_MONOTONIC nanoseconds.
    pub capture_ns: [u64; 2],
    /// Whether the result may be used.
    pub status: VisionStatus,
    /// Marks by view and mark index; `None` where a mark was not seen.
    pub marks: [[Option<MarkObservation>; MAX_MARKS]; 2],
    /// Number of marks seen in each view.
    pub seen: [u8; 2],
    /// Gripper pose in the rig at capture, from all marks of both views.
    pub left_from_gripper: Pose,
    /// Covariance of that pose as a small gripper-frame screw `[v; ω]` (m, rad).
    pub covariance: Matrix6<f64>,
    /// Root mean square of the weighted reprojection error of the used marks, pixels.
    pub residual_px: f64,
    /// Part of that residual that the rig's stated error does not explain, pixels.
    pub inner_residual_px: f64,
    /// State of the rig by the marks.
    pub rig: RigHealth,
}
