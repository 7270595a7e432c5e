//! What `graspd plan --mesh` is asked to do.

use std::path::PathBuf;

/// Files and options of `graspd plan --mesh`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeshRequest {
    /// STL or OBJ file.
    pub mesh: PathBuf,
    /// Unit of that file: "mm", "cm", "m" or "inch".
    pub unit: String,
    /// Pose file with `left_from_mesh`.
    pub mesh_pose: Option<PathBuf>,
    /// File with picked points.
    pub points: Option<PathBuf>,
    /// Picked points, each "X,Y,Z=UL,VL,UR,VR".
    pub picks: Vec<String>,
    /// Largest reprojection error of a picked pixel, pixels.
    pub pick_limit_px: Option<f64>,
    /// Rig file.
    pub rig: PathBuf,
    /// Gripper file.
    pub gripper: PathBuf,
    /// Images for the overlay, left and right.
    pub images: Option<[PathBuf; 2]>,
    /// Clearance between each claw and the part before closing, metres.
    pub clearance: Option<f64>,
    /// Smallest contact area of each claw, square millimetres.
    pub contact_mm2: Option<f64>,
    /// Distance of the pre-grasp before the grasp, metres.
    pub pregrasp: Option<f64>,
    /// Largest accepted standard deviation of the handle's position, millimetres.
    pub tolerance_mm: Option<f64>,
    /// Largest accepted standard deviation of the gripper's orientation, degrees.
    pub tolerance_deg: Option<f64>,
    /// Present pose `left_from_gripper`: a pose file or six numbers.
    pub present: Option<String>,
    /// Largest rotation from the present pose, degrees.
    pub max_turn_deg: Option<f64>,
    /// Model of the arm, for the reach test.
    pub arm: Option<String>,
    /// Joint angles of the arm, "Q1,...,Q6" in radians.
    pub joints: Option<String>,
    /// Pose `left_from_base` of the arm: a pose file or six numbers.
    pub base: Option<String>,
    /// List the handles, without a plan.
    pub list: bool,
    /// Plan on this handle of the list, counted from 1.
    pub handle: Option<usize>,
    /// Path of the plan.
    pub out: Option<PathBuf>,
    /// Path of the overlay, a PNG image.
    pub overlay: Option<PathBuf>,
    /// Path of the report, an HTML page.
    pub report: Option<PathBuf>,
}
