//! The robust fit of a torus to the outlines of both views.

use crate::offline::bar::torus::{Free, Ray, Torus, TorusFit, fit, rays};
use crate::offline::conic::robust::GATE;
use crate::offline::correspondence::tangency::excess_limit;
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::model::{Noise, Options};
use crate::offline::rim::planar::{Analysis, analyse, typical_sigma};
use crate::offline::rim::refusal::Refusal;
use crate::offline::statistics::{MAD, median};
use crate::offline::types::projection::Projection;
use crate::offline::types::{EdgePoint, Outline};
use nalgebra::Matrix2;

/// Ratio of the excess limit with 5 or 6 degrees of freedom to that with 2, at 4 sigma.
const EXCESS_LIMIT_RATIO: f64 = 1.5;

/// A torus fitted to both views, with the data for comparing and reporting it.
pub(crate) struct BarFit {
    pub(crate) fit: TorusFit,
    /// Residuals of all points in pixels, left then right, in the order given.
    pub(crate) residuals: [Vec<f64>; 2],
    /// Whether each point is an inlier.
    pub(crate) keep: [Vec<bool>; 2],
    pub(crate) noise: f64,
    pub(crate) count: usize,
    /// Two-view excess in units of the noise variance, and its limit.
    pub(crate) excess: f64,
    pub(crate) limit: f64,
    /// Whether both views have an inner outline.
    pub(crate) inner: bool,
}

/// Fits the round bar. `outer` is the plane analysis of the outer outlines.
///
/// # Errors
/// [`Refusal::NoFit`] when the fit diverges or most points are off the outlines; [`Refusal::BadInput`] for an
/// impossible diameter.
pub(crate) fn fit_bar(
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    outer: &Analysis,
    options: &Options,
) -> Result<BarFit, Refusal> {
    const CAMERA: Refusal = Refusal::NoFit { why: "a viewing ray is not finite" };
    let per_view = [rays(points[0], p[0]).ok_or(CAMERA)?, rays(points[1], p[1]).ok_or(CAMERA)?];
    let all: Vec<Ray> = per_view.iter().flatten().copied().collect();
    let split = per_view[0].len();
    let (start, inner) = start(points, p, outer, options)?;
    let free = if options.bar_diameter.is_some() { Free::KnownBar } else { Free::All };
    let sigma: Vec<f64> = points.iter().flat_map(|v| v.iter().map(|q| q.sigma)).collect();
    let scaled = |t: &Torus| -> Vec<f64> { all.iter().zip(&sigma).map(|(r, s)| (t.residual(r) / s).abs()).collect() };
    let mut torus = start;
    let mut keep = vec![true; all.len()];
    let mut fitted = None;
    for round in 0..12 {
        let r = scaled(&torus);
        // The start is off by several pixels: the first gate is wider.
        let gate = (if round == 0 && options.robust { 4.0 } else { GATE }) * (MAD * median(r.clone())).max(1e-9);
        let next: Vec<bool> = r.iter().map(|x| !options.robust || *x <= gate).collect();
        let unchanged = round > 1 && next == keep;
        keep = next;
        if unchanged {
            break;
        }
        let found = fit(&all, &keep, &torus, free).ok_or(Refusal::NoFit { why: "the torus fit diverged" })?;
        torus = found.torus;
        fitted = Some(found);
        if !options.robust && round > 0 {
            break;
        }
    }
    let mut fitted = fitted.ok_or(Refusal::NoFit { why: "the torus fit diverged" })?;
    // The normal points out of the face that the cameras see.
    if (outer.centres[0] - torus.centre).dot(&torus.normal) < 0.0 {
        flip(&mut fitted);
    }
    let count = keep.iter().filter(|k| **k).count();
    if count * 10 < all.len() * 6 || count <= 7 {
        return Err(Refusal::NoFit { why: "most points do not lie on the outlines of one bar" });
    }
    let dof = count.saturating_sub(fitted.parameters).max(1);
    let mut noise = (fitted.chi2 / dof as f64).sqrt().max(1e-6);
    let excess_and_dof =
        one_view_chi2(&all, &keep, split, &fitted.torus, if inner { Free::OneView } else { Free::Pose });
    let single_noise = (excess_and_dof.0 / excess_and_dof.1.max(1) as f64).sqrt().max(1e-6);
    let known = options.noise == Noise::AtLeastGiven && single_noise <= 1.0;
    let scale = if known { 1.0 } else { single_noise.max(1e-4 / typical_sigma(points[0])) };
    if options.noise == Noise::AtLeastGiven {
        noise = noise.max(1.0);
    }
    let excess = ((fitted.chi2 - excess_and_dof.0) / (scale * scale)).max(0.0);
    let slack = options.calibration_px / typical_sigma(points[0]) / scale;
    let limit = EXCESS_LIMIT_RATIO * excess_limit(options.gate_sigmas, if known { None } else { Some(dof) })
        + slack * slack * count as f64;
    let torus = fitted.torus;
    let residuals = [0, 1].map(|k| per_view[k].iter().map(|r| torus.residual(r)).collect());
    let keep = [keep[..split].to_vec(), keep[split..].to_vec()];
    Ok(BarFit { fit: fitted, residuals, keep, noise, count, excess, limit, inner })
}

