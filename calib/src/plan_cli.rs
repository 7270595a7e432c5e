//! `graspd plan` without the command line: paths and options in, files and figures out, every failure in words.

use crate::files::{ContentHash, FileError, GripperFile, RigFile};
use crate::offline::contour::select::Selection;
use crate::offline::decide::propose::Proposal;
use crate::offline::drawing::overlay;
use crate::offline::drawing::report;
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::handle::grasp::Approach;
use crate::offline::plan::{Plan, PlanError, PlanOptions, Prepared, model_name};
use crate::offline::rim::model::RimChoice;
use crate::progress::Progress;
use graspd_rt::geom::{Pixel, Pose};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Proposals listed by `--auto`.
const MOST_PROPOSALS: usize = 12;

/// What the command line says.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Request {
    /// Left image.
    pub left: PathBuf,
    /// Right image.
    pub right: PathBuf,
    /// Rig file.
    pub rig: PathBuf,
    /// Gripper file.
    pub gripper: PathBuf,
    /// Left selection: "U,V", "U,V;U,V;..." or "U0,V0,U1,V1".
    pub select_left: Option<String>,
    /// Right selection.
    pub select_right: Option<String>,
    /// Propose ellipses instead.
    pub auto: bool,
    /// Plan for this proposal, counted from 1.
    pub pick: Option<usize>,
    /// "auto", "edge", "circle", "ellipse" or "round-bar".
    pub rim: String,
    /// Known diameter of the bar, metres.
    pub bar_diameter: Option<f64>,
    /// Distance of the pre-grasp from the object's plane, metres.
    pub pregrasp: Option<f64>,
    /// Distance of the grasp from the object's plane, metres.
    pub standoff: Option<f64>,
    /// Largest acceptable standard deviation of the centre, millimetres.
    pub tolerance_mm: Option<f64>,
    /// Largest acceptable standard deviation of the normal, degrees.
    pub tolerance_deg: Option<f64>,
    /// Allowance for the rig's calibration error in the two-view test, pixels.
    pub calibration_px: Option<f64>,
    /// Where the gripper is now in the left camera's frame, if known.
    pub present: Option<Pose>,
    /// Largest turn from there, radians.
    pub max_turn: Option<f64>,
    /// Where to write the plan.
    pub out: Option<PathBuf>,
    /// Where to write the image.
    pub overlay: Option<PathBuf>,
    /// Where to write the report.
    pub report: Option<PathBuf>,
}

/// How it went; the daemon's exit codes follow from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Done (exit code 0).
    Done,
    /// The input is good, but the tests refuse the rim or the grasp (exit code 1).
    Refused,
    /// An option makes no sense (exit code 2).
    Usage,
    /// A file, image or selection is wrong (exit code 3).
    Input,
}

/// What to print, and how it went.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// How it went.
    pub class: Class,
    /// For people: the figures, or one clear sentence of what is wrong and what to do.
    pub text: String,
    /// For machines.
    pub json: Value,
}

/// Runs `graspd plan`.
pub fn run(request: &Request) -> Outcome {
    match work(request) {
        Ok(outcome) => outcome,
        Err((class, kind, text)) => {
            let json = json!({ "status": "error", "kind": kind, "reason": text });
            Outcome { class, text, json }
        }
    }
}

