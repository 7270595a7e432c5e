//! The complete plane-conic chain on two sets of edge points: fits, cones, closed forms, two-view test, maximum
//! likelihood.
//!
//! [`analyse`] keeps every intermediate result, so that a report can show each step of the paper next to the refined
//! result.

use crate::offline::conic::robust::{self, RobustFit};
use crate::offline::conic::sampson::Cloud;
use crate::offline::conic::{FitError, fit_ml};
use crate::offline::correspondence::tangency::{excess_limit, gaps_with_sigma};
use crate::offline::rim::circle::{ClosedForm, between_cameras, check_depth, check_front, extract};
use crate::offline::rim::cone::{ConePair, check_cameras};
use crate::offline::rim::ml::{MlFit, TwoViews};
use crate::offline::rim::model::{Noise, Options, Rim, RimModel};
use crate::offline::rim::pencil::Pencil;
use crate::offline::rim::plane::{paper, polar};
use crate::offline::rim::refusal::Refusal;
use crate::offline::statistics::median;
use crate::offline::types::EdgePoint;
use crate::offline::types::projection::Projection;
use graspd_rt::geom::View;
use nalgebra::Vector3;

/// Noise below this is rounding of the input, pixels.
const NOISE_FLOOR_PX: f64 = 1e-4;

/// Smallest axis ratio of an ellipse that is nearly a circle.
const NEARLY_ROUND: f64 = 0.97;

/// All results of the plane-conic chain.
#[derive(Clone, Debug)]
pub struct Analysis {
    /// Projection centres, left and right.
    pub centres: [Vector3<f64>; 2],
    /// Ellipse fits in the images with their inliers.
    pub fits: [RobustFit; 2],
    /// The viewing cones.
    pub cones: ConePair,
    /// Their pencil.
    pub pencil: Pencil,
    /// Epipolar tangency gaps, pixels.
    pub gap_px: [f64; 2],
    /// Their predicted standard deviations, pixels.
    pub gap_sigma_px: [f64; 2],
    /// Noise used in the tests, in units of the given sigmas.
    pub noise: f64,
    /// The paper's closed form: eigenvectors, left cone cut.
    pub paper: Result<ClosedForm, Refusal>,
    /// The camera-symmetric closed form, both cones cut.
    pub polar: Result<ClosedForm, Refusal>,
    /// Maximum-likelihood ellipse.
    pub ellipse: Result<MlFit, Refusal>,
    /// Maximum-likelihood circle.
    pub circle: Result<MlFit, Refusal>,
    /// The circle in the plane between the cameras with its chi-squared, where the ellipse in the other plane is not a
    /// circle.
    pub between: Option<(Rim, f64)>,
    /// Two-view excess over the one-view fits, in units of the noise variance.
    pub excess: f64,
    /// Its limit at the gate.
    pub excess_limit: f64,
    /// Whether the contours are two images of one plane rim seen from its face; the error says why not.
    pub verdict: Result<(), Refusal>,
}

impl Analysis {
    /// Any fitted plane rim, the circle first: the outline of a bar is nearly round, and a circle has fewer
    /// parameters.
    pub(crate) fn any_rim(&self) -> Option<Rim> {
        let fits = [&self.circle, &self.ellipse].into_iter().filter_map(|f| f.as_ref().ok()).map(|f| f.rim);
        let closed = [&self.polar, &self.paper].into_iter().filter_map(|f| f.as_ref().ok()).map(|f| f.rim);
        fits.chain(closed).next()
    }

    /// The reason why there is no plane rim.
    pub(crate) fn no_rim(&self) -> Refusal {
        self.verdict.clone().err().or(self.ellipse.clone().err()).unwrap_or(Refusal::NoFit { why: "no model fits" })
    }
}

