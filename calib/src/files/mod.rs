//! The files of the off-line stage: parsed into checked values, and written so that equal values give equal bytes.
//!
//! `rig.toml` holds the two cameras, `gripper.toml` the marks and the shape of the gripper, and `plan.toml` the result:
//! the set-point of the on-line stage, and how it was computed. `pose.toml` and `picks.toml` give the pose of a part
//! with a mesh. Every key is described in `docs/FILES.md`. Unknown keys, missing keys, NaN, infinity and impossible
//! shapes are refused with the file, the line, the key and the fix; nothing downstream validates again.

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
    CandidateRecord, ConeRecord, EdgeRecord, GoalRecord, GripRecord, ImageRecord, MarkRecord, MeshRecord, ModelRecord,
    ObjectRecord, PathRecord, PickRecord, PlanFile, SeenCamera, SeenRig, SelectionRecord, SourceRecord, ViewPair,
};
pub use pose::PoseRecord;
pub use rig::{Quality, RigFile};
pub use rig_covariance::RigCovariance;
