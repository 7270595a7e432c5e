//! `graspd plan --mesh`: a part with a CAD model (section 3.1 of the paper).

use super::args::PlanArgs;
use clap::Args;
use graspd_calib::commands::Outcome;
use graspd_calib::commands::mesh::{MeshRequest, run};
use std::path::PathBuf;

/// What concerns a mesh only.
#[derive(Debug, Args)]
#[command(next_help_heading = "A part with a CAD model")]
pub struct MeshArgs {
    /// Plan on this mesh (STL or OBJ) instead of a contour: every box handle of it, and which of them can be taken
    #[arg(long, value_name = "part.stl", conflicts_with_all = ["select_left", "select_right", "auto", "bar_diameter"])]
    pub mesh: Option<PathBuf>,
    /// Unit of the mesh file: mm, cm, m, inch. The file does not say
    #[arg(long, value_name = "UNIT", default_value = "mm", requires = "mesh")]
    pub mesh_unit: String,
    /// Where the part stands: a file with left_from_mesh
    #[arg(long, value_name = "pose.toml", requires = "mesh")]
    pub mesh_pose: Option<PathBuf>,
    /// Where the part stands: points of it picked in both images
    #[arg(long, value_name = "picks.toml", requires = "mesh")]
    pub points: Option<PathBuf>,
    /// A picked point: its place on the mesh (in the mesh's unit) and its pixels left and right; repeat it, three at least
    #[arg(long, value_name = "X,Y,Z=UL,VL,UR,VR", requires = "mesh", allow_hyphen_values = true)]
    pub pick_mesh: Vec<String>,
    /// How far a picked pixel may lie from where the others put it, pixels
    #[arg(long, value_name = "PX", default_value_t = 5.0, requires = "mesh")]
    pub pick_limit: f64,
    /// Air between each claw and the part before closing, metres
    #[arg(long, value_name = "M", default_value_t = 0.002, requires = "mesh")]
    pub clearance: f64,
    /// What each claw has to press at least, square millimetres
    #[arg(long, value_name = "MM2", default_value_t = 20.0, requires = "mesh")]
    pub contact_mm2: f64,
    /// Drop handles out of this arm's reach (ur3 to ur30); needs to know where the rig stands, see --joints and --base
    #[arg(long, value_name = "MODEL", requires = "mesh")]
    pub arm: Option<String>,
    /// The arm's joints at the present pose, radians, base to wrist 3: with --present they tell where the rig stands
    #[arg(long, value_name = "Q1,...,Q6", requires = "arm", allow_hyphen_values = true)]
    pub joints: Option<String>,
    /// Where the arm's base stands in the left camera's frame, instead: a pose file with left_from_base, or X,Y,Z,RX,RY,RZ
    #[arg(long, value_name = "POSE", requires = "arm", allow_hyphen_values = true)]
    pub base: Option<String>,
    /// Only list the handles, ranked, with the reason for each that is dropped; write nothing
    #[arg(long, requires = "mesh", conflicts_with_all = ["out", "overlay", "report", "handle"])]
    pub list: bool,
    /// Plan for this handle of the list instead of the best
    #[arg(long, value_name = "N", requires = "mesh")]
    pub handle: Option<usize>,
}

/// Runs it.
pub(super) fn plan(args: &PlanArgs) -> Outcome {
    let part = &args.part;
    let images = match (&args.left, &args.right) {
        (Some(l), Some(r)) => Some([l.clone(), r.clone()]),
        _ => None,
    };
    run(&MeshRequest {
        mesh: part.mesh.clone().unwrap_or_default(),
        unit: part.mesh_unit.clone(),
        mesh_pose: part.mesh_pose.clone(),
        points: part.points.clone(),
        picks: part.pick_mesh.clone(),
        pick_limit_px: Some(part.pick_limit),
        rig: args.rig.clone(),
        gripper: args.gripper.clone(),
        images,
        clearance: Some(part.clearance),
        contact_mm2: Some(part.contact_mm2),
        pregrasp: args.pregrasp,
        tolerance_mm: args.tolerance_mm,
        tolerance_deg: args.tolerance_deg,
        present: args.present.clone(),
        max_turn_deg: args.max_turn,
        arm: part.arm.clone(),
        joints: part.joints.clone(),
        base: part.base.clone(),
        list: part.list,
        handle: part.handle,
        out: args.out.clone(),
        overlay: args.overlay.clone(),
        report: args.report.clone(),
    })
}