/// Checks that coordinates are finite and sigmas positive.
pub(crate) fn usable(points: &[EdgePoint]) -> Result<(), Refusal> {
    for p in points {
        if !(p.uv.x.is_finite() && p.uv.y.is_finite()) {
            return Err(Refusal::BadInput { what: "an edge point", why: "a coordinate is not a finite number" });
        }
        if !(p.sigma.is_finite() && p.sigma > 0.0) {
            return Err(Refusal::BadInput { what: "an edge point", why: "its sigma is not a positive number" });
        }
    }
    Ok(())
}

/// Median sigma of a set of points: converts units of sigma to pixels.
pub(crate) fn typical_sigma(points: &[EdgePoint]) -> f64 {
    median(points.iter().map(|p| p.sigma).collect())
}

/// Ellipse fit of one view, with the refusals that concern one view.
fn fit_view(points: &[EdgePoint], view: View, options: &Options) -> Result<RobustFit, Refusal> {
    let fitted = if options.robust {
        robust::fit(points, options.scatter)
    } else {
        fit_ml(points, options.scatter).map(|fit| RobustFit { fit, inliers: vec![true; points.len()] })
    };
    let fitted = fitted.map_err(|e| match e {
        FitError::TooFew(count) => Refusal::TooFewPoints { view, count, needed: 5 },
        FitError::NotFinite => Refusal::BadInput { what: "an edge point", why: "it is not finite" },
        FitError::Collinear => Refusal::Collinear { view },
        FitError::NotAnEllipse => Refusal::NotAnEllipse { view },
        FitError::ArcTooShort(relative) => Refusal::ArcTooShort { view, percent: relative * 100.0 },
    })?;
    let sigma_px = fitted.fit.noise * typical_sigma(points);
    let minor = fitted.fit.ellipse.b;
    if minor < options.min_minor_axis_px {
        return Err(Refusal::EdgeOn { view, minor_px: minor, limit_px: options.min_minor_axis_px });
    }
    // Scatter of a tenth of the minor axis is not the noise of one contour, however large the contour, unless the
    // given sigmas state such noise.
    let stated = if options.noise == Noise::AtLeastGiven { 2.0 * typical_sigma(points) } else { 0.0 };
    let limit_px = options.max_noise_px.min((0.1 * minor).max(stated));
    if !(sigma_px <= limit_px) {
        return Err(Refusal::Scattered { view, sigma_px, limit_px });
    }
    let kept = fitted.inliers.iter().filter(|k| **k).count();
    if kept * 2 < points.len() {
        return Err(Refusal::Scattered { view, sigma_px: f64::INFINITY, limit_px });
    }
    Ok(fitted)
}

/// Runs the chain.
///
/// # Errors
/// A [`Refusal`] when one view alone or the cameras make a result impossible. The result of the two-view test is in
/// [`Analysis::verdict`].
pub fn analyse(points: [&[EdgePoint]; 2], p: [&Projection; 2], options: &Options) -> Result<Analysis, Refusal> {
    usable(points[0])?;
    usable(points[1])?;
    let centres = check_cameras(p[0], p[1])?;
    let fits = [fit_view(points[0], View::Left, options)?, fit_view(points[1], View::Right, options)?];
    let (noise, known) = pooled_noise(&fits, points, options);
    check_testable(&fits, points, noise, known, options)?;
    let cones = ConePair::new([&fits[0].fit.conic, &fits[1].fit.conic], p)?;
    let pencil = Pencil::new(&cones.q[0], &cones.q[1]);
    let (gap_px, gap_sigma_px) = gaps_with_sigma(
        [&fits[0].fit, &fits[1].fit],
        [&cones.p[0], &cones.p[1]],
        [&cones.o[0], &cones.o[1]],
        [noise; 2],
    );
    let paper = paper(&cones, &pencil).and_then(|pair| extract(&cones, pair, false));
    let polar = polar(&cones).and_then(|pair| extract(&cones, pair, true));
    let clouds = [0, 1].map(|k| {
        let e = &fits[k].fit.ellipse;
        Cloud::new(points[k], Some(&fits[k].inliers), e.centre, e.a, options.scatter)
    });
    let views = TwoViews::new(clouds, p);
    let (ellipse, circle) = refine(&views, &paper, &polar, p, &centres);
    let between = between(&views, &ellipse, &polar, &cones, p);
    let single = fits[0].fit.chi2 + fits[1].fit.chi2;
    let two = ellipse.as_ref().or(circle.as_ref()).map_or(f64::INFINITY, |f| f.chi2);
    let excess = ((two - single) / (noise * noise)).max(0.0);
    let dof = views.len().saturating_sub(10).max(1);
    let limit = excess_limit(options.gate_sigmas, if known { None } else { Some(dof) });
    let mut analysis = Analysis {
        centres,
        fits,
        cones,
        pencil,
        gap_px,
        gap_sigma_px,
        noise,
        paper,
        polar,
        ellipse,
        circle,
        between,
        excess,
        excess_limit: limit,
        verdict: Ok(()),
    };
    let calibration = options.calibration_px / typical_sigma(points[0]) / noise;
    analysis.verdict = verdict(&analysis, options, calibration * calibration * views.len() as f64);
    Ok(analysis)
}

