//! What the vision thread tells the command thread about one stereo pair.

use super::observation::{MarkObservation, RigHealth};
use crate::geom::Pose;
use crate::gripper::MAX_MARKS;
use nalgebra::Matrix6;

/// How much a [`Vision`] may be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VisionStatus {
    /// Marks are not found yet, or were lost: an acquisition is needed before anything may move.
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
    /// When each eye's image was taken (mid-exposure), CLOCK_MONOTONIC nanoseconds.
    pub capture_ns: [u64; 2],
    /// Whether this result may be used.
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
    /// What of that residual the rig's own error does not explain, pixels.
    pub inner_residual_px: f64,
    /// The rig as the marks show it.
    pub rig: RigHealth,
}
