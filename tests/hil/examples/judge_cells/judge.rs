//! One question to the off-line stage and the verdict on its answer.

use crate::cell::{Cell, Click, Kind, RigError, TrueRim};
use crate::reference::{Shape, best_fit, loop_ends};
use graspd_calib::files::RigFile;
use graspd_calib::offline::contour::select::Selection;
use graspd_calib::offline::plan::{Plan, PlanError, PlanOptions, Prepared};
use graspd_calib::offline::rim::circle::frame_of;
use graspd_calib::offline::rim::model::{Reconstruction, RimChoice, RimModel};
use graspd_hil::scenario::Truth;
use graspd_rt::geom::{Pixel, Rig};
use nalgebra::{Matrix5, Vector2, Vector5};
use rustix::time::{ClockId, clock_gettime};
use serde::Serialize;

/// Largest error of the centre above the error floor of the rig, millimetres.
const MAX_CENTRE_MM: f64 = 1.0;
/// Largest error of the normal above the error floor of the rig, degrees.
const MAX_NORMAL_DEG: f64 = 0.5;
/// Largest error of a bar's radius above the error floor of the rig, millimetres.
const MAX_BAR_MM: f64 = 1.0;
/// 99.9 % quantile of chi-squared with 5 degrees of freedom: centre and normal.
const REGION_999: f64 = 20.515;
/// 95 % quantile of chi-squared with 3 degrees of freedom: centre.
pub const CENTRE_95: f64 = 7.815;
/// 95 % quantile of chi-squared with 2 degrees of freedom: normal.
pub const NORMAL_95: f64 = 5.991;

/// The operator's rim option.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RimAsk {
    /// No option.
    Auto,
    /// A plane edge.
    Edge,
    /// A round bar.
    RoundBar,
    /// A round bar of this diameter (the true one).
    #[value(name = "round-bar+d")]
    #[serde(rename = "round-bar+d")]
    RoundBarOfDiameter,
}

/// The task's tolerance (one sigma) and the rig's stated calibration error, as on the command line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Asked {
    /// Tolerance of the centre, millimetres.
    pub tolerance_mm: f64,
    /// Tolerance of the normal, degrees.
    pub tolerance_deg: f64,
    /// Stated calibration error, pixels; `None` for the default.
    pub calibration_px: Option<f64>,
}

impl Default for Asked {
    fn default() -> Self {
        Self { tolerance_mm: 2.0, tolerance_deg: 1.0, calibration_px: None }
    }
}

/// One cell's answer to one question.
#[derive(Clone, Debug, Serialize)]
pub struct Answer {
    /// Kind of the cell.
    pub kind: Kind,
    /// Its seed.
    pub seed: u64,
    /// Error of the given rig.
    pub rig_error: String,
    /// Place of the click.
    pub click: Click,
    /// Rim option.
    pub rim: RimAsk,
    /// Processor time of one thread from the images to the answer, milliseconds.
    pub ms: f64,
    /// The answer.
    pub outcome: Outcome,
}

/// The result of a question.
#[derive(Clone, Debug, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// No plan.
    Refused {
        /// Variant of the refusal.
        kind: String,
        /// Its text.
        text: String,
    },
    /// A plan.
    Planned(Measured),
}

/// A plan compared with ground truth.
#[derive(Clone, Debug, Serialize)]
pub struct Measured {
    /// Reasons for which it is wrong; empty for a correct answer.
    pub wrong: Vec<&'static str>,
    /// Whether it is the rim that the click selects, or another one next to it.
    pub meant: bool,
    /// "circle", "ellipse" or "round bar".
    pub model: String,
    /// Error of centre, millimetres, and normal, degrees.
    pub error: [f64; 2],
    /// Error floor due to the rig.
    pub floor: [f64; 2],
    /// Stated standard deviations.
    pub sigma: [f64; 2],
    /// Squared Mahalanobis distance of ground truth: centre, normal, both together.
    pub distance: [f64; 3],
    /// Error of the bar's radius, millimetres.
    pub bar_mm: Option<f64>,
    /// Error of a converged servo loop: millimetres from the rim's centre, degrees from its axis.
    pub loop_error: Option<[f64; 2]>,
    /// Stated chi-squared per degree of freedom.
    pub chi2_per_dof: f64,
}

