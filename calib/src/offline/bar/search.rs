//! The search for a round bar from one clicked outline per view: its other outline is where a bar of some thickness
//! would show it in *both* views.
//!
//! One outline of a bar leaves its thickness open, but nothing else: for every thickness there is one bar with the
//! clicked outlines, and it predicts the other outline in both images. Thicknesses are tried from thin to thick and
//! scored by the edges at the predicted outlines. Around the best ones all four outlines are followed along the
//! predicted curves (an outline is not an ellipse), and the bar is fitted to them until it converges.

use crate::offline::bar::found::BarFound;
use crate::offline::bar::outlines::{View, support};
use crate::offline::bar::settle::settle;
use crate::offline::bar::torus::{Free, Ray, Torus, fit, rays};
use crate::offline::contour::{Contour, ViewEdges};
use crate::offline::rim::model::{Options, Reconstruction};
use crate::offline::statistics::median;
use crate::offline::types::EdgePoint;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::camera_centre;
use nalgebra::Vector3;

/// Result of a search.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Search {
    /// Bars whose four outlines were found.
    pub(in crate::offline) found: Vec<BarFound>,
    /// Support of the best hypothesis, followed or not ([`FULL_SUPPORT`] where the other outline is entirely visible
    /// in both views).
    pub(in crate::offline) support: f64,
    /// Fraction of the other outline that carries edges at the best-supported thickness.
    pub(in crate::offline) seen: f64,
    /// The same at the median thickness.
    pub(in crate::offline) usual: f64,
    /// Number of thicknesses tried.
    pub(in crate::offline) tried: f64,
}

/// Support of an outline that is entirely visible in both views.
const FULL_SUPPORT: f64 = 1.5;

/// Thinnest and thickest image of a bar, as a fraction of the outline's semi-major axis.
const WIDTHS: [f64; 2] = [0.05, 0.65];
/// Thinnest image of a bar, pixels: thinner bars are lines.
const MIN_WIDTH_PX: f64 = 4.0;
/// Smallest step of the thickness, pixels.
const STEP_PX: f64 = 2.0;
/// Smallest fraction of an outline that has to carry edges for a hypothesis to be followed.
const MIN_FOLLOWED: f64 = 0.3;
/// Number of thicknesses at which the pose is fitted.
const KNOTS: usize = 5;
/// Largest scatter of a bar that ends the search, pixels.
const MAX_CERTAIN_SCATTER_PX: f64 = 0.3;
/// Smallest support of such a bar.
const MIN_CERTAIN_SUPPORT: f64 = 1.1;
/// Largest noise of such a bar, in units of the edges' own standard deviations.
const MAX_CERTAIN_NOISE: f64 = 1.4;
/// Largest number of hypotheses that are followed.
const MAX_HYPOTHESES: usize = 3;

/// A thickness that both views support.
#[derive(Clone, Copy, Debug)]
struct Hypothesis {
    torus: Torus,
    /// Whether the clicked outline is the outer one.
    clicked_outer: bool,
    support: f64,
    /// Likelihood that the edges are the other outline: strong edges count for more.
    likely: f64,
    /// Support of the median thickness.
    usual: f64,
}

/// Where a clean circle was clicked, a further hypothesis is followed only if it is this likely relative to the best:
/// the shading of a bright bar can be as strong as its outline.
const MIN_RELATIVE_LIKELIHOOD: f64 = 0.85;

