//! `plan.toml`: the result of the off-line stage, complete enough to be checked and repeated.

mod check;
mod records;
mod seal;
mod seen_rig;
mod set_point;
mod write;

pub use records::{
    CandidateRecord, ConeRecord, EdgeRecord, GoalRecord, GripRecord, ImageRecord, MarkRecord, MeshRecord, ModelRecord,
    ObjectRecord, PathRecord, PickRecord, SelectionRecord, SourceRecord, ViewPair,
};
pub use seen_rig::{SeenCamera, SeenRig};

use serde::{Deserialize, Serialize};

const SCHEMA: &str = "graspd-plan/1";

/// The content of `plan.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanFile {
    /// "graspd-plan/1".
    pub schema: String,
    /// The view in which the marks are best visible: "left" or "right".
    pub best_view: String,
    /// Kind of handle: "circle", "ellipse" or "box".
    pub handle: String,
    /// Jaw opening at the grasp, metres.
    pub opening_m: f64,
    /// `(max - min) / max` of the visibility over the free angle; below 0.05 the visibility does not determine the
    /// angle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flatness: Option<f64>,
    /// Warnings for the operator, to be read before arming.
    pub warnings: Vec<String>,
    /// The rig file.
    pub rig: SourceRecord,
    /// The gripper file.
    pub gripper: SourceRecord,
    /// The object.
    pub object: ObjectRecord,
    /// Goal in front of the object.
    pub pregrasp: GoalRecord,
    /// Goal at the object.
    pub grasp: GoalRecord,
    /// The straight path from the present pose, if that pose was given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub path: Option<PathRecord>,
    /// The images.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub images: Option<ViewPair<ImageRecord>>,
    /// The selections.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub selection: Option<ViewPair<SelectionRecord>>,
    /// The contours and ellipses of both views.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edges: Option<ViewPair<EdgeRecord>>,
    /// The rig that the marks were predicted with, if it differs from the rig file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seen_rig: Option<SeenRig>,
    /// Diagnostics of the two viewing cones.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cones: Option<ConeRecord>,
    /// The mesh of a polyhedral part.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mesh: Option<MeshRecord>,
    /// The fitted models of the rim.
    #[serde(default)]
    pub model: Vec<ModelRecord>,
    /// The candidate grasps, best first.
    #[serde(default)]
    pub candidate: Vec<CandidateRecord>,
}

impl PlanFile {
    /// The value of the `schema` key.
    pub const SCHEMA: &'static str = SCHEMA;
}
