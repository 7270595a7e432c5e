//! The decision between a plane rim and a round bar with the clicked outlines.

use crate::offline::bar::fit::bar_start;
use crate::offline::bar::search;
use crate::offline::contour::select::Candidate;
use crate::offline::contour::{Contour, ViewEdges};
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::decide::average::average;
use crate::offline::decide::bars::{FourOutlines, known_radius};
use crate::offline::decide::judged::{Judged, score};
use crate::offline::decide::likelihood::{Fitted, Shape, Stretch};
use crate::offline::decide::models::{Model, Weighed, bar_alone, prior, stretch};
use crate::offline::decide::result::{grasp_difference, reconstruction};
use crate::offline::rim::choice::tolerable_in_images;
use crate::offline::rim::model::{Options, Reconstruction, RimChoice, RimModel};
use crate::offline::rim::planar::analyse;
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::{EdgePoint, Outline};
use graspd_rt::geom::Rig;

/// A pair of contours that is accepted.
#[derive(Clone, Debug)]
pub struct Pair {
    /// The outer (or only) contours, left and right.
    pub contours: [Contour; 2],
    /// The inner outlines, where the rim turned out to be a round bar.
    pub inner: [Option<Contour>; 2],
    /// What they are an image of.
    pub reconstruction: Reconstruction,
    /// The rig corrected by its expected error: it predicts positions in the images.
    pub rig: Rig,
    /// Number of more likely pairs that were refused.
    pub tried: usize,
}

/// Largest probability of a wrong grasp that is accepted: one in a thousand selections, as specified.
pub(super) const MAX_WRONG: f64 = 1e-3;
/// Largest probability of unrelated contours in an accepted pair: their prior already counts every neighbour of the
/// selected contour, and about one selection in twenty is mistaken.
const MAX_UNRELATED: f64 = 0.02;
/// Number of pairs at which a bar is searched where no plane rim is accepted.
const MAX_BAR_PAIRS: usize = 8;
/// Number of independent points at which a bar's other outline is visible or not, in both views together.
const OTHER_OUTLINE_POINTS: f64 = 16.0;
/// Fraction of a bar's other outline that carries edges: hub, spokes and occluding objects hide the rest.
const OTHER_OUTLINE_SEEN: f64 = 0.75;
/// Log probability that a bar's outlines cannot be followed although they are visible: 6 of 400 rendered bare wheels.
const LOG_NOT_FOLLOWED: f64 = -4.2;
/// Largest smooth edge error of a clean circle, pixels: that of edges without neighbours.
const MAX_CLEAN_WAVE_PX: f64 = 0.1;

/// Pairs of candidates with their cost, cheapest first.
pub(super) type Ordered<'a> = Vec<(f64, &'a Candidate, &'a Candidate)>;

