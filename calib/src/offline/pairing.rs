//! Which contour of the left view and which of the right are pictures of one rim.
//!
//! Each view's selection gives a few contours, likeliest first. Pairs are tried in the order of what they ask the operator to have meant; the first that
//! passes every test of the reconstruction is taken. The brighter side must agree: a painted line has two edges, and the inner one of one view
//! is never the outer one of the other. Where the rim may be a round bar, each contour's other outline is looked for first.

use super::contour::{Contour, ViewEdges};
use super::model::{EdgePoint, Options, Outline, Projection, Reconstruction, RimChoice, RimModel};
use super::outline::{OtherOutline, other_outline};
use super::reconstruct::reconstruct;
use super::refusal::Refusal;
use super::select::Candidate;

/// A pair of contours that reconstructs.
#[derive(Clone, Debug)]
pub struct Pair {
    /// The outer (or only) contours, left and right.
    pub contours: [Contour; 2],
    /// The inner outlines, where the rim turned out to be a round bar.
    pub inner: [Option<Contour>; 2],
    /// What they are a picture of.
    pub reconstruction: Reconstruction,
    /// How many likelier pairs were refused before.
    pub tried: usize,
}

/// A refusal that knows whether the same contours would do with the views swapped.
#[derive(Clone, Debug, PartialEq)]
pub struct Unpaired {
    /// Why the likeliest pair was refused.
    pub refusal: Refusal,
    /// Whether a pair is accepted when left and right are exchanged.
    pub swapped_fits: bool,
}

/// What a difference of the brighter side costs: two pictures of one edge hardly ever differ in it, except against another background.
const OTHER_SIDE: f64 = 12.0;

/// A view's outlines in the order outer, inner.
fn outlines<'c>(clicked: &'c Contour, other: Option<&'c OtherOutline>) -> (&'c Contour, Option<&'c Contour>) {
    match other {
        Some(o) if o.inside => (clicked, Some(&o.contour)),
        Some(o) => (&o.contour, Some(clicked)),
        None => (clicked, None),
    }
}

fn points(outer: &Contour, inner: Option<&Contour>) -> Vec<EdgePoint> {
    let mut all = outer.edge_points(Outline::Outer);
    all.extend(inner.iter().flat_map(|c| c.edge_points(Outline::Inner)));
    all
}

/// What a rim's semi-axes may differ by in the picture, pixels, before it is called an ellipse: neighbouring edges and shading move an edge by tenths of
/// a pixel, all round alike or in step with the tilt, which no count of points averages out.
const ROUND_PX: f64 = 1.0;

/// Thinnest bar in parts of its ring's radius.
const THINNEST: f64 = 0.015;

/// How many accepted pairs are compared; the two edges of a painted line are the usual case.
const COMPARED: usize = 3;

