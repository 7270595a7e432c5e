//! `graspd plan --mesh`: a part with a CAD model (section 3.1 of the paper).

use super::args::PlanArgs;
use graspd_calib::commands::Outcome;
use graspd_calib::commands::mesh::{MeshRequest, run};

/// Plans on a mesh.
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
