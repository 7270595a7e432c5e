//! The only value that crosses from the off-line to the on-line stage: where the marks have to be in both images.

use crate::geom::{Pixel, Pose, Vec3};
use crate::gripper::MAX_MARKS;

/// A gripper pose to be reached, as the paper means it: the predicted images of the marks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Goal {
    /// Gripper pose in the rig at the goal. It gives depths and the path; the loop is closed on `marks`.
    pub left_from_gripper: Pose,
    /// Predicted pixel of each mark's centre by view and mark index (distorted pixels); `None` where it would not be seen.
    pub marks: [[Option<Pixel>; MAX_MARKS]; 2],
}

/// A set-point: pre-grasp and grasp, in the order in which they are reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SetPoint {
    /// Identity: the first eight bytes of the plan file's content hash.
    pub id: u64,
    /// Standoff pose in front of the object.
    pub pregrasp: Goal,
    /// The grasp.
    pub grasp: Goal,
    /// Centre of the reconstructed conic in the rig, metres.
    pub object_centre: Vec3,
    /// Unit normal of its plane towards the cameras: the valve's axis.
    pub object_normal: Vec3,
    /// The view the paper's monocular mode should use: the one that sees the marks best.
    pub best_view: crate::geom::View,
}
