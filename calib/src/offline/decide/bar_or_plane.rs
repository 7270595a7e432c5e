//! BOP

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
use crate::offline::decide::result::{apart, reconstruction};
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
    /// The rig with its expected error put right: what predicts places in the images.
    pub rig: Rig,
    /// How many likelier pairs were refused before.
    pub tried: usize,
}

/// Probability of a wrong grasp that is accepted: one in a thousand selections, as the specification has it.
const MOST_WRONG: f64 = 1e-3;
/// Probability of unrelated contours up to which a pair is taken: their prior already counts every neighbour of the
/// contour that was meant, and one selection in twenty is mistaken at all.
const MOST_UNRELATED: f64 = 0.02;
/// Pairs at which a bar is looked for where no plane rim is accepted.
const BAR_PAIRS: usize = 8;
/// Independent places at which a bar's other outline is seen or not, in both views together.
const OTHER_OUTLINE_PLACES: f64 = 16.0;
/// Part of a bar's other outline that carries edges: hub, spokes and what stands before it hide the rest.
const OTHER_OUTLINE_SEEN: f64 = 0.75;
/// Logarithm of the probability that a bar's outlines cannot be followed although they are there: 6 of 400 rendered
/// bare wheels.
const LOG_NOT_FOLLOWED: f64 = -4.2;
/// Smooth edge error up to which a circle is a clean one, pixels: what edges on their own have.
const CLEAN_PX: f64 = 0.1;

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
        None => (0..order.len().min(BAR_PAIRS)).collect(),
    };
    let mut log_alone = prior(Model::Bar, options.rim).ln();
    let mut refused = None;
    for (_, l, r) in likely.iter().filter_map(|k| order.get(*k)) {
        let Some(found) = look_for_bars(views, [&l.contour, &r.contour], rig, options, best.as_ref()) else { continue };
        log_alone += found.log_unseen;
        let mut bars = found.bars;
        bars.sort_by(|a, b| b.log_odds().total_cmp(&a.log_odds()));
        let Some(bar) = bars.into_iter().next() else { continue };
        let odds = bar.log_odds();
        if odds > -MOST_WRONG.ln() {
            if is_plane(options.rim) {
                return Err(Refusal::IsABar);
            }
            return Ok(Some(bar_pair(bar, rig)?));
        }
        if odds > MOST_WRONG.ln() {
            let differs = match (&best, bar.bar()) {
                (Some(j), Some(b)) => j.best().is_none_or(|p| differ(&p.fitted, b, rig)),
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

/// Distance of centres, metres, and angle of normals, radians, from which two models lead to different grasps: half
/// of what the jaws forgive.
const SAME_CENTRE_M: f64 = 1e-3;
const SAME_NORMAL_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;

/// Whether the operator has named a plane rim.
fn is_plane(choice: RimChoice) -> bool {
    matches!(choice, RimChoice::Edge | RimChoice::Circle | RimChoice::Ellipse)
}

/// Whether two models lead to different grasps.
fn differ(a: &Fitted, b: &Fitted, rig: &RigError) -> bool {
    let (centre, normal) = apart(a, b, rig);
    !(centre <= SAME_CENTRE_M && normal <= SAME_NORMAL_RAD)
}

/// Thinnest bar as a fraction of its ring's radius: a thinner one is a line, and the two outlines of it are one.
const THINNEST: f64 = 0.015;

fn is_thick(bar: &Fitted) -> bool {
    matches!(bar.shapes.first(), Some(Shape::Bar(t, _)) if t.bar >= THINNEST * t.core)
}

/// Bars with the clicked outlines.
struct Bars {
    bars: Vec<FourOutlines>,
    /// Logarithm of how much less likely a bar is for its other outline not being where one of any thickness would
    /// have it.
    log_unseen: f64,
}

fn look_for_bars(
    views: [&ViewEdges<'_>; 2],
    clicked: [&Contour; 2],
    rig: &RigError,
    options: &Options,
    best: Option<&Judged>,
) -> Option<Bars> {
    let p = [&rig.p[0], &rig.p[1]];
    let points = [0, 1].map(|k| clicked[k].edge_points(Outline::Outer));
    let start = analyse([&points[0], &points[1]], p, options).ok()?.any_rim()?;
    let clean =
        best.is_some_and(|j| j.best().is_some_and(|b| b.model == Model::Circle && b.fitted.wave_px <= CLEAN_PX));
    let plane = (start.centre, start.normal, (start.a * start.b).sqrt());
    let search = search::find(views, clicked, plane, p, &options.without_tolerance(), clean);
    let (seen, usual) = (search.seen.clamp(0.02, 0.98), search.usual.clamp(0.02, OTHER_OUTLINE_SEEN - 0.05));
    let as_bar = seen * (OTHER_OUTLINE_SEEN / usual).ln();
    let as_none = (1.0 - seen) * ((1.0 - OTHER_OUTLINE_SEEN) / (1.0 - usual)).ln();
    let mut log_unseen = (OTHER_OUTLINE_PLACES * (as_bar + as_none) - search.tried.max(1.0).ln()).min(0.0);
    let followed = search.found.iter().any(|b| b.support > 0.9 * search.support);
    log_unseen = if followed { MOST_WRONG.ln() * 2.0 } else { log_unseen + LOG_NOT_FOLLOWED };
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
    let put_right = rig.corrected(fitted.phi.as_slice());
    Ok(Pair {
        contours: bar.found.outer,
        inner: bar.found.inner.map(Some),
        reconstruction: r,
        rig: put_right,
        tried: 0,
    })
}

/// The plane rim, or the bar of which only the clicked outlines are seen, if one of both is out of the question.
fn plane_pair(best: Judged, log_bar: f64, rig: &RigError, options: &Options) -> Result<Pair, Refusal> {
    let chosen = best.best().ok_or(Refusal::NoFit { why: "no plane model fits" })?;
    if 1.0 - best.rim() > MOST_UNRELATED {
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
        // Where both lead to one grasp nothing has to be decided, and the plane rim is the simpler.
        let differs = differ(bar, &chosen.fitted, rig);
        if differs && odds > -MOST_WRONG.ln() {
            if is_plane(options.rim) {
                return Err(Refusal::IsABar);
            }
            return alone();
        }
        if differs && odds > MOST_WRONG.ln() {
            return Err(Refusal::RimAmbiguous);
        }
    }
    if options.rim == RimChoice::RoundBar {
        return Err(Refusal::NotABar);
    }
    let stretches: Vec<Stretch> = [0, 1].map(|k| stretch(k, contours[k], Outline::Outer, 0)).into();
    let make = |w: &Weighed| reconstruction(&w.fitted, best.scores(), &best.analysis, lists, &stretches, rig);
    let mut r = make(chosen)?;
    // The other plane model may be right as well: the answer stays, and its covariance becomes that of both.
    for other in &best.models {
        let share = best.probability(other.model) / best.rim();
        if matches!(other.model, Model::Circle | Model::NearlyRound | Model::Ellipse)
            && other.model != chosen.model
            && share > MOST_WRONG
        {
            if let Ok(o) = make(other) {
                average(&mut r, &o, share);
            }
        }
    }
    let put_right = rig.corrected(chosen.fitted.phi.as_slice());
    let tried = best.tried;
    Ok(Pair { contours: best.contours, inner: [None, None], reconstruction: r, rig: put_right, tried })
}
