//! Serde representation of a recording: keys as in the file, lengths in the file's unit.

use serde::{Deserialize, Serialize};

/// Rows of a 4x4 homogeneous transformation.
pub(super) type Matrix4 = [[f64; 4]; 4];

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct RawRecording {
    pub(super) kind: Option<String>,
    pub(super) units: Option<RawUnits>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) gripper_toml: Option<String>,
    pub(super) noise: Option<RawNoise>,
    pub(super) rig: Option<RawRig>,
    pub(super) marks_mm: Vec<[f64; 3]>,
    #[serde(rename = "assumed_flange_T_gripper", skip_serializing_if = "Option::is_none")]
    pub(super) assumed_flange_t_gripper: Option<Matrix4>,
    pub(super) poses: Vec<RawPose>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct RawUnits {
    pub(super) length: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) pixel: Option<String>,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct RawNoise {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) flange_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) flange_deg: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) mark_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) mark_model_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) outlier_fraction: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) rig: Option<RawRigNoise>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct RawRigNoise {
    pub(super) focal_px: f64,
    pub(super) principal_px: f64,
    pub(super) rotation_deg: f64,
    #[serde(default)]
    pub(super) baseline_relative: f64,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct RawRig {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) image_size: Option<[u32; 2]>,
    pub(super) left: RawCamera,
    pub(super) right: RawCamera,
    #[serde(rename = "right_T_left")]
    pub(super) right_t_left: Matrix4,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) covariance: Option<Vec<Vec<f64>>>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct RawCamera {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) model: Option<String>,
    #[serde(rename = "K")]
    pub(super) k: [[f64; 3]; 3],
    #[serde(rename = "D", default)]
    pub(super) d: Vec<f64>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct RawPose {
    #[serde(rename = "base_T_flange")]
    pub(super) base_t_flange: Matrix4,
    #[serde(rename = "base_T_tcp", skip_serializing_if = "Option::is_none")]
    pub(super) base_t_tcp: Option<Matrix4>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) joints_rad: Option<[f64; 6]>,
    pub(super) marks: Vec<RawSighting>,
}

#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct RawSighting {
    pub(super) mark: usize,
    pub(super) left: Option<[f64; 2]>,
    pub(super) right: Option<[f64; 2]>,
}
