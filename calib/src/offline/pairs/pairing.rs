//! Which contour of the left view and which of the right are pictures of one rim.
//!
//! Each view's selection gives a few contours, likeliest first. Pairs are tried in the order of what they ask the operator to have meant; the first that
//! passes every test of the reconstruction is taken. The brighter side must agree: a painted line has two edges, and the inner one of one view
//! is never the outer one of the other. Where the rim may be a round bar, the bar that has the clicked outlines is looked for, and the shape of all four
//! outlines decides. What neither of both explains better is refused: a bar taken for a plane edge is wrong by degrees without looking so.

use crate::offline::bar::found::BarFound;
use crate::offline::bar::search;
use crate::offline::contour::select::Candidate;
use crate::offline::contour::{Contour, ViewEdges, told_apart};
use crate::offline::rim::average::{average, share_of_ellipse};
use crate::offline::rim::model::{Options, Outline, Projection, Reconstruction, RimChoice, RimModel};
use crate::offline::rim::reconstruct::{bar_alone, cut_off, reconstruct, tolerable};
use crate::offline::rim::refusal::Refusal;
use crate::offline::rim::systematic::{Stretch, widen};

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

/// What a rim's semi-axes may differ by in the picture, pixels, before it is called an ellipse: neighbouring edges and shading move an edge by tenths of
/// a pixel, all round alike or in step with the tilt, which no count of points averages out.
const ROUND_PX: f64 = 1.0;

/// How far apart the tangents of two contours that are no clean circle may be, in units of the rig's own doubt.
const UNCLEAN_GAP: f64 = 1.5;

/// Thinnest bar in parts of its ring's radius.
const THINNEST: f64 = 0.015;

/// How many accepted pairs are compared; the two edges of a painted line are the usual case.
const COMPARED: usize = 3;

