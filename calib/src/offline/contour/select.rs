//! From the operator's selection to candidate contours.
//!
//! A click near a painted line means one of its two edges, and the click alone does not say which; the other view
//! decides. A selection therefore gives several candidate contours, most likely first, each through edges next to the
//! click. The pair that is the image of one rim is chosen later (see [`crate::offline::decide::pairing`]).

use crate::offline::contour::grow::Trial;
use crate::offline::contour::one_ellipse::{Contour, MIN_COVERAGE, alike};
use crate::offline::contour::quick_fit::Walk;
use crate::offline::contour::view_edges::ViewEdges;
use graspd_rt::geom::{Pixel, View};

/// The operator's selection in one view, raw pixels.
#[derive(Clone, Debug, PartialEq)]
pub enum Selection {
    /// A click near the contour.
    Click(Pixel),
    /// Several points on the contour.
    Points(Vec<Pixel>),
    /// Two opposite corners of a box around the contour.
    Box(Pixel, Pixel),
}

impl Selection {
    /// The kind as written to the plan file.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Click(_) => "click",
            Self::Points(_) => "points",
            Self::Box(..) => "box",
        }
    }

    /// The selected pixels.
    pub fn pixels(&self) -> Vec<Pixel> {
        match self {
            Self::Click(p) => vec![*p],
            Self::Points(p) => p.clone(),
            Self::Box(a, b) => vec![*a, *b],
        }
    }
}

/// Why a selection gives no contour.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SelectError {
    /// A pixel outside the image.
    #[error("the {} selection ({:.1}, {:.1}) is outside the {width}x{height} image: click inside it", name(.view), at.x, at.y)]
    Outside {
        /// The view.
        view: View,
        /// The pixel.
        at: Pixel,
        /// Width of the image.
        width: usize,
        /// Height of the image.
        height: usize,
    },
    /// No edge near the click.
    #[error("no edge within {radius:.0} px of the {} click ({:.1}, {:.1}){}: click closer to the contour", name(.view), at.x, at.y, nearest_text(.nearest))]
    NoEdge {
        /// The view.
        view: View,
        /// The click.
        at: Pixel,
        /// Radius of the search, pixels.
        radius: f64,
        /// The nearest edge that is part of an arc, if any.
        nearest: Option<Pixel>,
    },
    /// Edges, but no ellipse.
    #[error("the edges near the {} selection ({:.1}, {:.1}) do not form an ellipse: the best one has edges on {percent:.0} % of its outline, at least {least:.0} % on one smooth line are required: click the rim itself, or several points on it", name(.view), at.x, at.y)]
    NoEllipse {
        /// The view.
        view: View,
        /// The click or the middle of the selection.
        at: Pixel,
        /// Coverage of the best ellipse, percent.
        percent: f64,
        /// The required coverage, percent.
        least: f64,
    },
    /// A box without edges, or too few points.
    #[error("the {} selection is empty: {fix}", name(.view))]
    Empty {
        /// The view.
        view: View,
        /// What to do.
        fix: &'static str,
    },
}

fn name(view: &View) -> &'static str {
    match view {
        View::Left => "left",
        View::Right => "right",
    }
}

fn nearest_text(p: &Option<Pixel>) -> String {
    p.map_or(String::new(), |p| format!(", the nearest is at ({:.0}, {:.0})", p.x, p.y))
}

/// A candidate contour with its cost.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The contour.
    pub contour: Contour,
    /// Distance from the selection in pixels, plus penalties for missing outline and for scatter. The smallest cost is
    /// the most likely.
    pub cost: f64,
}

/// Largest distance between a click and an edge, pixels: the accuracy of a hand on a large image.
pub fn snap_radius(width: usize) -> f64 {
    (0.01 * width as f64).clamp(8.0, 20.0)
}

/// Cost above which a contour through the edges at the click is doubtful, so that contours with a gap there are tried
/// too, pixels.
const MAX_CERTAIN_COST_PX: f64 = 6.0;
/// Penalty of a contour without an edge at the click, pixels.
const GAP_COST_PX: f64 = 3.0;
/// Largest number of arcs tried for such a contour.
const MAX_GAP_SEEDS: usize = 6;

