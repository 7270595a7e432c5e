//! The on-line stage: stereo pairs in, gripper pose out; and the parts of the control law.
//!
//! In reading order:
//!
//! | file | content |
//! |---|---|
//! | `observation`, `vision` | [`MarkObservation`], [`Vision`]: values passed between files and threads |
//! | `frame`, `content` | checks of a stereo pair: sizes and stamps, frozen and badly exposed images |
//! | [`marks`] | measures one mark to sub-pixel |
//! | [`pose`] | the gripper's pose from the marks of both views |
//! | [`acquire`] | finds the marks without an earlier pose |
//! | [`rig_fit`], `likelihood`, [`rig_watch`] | the error of the rig, and the detection of a moved camera |
//! | `vision_cycle` | [`VisionCycle::step`]: tracks one stereo pair with all of the above |
//! | [`predict`] | from the capture of an image to now, by the joints |
//! | [`interaction`] | the interaction matrix of a mark: the sign of the servo |
//! | [`path`] | the reference that moves from the gripper to the goal |
//! | [`screw`] | the law: stacked marks to the correction of the pose |
//! | [`rates`] | a gripper screw to joint rates |

pub mod acquire;
mod arm_motion;
mod content;
mod frame;
pub mod interaction;
mod likelihood;
pub mod marks;
mod observation;
pub mod path;
pub mod pose;
pub mod predict;
pub mod rates;
pub mod rig_fit;
pub mod rig_watch;
pub mod screw;
mod vision;
mod vision_cycle;

pub use arm_motion::{ArmMotion, mid_exposure_ns};
pub use frame::{FrameFaults, FrameLimits, FrameReject, StereoFrame};
pub use observation::{MarkObservation, RigHealth};
pub use vision::{Vision, VisionStatus};
pub use vision_cycle::{StepStage, VisionCycle, VisionHealth, VisionSettings};