/// Reverses the normal and transforms the covariance to the new chart.
fn flip(fit: &mut TorusFit) {
    let before = frame_of(&fit.torus.normal);
    fit.torus.normal = -fit.torus.normal;
    let after = frame_of(&fit.torus.normal);
    if let Some(c) = &mut fit.cofactor {
        // A change dn of the old normal is a change -dn of the new one.
        let r = Matrix2::from_fn(|i, j| -after.column(i).dot(&before.column(j)));
        let mut t = nalgebra::SMatrix::<f64, 7, 7>::identity();
        t.fixed_view_mut::<2, 2>(3, 3).copy_from(&r);
        *c = t * *c * t.transpose();
    }
}

/// Summed chi-squared of the best torus of each view alone, and its degrees of freedom.
fn one_view_chi2(all: &[Ray], keep: &[bool], split: usize, torus: &Torus, free: Free) -> (f64, usize) {
    let mut chi2 = 0.0;
    for (rays, keep) in [(&all[..split], &keep[..split]), (&all[split..], &keep[split..])] {
        chi2 += fit(rays, keep, torus, free).map_or(f64::INFINITY, |f| f.chi2);
    }
    let count = keep.iter().filter(|k| **k).count();
    (if chi2.is_finite() { chi2 } else { 0.0 }, count.saturating_sub(12))
}

/// Start from the closed forms of the outlines: centre and normal of the outer (and inner) plane fits, radii from half
/// the sum and half the difference. Also returns whether both views have an inner outline.
fn start(
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    outer: &Analysis,
    options: &Options,
) -> Result<(Torus, bool), Refusal> {
    let rim = outer.any_rim().ok_or_else(|| {
        outer.verdict.clone().err().unwrap_or(Refusal::NoFit { why: "the outer outline gives no start" })
    })?;
    let inside = points.map(|v| v.iter().filter(|q| q.outline == Outline::Inner).copied().collect::<Vec<_>>());
    let radius = (rim.a * rim.b).sqrt();
    let bar = options.bar_diameter.map(|d| 0.5 * d);
    if let Some(r) = bar
        && !(r > 0.0 && r < 0.95 * radius)
    {
        return Err(Refusal::BadInput {
            what: "the bar's diameter",
            why: "it is not between 0 and the rim's diameter",
        });
    }
    let has_inner = inside.iter().all(|v| v.len() >= 10);
    if has_inner
        && let Ok(a) = analyse([&inside[0], &inside[1]], p, options)
        && let Some(hole) = a.any_rim()
    {
        let small = (hole.a * hole.b).sqrt();
        let r = bar.unwrap_or(0.5 * (radius - small)).max(0.01 * radius);
        let torus = Torus {
            centre: (rim.centre + hole.centre) * 0.5,
            normal: (rim.normal + hole.normal).normalize(),
            core: 0.5 * (radius + small),
            bar: r,
        };
        if r < 0.9 * torus.core && torus.normal.iter().all(|x| x.is_finite()) {
            return Ok((torus, true));
        }
    }
    let r = bar.unwrap_or(0.1 * radius);
    Ok((Torus { centre: rim.centre, normal: rim.normal, core: radius - r, bar: r }, has_inner))
}

/// The bar that has two contours as its outer outlines, however well they determine it.
pub(crate) fn bar_start(
    points: [&[EdgePoint]; 2],
    p: [&Projection; 2],
    analysis: &Analysis,
    options: &Options,
) -> Option<Torus> {
    fit_bar(points, p, analysis, options).ok().map(|bar| bar.fit.torus)
}
