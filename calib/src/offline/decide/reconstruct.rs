//! From edge points in two views to a rim in space, without images: the chain of section 4, refined, with the model
//! chosen and its uncertainty.

use crate::offline::bar::fit::fit_bar;
use crate::offline::bar::result::{bar_alone, bar_result};
use crate::offline::conic::robust::GATE;
use crate::offline::conic::sampson::distance;
use crate::offline::rim::choice::{choose_plane_model, plane, score};
use crate::offline::rim::ml::image_conic;
use crate::offline::rim::model::{Options, Reconstruction, RimChoice, RimModel, Score};
use crate::offline::rim::planar::{Analysis, analyse};
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::projection::Projection;
use crate::offline::types::{EdgePoint, Outline};

/// Reconstructs a rim from the edge points of both views.
///
/// Points are undistorted pixels. The matrices may use any length unit and frame, and any scale and sign. Points of
/// the inner outline are used by the round-bar model only.
///
/// # Errors
/// A [`Refusal`] that says what is wrong and what to change. Never panics, whatever the input.
pub fn reconstruct(
    left: &[EdgePoint],
    p_left: &Projection,
    right: &[EdgePoint],
    p_right: &Projection,
    options: &Options,
) -> Result<Reconstruction, Refusal> {
    let outer = [left, right].map(|v| v.iter().filter(|p| p.outline == Outline::Outer).copied().collect::<Vec<_>>());
    let p = [p_left, p_right];
    let analysis = analyse([&outer[0], &outer[1]], p, options)?;
    let points = [left, right];
    match options.rim {
        RimChoice::Edge | RimChoice::Circle | RimChoice::Ellipse => plane(&analysis, points, p, options),
        RimChoice::RoundBar => bar_alone(&analysis, points, p, options),
        RimChoice::Auto => any_model(&analysis, points, p, options),
    }
}

/// Plane edge or round bar, by the information criterion over the same points.
fn any_model(
    a: &Analysis,
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Reconstruction, Refusal> {
    let inner = points.map(|v| v.iter().filter(|q| q.outline == Outline::Inner).copied().collect::<Vec<_>>());
    let both = inner.iter().all(|v| v.len() >= 10);
    let flat = plane(a, points, p, options);
    // One outline without the bar's diameter: a bar would only add a parameter that the points do not determine, and
    // with it the freedom to explain two contours that do not match.
    if !both && options.bar_diameter.is_none() {
        return flat;
    }
    let bar = match fit_bar(points, p, a, options) {
        Ok(bar) => bar,
        Err(e) => return flat.map_err(|flat| if both { e } else { flat }),
    };
    let bar_scored = |noise: f64| {
        let all: Vec<f64> = scaled(&bar.residuals, points, |_| true);
        score(RimModel::RoundBar, truncated(&all, noise), bar.fit.parameters, all.len(), noise)
    };
    let Ok(flat) = flat else {
        let result = bar_result(&bar, vec![bar_scored(bar.noise)], a, points, p, options);
        // Neither fits: the refusal of the plane model describes the contours, that of the bar matters only where it
        // fits the points.
        return match (flat, result) {
            (_, Ok(r)) => Ok(r),
            (_, Err(e @ Refusal::BarUndetermined { .. })) => Err(e),
            (Err(e), Err(b)) => Err(if both { b } else { e }),
            (Ok(r), Err(_)) => Ok(r),
        };
    };
    // The hole of a flat ring is a second rim, with its own parameters.
    let hole = if both { analyse([&inner[0], &inner[1]], p, options).ok() } else { None };
    let hole_fit = hole.as_ref().and_then(|h| choose_plane_model(h, RimChoice::Edge, options).ok());
    let own = scaled(&flat.report.residuals, points, |o| o == Outline::Outer);
    let parameters = |m: RimModel| if m == RimModel::Circle { 6 } else { 8 };
    let (mut rest, mut more) = (own, parameters(flat.model));
    if both {
        match &hole_fit {
            Some((f, _)) => {
                more += f.parameters;
                for k in 0..2 {
                    let conic = image_conic(p[k], &f.rim);
                    rest.extend(inner[k].iter().map(|q| distance(&conic, &q.uv) / q.sigma));
                }
            }
            None => return bar_result(&bar, vec![bar_scored(bar.noise)], a, points, p, options),
        }
    }
    let noise = bar.noise.min(flat.report.noise).max(1e-6);
    let flat_score = score(flat.model, truncated(&rest, noise), more, rest.len(), noise);
    let bar_score = bar_scored(noise);
    let scores: Vec<Score> = flat.report.scores.iter().copied().chain([bar_score]).collect();
    if bar_score.bic < flat_score.bic {
        match bar_result(&bar, scores.clone(), a, points, p, options) {
            Ok(r) => return Ok(r),
            Err(e) if both => return Err(e),
            Err(_) => {}
        }
    }
    let mut flat = flat;
    flat.report.scores = scores;
    Ok(flat)
}

/// Residuals in units of sigma of the points on the selected outlines.
fn scaled(residuals: &[Vec<f64>; 2], points: [&[EdgePoint]; 2], selected: impl Fn(Outline) -> bool) -> Vec<f64> {
    let mut out = Vec::new();
    for k in 0..2 {
        out.extend(residuals[k].iter().zip(points[k]).filter(|(_, q)| selected(q.outline)).map(|(r, q)| r / q.sigma));
    }
    out
}

/// Sum of squares with every residual truncated at the outlier gate, so that models with different outliers can be
/// compared.
fn truncated(r: &[f64], noise: f64) -> f64 {
    let most = GATE * noise;
    r.iter().map(|x| if x.is_finite() { (x * x).min(most * most) } else { most * most }).sum()
}