type Failure = (Class, &'static str, String);

fn usage(text: String) -> Failure {
    (Class::Usage, "usage", text)
}

fn failed(e: &PlanError) -> Failure {
    (if e.is_input() { Class::Input } else { Class::Refused }, e.kind(), e.to_string())
}

fn file(e: FileError) -> Failure {
    failed(&PlanError::File(e))
}

/// Reads a selection as it stands on the command line.
pub fn parse_selection(text: &str) -> Result<Selection, String> {
    let wrong =
        || format!("the selection \"{text}\" is neither \"U,V\" nor \"U,V;U,V;...\" nor \"U0,V0,U1,V1\" (pixels)");
    let numbers = |part: &str| -> Option<Vec<f64>> {
        part.split(',').map(|n| n.trim().parse::<f64>().ok().filter(|v| v.is_finite())).collect()
    };
    let parts: Vec<Vec<f64>> =
        text.split(';').filter(|p| !p.trim().is_empty()).map(numbers).collect::<Option<_>>().ok_or_else(wrong)?;
    match parts.as_slice() {
        [one] => match one.as_slice() {
            [u, v] => Ok(Selection::Click(Pixel::new(*u, *v))),
            [a, b, c, d] => Ok(Selection::Box(Pixel::new(*a, *b), Pixel::new(*c, *d))),
            _ => Err(wrong()),
        },
        [] => Err(wrong()),
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

fn options(r: &Request) -> Result<PlanOptions, Failure> {
    let mut o = PlanOptions::default();
    o.rim.rim = match r.rim.as_str() {
        "" | "auto" => RimChoice::Auto,
        "edge" => RimChoice::Edge,
        "circle" => RimChoice::Circle,
        "ellipse" => RimChoice::Ellipse,
        "round-bar" => RimChoice::RoundBar,
        other => return Err(usage(format!("--rim {other}: give auto, edge, circle, ellipse or round-bar"))),
    };
    let checked = |name: &str, v: Option<f64>, lo: f64, hi: f64| match v {
        Some(v) if !(v >= lo && v <= hi) => Err(usage(format!("--{name} {v}: give a number between {lo} and {hi}"))),
        v => Ok(v),
    };
    o.rim.bar_diameter = checked("bar-diameter", r.bar_diameter, 1e-4, 1.0)?;
    let defaults = Approach::default();
    o.approach.pregrasp_standoff = checked("pregrasp", r.pregrasp, 0.0, 5.0)?.unwrap_or(defaults.pregrasp_standoff);
    o.approach.grasp_standoff = checked("standoff", r.standoff, -1.0, 5.0)?.unwrap_or(defaults.grasp_standoff);
    if o.approach.pregrasp_standoff < o.approach.grasp_standoff {
        return Err(usage(
            "--pregrasp lies nearer than --standoff: the pre-grasp comes first, in front of the grasp".to_owned(),
        ));
    }
    o.rim.max_sigma_centre = checked("tolerance-mm", r.tolerance_mm, 1e-3, 1e3)?.map(|v| v * 1e-3);
    if let Some(deg) = checked("tolerance-deg", r.tolerance_deg, 1e-3, 45.0)? {
        o.rim.max_sigma_normal = deg.to_radians();
    }
    if let Some(px) = checked("calibration-px", r.calibration_px, 0.0, 20.0)? {
        o.calibration_px = Some(px);
    }
    o.approach.present = r.present;
    o.approach.max_turn = r.max_turn;
    Ok(o)
}

fn work(r: &Request) -> Result<Outcome, Failure> {
    let options = options(r)?;
    if !r.auto && (r.select_left.is_none() || r.select_right.is_none()) {
        return Err(usage("select the contour in both images with --select-left U,V and --select-right U,V, or let --auto propose some".to_owned()));
    }
    if r.pick == Some(0) {
        return Err(usage("--pick counts from 1".to_owned()));
    }
    let select = |s: &Option<String>| s.as_deref().map(parse_selection).transpose().map_err(usage);
    let (left, right) = (select(&r.select_left)?, select(&r.select_right)?);
    let rig = RigFile::load(&r.rig).map_err(file)?;
    let gripper = GripperFile::load(&r.gripper).map_err(file)?;
    let images = [GreyImage::load(&r.left).map_err(file)?, GreyImage::load(&r.right).map_err(file)?];
    let images = [&images[0], &images[1]];
    if images[0] == images[1] {
        return Err((
            Class::Input,
            "same-image",
            format!("{} and {} are the same image: give one of each camera", r.left.display(), r.right.display()),
        ));
    }
    let views = Prepared::with_prior(images, &rig, &options.prior(&rig)).map_err(|e| failed(&e))?;
    let done = match (left, right) {
        (Some(l), Some(s)) if !r.auto => views.plan([&l, &s], &gripper, &options).map_err(|e| failed(&e))?,
        _ => {
            let mut progress = Progress::new("looking for rims");
            let found = views.proposals(&options, MOST_PROPOSALS, &mut |part| progress.at(part));
            drop(progress);
            let found = found.map_err(|e| failed(&e))?;
            if found.is_empty() {
                return Err((
                    Class::Refused,
                    "no-proposal",
                    "no ellipse of one view fits one of the other: select the contour by hand with --select-left and --select-right".to_owned(),
                ));
            }
            let Some(pick) = r.pick else {
                if let Some(path) = &r.overlay {
                    write_bytes(path, overlay::draw_proposals(&found, images, &rig))?;
                }
                return Ok(list(&found));
            };
            let Some(chosen) = found.get(pick - 1) else {
                return Err(usage(format!("--pick {pick}: there are {} proposals", found.len())));
            };
            views.plan_proposal(chosen, &gripper, &options).map_err(|e| failed(&e))?
        }
    };
    if let Some(path) = &r.out {
        done.file.save(path).map_err(file)?;
    }
    let drawn =
        if r.overlay.is_some() || r.report.is_some() { overlay::draw(&done, images, &rig, &gripper) } else { None };
    if let Some(path) = &r.overlay {
        write_bytes(path, drawn.clone())?;
    }
    if let Some(path) = &r.report {
        write_bytes(path, Some(report::html(&done, drawn.as_deref()).into_bytes()))?;
    }
    Ok(outcome(&done))
}

fn write_bytes(path: &Path, bytes: Option<Vec<u8>>) -> Result<(), Failure> {
    let refuse = |reason: String| file(FileError::Write { path: path.display().to_string(), reason });
    let bytes = bytes.ok_or_else(|| refuse("the drawing is too large".to_owned()))?;
    std::fs::write(path, bytes).map_err(|e| refuse(e.to_string()))
}

fn list(found: &[Proposal]) -> Outcome {
    let mut text = String::from("  N  model    radius mm  centre mm                    axis ratio  on the rim\n");
    let mut rows = Vec::new();
    for (k, p) in found.iter().enumerate() {
        let r = &p.reconstruction;
        let c = r.rim.centre * 1e3;
        let coverage = p.contours.iter().map(|c| c.coverage).fold(1.0, f64::min);
        text += &format!(
            "{:>3}  {:<8} {:>8.1}  ({:>7.1}, {:>7.1}, {:>7.1})  {:>9.3}  {:>6.0} %\n",
            k + 1,
            model_name(r.model),
            r.rim.a * 1e3,
            c.x,
            c.y,
            c.z,
            r.rim.b / r.rim.a,
            100.0 * coverage
        );
        rows.push(json!({
            "number": k + 1, "model": model_name(r.model), "centre_m": [r.rim.centre.x, r.rim.centre.y, r.rim.centre.z],
            "normal": [r.rim.normal.x, r.rim.normal.y, r.rim.normal.z], "semi_axes_m": [r.rim.a, r.rim.b],
            "coverage": coverage, "score": p.score,
        }));
    }
    text += "plan for one of them with --auto --pick N";
    Outcome { class: Class::Done, text, json: json!({ "status": "ok", "proposals": rows }) }
}

fn outcome(p: &Plan) -> Outcome {
    let o = &p.file.object;
    let r = &p.reconstruction;
    let seen = p.set_point.grasp.marks.map(|m| m.iter().flatten().count());
    let c = r.rim.centre * 1e3;
    let mut text = format!(
        "{} of {:.2} x {:.2} mm at ({:.1}, {:.1}, {:.1}) mm, sigma {:.2} mm and {:.2} degrees\n{} handle, jaws {:.1} mm, {} marks seen left and {} right, best view {}",
        o.model,
        r.rim.a * 1e3,
        r.rim.b * 1e3,
        c.x,
        c.y,
        c.z,
        o.sigma_centre_mm,
        o.sigma_normal_deg,
        p.file.handle,
        p.file.opening_m * 1e3,
        seen[0],
        seen[1],
        p.file.best_view
    );
    for w in &p.file.warnings {
        text += &format!("\nnote: {w}");
    }
    let plan = serde_json::to_value(&p.file).unwrap_or(Value::Null);
    let hash = ContentHash::of(p.text.as_bytes());
    let json = json!({ "status": "ok", "set_point": format!("{:016x}", hash.short()), "plan_sha256": hash.to_string(), "axis_ratio": r.rim.b / r.rim.a, "plan": plan });
    Outcome { class: Class::Done, text, json }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selections_are_read_as_the_help_says() {
        assert_eq!(parse_selection("12.5,40"), Ok(Selection::Click(Pixel::new(12.5, 40.0))));
        assert_eq!(parse_selection("1,2,3,4"), Ok(Selection::Box(Pixel::new(1.0, 2.0), Pixel::new(3.0, 4.0))));
        assert!(matches!(parse_selection("1,2;3,4; 5,6"), Ok(Selection::Points(p)) if p.len() == 3));
        for bad in ["", "1", "1,2,3", "a,b", "nan,1", "1,2;3", "inf,inf"] {
            assert!(parse_selection(bad).is_err(), "{bad}");
        }
    }
}