/// Weighs the bars that have the clicked outlines against the plane rim. `Ok(None)` where there is neither.
pub(super) fn bar_or_plane(
    views: [&ViewEdges<'_>; 2],
    order: &Ordered<'_>,
    best: Option<Judged>,
    rig: &RigError,
    options: &Options,
) -> Result<Option<Pair>, Refusal> {
    let likely: Vec<usize> = match &best {
        Some(j) => vec![j.tried],
        None => (0..order.len().min(MAX_BAR_PAIRS)).collect(),
    };
    let mut log_alone = prior(Model::Bar, options.rim).ln();
    let mut refused = None;
    for (_, l, r) in likely.iter().filter_map(|k| order.get(*k)) {
        let Some(found) = search_bars(views, [&l.contour, &r.contour], rig, options, best.as_ref()) else { continue };
        log_alone += found.log_unseen;
        let mut bars = found.bars;
        bars.sort_by(|a, b| b.log_odds().total_cmp(&a.log_odds()));
        let Some(bar) = bars.into_iter().next() else { continue };
        let odds = bar.log_odds();
        if odds > -MAX_WRONG.ln() {
            if is_plane_choice(options.rim) {
                return Err(Refusal::IsABar);
            }
            return Ok(Some(bar_pair(bar, rig)?));
        }
        if odds > MAX_WRONG.ln() {
            let differs = match (&best, bar.bar()) {
                (Some(j), Some(b)) => j.best().is_none_or(|p| lead_to_different_grasps(&p.fitted, b, rig)),
                _ => true,
            };
            if differs {
                refused = Some(Refusal::RimAmbiguous);
            }
        }
    }
    if let Some(e) = refused {
        return Err(e);
    }
    let Some(best) = best else { return Ok(None) };
    plane_pair(best, log_alone, rig, options).map(Some)
}

/// Largest distance of centres up to which two models lead to the same grasp, metres: half of what the jaws tolerate.
const MAX_SAME_CENTRE_M: f64 = 1e-3;
/// The same for the angle of the normals, radians.
const MAX_SAME_NORMAL_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;

/// Whether the operator specified a plane rim.
fn is_plane_choice(choice: RimChoice) -> bool {
    matches!(choice, RimChoice::Edge | RimChoice::Circle | RimChoice::Ellipse)
}

/// Whether two models lead to different grasps.
fn lead_to_different_grasps(a: &Fitted, b: &Fitted, rig: &RigError) -> bool {
    let (centre, normal) = grasp_difference(a, b, rig);
    !(centre <= MAX_SAME_CENTRE_M && normal <= MAX_SAME_NORMAL_RAD)
}

/// Smallest bar radius as a fraction of the core radius: the two outlines of a thinner bar are one line.
const MIN_BAR_FRACTION: f64 = 0.015;

fn is_thick(bar: &Fitted) -> bool {
    matches!(bar.shapes.first(), Some(Shape::Bar(t, _)) if t.bar >= MIN_BAR_FRACTION * t.core)
}

/// Bars with the clicked outlines.
struct Bars {
    bars: Vec<FourOutlines>,
    /// Log likelihood ratio of a bar against a plane rim, from the visibility of the other outline at any thickness.
    log_unseen: f64,
}

fn search_bars(
    views: [&ViewEdges<'_>; 2],
    clicked: [&Contour; 2],
    rig: &RigError,
    options: &Options,
    best: Option<&Judged>,
) -> Option<Bars> {
    let p = [&rig.p[0], &rig.p[1]];
    let points = [0, 1].map(|k| clicked[k].edge_points(Outline::Outer));
    let start = analyse([&points[0], &points[1]], p, options).ok()?.any_rim()?;
    let clean = best
        .is_some_and(|j| j.best().is_some_and(|b| b.model == Model::Circle && b.fitted.wave_px <= MAX_CLEAN_WAVE_PX));
    let plane = (start.centre, start.normal, (start.a * start.b).sqrt());
    let search = search::find(views, clicked, plane, p, &options.without_tolerance(), clean);
    let (seen, usual) = (search.seen.clamp(0.02, 0.98), search.usual.clamp(0.02, OTHER_OUTLINE_SEEN - 0.05));
    let as_bar = seen * (OTHER_OUTLINE_SEEN / usual).ln();
    let as_none = (1.0 - seen) * ((1.0 - OTHER_OUTLINE_SEEN) / (1.0 - usual)).ln();
    let mut log_unseen = (OTHER_OUTLINE_POINTS * (as_bar + as_none) - search.tried.max(1.0).ln()).min(0.0);
    let followed = search.found.iter().any(|b| b.support > 0.9 * search.support);
    log_unseen = if followed { MAX_WRONG.ln() * 2.0 } else { log_unseen + LOG_NOT_FOLLOWED };
    let bars = search.found.into_iter().filter_map(|b| FourOutlines::new(b, rig, options)).collect();
    Some(Bars { bars, log_unseen })
}

fn bar_pair(bar: FourOutlines, rig: &RigError) -> Result<Pair, Refusal> {
    let fitted = bar.bar().ok_or(Refusal::RimAmbiguous)?;
    let model = |m: Model| match m {
        Model::Bar => Some(RimModel::RoundBar),
        Model::Circle => Some(RimModel::Circle),
        Model::Ellipse => Some(RimModel::Ellipse),
        _ => None,
    };
    let scores = bar.models.iter().filter_map(|m| Some(score(model(m.model)?, m))).collect();
    let all = [0, 1].map(|k| bar.found.points(k));
    let r = reconstruction(fitted, scores, &bar.outer, [&all[0], &all[1]], &bar.stretches, rig)?;
    let corrected = rig.corrected(fitted.phi.as_slice());
    Ok(Pair {
        contours: bar.found.outer,
        inner: bar.found.inner.map(Some),
        reconstruction: r,
        rig: corrected,
        tried: 0,
    })
}

/// The plane rim, or the bar of which only the clicked outlines are visible, if the other of the two is excluded.
fn plane_pair(best: Judged, log_bar: f64, rig: &RigError, options: &Options) -> Result<Pair, Refusal> {
    let chosen = best.best().ok_or(Refusal::NoFit { why: "no plane model fits" })?;
    if 1.0 - best.rim() > MAX_UNRELATED {
        return Err(best.refusal(rig));
    }
    let contours = [&best.contours[0], &best.contours[1]];
    let points = [0, 1].map(|k| best.contours[k].edge_points(Outline::Outer));
    let lists: [&[EdgePoint]; 2] = [&points[0], &points[1]];
    let p = [&rig.p[0], &rig.p[1]];
    let bar = bar_start(lists, p, &best.analysis, options)
        .and_then(|torus| bar_alone(contours, torus, known_radius(options), rig))
        .filter(is_thick);
    if let Some(bar) = &bar {
        let odds = bar.log_evidence + log_bar - best.log_rim();
        let alone = || -> Result<Pair, Refusal> {
            let stretches: Vec<Stretch> = [0, 1].map(|k| stretch(k, contours[k], Outline::Outer, 0)).into();
            let r = reconstruction(bar, best.scores(), &best.analysis, lists, &stretches, rig)?;
            if tolerable_in_images(&r, options).is_err() {
                let (sigma_centre, normal) = (r.report.sigma_centre_in_images, r.report.sigma_normal_in_images);
                let sigma_normal_deg = normal.to_degrees();
                return Err(Refusal::BarUndetermined { sigma_centre, sigma_normal_deg });
            }
            let rig = rig.corrected(bar.phi.as_slice());
            Ok(Pair { contours: best.contours.clone(), inner: [None, None], reconstruction: r, rig, tried: best.tried })
        };
        // Where both lead to the same grasp no decision is needed, and the plane rim is simpler.
        let differs = lead_to_different_grasps(bar, &chosen.fitted, rig);
        if differs && odds > -MAX_WRONG.ln() {
            if is_plane_choice(options.rim) {
                return Err(Refusal::IsABar);
            }
            return alone();
        }
        if differs && odds > MAX_WRONG.ln() {
            return Err(Refusal::RimAmbiguous);
        }
    }
    if options.rim == RimChoice::RoundBar {
        return Err(Refusal::NotABar);
    }
    let stretches: Vec<Stretch> = [0, 1].map(|k| stretch(k, contours[k], Outline::Outer, 0)).into();
    let make = |w: &Weighed| reconstruction(&w.fitted, best.scores(), &best.analysis, lists, &stretches, rig);
    let mut r = make(chosen)?;
    // Another plane model may be right as well: the answer stays, and its covariance becomes that of both.
    for other in &best.models {
        let weight = best.probability(other.model) / best.rim();
        if matches!(other.model, Model::Circle | Model::NearlyRound | Model::Ellipse)
            && other.model != chosen.model
            && weight > MAX_WRONG
        {
            if let Ok(o) = make(other) {
                average(&mut r, &o, weight);
            }
        }
    }
    let corrected = rig.corrected(chosen.fitted.phi.as_slice());
    let tried = best.tried;
    Ok(Pair { contours: best.contours, inner: [None, None], reconstruction: r, rig: corrected, tried })
}
