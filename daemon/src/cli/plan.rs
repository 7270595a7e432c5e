//! `graspd plan`: the off-line stage, for a contour in two images or for a CAD mesh.

use super::answer::finish;
use super::args::PlanArgs;
use crate::exit::{Exit, Failure};
use graspd_calib::commands::parse_pose;
use graspd_calib::commands::plan::{PlanRequest, run};
use graspd_calib::files::keep_apart;
use std::path::Path;

/// Makes a plan.
///
/// # Errors
/// Usage (2), a wrong file or selection (3), a rim or grasp that the tests refuse (1). Nothing is written then.
pub fn plan(args: &PlanArgs) -> Result<Exit, Failure> {
    check_outputs(args).map_err(|message| Failure { exit: Exit::Usage, message })?;
    if args.part.mesh.is_some() {
        return finish(args.json, super::mesh::plan(args));
    }
    let present = args
        .present
        .as_deref()
        .map(|t| parse_pose("--present", t, "left_from_gripper"))
        .transpose()
        .map_err(|e| Failure::input(e.to_string()))?;
    let max_turn = match args.max_turn {
        Some(deg) if !(0.0..=180.0).contains(&deg) => {
            return Err(Failure { exit: Exit::Usage, message: format!("--max-turn {deg}: give 0 to 180 degrees") });
        }
        deg => deg.map(f64::to_radians),
    };
    let outcome = run(&PlanRequest {
        left: args.left.clone().unwrap_or_default(),
        right: args.right.clone().unwrap_or_default(),
        rig: args.rig.clone(),
        gripper: args.gripper.clone(),
        select_left: args.select_left.clone(),
        select_right: args.select_right.clone(),
        auto: args.auto,
        pick: args.pick,
        rim: args.rim.clone(),
        bar_diameter: args.bar_diameter,
        pregrasp: args.pregrasp,
        standoff: Some(args.standoff),
        tolerance_mm: Some(args.tolerance_mm.unwrap_or(2.0)),
        tolerance_deg: Some(args.tolerance_deg.unwrap_or(1.0)),
        calibration_px: args.calibration_px,
        present,
        max_turn,
        out: args.out.clone(),
        overlay: args.overlay.clone(),
        report: args.report.clone(),
    });
    finish(args.json, outcome)
}

/// Refuses to overwrite an input with an output.
fn check_outputs(args: &PlanArgs) -> Result<(), String> {
    let part = &args.part;
    // These two are a file or six numbers; no output has six numbers as its name.
    let (present, base) = (args.present.as_deref().map(Path::new), part.base.as_deref().map(Path::new));
    keep_apart(
        &[("--out", args.out.as_deref()), ("--overlay", args.overlay.as_deref()), ("--report", args.report.as_deref())],
        &[
            ("--left", args.left.as_deref()),
            ("--right", args.right.as_deref()),
            ("--rig", Some(&args.rig)),
            ("--gripper", Some(&args.gripper)),
            ("--present", present),
            ("--mesh", part.mesh.as_deref()),
            ("--mesh-pose", part.mesh_pose.as_deref()),
            ("--points", part.points.as_deref()),
            ("--base", base),
        ],
    )
}