/// A true rim and the error floor of a rig for it.
struct Target<'a> {
    rim: &'a TrueRim,
    /// Centre (mm), normal (degrees), bar (mm).
    floor: [f64; 3],
}

impl<'a> Target<'a> {
    fn new(rim: &'a TrueRim, given: &Rig) -> Option<Self> {
        let fit = best_fit(&rim.shape, &rim.pixels, given)?;
        let (a, b): (&Shape, &Shape) = (&rim.shape, &fit);
        let bar = a.bar.zip(b.bar).map_or(0.0, |(a, b)| (a - b).abs() * 1e3);
        let turned = a.normal.cross(&b.normal).norm().atan2(a.normal.dot(&b.normal));
        Some(Self { rim, floor: [(a.centre - b.centre).norm() * 1e3, turned.to_degrees(), bar] })
    }
}

/// Asks a cell every question and judges the answers.
pub fn judge(
    cell: &Cell,
    errors: &[RigError],
    clicks: &[Click],
    rims: &[RimAsk],
    asked: &Asked,
) -> Result<Vec<Answer>, String> {
    let mut out = Vec::new();
    for error in errors {
        let given = cell.given(error)?;
        let file = RigFile::new(given);
        let target = |rim| Target::new(rim, &given).ok_or("no reference fit to exact edges");
        let paint = cell.paint.as_ref().map(target).transpose()?;
        let bar = cell.bar.as_ref().map(target).transpose()?;
        let before = processor_ms();
        let prepared = Prepared::with_prior(
            [&cell.images[0], &cell.images[1]],
            &file,
            &PlanOptions { calibration_px: asked.calibration_px, ..PlanOptions::default() }.prior(&file),
        )
        .map_err(|e| e.to_string())?;
        prepared.order();
        let preparing = processor_ms() - before;
        for &click in clicks {
            let Some(at) = cell.click(click) else { continue };
            for &rim in rims {
                let Some(options) = options(cell, rim, asked) else { continue };
                let before = processor_ms();
                let answer = ask(&prepared, at, cell, &options);
                let ms = preparing + processor_ms() - before;
                let outcome = match answer {
                    Ok(p) => Outcome::Planned(measure(cell, &p, click, paint.as_ref(), bar.as_ref())?),
                    Err(e) => Outcome::Refused { kind: refusal(&e), text: e.to_string() },
                };
                let rig_error = error.to_string();
                out.push(Answer { kind: cell.kind, seed: cell.seed, rig_error, click, rim, ms, outcome });
            }
        }
    }
    Ok(out)
}

fn ask(prepared: &Prepared<'_>, at: [Pixel; 2], cell: &Cell, options: &PlanOptions) -> Result<Plan, PlanError> {
    let [l, r] = at.map(Selection::Click);
    prepared.plan([&l, &r], &cell.gripper, options)
}

/// Plan options of a question; `None` for the diameter of a bar that does not exist.
fn options(cell: &Cell, rim: RimAsk, asked: &Asked) -> Option<PlanOptions> {
    let mut o = PlanOptions::default();
    o.rim.rim = match rim {
        RimAsk::Auto => RimChoice::Auto,
        RimAsk::Edge => RimChoice::Edge,
        RimAsk::RoundBar | RimAsk::RoundBarOfDiameter => RimChoice::RoundBar,
    };
    if rim == RimAsk::RoundBarOfDiameter {
        o.rim.bar_diameter = Some(2.0 * cell.bar.as_ref()?.shape.bar?);
    }
    o.rim.max_sigma_centre = Some(asked.tolerance_mm * 1e-3);
    o.rim.max_sigma_normal = asked.tolerance_deg.to_radians();
    if let Some(px) = asked.calibration_px {
        o.calibration_px = Some(px);
    }
    Some(o)
}

fn processor_ms() -> f64 {
    let t = clock_gettime(ClockId::ThreadCPUTime);
    t.tv_sec as f64 * 1e3 + t.tv_nsec as f64 * 1e-6
}

/// Variant names of a refusal, for example `Rim/Unlike`.
fn refusal(e: &PlanError) -> String {
    let debug = format!("{e:?}");
    debug.split([' ', '{']).next().unwrap_or_default().replace('(', "/").replace(')', "")
}

