//! The on-line stage, one file per arrow of the paper: frames in, gripper pose out.

pub mod interaction;
pub mod path;
pub mod predict;
pub mod rates;
pub mod screw;
mod vision;

pub use vision::{MarkObservation, Vision, VisionStatus};