/// The contours with their edges told apart from their neighbours, as a plane rim.
fn sharpened(
    views: [&ViewEdges<'_>; 2],
    clicked: [&Contour; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Pair, Refusal> {
    let contours = told_apart(views, clicked);
    let all = [0, 1].map(|k| contours[k].edge_points(Outline::Outer));
    let run = |o: &Options| reconstruct(&all[0], p[0], &all[1], p[1], o);
    let mut reconstruction = run(options)?;
    if reconstruction.model == RimModel::Ellipse && options.rim == RimChoice::Edge {
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
    // Noise that hides a gap in sigmas does not make two contours one. That two ellipses are a circle to within their edges' noise speaks for itself; that
    // they are some ellipse is all but always so, and only the tangents tell whether they belong together.
    let r = &reconstruction.report;
    let doubt = options.calibration_px.max(0.25);
    let limit = match is_clean_circle(&reconstruction) {
        true => options.gate_sigmas * doubt + 1.0,
        false => UNCLEAN_GAP * doubt,
    };
    if largest_gap(&reconstruction) > limit {
        let (gap_px, gap_sigma_px) = (r.gap_px, r.gap_sigma_px);
        return Err(Refusal::Mismatch { gap_px, gap_sigma_px, excess: r.excess, limit, delta: r.delta });
    }
    let chi2_per_dof = chi2_per_dof(&reconstruction);
    if chi2_per_dof > UNLIKE {
        return Err(Refusal::Unlike { chi2_per_dof, limit: UNLIKE });
    }
    // A gap that nobody knows closes on anything.
    let loosest = r.gap_sigma_px.into_iter().filter(|s| s.is_finite()).fold(0.0, f64::max);
    if loosest > LOOSE_PX {
        return Err(Refusal::Loose { gap_sigma_px: loosest, limit_px: LOOSE_PX });
    }
    Ok(Pair { contours, inner: [None, None], reconstruction, tried: 0 })
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

/// By how much the information criterion has to prefer one model before the other is forgotten.
const DECISIVE: f64 = 60.0;

/// Chi-squared per degree of freedom up to which a rim is clean.
const CLEAN: f64 = 1.6;

/// Chi-squared per degree of freedom above which edges do not lie on one plane rim. Plane rims of 300 rendered worlds stay below two, contours of unlike things that
/// pass every other test are at five and more.
const UNLIKE: f64 = 4.0;

/// Uncertainty of the epipolar tangents, pixels, above which two arcs cannot be held against each other. Whole rims are at a hundredth, ones hidden by a third at a
/// third of it.
const LOOSE_PX: f64 = 0.9;

/// Chi-squared by which a bar has to fit better than a circle, one parameter more allowed for.
const BETTER: f64 = 20.0;

/// Normals closer than this do not need to be decided between, degrees.
const SAME_DEG: f64 = 0.3;

/// Part of the options' edge error that even the cleanest contour is taken to have.
const SHARE_OF_BIAS: f64 = 0.5;

/// Pairs at which a bar is looked for.
const BAR_PAIRS: usize = 8;

/// The bars whose outlines were clicked, with the evidence for each, and how well the best guess is supported: in all, and beyond what is usual.
fn bars(
    views: [&ViewEdges<'_>; 2],
    clicked: [&Contour; 2],
    p: [&Projection; 2],
    options: &Options,
    clean: bool,
) -> (Vec<(f64, BarFound)>, f64, f64) {
    // An outline's ellipse misses its tangents by less than a lenient gate, and its plane rim is a start for the bar.
    let plane = Options { rim: RimChoice::Edge, calibration_px: options.calibration_px.max(2.0), ..*options };
    let points = [0, 1].map(|k| clicked[k].edge_points(Outline::Outer));
    let Ok(r) = reconstruct(&points[0], p[0], &points[1], p[1], &plane) else { return (Vec::new(), 0.0, 0.0) };
    let start = (r.rim.centre, r.rim.normal, (r.rim.a * r.rim.b).sqrt());
    let found = search::find(views, clicked, start, p, options, clean);
    let mut out: Vec<(f64, BarFound)> = found.found.into_iter().map(|b| (b.evidence(p, options), b)).collect();
    // Of two bars the one whose outlines are the more complete and keep to it the closer: their evidences are about different edges.
    out.sort_by(|a, b| a.1.doubt().total_cmp(&b.1.doubt()));
    (out, found.support, found.excess)
}

impl From<BarFound> for Pair {
    fn from(b: BarFound) -> Self {
        Self { contours: b.outer, inner: b.inner.map(Some), reconstruction: b.reconstruction, tried: 0 }
    }
}

/// Finds the likeliest pair that is the picture of one rim. `views` are where the candidates come from.
pub fn pair(
    views: [&ViewEdges<'_>; 2],
    candidates: [&[Candidate]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Pair, Unpaired> {
    // What the task tolerates must not choose the contours: a wrong pair may well be the more certain one.
    let mut found = likeliest(views, candidates, p, &options.tolerating_anything())?;
    found.doubt(p, options).map_err(|refusal| Unpaired { refusal, swapped_fits: false })?;
    Ok(found)
}

impl Pair {
    /// Adds what edges have wrong together to the covariance, and holds the result against the tolerance once more.
    fn doubt(&mut self, p: [&Projection; 2], options: &Options) -> Result<(), Refusal> {
        let mut lists = Vec::new();
        for (view, (outer, inner)) in self.contours.iter().zip(&self.inner).enumerate() {
            lists.push((view, outer, outer.edge_points(Outline::Outer)));
            lists.extend(inner.iter().map(|c| (view, c, c.edge_points(Outline::Inner))));
        }
        let stretches: Vec<Stretch<'_>> = lists
            .iter()
            .map(|(view, c, points)| Stretch {
                view: *view,
                points,
                place: c.points.iter().map(|p| p.parameter).collect(),
            })
            .collect();
        let r = &mut self.reconstruction;
        let floor = (options.edge_bias_px > 0.0).then_some(SHARE_OF_BIAS * options.edge_bias_px);
        if let Some(floor) = floor {
            widen(r, &stretches, p, floor);
        }
        let chosen = matches!(options.rim, RimChoice::Auto | RimChoice::Edge) && r.model == RimModel::Circle;
        if let Some(share) = share_of_ellipse(&r.report.scores).filter(|_| chosen) {
            let whatever = Options { rim: RimChoice::Ellipse, ..*options }.tolerating_anything();
            let outer = [0, 1].map(|k| self.contours[k].edge_points(Outline::Outer));
            if let Ok(mut ellipse) = reconstruct(&outer[0], p[0], &outer[1], p[1], &whatever) {
                if let Some(floor) = floor {
                    widen(&mut ellipse, &stretches, p, floor);
                }
                average(r, &ellipse, share);
            }
        }
        tolerable(r.report.sigma_centre, r.report.sigma_normal, r.rim.a, r.report.vergence, r.model, options)
    }
}

fn chi2_per_dof(r: &Reconstruction) -> f64 {
    r.report.chi2 / r.report.dof.max(1) as f64
}

/// Whether the edges lie on the rim as closely as their noise lets them.
fn is_clean(r: &Reconstruction) -> bool {
    chi2_per_dof(r) <= CLEAN
}

/// Whether they do, and the rim is a circle.
fn is_clean_circle(r: &Reconstruction) -> bool {
    r.model == RimModel::Circle && is_clean(r)
}

/// Whether a plane rim's contours are the outer outlines of a bar as well: a torus and an ellipse are told apart by their other outline, or not at all. A circle
/// is nothing that a bar's outlines look like by chance, unless the bar fits them better.
fn may_be_a_bar(best: &Pair, p: [&Projection; 2], options: &Options) -> bool {
    let plane = &best.reconstruction;
    let points = [0, 1].map(|k| best.contours[k].edge_points(Outline::Outer));
    let points = [points[0].as_slice(), points[1].as_slice()];
    let noise = plane.report.noise.max(1.0);
    let Some((bar, chi2)) = bar_alone(points, p, noise, options) else { return false };
    let worse = (chi2 - cut_off(plane, points, noise)) / (noise * noise);
    let limit = if plane.model == RimModel::Ellipse { DECISIVE } else { -BETTER };
    let apart = bar.normal.cross(&plane.rim.normal).norm().asin().to_degrees();
    bar.bar >= THINNEST * bar.core && apart > SAME_DEG && worse < limit
}

fn ambiguous() -> Result<Pair, Unpaired> {
    Err(Unpaired { refusal: Refusal::RimAmbiguous, swapped_fits: false })
}

fn likeliest(
    views: [&ViewEdges<'_>; 2],
    candidates: [&[Candidate]; 2],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Pair, Unpaired> {
    let mut order = Vec::new();
    for l in candidates[0] {
        for r in candidates[1] {
            let side = if l.contour.bright_inside == r.contour.bright_inside { 0.0 } else { OTHER_SIDE };
            order.push((l.cost + r.cost + side, l, r));
        }
    }
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    if options.rim == RimChoice::RoundBar {
        return round_bar(views, &order, p, options);
    }
    let flat = Options { rim: if options.rim == RimChoice::Auto { RimChoice::Edge } else { options.rim }, ..*options };
    let mut first: Option<Refusal> = None;
    let mut accepted: Vec<(f64, usize, Pair)> = Vec::new();
    for (tried, (cost, l, r)) in order.iter().enumerate() {
        // What lies much further from the clicks was not meant, however well it fits.
        if accepted.len() >= COMPARED || accepted.first().is_some_and(|a| *cost > a.0 + 6.0) {
            break;
        }
        let clicked = [&l.contour, &r.contour];
        let coarse = clicked.map(|c| c.edge_points(Outline::Outer));
        let pair =
            reconstruct(&coarse[0], p[0], &coarse[1], p[1], &flat).and_then(|_| sharpened(views, clicked, p, &flat));
        match pair {
            Ok(pair) => accepted.push((cost + misfit(&pair), tried, Pair { tried, ..pair })),
            Err(e) => {
                first.get_or_insert(e);
            }
        }
    }
    let best = accepted.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
    if options.rim == RimChoice::Auto {
        let likely: Vec<usize> = match &best {
            Some((_, tried, _)) => vec![*tried],
            None => (0..order.len().min(BAR_PAIRS)).collect(),
        };
        for (_, l, r) in likely.iter().filter_map(|k| order.get(*k)) {
            let clean = best.as_ref().is_some_and(|(_, _, b)| is_clean(&b.reconstruction));
            let round = best.as_ref().is_some_and(|(_, _, b)| is_clean_circle(&b.reconstruction));
            let (found, support, excess) = bars(views, [&l.contour, &r.contour], p, options, round);
            // The best guess has to be the one that was followed and found wanting; that some other bar is not there says nothing.
            let decided = found.iter().any(|(e, b)| e.abs() > DECISIVE && b.support > 0.9 * support);
            if let Some((evidence, bar)) = found.into_iter().next() {
                if evidence > DECISIVE {
                    return Ok(bar.into());
                }
                if let Some((_, _, plane)) = &best {
                    let apart = bar.reconstruction.rim.normal.angle(&plane.reconstruction.rim.normal).to_degrees();
                    if evidence > -DECISIVE && apart > SAME_DEG {
                        return ambiguous();
                    }
                }
            }
            // A second outline that cannot be followed, and a first one that is no clean rim: nobody knows. Whether a clean one is a bar's, it tells itself.
            if best.is_some() && !decided && !clean && excess > search::SUPPORTED {
                return ambiguous();
            }
        }
    }
    if let Some((_, _, best)) = best {
        if options.rim == RimChoice::Auto && may_be_a_bar(&best, p, options) {
            return ambiguous();
        }
        return Ok(best);
    }
    let swapped_fits = order.iter().take(4).any(|(_, l, r)| {
        let (a, b) = (r.contour.edge_points(Outline::Outer), l.contour.edge_points(Outline::Outer));
        reconstruct(&a, p[0], &b, p[1], options).is_ok()
    });
    let refusal = first.unwrap_or(Refusal::BadInput { what: "the selection", why: "no contour was found" });
    Err(Unpaired { refusal, swapped_fits })
}

/// A round bar because the operator says so: both outlines if they can be found, the clicked one alone if that is enough.
fn round_bar(
    views: [&ViewEdges<'_>; 2],
    order: &[(f64, &Candidate, &Candidate)],
    p: [&Projection; 2],
    options: &Options,
) -> Result<Pair, Unpaired> {
    let mut first: Option<Refusal> = None;
    for (tried, (_, l, r)) in order.iter().take(BAR_PAIRS).enumerate() {
        let clicked = [&l.contour, &r.contour];
        let whole = |b: &BarFound| b.outer.iter().chain(&b.inner).map(|c| c.coverage).sum::<f64>();
        let found = bars(views, clicked, p, options, false).0.into_iter().map(|b| b.1);
        if let Some(best) = found.max_by(|a, b| whole(a).total_cmp(&whole(b))) {
            return Ok(Pair { tried, ..best.into() });
        }
        let contours = told_apart(views, clicked);
        let points = [0, 1].map(|k| contours[k].edge_points(Outline::Outer));
        match reconstruct(&points[0], p[0], &points[1], p[1], options) {
            // A bar without thickness is one outline taken for two.
            Ok(r) if r.bar_radius.is_some_and(|b| b >= THINNEST * r.rim.a) => {
                return Ok(Pair { contours, inner: [None, None], reconstruction: r, tried });
            }
            Ok(r) => {
                let (sigma_centre, sigma_normal_deg) = (r.report.sigma_centre, r.report.sigma_normal.to_degrees());
                first.get_or_insert(Refusal::BarUndetermined { sigma_centre, sigma_normal_deg });
            }
            Err(e) => {
                first.get_or_insert(e);
            }
        }
    }
    let refusal = first.unwrap_or(Refusal::BadInput { what: "the selection", why: "no contour was found" });
    Err(Unpaired { refusal, swapped_fits: false })
}