/// Searches the bar whose outline was clicked. `plane` is centre, normal and radius of the contours as a plane rim.
/// With a known diameter only that thickness is tried. `clean` states that the contours fit a circle well.
pub(in crate::offline) fn find(
    views: [&ViewEdges<'_>; 2],
    clicked: [&Contour; 2],
    plane: (Vector3<f64>, Vector3<f64>, f64),
    p: [&Projection; 2],
    options: &Options,
    clean: bool,
) -> Search {
    let mut search = Search { found: Vec::new(), support: 0.0, seen: 0.0, usual: 0.0, tried: 0.0 };
    let Some(centres) = camera_centre(p[0]).zip(camera_centre(p[1])) else { return search };
    let views = [View::new(views[0], clicked[0], p[0], centres.0), View::new(views[1], clicked[1], p[1], centres.1)];
    let (hypotheses, tried) = hypotheses(&views, clicked, plane, options);
    search.tried = tried as f64;
    let likeliest = hypotheses.first().map_or(0.0, |g| g.likely);
    for g in hypotheses {
        if clean && g.likely < MIN_RELATIVE_LIKELIHOOD * likeliest {
            break;
        }
        search.support = search.support.max(g.support);
        if g.support / FULL_SUPPORT > search.seen {
            (search.seen, search.usual) = (g.support / FULL_SUPPORT, g.usual / FULL_SUPPORT);
        }
        let Some(bar) = settle(&views, g.torus, g.support, options) else { continue };
        // Two hypotheses often lead to the same bar.
        let same = |b: &BarFound| {
            let (x, y) = (&b.reconstruction, &bar.reconstruction);
            let near = 0.01 * x.rim.a;
            let r = |q: &Reconstruction| q.bar_radius.unwrap_or(0.0);
            (x.rim.a - y.rim.a).abs() < near && (r(x) - r(y)).abs() < near
        };
        let certain = bar.scatter() <= MAX_CERTAIN_SCATTER_PX
            && g.support >= MIN_CERTAIN_SUPPORT
            && bar.reconstruction.report.noise <= MAX_CERTAIN_NOISE;
        if !search.found.iter().any(same) {
            search.found.push(bar);
        }
        if certain {
            break;
        }
    }
    search
}

/// The best-supported thicknesses, and the number tried.
fn hypotheses(
    views: &[View<'_, '_>; 2],
    clicked: [&Contour; 2],
    (centre, normal, radius): (Vector3<f64>, Vector3<f64>, f64),
    options: &Options,
) -> (Vec<Hypothesis>, usize) {
    let thin = |c: &Contour, v: &View<'_, '_>| -> Option<Vec<Ray>> {
        let step = (c.points.len() / 40).max(1);
        let points: Vec<EdgePoint> = c.points.iter().step_by(step).map(|p| p.edge).collect();
        rays(&points, v.p)
    };
    let (Some(l), Some(r)) = (thin(clicked[0], &views[0]), thin(clicked[1], &views[1])) else { return (Vec::new(), 0) };
    let all: Vec<Ray> = l.into_iter().chain(r).collect();
    let keep = vec![true; all.len()];
    let major = 0.5 * (clicked[0].ellipse.a + clicked[1].ellipse.a);
    // Length of a pixel at the rim.
    let pixel = radius / major;
    let mut widths = Vec::new();
    if let Some(d) = options.bar_diameter {
        widths.push(d / pixel);
    } else {
        let mut w = (WIDTHS[0] * major).max(MIN_WIDTH_PX);
        while w < WIDTHS[1] * major {
            widths.push(w);
            w += STEP_PX.max(0.03 * w);
        }
    }
    let mut out: Vec<Hypothesis> = Vec::new();
    let (thin, thick) = (widths.first().copied().unwrap_or(0.0), widths.last().copied().unwrap_or(0.0));
    for clicked_outer in [true, false] {
        // The pose changes slowly with the thickness: a few fits, and linear interpolation between them.
        let knots: Vec<(f64, Torus)> = (0..KNOTS)
            .map(|k| thin + (thick - thin) * k as f64 / (KNOTS - 1) as f64)
            .filter_map(|w| {
                let bar = 0.5 * w * pixel;
                let core = if clicked_outer { radius - bar } else { radius + bar };
                let start = Torus { centre, normal, core, bar };
                fit(&all, &keep, &start, Free::KnownBar).map(|f| (w, f.torus))
            })
            .collect();
        let mut row: Vec<Hypothesis> = Vec::new();
        for w in &widths {
            let Some(t) = between(&knots, *w, 0.5 * w * pixel) else { continue };
            let (support, likely) = support(views, &t, clicked_outer, 2.0);
            row.push(Hypothesis { torus: t, clicked_outer, support, likely, usual: 0.0 });
        }
        let usual = median(row.iter().map(|g| g.support).collect());
        row.iter_mut().for_each(|g| g.usual = usual);
        for k in 0..row.len() {
            let w = |k: Option<usize>| k.and_then(|k| row.get(k)).map_or(0.0, |g| g.likely);
            if let Some(g) = row.get(k).filter(|g| {
                g.support >= 1.5 * MIN_FOLLOWED && g.likely > w(k.checked_sub(1)) && g.likely >= w(Some(k + 1))
            }) {
                out.push(refined(g, views, &knots, pixel));
            }
        }
    }
    out.sort_by(|a, b| b.likely.total_cmp(&a.likely));
    out.truncate(MAX_HYPOTHESES);
    (out, widths.len())
}

/// The bar of a given thickness, interpolated between fitted ones.
fn between(knots: &[(f64, Torus)], width: f64, bar: f64) -> Option<Torus> {
    let after = knots.iter().position(|k| k.0 >= width).unwrap_or(knots.len().checked_sub(1)?);
    let (b, a) = (knots.get(after)?, knots.get(after.saturating_sub(1))?);
    let f = if b.0 > a.0 { ((width - a.0) / (b.0 - a.0)).clamp(0.0, 1.0) } else { 0.0 };
    Some(Torus {
        centre: a.1.centre.lerp(&b.1.centre, f),
        normal: a.1.normal.lerp(&b.1.normal, f).try_normalize(0.5)?,
        core: a.1.core + (b.1.core - a.1.core) * f,
        bar,
    })
}

/// A hypothesis with its thickness refined to a fraction of a pixel: the best-supported one near it.
fn refined(hypothesis: &Hypothesis, views: &[View<'_, '_>; 2], knots: &[(f64, Torus)], pixel: f64) -> Hypothesis {
    let middle = 2.0 * hypothesis.torus.bar / pixel;
    let mut best = (0.0, hypothesis.torus);
    for k in -6..=6 {
        let w = middle + 0.5 * f64::from(k);
        let Some(t) = between(knots, w, 0.5 * w * pixel).filter(|t| t.bar > 0.0) else { continue };
        let likely = support(views, &t, hypothesis.clicked_outer, 1.0).1;
        if likely > best.0 {
            best = (likely, t);
        }
    }
    Hypothesis { torus: best.1, ..*hypothesis }
}
