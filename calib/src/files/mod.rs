//! The three files of the off-line stage, read into values that are valid and written so that the same values give the same bytes.
//!
//! `rig.toml` holds the two cameras, `gripper.toml` the marks and the shape of the gripper, `plan.toml` the outcome: everything
//! the loop needs, and everything a person wants to know about how it came about. Every key is described in `docs/FILES.md`.
//! Unknown keys, missing keys, numbers that are no measurement and shapes that cannot be are refused with the file, the line,
//! the key and what to do about it; nothing downstream validates again.

mod boxes;
mod error;
mod gripper;
mod hash;
mod mesh;
mod outputs;
mod plan;
mod pose;
mod rig;
mod rig_covariance;

pub use boxes::OrientedBox;
pub use error::FileError;
pub use gripper::{Finger, GripperFile};
pub use hash::ContentHash;
pub use mesh::{Pick, PicksFile, PoseFile};
pub use outputs::keep_apart;
pub use plan::{
    CandidateRecord, ConeRecord, EdgeRecord, GoalRecord, GripRecord, MarkRecord, MeshRecord, ModelRecord, ObjectRecord,
    PathRecord, PickRecord, PictureRecord, PlanFile, SeenCamera, SeenRig, SelectionRecord, SourceRecord, ViewPair,
};
pub use pose::PoseRecord;
pub use rig::{Quality, RigFile};
pub use rig_covariance::RigCovariance;
