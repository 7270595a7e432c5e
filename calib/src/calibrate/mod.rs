//! Calibration of the rig and of the gripper.
//!
//! 1. [`target`]: the printed pattern, and detection of its points in an image with their covariances.
//! 2. [`rig`]: estimates the rig from these points in both views: start values, joint bundle, tests of the pairs,
//!    hold-out, coverage, verdict.
//! 3. [`gripper`]: estimates marks, mounting and the rig's pose in the arm's base from recordings of an arm at rest.
//! 4. [`report`]: the HTML report.

pub mod gripper;
pub mod report;
pub mod rig;
pub mod target;