/// Candidate contours of a selection, most likely first, at most `keep`.
///
/// # Errors
/// [`SelectError`] when a pixel is outside the image, or no edge or no ellipse is near the selection.
pub fn contours(
    view: View,
    edges: &ViewEdges<'_>,
    selection: &Selection,
    keep: usize,
) -> Result<Vec<Candidate>, SelectError> {
    for p in selection.pixels() {
        if !edges.image.contains(p, 0.0) {
            let (width, height) = (edges.image.width(), edges.image.height());
            return Err(SelectError::Outside { view, at: p, width, height });
        }
    }
    match selection {
        Selection::Click(p) => click(view, edges, *p, keep),
        Selection::Points(p) => points(view, edges, p, keep),
        Selection::Box(a, b) => boxed(view, edges, *a, *b, keep),
    }
}

/// Penalty against a contour being a rim, in pixels of click distance: a gappy outline, and edges that scatter about
/// the ellipse.
fn penalty(c: &Contour) -> f64 {
    let missing = 1.0 - c.coverage;
    8.0 * missing * missing + 5.0 * c.rms_px.min(2.0)
}

/// One edge of each arc near a pixel, nearest first.
fn seeds(edges: &ViewEdges<'_>, at: Pixel, radius: f64) -> Vec<(f64, usize)> {
    let mut best: std::collections::BTreeMap<usize, (f64, usize)> = std::collections::BTreeMap::new();
    for (k, e) in edges.map.near(at, radius.ceil() as i32) {
        let d = (e.at - at).norm();
        let Some(arc) = edges.arcs.of(k) else { continue };
        let slot = best.entry(arc).or_insert((f64::INFINITY, 0));
        if d <= radius && d < slot.0 {
            *slot = (d, k);
        }
    }
    let mut out: Vec<_> = best.into_values().filter(|s| s.0.is_finite()).collect();
    out.sort_by(|a, b| a.0.total_cmp(&b.0));
    out
}

fn click(view: View, edges: &ViewEdges<'_>, at: Pixel, keep: usize) -> Result<Vec<Candidate>, SelectError> {
    let radius = snap_radius(edges.image.width());
    let seeds = seeds(edges, at, radius);
    if seeds.is_empty() {
        let nearest = edges
            .map
            .edges()
            .iter()
            .enumerate()
            .filter(|(k, _)| edges.arcs.of(*k).is_some())
            .map(|(_, e)| e.at)
            .min_by(|p, q| (p - at).norm_squared().total_cmp(&(q - at).norm_squared()));
        return Err(SelectError::NoEdge { view, at, radius, nearest });
    }
    let mut out: Vec<Candidate> = Vec::new();
    let mut best = 0.0f64;
    for (_, seed) in seeds.iter().take(6) {
        for t in edges.trials(*seed, 3) {
            best = best.max(t.coverage);
            if let Some(contour) = edges.contour(&t) {
                let cost = contour.distance(at) + penalty(&contour);
                push(&mut out, Candidate { contour, cost });
            }
        }
    }
    if out.iter().all(|c| c.cost > MAX_CERTAIN_COST_PX) {
        through(edges, at, radius, &mut out);
    }
    finish(view, at, best, out, keep)
}

/// Adds contours that have a gap at the click.
fn through(edges: &ViewEdges<'_>, at: Pixel, radius: f64, out: &mut Vec<Candidate>) {
    let Some(ideal) = edges.lens.ideal(at) else { return };
    for seed in edges.passing(ideal, radius, MAX_GAP_SEEDS) {
        // Most arcs of a contour lead to the same ellipse.
        let known = |c: &Candidate| {
            edges.arcs.ideal.get(seed).is_some_and(|e| Walk::new(&c.contour.ellipse).measure(e.at).0.abs() < 1.0)
        };
        if out.iter().any(known) {
            continue;
        }
        for t in edges.trials(seed, 1) {
            let off = Walk::new(&t.ellipse).measure(ideal).0.abs();
            if off > radius {
                continue;
            }
            if let Some(contour) = edges.contour(&t) {
                let cost = off + penalty(&contour) + GAP_COST_PX;
                push(out, Candidate { contour, cost });
            }
        }
    }
}

