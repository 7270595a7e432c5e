//! The set-point, the only value that the off-line stage passes to the on-line stage: the pixels of the marks at the
//! goal.

use crate::geom::{Pixel, Pose, Vec3};
use crate::gripper::MAX_MARKS;

/// A pose to be reached, given as in the paper by the predicted pixels of the marks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Goal {
    /// Gripper pose in the rig at the goal. It gives depths and path; the loop is closed on `marks`.
    pub left_from_gripper: Pose,
    /// Predicted pixel of each mark's centre by view and mark index, with lens distortion; `None` where it would not be
    /// seen.
    pub marks: [[Option<Pixel>; MAX_MARKS]; 2],
}

/// A set-point: pre-grasp and grasp.
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
    /// The view for the paper's monocular mode: the one that shows the marks best.
    pub best_view: crate::geom::View,
}
