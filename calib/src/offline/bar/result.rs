//! From a fitted torus to a reconstruction: two-view test, side, covariance, report.

use crate::offline::bar::fit::{BarFit, fit_bar};
use crate::offline::rim::choice::{base_report, score, tolerable};
use crate::offline::rim::circle::{check_front, frame_of, signed_axis, vergence};
use crate::offline::rim::model::{Options, Reconstruction, Rim, RimModel, Score};
use crate::offline::rim::planar::{Analysis, analyse, typical_sigma};
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::projection::Projection;
use crate::offline::types::{EdgePoint, Outline};
use nalgebra::{Matrix2, SMatrix};

/// Standard deviation of the difference between an outline and its ellipse at the epipolar tangents, pixels.
const OUTLINE_SIGMA_PX: f64 = 0.25;

/// Reconstructs a round bar from its outlines in both views.
///
/// # Errors
/// A [`Refusal`] where the outer outlines cannot be analysed, no bar fits, or the bar is not determined well enough.
pub(crate) fn reconstruct_bar(
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Reconstruction, Refusal> {
    let outer = points.map(|v| v.iter().filter(|q| q.outline == Outline::Outer).copied().collect::<Vec<_>>());
    let analysis = analyse([&outer[0], &outer[1]], p, options)?;
    bar_alone(&analysis, points, p, options)
}

/// Fits and reports the round bar, with the outer outlines already analysed.
pub(crate) fn bar_alone(
    outer: &Analysis,
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Reconstruction, Refusal> {
    let bar = fit_bar(points, p, outer, options)?;
    let scores = vec![score(RimModel::RoundBar, bar.fit.chi2, bar.fit.parameters, bar.count, bar.noise)];
    bar_result(&bar, scores, outer, points, p, options)
}

/// Converts a fit to a reconstruction.
///
/// # Errors
/// A [`Refusal`] when the two-view test, the side of the cameras or the covariance rejects it.
pub(crate) fn bar_result(
    bar: &BarFit,
    scores: Vec<Score>,
    outer: &Analysis,
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Reconstruction, Refusal> {
    check_two_views(bar, outer, points, options)?;
    let torus = bar.fit.torus;
    let f = frame_of(&torus.normal);
    let axis_a = signed_axis(f.column(1).into_owned());
    let rim = Rim {
        centre: torus.centre,
        normal: torus.normal,
        a: torus.core,
        b: torus.core,
        axis_a,
        axis_b: torus.normal.cross(&axis_a),
    };
    check_front(&Rim { a: torus.core + torus.bar, b: torus.core + torus.bar, ..rim }, p, &outer.centres)?;
    let (cov, cov_axes) = covariance(bar, outer, options)?;
    let cov_centre = cov.fixed_view::<3, 3>(0, 0).into_owned();
    let cov_normal = cov.fixed_view::<2, 2>(3, 3).into_owned();
    let mut report = base_report(outer, points);
    report.sigma_centre = cov_centre.trace().sqrt();
    report.sigma_normal = cov_normal.trace().sqrt();
    report.vergence = vergence(&torus.centre, &outer.centres);
    report.excess = bar.excess;
    report.chi2 = bar.fit.chi2;
    report.dof = bar.count.saturating_sub(bar.fit.parameters).max(1);
    report.noise = bar.noise;
    report.scores = scores;
    report.residuals = bar.residuals.clone();
    report.inliers = bar.keep.clone();
    Ok(Reconstruction {
        model: RimModel::RoundBar,
        rim,
        bar_radius: Some(torus.bar),
        cov_centre,
        cov_normal,
        cov_centre_normal: cov.fixed_view::<3, 2>(0, 3).into_owned(),
        cov_axes,
        report,
    })
}

/// Checks the scatter of the points, the epipolar tangency gaps and the two-view excess.
fn check_two_views(
    bar: &BarFit,
    outer: &Analysis,
    points: [&[EdgePoint]; 2],
    options: &Options,
) -> Result<(), Refusal> {
    let px = bar.noise * typical_sigma(points[0]);
    if px > options.max_noise_px {
        return Err(Refusal::NoFit { why: "the points do not lie on the outlines of one bar" });
    }
    // The epipolar planes that touch the bar touch both its outlines. The tangency gaps therefore close for a bar as
    // they do for a plane rim, up to the difference between an outline and the ellipse fitted to it.
    let open = (0..2).any(|k| {
        let allowed = outer.gap_sigma_px[k].hypot(options.calibration_px).hypot(OUTLINE_SIGMA_PX);
        outer.gap_px[k].abs() > options.gate_sigmas * allowed
    });
    if open || bar.excess > bar.limit {
        return Err(Refusal::Mismatch {
            gap_px: outer.gap_px,
            gap_sigma_px: outer.gap_sigma_px,
            excess: bar.excess,
            limit: bar.limit,
            delta: outer.pencil.delta(),
        });
    }
    Ok(())
}

/// Covariance of centre, normal and radii, and of `(R, r)` alone; refused where it exceeds the task's tolerance.
fn covariance(
    bar: &BarFit,
    outer: &Analysis,
    options: &Options,
) -> Result<(SMatrix<f64, 7, 7>, Matrix2<f64>), Refusal> {
    let torus = bar.fit.torus;
    let outer_only = !bar.inner && options.bar_diameter.is_none();
    let undetermined = |centre: f64, normal: f64| Refusal::BarUndetermined {
        sigma_centre: centre,
        sigma_normal_deg: normal.to_degrees(),
    };
    let Some(cofactor) = bar.fit.cofactor else {
        return Err(if outer_only {
            undetermined(f64::INFINITY, f64::INFINITY)
        } else {
            Refusal::NoFit { why: "the bar is not determined" }
        });
    };
    let cov = cofactor * (bar.noise * bar.noise);
    let sigma_centre = cov.fixed_view::<3, 3>(0, 0).trace().sqrt();
    let sigma_normal = cov.fixed_view::<2, 2>(3, 3).trace().sqrt();
    let angle = vergence(&torus.centre, &outer.centres);
    tolerable(sigma_centre, sigma_normal, torus.core, angle, RimModel::RoundBar, options)
        .map_err(|e| if outer_only { undetermined(sigma_centre, sigma_normal) } else { e })?;
    let cov_axes = match bar.fit.parameters {
        7 => cov.fixed_view::<2, 2>(5, 5).into_owned(),
        _ => Matrix2::new(cov[(5, 5)], 0.0, 0.0, 0.0),
    };
    // The two radii can be confused with each other while centre and normal are well determined. Such radii are no
    // answer once the bar's radius is uncertain by more than a tenth of itself.
    if outer_only && cov_axes[(1, 1)].sqrt() > 0.1 * torus.bar {
        return Err(undetermined(sigma_centre, sigma_normal));
    }
    Ok((cov, cov_axes))
}