fn points(view: View, edges: &ViewEdges<'_>, at: &[Pixel], keep: usize) -> Result<Vec<Candidate>, SelectError> {
    let Some(first) = at.first() else {
        return Err(SelectError::Empty { view, fix: "give at least one point on the contour" });
    };
    let radius = snap_radius(edges.image.width());
    let mut out: Vec<Candidate> = Vec::new();
    let (mut best, mut any) = (0.0f64, false);
    for p in at.iter().take(32) {
        for (_, seed) in seeds(edges, *p, radius).iter().take(2) {
            any = true;
            for t in edges.trials(*seed, 2) {
                best = best.max(t.coverage);
                // Three quarters of the points have to lie on the contour: one misplaced point is tolerated, a
                // different contour is not.
                let far = |t: &Trial| {
                    let w = Walk::new(&t.ellipse);
                    let mut d: Vec<f64> = at
                        .iter()
                        .map(|p| edges.lens.ideal(*p).map_or(f64::INFINITY, |i| w.measure(i).0.abs()))
                        .collect();
                    d.sort_by(f64::total_cmp);
                    d.get((3 * d.len() / 4).min(d.len() - 1)).copied().unwrap_or(f64::INFINITY)
                };
                let d = far(&t);
                if d > radius {
                    continue;
                }
                if let Some(contour) = edges.contour(&t) {
                    let cost = d + penalty(&contour);
                    push(&mut out, Candidate { contour, cost });
                }
            }
        }
    }
    if !any {
        return Err(SelectError::NoEdge { view, at: *first, radius, nearest: None });
    }
    let middle = at.iter().sum::<Pixel>() / at.len() as f64;
    finish(view, middle, best, out, keep)
}

fn boxed(view: View, edges: &ViewEdges<'_>, a: Pixel, b: Pixel, keep: usize) -> Result<Vec<Candidate>, SelectError> {
    let (lo, hi) = (a.inf(&b), a.sup(&b));
    let middle = (lo + hi) * 0.5;
    if (hi - lo).min() < 8.0 {
        return Err(SelectError::Empty { view, fix: "draw a box of at least 8 px around the contour" });
    }
    let inside = |p: Pixel| p.x >= lo.x - 3.0 && p.y >= lo.y - 3.0 && p.x <= hi.x + 3.0 && p.y <= hi.y + 3.0;
    let mut arcs: Vec<_> = edges
        .arcs
        .arcs
        .iter()
        .filter(|a| a.edges.iter().step_by(4).filter_map(|k| edges.map.edges().get(*k as usize)).all(|e| inside(e.at)))
        .collect();
    arcs.sort_by_key(|a| std::cmp::Reverse(a.edges.len()));
    let mut out: Vec<Candidate> = Vec::new();
    let mut best = 0.0f64;
    for arc in arcs.iter().take(40) {
        let Some(seed) = arc.edges.get(arc.edges.len() / 2) else { continue };
        if let Some(p) = edges.map.edges().get(*seed as usize).and_then(|e| edges.lens.ideal(e.at)) {
            // Most seeds lie on a contour that is already found.
            if out.iter().any(|c| Walk::new(&c.contour.ellipse).measure(p).0.abs() < 1.0) {
                continue;
            }
        }
        for t in edges.trials(*seed as usize, 1) {
            best = best.max(t.coverage);
            let Some(contour) = edges.contour(&t) else { continue };
            let (mut l, mut h) = (Pixel::repeat(f64::INFINITY), Pixel::repeat(f64::NEG_INFINITY));
            let w = Walk::new(&contour.ellipse);
            for t in w.parameters(4.0, 400) {
                let p = edges.lens.raw(w.at(t).0);
                l = l.inf(&p);
                h = h.sup(&p);
            }
            if !(inside(l) && inside(h)) {
                continue;
            }
            // The contour that fills the box best is the most likely.
            let gap = (l - lo).abs().max().max((hi - h).abs().max());
            let cost = gap + penalty(&contour);
            push(&mut out, Candidate { contour, cost });
        }
    }
    if arcs.is_empty() {
        return Err(SelectError::Empty { view, fix: "there are no edges in the box; draw it around the contour" });
    }
    finish(view, middle, best, out, keep)
}

fn push(out: &mut Vec<Candidate>, c: Candidate) {
    match out
        .iter_mut()
        .find(|o| alike(&o.contour.ellipse, &c.contour.ellipse) && o.contour.bright_inside == c.contour.bright_inside)
    {
        Some(o) if o.cost <= c.cost => {}
        Some(o) => *o = c,
        None => out.push(c),
    }
}

fn finish(
    view: View,
    at: Pixel,
    best: f64,
    mut out: Vec<Candidate>,
    keep: usize,
) -> Result<Vec<Candidate>, SelectError> {
    if out.is_empty() {
        return Err(SelectError::NoEllipse { view, at, percent: 100.0 * best, least: 100.0 * MIN_COVERAGE });
    }
    out.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    out.truncate(keep);
    Ok(out)
}