/// The chosen contours with their edges told apart from their neighbours, and what they are a picture of.
fn sharpened(
    views: [&ViewEdges<'_>; 2],
    outer: [&Contour; 2],
    inner: [Option<&Contour>; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Pair, Refusal> {
    let contours = [views[0].sharpened(outer[0]), views[1].sharpened(outer[1])];
    let inner = [inner[0].map(|c| views[0].sharpened(c)), inner[1].map(|c| views[1].sharpened(c))];
    let all = [0, 1].map(|k| points(&contours[k], inner[k].as_ref()));
    let run = |o: &Options| reconstruct(&all[0], p[0], &all[1], p[1], o);
    let mut reconstruction = run(options)?;
    if reconstruction.model == RimModel::Ellipse && matches!(options.rim, RimChoice::Auto | RimChoice::Edge) {
        let rim = &reconstruction.rim;
        let largest = contours[0].ellipse.a.max(contours[1].ellipse.a);
        if (1.0 - rim.b / rim.a) * largest < ROUND_PX {
            if let Ok(mut round) = run(&Options { rim: RimChoice::Circle, ..*options }) {
                // Both models were compared; the report goes on saying so.
                round.report.scores = reconstruction.report.scores.clone();
                reconstruction = round;
            }
        }
    }
    // A bar without thickness is one outline taken for two.
    if let Some(bar) = reconstruction.bar_radius.filter(|r| *r < THINNEST * reconstruction.rim.a) {
        let r = &reconstruction.report;
        let sigma_centre = r.sigma_centre.max(bar);
        return Err(Refusal::BarUndetermined { sigma_centre, sigma_normal_deg: r.sigma_normal.to_degrees() });
    }
    // Noise that hides a gap in sigmas does not make two contours one.
    let r = &reconstruction.report;
    let gap = largest_gap(&reconstruction);
    let limit = options.gate_sigmas * options.calibration_px.max(0.25) + 1.0;
    if gap > limit && reconstruction.bar_radius.is_none() {
        let (gap_px, gap_sigma_px) = (r.gap_px, r.gap_sigma_px);
        return Err(Refusal::Mismatch { gap_px, gap_sigma_px, excess: r.excess, limit, delta: r.delta });
    }
    Ok(Pair { contours, inner, reconstruction, tried: 0 })
}

fn largest_gap(r: &Reconstruction) -> f64 {
    r.report.gap_px.iter().filter(|g| g.is_finite()).map(|g| g.abs()).fold(0.0, f64::max)
}

/// What speaks against a pair besides its place, in pixels of click distance: edges that do not lie on one rim of both views.
fn misfit(pair: &Pair) -> f64 {
    let r = &pair.reconstruction.report;
    let (mut sum, mut count) = (0.0, 0.0);
    for (residuals, used) in r.residuals.iter().zip(&r.inliers) {
        for (d, _) in residuals.iter().zip(used).filter(|(d, u)| **u && d.is_finite()) {
            sum += d * d;
            count += 1.0;
        }
    }
    20.0 * (sum / f64::max(count, 1.0)).sqrt() + 3.0 * largest_gap(&pair.reconstruction)
}

/// Finds the likeliest pair that is the picture of one rim. `views` are where the candidates come from.
pub fn pair(
    views: [&ViewEdges<'_>; 2],
    candidates: [&[Candidate]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Pair, Unpaired> {
    let strict = match options.rim {
        RimChoice::RoundBar => Some(false),
        RimChoice::Auto => Some(true),
        _ => None,
    };
    let others: Vec<Vec<Option<OtherOutline>>> = views
        .iter()
        .zip(candidates)
        .map(|(v, c)| c.iter().map(|c| strict.and_then(|s| other_outline(v, &c.contour, s))).collect())
        .collect();
    let (Some(other_left), Some(other_right)) = (others.first(), others.get(1)) else {
        return Err(Unpaired {
            refusal: Refusal::BadInput { what: "the selection", why: "no contour was found" },
            swapped_fits: false,
        });
    };
    let mut order = Vec::new();
    for (l, ol) in candidates[0].iter().zip(other_left) {
        for (r, or) in candidates[1].iter().zip(other_right) {
            let side = if l.contour.bright_inside == r.contour.bright_inside { 0.0 } else { OTHER_SIDE };
            order.push((l.cost + r.cost + side, l, ol.as_ref(), r, or.as_ref()));
        }
    }
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut first: Option<Refusal> = None;
    let mut accepted: Vec<(f64, Pair)> = Vec::new();
    for (tried, (cost, l, ol, r, or)) in order.iter().enumerate() {
        // What lies much further from the clicks was not meant, however well it fits.
        if accepted.len() >= COMPARED || accepted.first().is_some_and(|a| *cost > a.0 + 6.0) {
            break;
        }
        // Both clicks must be on the same outline of the two.
        let agree = matches!((ol, or), (Some(a), Some(b)) if a.inside == b.inside);
        let (left, left_inner) = outlines(&l.contour, ol.filter(|_| agree));
        let (right, right_inner) = outlines(&r.contour, or.filter(|_| agree));
        match reconstruct(&points(left, left_inner), p[0], &points(right, right_inner), p[1], options) {
            Ok(coarse) => {
                let bar = coarse.bar_radius.is_some();
                // A plane rim is what was clicked, whatever lies inside or round it.
                let (pair, inner) = if bar {
                    ([left, right], [left_inner, right_inner])
                } else {
                    ([&l.contour, &r.contour], [None, None])
                };
                match sharpened(views, pair, inner, p, options) {
                    Ok(pair) => {
                        let pair = Pair { tried, ..pair };
                        accepted.push((cost + misfit(&pair), pair));
                    }
                    Err(e) => {
                        first.get_or_insert(e);
                    }
                }
            }
            Err(e) => {
                first.get_or_insert(e);
            }
        }
    }
    if let Some((_, best)) = accepted.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)) {
        return Ok(best);
    }
    let swapped_fits = order.iter().take(4).any(|(_, l, _, r, _)| {
        reconstruct(&points(&r.contour, None), p[0], &points(&l.contour, None), p[1], options).is_ok()
    });
    let refusal = first.unwrap_or(Refusal::BadInput { what: "the selection", why: "no contour was found" });
    Err(Unpaired { refusal, swapped_fits })
}