/// Pooled noise of both fits (not below rounding, nor below the given sigmas if so requested), and whether it is known
/// rather than estimated.
fn pooled_noise(fits: &[RobustFit; 2], points: [&[EdgePoint]; 2], options: &Options) -> (f64, bool) {
    let dof = (fits[0].fit.count + fits[1].fit.count).saturating_sub(10);
    let estimated = ((fits[0].fit.chi2 + fits[1].fit.chi2) / dof.max(1) as f64).sqrt();
    let floor = NOISE_FLOOR_PX / typical_sigma(points[0]).max(typical_sigma(points[1]));
    match options.noise {
        Noise::AtLeastGiven if estimated <= 1.0 => (1.0, true),
        _ if estimated <= floor => (floor, true),
        _ => (estimated, false),
    }
}

/// Refuses so few points that their own scatter cannot separate a match from chance. With unknown noise, ten residuals
/// beyond the parameters are required; with given sigmas, the scatter must at least agree with them.
fn check_testable(
    fits: &[RobustFit; 2],
    points: [&[EdgePoint]; 2],
    noise: f64,
    known: bool,
    options: &Options,
) -> Result<(), Refusal> {
    let dof = (fits[0].fit.count + fits[1].fit.count).saturating_sub(10);
    if known || dof >= 10 || (options.noise == Noise::AtLeastGiven && noise <= 3.0) {
        return Ok(());
    }
    let k = usize::from(points[1].len() < points[0].len());
    Err(Refusal::TooFewPoints { view: View::BOTH[k], count: points[k].len(), needed: 10 })
}

/// Both maximum-likelihood fits from every closed form, the better minimum of each, then checked for cameras and face.
fn refine(
    views: &TwoViews,
    paper: &Result<ClosedForm, Refusal>,
    polar: &Result<ClosedForm, Refusal>,
    p: [&Projection; 2],
    centres: &[Vector3<f64>; 2],
) -> (Result<MlFit, Refusal>, Result<MlFit, Refusal>) {
    let mut starts: Vec<Rim> = [polar, paper].into_iter().filter_map(|c| c.as_ref().ok()).map(|c| c.rim).collect();
    starts.retain(|r| check_front(r, p, centres).is_ok());
    // The two methods nearly coincide on good data: then one start is enough.
    if let [a, b] = starts[..]
        && (a.centre - b.centre).norm() < 0.05 * a.a
        && a.normal.dot(&b.normal) > 0.99
    {
        starts.truncate(1);
    }
    if starts.is_empty() {
        let why = polar.as_ref().err().or(paper.as_ref().err()).cloned();
        let why = why.unwrap_or(Refusal::OppositeSides { why: "the closed-form rim is behind a camera or faces away" });
        return (Err(why.clone()), Err(why));
    }
    let ellipse = best(views, &starts, RimModel::Ellipse, p, centres);
    let mut round: Vec<Rim> = starts;
    if let Ok(fit) = &ellipse {
        round.insert(0, fit.rim);
        // A start at the ellipse's minimum is enough when the ellipse is nearly a circle.
        if fit.rim.b > NEARLY_ROUND * fit.rim.a {
            round.truncate(1);
        }
    }
    let circle = best(views, &round, RimModel::Circle, p, centres);
    (ellipse, circle)
}

