//! The arguments of `graspd plan --mesh`.

use clap::Args;
use std::path::PathBuf;

/// Arguments that apply to a mesh only.
#[derive(Debug, Args)]
#[command(next_help_heading = "A part with a CAD model")]
pub struct MeshArgs {
    /// Plan on this mesh (STL or OBJ) instead of a contour: lists every box handle, and which of them can be grasped
    #[arg(long, value_name = "part.stl", conflicts_with_all = ["select_left", "select_right", "auto", "bar_diameter"])]
    pub mesh: Option<PathBuf>,
    /// Unit of the mesh file: mm, cm, m, inch. Mesh files do not state it
    #[arg(long, value_name = "UNIT", default_value = "mm", requires = "mesh")]
    pub mesh_unit: String,
    /// Pose of the part: a file with left_from_mesh
    #[arg(long, value_name = "pose.toml", requires = "mesh")]
    pub mesh_pose: Option<PathBuf>,
    /// Pose of the part, from points of it picked in both images
    #[arg(long, value_name = "picks.toml", requires = "mesh")]
    pub points: Option<PathBuf>,
    /// A picked point: its position on the mesh (in the mesh's unit) and its pixels left and right; give at least three
    #[arg(long, value_name = "X,Y,Z=UL,VL,UR,VR", requires = "mesh", allow_hyphen_values = true)]
    pub pick_mesh: Vec<String>,
    /// Maximum distance of a picked pixel from the fit of all picks, pixels
    #[arg(long, value_name = "PX", default_value_t = 5.0, requires = "mesh")]
    pub pick_limit: f64,
    /// Clearance between each claw and the part before closing, metres
    #[arg(long, value_name = "M", default_value_t = 0.002, requires = "mesh")]
    pub clearance: f64,
    /// Minimum contact area of each claw, square millimetres
    #[arg(long, value_name = "MM2", default_value_t = 20.0, requires = "mesh")]
    pub contact_mm2: f64,
    /// Drop handles out of reach of this arm (ur3 to ur30); needs the pose of the rig, see --joints and --base
    #[arg(long, value_name = "MODEL", requires = "mesh")]
    pub arm: Option<String>,
    /// The arm's joints at the present pose, radians, base to wrist 3: with --present they give the pose of the rig
    #[arg(long, value_name = "Q1,...,Q6", requires = "arm", allow_hyphen_values = true)]
    pub joints: Option<String>,
    /// Instead: pose of the arm's base in the left camera's frame, as a pose file with left_from_base, or
    /// X,Y,Z,RX,RY,RZ
    #[arg(long, value_name = "POSE", requires = "arm", allow_hyphen_values = true)]
    pub base: Option<String>,
    /// Only list the handles, ranked, with the reason for each that is dropped; write nothing
    #[arg(long, requires = "mesh", conflicts_with_all = ["out", "overlay", "report", "handle"])]
    pub list: bool,
    /// Plan for this handle of the list instead of the best one
    #[arg(long, value_name = "N", requires = "mesh")]
    pub handle: Option<usize>,
}
