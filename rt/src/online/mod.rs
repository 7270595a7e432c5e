//! The on-line stage, one file per arrow of the paper: frames in, gripper pose out.

pub mod acquire;
mod content;
mod frame;
pub mod interaction;
mod likelihood;
pub mod marks;
pub mod path;
pub mod pose;
pub mod predict;
pub mod rates;
pub mod rig_fit;
pub mod rig_watch;
pub mod screw;
mod vision;
mod vision_cycle;

pub use frame::{FrameFaults, FrameLimits, FrameReject, StereoFrame};
pub use vision::{MarkObservation, Vision, VisionStatus};
pub use vision_cycle::{StepStage, VisionCycle, VisionHealth, VisionSettings};
