//! `graspd plan`: the off-line stage on two pictures.

use super::args::PlanArgs;
use crate::exit::{Exit, Failure};
use graspd_calib::files::{GripperFile, RigFile};
use graspd_calib::offline::model::RimChoice;
use graspd_calib::offline::overlay;
use graspd_calib::offline::picture::Picture;
use graspd_calib::offline::plan::{Plan, PlanError, PlanOptions, plan as plan_on};
use graspd_calib::offline::select::Selection;
use graspd_rt::geom::Pixel;
use serde_json::{Value, json};
use std::path::Path;

fn usage(message: String) -> Failure {
    Failure { exit: Exit::Usage, message }
}

/// A selection as typed: `U,V`, `U,V;U,V;...` or `U0,V0,U1,V1`.
fn selection(text: &str, key: &str) -> Result<Selection, Failure> {
    let wrong = || usage(format!("{key} {text}: give one click U,V, several points U,V;U,V;... or a box U0,V0,U1,V1"));
    let numbers = |part: &str| -> Result<Vec<f64>, Failure> {
        part.split(',').map(|n| n.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(wrong)).collect()
    };
    let parts: Vec<Vec<f64>> = text.split(';').map(numbers).collect::<Result<_, _>>()?;
    match parts.as_slice() {
        [one] => match one.as_slice() {
            [u, v] => Ok(Selection::Click(Pixel::new(*u, *v))),
            [u0, v0, u1, v1] => Ok(Selection::Box(Pixel::new(*u0, *v0), Pixel::new(*u1, *v1))),
            _ => Err(wrong()),
        },
        many => many
            .iter()
            .map(|p| match p.as_slice() {
                [u, v] => Ok(Pixel::new(*u, *v)),
                _ => Err(wrong()),
            })
            .collect::<Result<Vec<_>, _>>()
            .map(Selection::Points),
    }
}

fn rim(text: &str) -> Result<RimChoice, Failure> {
    match text {
        "auto" => Ok(RimChoice::Auto),
        "edge" => Ok(RimChoice::Edge),
        "circle" => Ok(RimChoice::Circle),
        "ellipse" => Ok(RimChoice::Ellipse),
        "round-bar" => Ok(RimChoice::RoundBar),
        _ => Err(usage(format!("--rim {text}: use auto, edge, circle, ellipse or round-bar"))),
    }
}

fn positive(key: &str, value: f64, max: f64) -> Result<f64, Failure> {
    if value.is_finite() && value > 0.0 && value <= max {
        return Ok(value);
    }
    Err(usage(format!("{key} {value}: give a number above 0 and up to {max}")))
}

fn options(args: &PlanArgs) -> Result<PlanOptions, Failure> {
    let mut o = PlanOptions::default();
    o.rim.rim = rim(&args.rim)?;
    if let Some(d) = args.bar_diameter {
        o.rim.bar_diameter = Some(positive("--bar-diameter", d, 1.0)?);
    }
    o.rim.max_sigma_centre = Some(positive("--tolerance-mm", args.tolerance_mm, 1000.0)? * 1e-3);
    o.rim.max_sigma_normal = positive("--tolerance-deg", args.tolerance_deg, 90.0)?.to_radians();
    o.approach.pregrasp_standoff = positive("--pregrasp", args.pregrasp, 2.0)?;
    if !(args.standoff.is_finite() && args.standoff.abs() <= 1.0 && args.standoff < args.pregrasp) {
        return Err(usage(format!("--standoff {}: give metres within 1, less than --pregrasp", args.standoff)));
    }
    o.approach.grasp_standoff = args.standoff;
    Ok(o)
}

fn failure(e: &PlanError) -> Failure {
    if e.is_input() { Failure::input(e.to_string()) } else { Failure::refused(e.to_string()) }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    std::fs::write(path, bytes)
        .map_err(|e| Failure::input(format!("{}: cannot be written ({e}); choose another file", path.display())))
}

/// Runs it.
///
/// # Errors
/// Usage (2), a file or selection that is wrong (3), a rim or grasp that the tests refuse (1). Nothing is written then.
pub fn plan(args: &PlanArgs) -> Result<Exit, Failure> {
    let options = options(args)?;
    let input = |e: graspd_calib::files::FileError| Failure::input(e.to_string());
    let rig = RigFile::load(&args.rig).map_err(input)?;
    let gripper = GripperFile::load(&args.gripper).map_err(input)?;
    let left = Picture::load(&args.left).map_err(input)?;
    let right = Picture::load(&args.right).map_err(input)?;
    let pictures = [&left, &right];
    let need = |text: &Option<String>, key: &str| {
        let text = text.as_ref().ok_or_else(|| usage(format!("{key} is missing: click the contour, or use --auto")))?;
        selection(text, key)
    };
    let made = {
        let l = need(&args.select_left, "--select-left")?;
        let r = need(&args.select_right, "--select-right")?;
        plan_on(pictures, [&l, &r], &rig, &gripper, &options).map_err(|e| failure(&e))?
    };
    finish(args, &made, pictures, &rig, &gripper)
}

fn finish(
    args: &PlanArgs,
    made: &Plan,
    pictures: [&Picture; 2],
    rig: &RigFile,
    gripper: &GripperFile,
) -> Result<Exit, Failure> {
    if let Some(path) = &args.overlay {
        let png = overlay::draw(made, pictures, rig, gripper)
            .ok_or_else(|| Failure::input(format!("{}: the pictures are too large to be drawn", path.display())))?;
        write(path, &png)?;
    }
    if let Some(path) = &args.out {
        write(path, made.text.as_bytes())?;
    }
    if args.json {
        println!("{}", as_json(made)?);
    } else {
        print!("{}", words(made));
    }
    Ok(Exit::Done)
}

/// The plan file as JSON.
fn as_json(made: &Plan) -> Result<Value, Failure> {
    let mut v = serde_json::to_value(&made.file)
        .map_err(|e| Failure::input(format!("the plan cannot be written as JSON ({e})")))?;
    if let Some(map) = v.as_object_mut() {
        map.insert("setpoint".into(), json!(format!("{:016x}", made.set_point.id)));
    }
    Ok(v)
}

fn words(made: &Plan) -> String {
    let o = &made.file.object;
    let mut out = format!(
        "{} of {:.1} x {:.1} mm, centre ({:.1}, {:.1}, {:.1}) mm +- {:.2} mm, normal +- {:.2} degrees\n",
        o.model,
        o.semi_axes_m[0] * 1e3,
        o.semi_axes_m[1] * 1e3,
        o.centre_m[0] * 1e3,
        o.centre_m[1] * 1e3,
        o.centre_m[2] * 1e3,
        o.sigma_centre_mm,
        o.sigma_normal_deg
    );
    for w in &made.file.warnings {
        out.push_str(&format!("! {w}\n"));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selections_as_typed() {
        assert_eq!(selection("1,2", "x").unwrap(), Selection::Click(Pixel::new(1.0, 2.0)));
        assert_eq!(selection("1,2;3,4", "x").unwrap().pixels().len(), 2);
        assert_eq!(selection("1,2,3,4", "x").unwrap().kind(), "box");
        for bad in ["", "1", "1,2,3", "a,b", "1,nan", "1,2;3"] {
            assert_eq!(selection(bad, "x").unwrap_err().exit, Exit::Usage, "{bad}");
        }
    }
}
