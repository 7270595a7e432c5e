//! The tables of `plan.toml`. Every key is described in `docs/FILES.md`.

use crate::files::pose::PoseRecord;
use graspd_rt::geom::View;
use serde::{Deserialize, Serialize};

/// One value per view.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewPair<T> {
    /// Value of the left view.
    pub left: T,
    /// Value of the right view.
    pub right: T,
}

impl<T> ViewPair<T> {
    /// The value of a view.
    pub fn get(&self, view: View) -> &T {
        match view {
            View::Left => &self.left,
            View::Right => &self.right,
        }
    }
}

/// A rig or gripper file that the plan was made with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceRecord {
    /// Name given in that file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// SHA-256 of that file's values, not of its comments.
    pub hash: String,
}

/// An image that the plan was made from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageRecord {
    /// SHA-256 of the grey values, row by row, eight bits each.
    pub hash: String,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
}

/// The selection in a view.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelectionRecord {
    /// "click", "points", "box" or "auto".
    pub kind: String,
    /// Pixels of one click, of several points, or of two opposite corners of a box.
    pub points_px: Vec<[f64; 2]>,
}

/// The contour of a view and its ellipse.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EdgeRecord {
    /// Edge points on the contour.
    pub points: usize,
    /// Edge points rejected as outliers.
    pub rejected: usize,
    /// Fraction of the ellipse that carries edge points, 0 to 1.
    pub coverage: f64,
    /// Predicted standard deviation of an edge point, pixels.
    pub sigma_px: f64,
    /// Root mean square distance of the edge points from the ellipse, pixels.
    pub rms_px: f64,
    /// Ellipse in the undistorted image: centre u, centre v, semi-axes a >= b (pixels), angle of a (radians).
    pub ellipse: [f64; 5],
}

/// A fitted model of the rim.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelRecord {
    /// "circle", "ellipse" or "round bar".
    pub model: String,
    /// Information criterion; the model with the smallest value is chosen unless the operator names one.
    pub criterion: f64,
    /// Weighted sum of squared residuals.
    pub chi2: f64,
    /// Degrees of freedom.
    pub dof: usize,
    /// "chosen", or why the model was not chosen.
    pub verdict: String,
}

/// Diagnostics of the two viewing cones.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConeRecord {
    /// Scale-free correspondence score of the two images; 0 for one conic.
    pub delta: f64,
    /// Gaps between the two pairs of corresponding epipolar tangents, pixels.
    pub gap_px: [f64; 2],
    /// The gaps in standard deviations.
    pub gap_sigma: [f64; 2],
    /// Rank-2 residue: the largest eigenvalue that should be zero over the smaller of the two that should not.
    pub rank2_residue: f64,
    /// Angle between the two viewing rays, degrees.
    pub vergence_deg: f64,
    /// Semi-minor axis of each image ellipse, pixels.
    pub minor_axis_px: [f64; 2],
}

/// The reconstructed rim, in the left camera's frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectRecord {
    /// "circle", "ellipse", "round bar" or "mesh".
    pub model: String,
    /// Centre, metres.
    pub centre_m: [f64; 3],
    /// Unit normal of the plane, pointing towards the cameras.
    pub normal: [f64; 3],
    /// Semi-axes a >= b, metres; for a round bar, those of the core circle.
    pub semi_axes_m: [f64; 2],
    /// Unit direction of the semi-axis a.
    pub axis_a: [f64; 3],
    /// Radius of the bar, metres; only for a round bar.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bar_radius_m: Option<f64>,
    /// Object frame: origin at the centre, z along the normal, x along a.
    pub left_from_object: PoseRecord,
    /// Standard deviation of the centre along its worst direction, millimetres.
    pub sigma_centre_mm: f64,
    /// Standard deviation of the normal along its worst direction, degrees.
    pub sigma_normal_deg: f64,
    /// Covariance of the centre, square metres.
    pub covariance_centre_m2: [[f64; 3]; 3],
    /// Covariance of the normal in the tangent directions x and y of the object's frame, square radians.
    pub covariance_normal_rad2: [[f64; 2]; 2],
    /// Covariance of the semi-axes, square metres.
    pub covariance_axes_m2: [[f64; 2]; 2],
    /// Weighted sum of squared residuals over degrees of freedom.
    pub chi2_per_dof: f64,
}

/// A candidate grasp.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CandidateRecord {
    /// Angle of the closing direction about the normal, from the object's x axis, degrees.
    pub angle_deg: f64,
    /// Jaw opening, metres.
    pub opening_m: f64,
    /// Sum of the solid angles of the visible marks for each camera, microsteradians.
    pub visibility_usr: [f64; 2],
    /// Marks visible in each view.
    pub marks_seen: [usize; 2],
    /// "chosen", "possible", or why the candidate was dropped.
    pub verdict: String,
    /// Faces and directions of a box handle.
    #[serde(rename = "box", default, skip_serializing_if = "Option::is_none")]
    pub grip: Option<GripRecord>,
}

/// How the claws grip a box handle, in the mesh frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GripRecord {
    /// Distance between the faces, metres.
    pub width_m: f64,
    /// Contact area of each claw, square metres.
    pub contact_m2: f64,
    /// Unit closing direction.
    pub closing: [f64; 3],
    /// Unit direction of the approach.
    pub approach: [f64; 3],
}

/// The mesh of a polyhedral plan and its pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeshRecord {
    /// SHA-256 of the mesh file.
    pub hash: String,
    /// Length of the file's unit, metres.
    pub unit_m: f64,
    /// Number of triangles, without degenerate ones.
    pub triangles: usize,
    /// Size of the bounding box, metres.
    pub size_m: [f64; 3],
    /// Pose of the mesh.
    pub left_from_mesh: PoseRecord,
    /// Root mean square reprojection error of the picked points, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rms_px: Option<f64>,
    /// The picked points, if the pose was fitted to them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub picked: Vec<PickRecord>,
}

/// A picked point of a mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PickRecord {
    /// The point in the mesh frame, metres.
    pub point_m: [f64; 3],
    /// Picked pixel in the left image.
    pub left_px: [f64; 2],
    /// Picked pixel in the right image.
    pub right_px: [f64; 2],
}

/// A mark at a goal.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkRecord {
    /// Index of the mark in the gripper file, counted from 0.
    pub index: usize,
    /// Pixel of its centre in the left image, lens distortion included; absent if the mark is not visible.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub left_px: Option<[f64; 2]>,
    /// Pixel of its centre in the right image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub right_px: Option<[f64; 2]>,
}

/// A gripper pose to reach.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GoalRecord {
    /// Distance of the gripper's origin from the object's centre along the normal, metres.
    pub standoff_m: f64,
    /// Gripper pose in the left camera's frame.
    pub left_from_gripper: PoseRecord,
    /// Predicted pixels of the marks.
    pub mark: Vec<MarkRecord>,
}

/// Visibility of the marks along the straight path from the present pose.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PathRecord {
    /// Smallest number of marks visible in each view along the path.
    pub fewest_marks: [usize; 2],
    /// Fraction of the path, 0 to 1, at which that number occurs.
    pub at_fraction: [f64; 2],
    /// Rotation from the present pose to the grasp, degrees.
    pub turn_deg: f64,
    /// Length of the path to the grasp, metres.
    pub length_m: f64,
}
