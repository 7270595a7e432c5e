//! `graspd plan`: the off-line stage on two pictures.

use super::args::PlanArgs;
use crate::exit::{Exit, Failure};
use graspd_calib::plan_cli::{Class, Request, run};

/// Runs it.
///
/// # Errors
/// Usage (2), a file or selection that is wrong (3), a rim or grasp that the tests refuse (1). Nothing is written then.
pub fn plan(args: &PlanArgs) -> Result<Exit, Failure> {
    let outcome = run(&Request {
        left: args.left.clone(),
        right: args.right.clone(),
        rig: args.rig.clone(),
        gripper: args.gripper.clone(),
        select_left: args.select_left.clone(),
        select_right: args.select_right.clone(),
        auto: args.auto,
        pick: args.pick,
        rim: args.rim.clone(),
        bar_diameter: args.bar_diameter,
        pregrasp: Some(args.pregrasp),
        standoff: Some(args.standoff),
        tolerance_mm: Some(args.tolerance_mm),
        tolerance_deg: Some(args.tolerance_deg),
        calibration_px: args.calibration_px,
        present: None,
        max_turn: None,
        out: args.out.clone(),
        overlay: args.overlay.clone(),
        report: args.report.clone(),
    });
    if args.json {
        println!("{}", outcome.json);
    }
    let exit = match outcome.class {
        Class::Done => {
            if !args.json {
                println!("{}", outcome.text);
            }
            return Ok(Exit::Done);
        }
        Class::Refused => Exit::NotConverged,
        Class::Usage => Exit::Usage,
        Class::Input => Exit::Input,
    };
    Err(Failure { exit, message: outcome.text })
}
