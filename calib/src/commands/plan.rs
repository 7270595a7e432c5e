//! `graspd plan` on a rim: two images, a rig and a gripper in; plan, overlay and report out.

use super::progress::Progress;
use super::{Class, Failure, Outcome, counts_from_one, in_range, usage, write_bytes};
use crate::files::{ContentHash, GripperFile, RigFile};
use crate::offline::contour::select::Selection;
use crate::offline::decide::propose::Proposal;
use crate::offline::drawing::{overlay, report};
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::handle::grasp::Approach;
use crate::offline::plan::{Plan, PlanError, PlanOptions, Prepared, model_name};
use crate::offline::rim::model::RimChoice;
use graspd_rt::geom::{Pixel, Pose};
use serde_json::{Value, json};
use std::path::PathBuf;

/// Most proposals that `--auto` lists.
const MAX_PROPOSALS: usize = 12;

/// Files and options of `graspd plan`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlanRequest {
    /// Left image.
    pub left: PathBuf,
    /// Right image.
    pub right: PathBuf,
    /// Rig file.
    pub rig: PathBuf,
    /// Gripper file.
    pub gripper: PathBuf,
    /// Left selection: "U,V", "U,V;U,V;..." or "U0,V0,U1,V1", pixels.
    pub select_left: Option<String>,
    /// Right selection.
    pub select_right: Option<String>,
    /// Propose rims instead of using selections.
    pub auto: bool,
    /// Plan on this proposal, counted from 1.
    pub pick: Option<usize>,
    /// "auto", "edge", "circle", "ellipse" or "round-bar"; empty means "auto".
    pub rim: String,
    /// Known diameter of the bar, metres.
    pub bar_diameter: Option<f64>,
    /// Distance of the pre-grasp from the rim's plane, metres.
    pub pregrasp: Option<f64>,
    /// Distance of the grasp from the rim's plane, metres.
    pub standoff: Option<f64>,
    /// Largest accepted standard deviation of the centre, millimetres.
    pub tolerance_mm: Option<f64>,
    /// Largest accepted standard deviation of the normal, degrees.
    pub tolerance_deg: Option<f64>,
    /// Allowance for the rig's calibration error in the two-view test, pixels.
    pub calibration_px: Option<f64>,
    /// Present pose `left_from_gripper`, if known.
    pub present: Option<Pose>,
    /// Largest rotation from the present pose, radians.
    pub max_turn: Option<f64>,
    /// Path of the plan.
    pub out: Option<PathBuf>,
    /// Path of the overlay, a PNG image.
    pub overlay: Option<PathBuf>,
    /// Path of the report, an HTML page.
    pub report: Option<PathBuf>,
}

/// Runs `graspd plan`.
pub fn run(request: &PlanRequest) -> Outcome {
    plan(request).unwrap_or_else(Outcome::from)
}

impl From<PlanError> for Failure {
    fn from(e: PlanError) -> Self {
        let class = if e.is_input() { Class::Input } else { Class::Refused };
        Self { class, kind: e.kind(), reason: e.to_string() }
    }
}

/// Parses a selection given on the command line.
///
/// # Errors
/// One sentence with the accepted forms.
pub fn parse_selection(text: &str) -> Result<Selection, String> {
    let invalid =
        || format!("the selection \"{text}\" is invalid: give \"U,V\", \"U,V;U,V;...\" or \"U0,V0,U1,V1\" in pixels");
    let numbers = |part: &str| -> Option<Vec<f64>> {
        part.split(',').map(|n| n.trim().parse::<f64>().ok().filter(|v| v.is_finite())).collect()
    };
    let parts: Vec<Vec<f64>> =
        text.split(';').filter(|p| !p.trim().is_empty()).map(numbers).collect::<Option<_>>().ok_or_else(invalid)?;
    match parts.as_slice() {
        [one] => match one.as_slice() {
            [u, v] => Ok(Selection::Click(Pixel::new(*u, *v))),
            [a, b, c, d] => Ok(Selection::Box(Pixel::new(*a, *b), Pixel::new(*c, *d))),
            _ => Err(invalid()),
        },
        [] => Err(invalid()),
        many => many
            .iter()
            .map(|p| match p.as_slice() {
                [u, v] => Ok(Pixel::new(*u, *v)),
                _ => Err(invalid()),
            })
            .collect::<Result<Vec<_>, _>>()
            .map(Selection::Points),
    }
}

fn options(r: &PlanRequest) -> Result<PlanOptions, Failure> {
    let mut o = PlanOptions::default();
    o.rim.rim = match r.rim.as_str() {
        "" | "auto" => RimChoice::Auto,
        "edge" => RimChoice::Edge,
        "circle" => RimChoice::Circle,
        "ellipse" => RimChoice::Ellipse,
        "round-bar" => RimChoice::RoundBar,
        other => return Err(usage(format!("--rim {other}: give auto, edge, circle, ellipse or round-bar"))),
    };
    o.rim.bar_diameter = in_range("bar-diameter", r.bar_diameter, 1e-4, 1.0)?;
    let defaults = Approach::default();
    o.approach.pregrasp_standoff = in_range("pregrasp", r.pregrasp, 0.0, 5.0)?.unwrap_or(defaults.pregrasp_standoff);
    o.approach.grasp_standoff = in_range("standoff", r.standoff, -1.0, 5.0)?.unwrap_or(defaults.grasp_standoff);
    if o.approach.pregrasp_standoff < o.approach.grasp_standoff {
        return Err(usage(format!(
            "--pregrasp {} is nearer to the object than --standoff {}: give a pre-grasp in front of the grasp",
            o.approach.pregrasp_standoff, o.approach.grasp_standoff
        )));
    }
    o.rim.max_sigma_centre = in_range("tolerance-mm", r.tolerance_mm, 1e-3, 1e3)?.map(|v| v * 1e-3);
    if let Some(deg) = in_range("tolerance-deg", r.tolerance_deg, 1e-3, 45.0)? {
        o.rim.max_sigma_normal = deg.to_radians();
    }
    if let Some(px) = in_range("calibration-px", r.calibration_px, 0.0, 20.0)? {
        o.calibration_px = Some(px);
    }
    o.approach.present = r.present;
    o.approach.max_turn = r.max_turn;
    Ok(o)
}

