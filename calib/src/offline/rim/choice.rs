//! The choice between circle and ellipse, the task's tolerance, and the report of a plane rim.

use crate::offline::conic::sampson::distance;
use crate::offline::rim::circle::vergence;
use crate::offline::rim::ml::{MlFit, image_conic};
use crate::offline::rim::model::{Noise, Options, Reconstruction, Report, RimChoice, RimModel, Score};
use crate::offline::rim::planar::Analysis;
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::projection::Projection;
use crate::offline::types::{EdgePoint, Outline};

/// Default limit of the centre's standard deviation, as a fraction of the radius.
const MAX_SIGMA_CENTRE_FRACTION: f64 = 0.1;
/// Chi-squared by which a circle may fit worse than an ellipse, which has two more parameters: four standard
/// deviations at two degrees of freedom.
const MAX_CIRCLE_EXCESS: f64 = 19.4;

/// The better of the plane models.
pub(crate) fn plane(
    a: &Analysis,
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Reconstruction, Refusal> {
    a.verdict.clone()?;
    let (fit, scores) = choose_plane_model(a, options.rim, options)?;
    Ok(plane_result(a, &fit, scores, points, p, options))
}

/// Chooses between circle and ellipse by the information criterion (or as requested), and checks the result against
/// the task's tolerance.
///
/// # Errors
/// A [`Refusal`] when the requested model does not fit, the cameras look at opposite faces, or the result is too
/// uncertain.
pub fn choose_plane_model(a: &Analysis, rim: RimChoice, options: &Options) -> Result<(MlFit, Vec<Score>), Refusal> {
    let ellipse = a.ellipse.as_ref();
    let circle = a.circle.as_ref();
    // The noise of the model with more parameters is the scale for both.
    let noise = ellipse.or(circle).map_or(1.0, |f| noise_of(f, a, options));
    let mut scores: Vec<Score> =
        [circle, ellipse].into_iter().flatten().map(|f| score(f.model, f.chi2, f.parameters, f.count, noise)).collect();
    let fit = match (rim, circle, ellipse) {
        (RimChoice::Circle, c, _) => c.map_err(Clone::clone)?,
        (RimChoice::Ellipse, _, e) => e.map_err(Clone::clone)?,
        (_, Ok(c), Ok(e)) => {
            let bic = |m| scores.iter().find(|s| s.model == m).map_or(f64::INFINITY, |s| s.bic);
            if bic(RimModel::Circle) <= bic(RimModel::Ellipse) {
                c
            } else if round_within_bias(e, a, options) {
                for s in scores.iter_mut().filter(|s| s.model == RimModel::Ellipse) {
                    s.excluded = Some("a circle, within the systematic error of the edges");
                }
                c
            } else {
                e
            }
        }
        (_, Ok(c), Err(_)) => c,
        (_, Err(_), e) => e.map_err(Clone::clone)?,
    };
    let noise = noise_of(fit, a, options);
    // Refuse when the plane between the cameras carries a circle that fits as well with two parameters fewer, or a
    // better one than the circle in front of them.
    let margin = if fit.model == RimModel::Ellipse { MAX_CIRCLE_EXCESS } else { -MAX_CIRCLE_EXCESS };
    let scale = noise_of(a.ellipse.as_ref().unwrap_or(fit), a, options);
    if a.between.is_some_and(|(_, chi2)| chi2 < fit.chi2 + margin * scale * scale) {
        return Err(Refusal::OppositeSides {
            why: "the plane between the cameras carries a circle, the plane in front of them does not",
        });
    }
    tolerable(
        fit.cov_centre(noise).trace().sqrt(),
        fit.cov_normal(noise).trace().sqrt(),
        fit.rim.a,
        vergence(&fit.rim.centre, &a.centres),
        fit.model,
        options,
    )?;
    Ok((fit.clone(), scores))
}

/// Whether an ellipse is so nearly round that the systematic error of the edges could have caused the difference: `1 -
/// b/a` within three standard deviations of zero. This error of detected edges does not average out over their number.
fn round_within_bias(e: &MlFit, a: &Analysis, options: &Options) -> bool {
    let radius = a.fits.iter().map(|f| f.fit.ellipse.a).fold(f64::INFINITY, f64::min);
    1.0 - e.rim.b / e.rim.a <= 3.0 * options.edge_bias_px / radius
}

/// Bayesian information criterion of a model for a given noise.
pub(crate) fn score(model: RimModel, chi2: f64, parameters: usize, count: usize, noise: f64) -> Score {
    let bic = chi2 / (noise * noise) + parameters as f64 * (count.max(1) as f64).ln();
    Score { model, chi2, parameters, bic, excluded: None }
}

/// Noise of a fit, from its residuals; not below the given sigmas if so requested, nor below rounding.
fn noise_of(fit: &MlFit, a: &Analysis, options: &Options) -> f64 {
    match options.noise {
        Noise::AtLeastGiven => fit.noise().max(1.0),
        Noise::FromFit => fit.noise().max(1e-12 * a.noise),
    }
}

/// Checks a reconstruction against the task's tolerance *in the images*. The loop closes in both images, so that an
/// absolute error by which the rig displaces rim and marks together does not reach the grasp.
pub(crate) fn tolerable_in_images(r: &Reconstruction, options: &Options) -> Result<(), Refusal> {
    let (centre, normal) = (r.report.sigma_centre_in_images, r.report.sigma_normal_in_images);
    tolerable(centre, normal, r.rim.a, r.report.vergence, r.model, options)
}

/// Refuses a result that is less certain than the task allows, with advice that fits the cause.
pub(crate) fn tolerable(
    sigma_centre: f64,
    sigma_normal: f64,
    radius: f64,
    vergence: f64,
    model: RimModel,
    options: &Options,
) -> Result<(), Refusal> {
    let limit_centre = options.max_sigma_centre.unwrap_or(MAX_SIGMA_CENTRE_FRACTION * radius);
    if sigma_centre <= limit_centre && sigma_normal <= options.max_sigma_normal {
        return Ok(());
    }
    let advice = if vergence < 5.0_f64.to_radians() {
        "the cameras see the rim from nearly the same direction: widen the baseline or move the rig closer"
    } else if model == RimModel::Ellipse {
        "click more of the rim, or specify a circle (--rim circle) if it is one"
    } else {
        "click more of the rim, move the rig closer, or view its face less obliquely"
    };
    Err(Refusal::TooUncertain {
        sigma_centre,
        limit_centre,
        sigma_normal_deg: sigma_normal.to_degrees(),
        limit_normal_deg: options.max_sigma_normal.to_degrees(),
        vergence_deg: vergence.to_degrees(),
        advice,
    })
}

/// The fields of the report that do not depend on the model.
pub(crate) fn base_report(a: &Analysis, points: [&[EdgePoint]; 2]) -> Report {
    let routes_differ = match (&a.paper, &a.polar) {
        (Ok(x), Ok(y)) => x.rim.normal.cross(&y.rim.normal).norm().atan2(x.rim.normal.dot(&y.rim.normal)),
        _ => f64::NAN,
    };
    let (rank2, separation) = a.paper.as_ref().map_or((f64::NAN, f64::NAN), |c| (c.pair.rank2, c.pair.separation));
    Report {
        sigma_centre: f64::NAN,
        sigma_normal: f64::NAN,
        sigma_centre_in_images: f64::NAN,
        sigma_normal_in_images: f64::NAN,
        smooth_px: f64::NAN,
        minor_axis_px: [a.fits[0].fit.ellipse.b, a.fits[1].fit.ellipse.b],
        vergence: f64::NAN,
        rank2,
        separation,
        delta: a.pencil.delta(),
        gap_px: a.gap_px,
        gap_sigma_px: a.gap_sigma_px,
        excess: a.excess,
        routes_differ,
        chi2: f64::NAN,
        dof: 0,
        noise: a.noise,
        scores: Vec::new(),
        image_ellipse: [a.fits[0].fit.ellipse, a.fits[1].fit.ellipse],
        residuals: points.map(|v| vec![f64::NAN; v.len()]),
        inliers: points.map(|v| vec![false; v.len()]),
    }
}

/// The result of a plane model.
fn plane_result(
    a: &Analysis,
    fit: &MlFit,
    scores: Vec<Score>,
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Reconstruction {
    let noise = noise_of(fit, a, options);
    let mut report = base_report(a, points);
    for k in 0..2 {
        let conic = image_conic(p[k], &fit.rim);
        let mut used = a.fits[k].inliers.iter();
        for (i, point) in points[k].iter().enumerate() {
            report.residuals[k][i] = distance(&conic, &point.uv);
            if point.outline == Outline::Outer {
                report.inliers[k][i] = used.next().copied().unwrap_or(false);
            }
        }
    }
    let (cov_centre, cov_normal) = (fit.cov_centre(noise), fit.cov_normal(noise));
    report.sigma_centre = cov_centre.trace().sqrt();
    report.sigma_normal = cov_normal.trace().sqrt();
    report.vergence = vergence(&fit.rim.centre, &a.centres);
    report.chi2 = fit.chi2;
    report.dof = fit.dof();
    report.noise = noise;
    report.scores = scores;
    Reconstruction {
        model: fit.model,
        rim: fit.rim,
        bar_radius: None,
        cov_centre,
        cov_normal,
        cov_centre_normal: fit.cov_centre_normal(noise),
        cov_axes: fit.cov_axes(noise),
        report,
    }
}
