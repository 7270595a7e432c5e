//! Calibration: from images of a target to a rig file that says how good it is.
//!
//! 1. [`target`]: what is printed on the board, and where its points are in an image, with their covariances.
//! 2. [`rig`]: from those points in both views to the rig: start values, joint bundle, wrong pairs, hold-out, coverage,
//!    verdict.
//! 3. [`gripper`]: from marks and joints of an arm at rest to marks, mounting and the rig's pose in the arm's base.
//! 4. [`report`]: what people look at; [`command`]: options in, files and figures out.

pub mod command;
pub mod gripper;
pub mod report;
pub mod rig;
pub mod target;