/// What `--select-*`, `--auto` and `--pick` ask for.
enum Target {
    /// The contour selected in each view.
    Selected([Selection; 2]),
    /// A list of proposals.
    Proposals,
    /// The proposal of this number, counted from 1.
    Proposal(usize),
}

fn target(r: &PlanRequest) -> Result<Target, Failure> {
    if !r.auto && (r.select_left.is_none() || r.select_right.is_none()) {
        return Err(usage(
            "no contour is selected: give --select-left U,V and --select-right U,V, or --auto for proposals",
        ));
    }
    counts_from_one("pick", r.pick)?;
    let select = |s: &Option<String>| s.as_deref().map(parse_selection).transpose().map_err(usage);
    Ok(match (select(&r.select_left)?, select(&r.select_right)?, r.pick) {
        (Some(left), Some(right), _) if !r.auto => Target::Selected([left, right]),
        (_, _, Some(number)) => Target::Proposal(number),
        _ => Target::Proposals,
    })
}

fn plan(r: &PlanRequest) -> Result<Outcome, Failure> {
    let options = options(r)?;
    let target = target(r)?;
    let rig = RigFile::load(&r.rig)?;
    let gripper = GripperFile::load(&r.gripper)?;
    let images = [GreyImage::load(&r.left)?, GreyImage::load(&r.right)?];
    let images = [&images[0], &images[1]];
    if images[0] == images[1] {
        let reason =
            format!("{} and {} are the same image: give one image of each camera", r.left.display(), r.right.display());
        return Err(Failure { class: Class::Input, kind: "same-image", reason });
    }
    let views = Prepared::with_prior(images, &rig, &options.prior(&rig))?;
    let planned = match target {
        Target::Selected([left, right]) => views.plan([&left, &right], &gripper, &options)?,
        Target::Proposals => {
            let found = proposals(&views, &options)?;
            if let Some(path) = &r.overlay {
                write_bytes(path, overlay::draw_proposals(&found, images, &rig).as_deref())?;
            }
            return Ok(list(&found));
        }
        Target::Proposal(number) => {
            let found = proposals(&views, &options)?;
            let count = found.len();
            let chosen = found
                .get(number - 1)
                .ok_or_else(|| usage(format!("--pick {number}: there are {count} proposals; give 1 to {count}")))?;
            views.plan_proposal(chosen, &gripper, &options)?
        }
    };
    if let Some(path) = &r.out {
        planned.file.save(path)?;
    }
    if r.overlay.is_some() || r.report.is_some() {
        let drawn = overlay::draw(&planned, images, &rig, &gripper);
        if let Some(path) = &r.overlay {
            write_bytes(path, drawn.as_deref())?;
        }
        if let Some(path) = &r.report {
            write_bytes(path, Some(report::html(&planned, drawn.as_deref()).as_bytes()))?;
        }
    }
    Ok(outcome(&planned))
}

fn proposals(views: &Prepared<'_>, options: &PlanOptions) -> Result<Vec<Proposal>, Failure> {
    let mut progress = Progress::new("searching for rims");
    let found = views.proposals(options, MAX_PROPOSALS, &mut |fraction| progress.at(fraction))?;
    if found.is_empty() {
        return Err(Failure {
            class: Class::Refused,
            kind: "no-proposal",
            reason: "no ellipse of the left view matches one of the right view: select the contour with --select-left \
                     and --select-right"
                .to_owned(),
        });
    }
    Ok(found)
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
    text += "plan on one of them with --auto --pick N";
    Outcome { class: Class::Done, text, json: json!({ "status": "ok", "proposals": rows }) }
}

fn outcome(p: &Plan) -> Outcome {
    let o = &p.file.object;
    let r = &p.reconstruction;
    let seen = p.set_point.grasp.marks.map(|m| m.iter().flatten().count());
    let c = r.rim.centre * 1e3;
    let mut text = format!(
        "{} of {:.2} x {:.2} mm at ({:.1}, {:.1}, {:.1}) mm, sigma {:.2} mm and {:.2} degrees\n\
         {} handle, jaws {:.1} mm, marks visible: {} left, {} right; best view {}",
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
    let json = json!({
        "status": "ok", "set_point": format!("{:016x}", hash.short()), "plan_sha256": hash.to_string(),
        "axis_ratio": r.rim.b / r.rim.a, "plan": plan,
    });
    Outcome { class: Class::Done, text, json }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selections_have_three_forms() {
        assert_eq!(parse_selection("12.5,40"), Ok(Selection::Click(Pixel::new(12.5, 40.0))));
        assert_eq!(parse_selection("1,2,3,4"), Ok(Selection::Box(Pixel::new(1.0, 2.0), Pixel::new(3.0, 4.0))));
        assert!(matches!(parse_selection("1,2;3,4; 5,6"), Ok(Selection::Points(p)) if p.len() == 3));
        for bad in ["", "1", "1,2,3", "a,b", "nan,1", "1,2;3", "inf,inf"] {
            assert!(parse_selection(bad).is_err(), "{bad}");
        }
    }
}
