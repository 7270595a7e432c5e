//! The gripper as the loop sees it: round marks in the gripper frame, and where the gripper sits on the flange.
//!
//! The gripper frame has its origin between the finger tips, z along the approach, x along the closing direction.

use crate::geom::{Pose, Vec3};

/// The largest number of marks a gripper may carry.
pub const MAX_MARKS: usize = 32;

/// One round flat mark.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// Centre in the gripper frame, metres.
    pub position: Vec3,
    /// Outward unit normal in the gripper frame.
    pub normal: Vec3,
    /// Radius of the disc, metres.
    pub radius: f64,
    /// Whether the disc is darker than what surrounds it.
    pub dark: bool,
}

/// The marks of a gripper, and its mounting.
#[derive(Clone, Debug, PartialEq)]
pub struct Gripper {
    /// The marks, in the order of the gripper file; this order is their identity everywhere.
    pub marks: heapless::Vec<Mark, MAX_MARKS>,
    /// Maps gripper coordinates into the flange's.
    pub flange_from_gripper: Pose,
}
