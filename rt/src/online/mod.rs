//! The on-line stage, one file per arrow of the paper: frames in, gripper pose out.

mod vision;

pub use vision::{MarkObservation, Vision, VisionStatus};