/// The circle in the plane between the cameras. A circle is far less likely by chance than an ellipse: where that
/// plane carries a circle and the plane in front of the cameras does not, they look at opposite faces of a thin
/// object.
fn between(
    views: &TwoViews,
    ellipse: &Result<MlFit, Refusal>,
    polar: &Result<ClosedForm, Refusal>,
    cones: &ConePair,
    p: [&Projection; 2],
) -> Option<(Rim, f64)> {
    if ellipse.as_ref().is_ok_and(|e| e.rim.b > NEARLY_ROUND * e.rim.a) {
        return None;
    }
    let start = between_cameras(cones, &polar.as_ref().ok()?.pair)?;
    if check_depth(&start, p).is_err() || start.b < 0.8 * start.a {
        return None;
    }
    let r = (start.a * start.b).sqrt();
    views.fit(&Rim { a: r, b: r, ..start }, RimModel::Circle).ok().map(|f| (f.rim, f.chi2))
}

/// The lowest admissible minimum over several starts.
fn best(
    views: &TwoViews,
    starts: &[Rim],
    model: RimModel,
    p: [&Projection; 2],
    centres: &[Vector3<f64>; 2],
) -> Result<MlFit, Refusal> {
    let mut found: Result<MlFit, Refusal> = Err(Refusal::NoFit { why: "there is no start" });
    for start in starts {
        let start = if model == RimModel::Circle {
            let r = (start.a * start.b).sqrt();
            Rim { a: r, b: r, ..*start }
        } else {
            *start
        };
        let fit = views.fit(&start, model).and_then(|f| check_front(&f.rim, p, centres).map(|()| f));
        found = match (found, fit) {
            (Ok(old), Ok(new)) => Ok(if new.chi2 < old.chi2 { new } else { old }),
            (Ok(old), Err(_)) => Ok(old),
            (Err(_), new) => new,
        };
    }
    found
}

/// The two-view test. `slack` is the excess that the calibration error of the rig may cause.
fn verdict(a: &Analysis, options: &Options, slack: f64) -> Result<(), Refusal> {
    let mismatch = || {
        Err(Refusal::Mismatch {
            gap_px: a.gap_px,
            gap_sigma_px: a.gap_sigma_px,
            excess: a.excess,
            limit: a.excess_limit,
            delta: a.pencil.delta(),
        })
    };
    let gate = |k: usize| options.gate_sigmas * a.gap_sigma_px[k].hypot(options.calibration_px);
    let gaps_open = (0..2).any(|k| a.gap_px[k].abs() > gate(k));
    if a.ellipse.is_err() && a.circle.is_err() {
        // A wrong pair is the more likely explanation when the tangents disagree, and the one that the operator can
        // correct.
        if gaps_open {
            return mismatch();
        }
        return Err(a.ellipse.clone().err().unwrap_or(Refusal::NoFit { why: "no model fits" }));
    }
    // The excess is exact where the gaps are only linearised (short arcs) or undefined (epipole inside). The gaps are
    // more informative where the rig itself is uncertain, because a calibration error displaces both curves as a
    // whole.
    let excess_open = a.excess > a.excess_limit + slack;
    let gaps_known = a.gap_px.iter().all(|g| g.is_finite());
    let open = if options.calibration_px > 0.0 && gaps_known { gaps_open && excess_open } else { excess_open };
    if open { mismatch() } else { Ok(()) }
}
