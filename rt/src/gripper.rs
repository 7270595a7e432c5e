//! The gripper: round marks in the gripper frame, and its pose on the flange.
//!
//! The gripper frame has its origin between the finger tips, z along the approach, x along the closing direction.

use crate::geom::{Pose, Vec3};

/// Largest number of marks of a gripper.
pub const MAX_MARKS: usize = 32;

/// A flat round mark.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// Centre in the gripper frame, metres.
    pub position: Vec3,
    /// Outward unit normal, gripper frame.
    pub normal: Vec3,
    /// Radius of the disc, metres.
    pub radius: f64,
    /// Whether the disc is darker than its surroundings.
    pub dark: bool,
}

/// The marks of a gripper, and its mounting.
#[derive(Clone, Debug, PartialEq)]
pub struct Gripper {
    /// The marks, in the order of the gripper file; the index identifies a mark everywhere.
    pub marks: heapless::Vec<Mark, MAX_MARKS>,
    /// Pose of the gripper in the flange frame.
    pub flange_from_gripper: Pose,
}