/// Compares a plan with the rims that the click could select: a bar with the bar, a plane edge clicked on paint with
/// the paint, a plane edge clicked on a silhouette with the nearer one of both.
fn measure(
    cell: &Cell,
    p: &Plan,
    click: Click,
    paint: Option<&Target<'_>>,
    bar: Option<&Target<'_>>,
) -> Result<Measured, String> {
    let r = &p.reconstruction;
    let is_bar = r.model == RimModel::RoundBar;
    let candidates: Vec<&Target<'_>> = match (is_bar, click) {
        (true, _) if bar.is_some() => bar.into_iter().collect(),
        (_, Click::Paint) => paint.into_iter().collect(),
        _ => bar.into_iter().chain(paint).collect(),
    };
    let far = |t: &Target<'_>| {
        let [c, n] = error(r, &t.rim.shape);
        (c / (MAX_CENTRE_MM + t.floor[0])).max(n / (MAX_NORMAL_DEG + t.floor[1]))
    };
    let best = candidates.into_iter().min_by(|a, b| far(a).total_cmp(&far(b))).ok_or("no true rim to compare with")?;
    let truth = &best.rim.shape;
    let error = error(r, truth);
    let distance = distances(r, truth);
    let bar_mm = r.bar_radius.map(|b| (b - truth.bar.unwrap_or(0.0)).abs() * 1e3);
    let mut wrong = Vec::new();
    // `!(<=)` instead of `>`: the distance is NaN if the covariance has no inverse.
    if !(distance[2] <= REGION_999) {
        wrong.push("region");
    }
    if !(error[0] <= MAX_CENTRE_MM + best.floor[0]) {
        wrong.push("centre");
    }
    if !(error[1] <= MAX_NORMAL_DEG + best.floor[1]) {
        wrong.push("normal");
    }
    if bar_mm.is_some_and(|b| !(b <= MAX_BAR_MM + best.floor[2])) {
        wrong.push("bar");
    }
    let end = loop_ends(&p.set_point.grasp, &cell.gripper.gripper, &cell.true_rig);
    let loop_error = end.map(|left_from_gripper| {
        let t = Truth::of(&(truth.pose().inverse() * left_from_gripper), 0.0);
        [t.position_error_mm, t.orientation_error_deg]
    });
    Ok(Measured {
        wrong,
        meant: (click == Click::Paint) != truth.bar.is_some(),
        model: p.file.object.model.clone(),
        error,
        floor: [best.floor[0], best.floor[1]],
        sigma: [p.file.object.sigma_centre_mm, p.file.object.sigma_normal_deg],
        distance,
        bar_mm,
        loop_error,
        chi2_per_dof: p.file.object.chi2_per_dof,
    })
}

/// Errors of centre (mm) and normal (degrees).
fn error(r: &Reconstruction, truth: &Shape) -> [f64; 2] {
    let n = &r.rim.normal;
    let turned = n.cross(&truth.normal).norm().atan2(n.dot(&truth.normal));
    [(r.rim.centre - truth.centre).norm() * 1e3, turned.to_degrees()]
}

/// Squared Mahalanobis distances of ground truth: centre, normal, both.
fn distances(r: &Reconstruction, truth: &Shape) -> [f64; 3] {
    let c = truth.centre - r.rim.centre;
    let f = frame_of(&r.rim.normal);
    let n = Vector2::new(truth.normal.dot(&f.column(0)), truth.normal.dot(&f.column(1)));
    let mut both = Matrix5::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(&r.cov_centre);
    both.fixed_view_mut::<3, 2>(0, 3).copy_from(&r.cov_centre_normal);
    both.fixed_view_mut::<2, 3>(3, 0).copy_from(&r.cov_centre_normal.transpose());
    both.fixed_view_mut::<2, 2>(3, 3).copy_from(&r.cov_normal);
    // Metres and radians have similar magnitudes here; only a positive definite matrix is a covariance.
    let x = Vector5::new(c.x, c.y, c.z, n.x, n.y);
    let of_both = both.cholesky().map_or(f64::NAN, |l| x.dot(&l.solve(&x)));
    let of_centre = r.cov_centre.cholesky().map_or(f64::NAN, |l| c.dot(&l.solve(&c)));
    let of_normal = r.cov_normal.cholesky().map_or(f64::NAN, |l| n.dot(&l.solve(&n)));
    [of_centre, of_normal, of_both]
}
