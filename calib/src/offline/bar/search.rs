//! A round bar looked for from one clicked outline a view: its other outline is where a bar of some thickness would show it in *both* views.
//!
//! One outline of a bar leaves its thickness open, but nothing else: for every thickness there is one bar that has the clicked outlines, and it says
//! where the other outline has to be in both images. So thickness is tried from thin to thick, and each is judged by the edges there. Around the best ones
//! all four outlines are followed along the curves that the bar predicts (an outline is no ellipse) and the bar is fitted to them, until it stands still.

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

/// What a search found.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Search {
    /// Bars whose four outlines are there.
    pub(in crate::offline) found: Vec<BarFound>,
    /// Support of the best guess, followed or not (1.5 where the other outline is seen whole in both views).
    pub(in crate::offline) support: f64,
    /// Part of the other outline that carries edges at the best-supported thickness, and at the usual one.
    pub(in crate::offline) seen: f64,
    pub(in crate::offline) usual: f64,
    /// Number of thicknesses that were tried.
    pub(in crate::offline) tried: f64,
}

/// Support of an outline that is seen whole in both views.
const WHOLE: f64 = 1.5;

/// Thinnest and thickest image of a bar, in parts of the outline's semi-major axis.
const WIDTH: [f64; 2] = [0.05, 0.65];
/// Thinnest image of a bar, pixels: what is thinner is a line.
const THIN_PX: f64 = 4.0;
/// Step of the search, pixels.
const STEP: f64 = 2.0;
/// Least part of an outline that has to carry edges for a guess to be followed up.
const FOLLOWED: f64 = 0.3;
/// Thicknesses at which the pose is fitted.
const KNOTS: usize = 5;
/// Scatter (pixels), support and noise (in the edges' own) of a bar that makes further guesses needless.
const PLAIN: (f64, f64, f64) = (0.3, 1.1, 1.4);
/// Guesses followed up.
const GUESSES: usize = 3;

/// A thickness that both views support.
#[derive(Clone, Copy, Debug)]
struct Guess {
    torus: Torus,
    /// Whether the clicked outline is the outer one.
    clicked_outer: bool,
    worth: f64,
    /// How likely the edges are the other outline: strong ones count for more.
    likely: f64,
    /// What the median thickness is worth.
    usual: f64,
}

/// Where a clean circle was clicked, only a guess this likely, in parts of the likeliest, is followed up besides it: a bright bar's shading may be the equal of
/// its outline.
const AS_LIKELY: f64 = 0.85;

/// Looks for the bar whose outline was clicked. `plane` is what the contours are an image of if they are a plane rim; with the bar's diameter known only that is tried.
pub(in crate::offline) fn find(
    views: [&ViewEdges<'_>; 2],
    clicked: [&Contour; 2],
    plane: (Vector3<f64>, Vector3<f64>, f64),
    p: [&Projection; 2],
    options: &Options,
    clean: bool,
) -> Search {
    let mut search = Search { found: Vec::new(), support: 0.0, seen: 0.0, usual: 0.0, tried: 0.0 };
    let Some(eyes) = camera_centre(p[0]).zip(camera_centre(p[1])) else { return search };
    let views = [View::new(views[0], clicked[0], p[0], eyes.0), View::new(views[1], clicked[1], p[1], eyes.1)];
    let (guesses, tried) = guesses(&views, clicked, plane, options);
    search.tried = tried as f64;
    let likeliest = guesses.first().map_or(0.0, |g| g.likely);
    for g in guesses {
        if clean && g.likely < AS_LIKELY * likeliest {
            break;
        }
        search.support = search.support.max(g.worth);
        if g.worth / WHOLE > search.seen {
            (search.seen, search.usual) = (g.worth / WHOLE, g.usual / WHOLE);
        }
        let Some(bar) = settle(&views, g.torus, g.worth, options) else { continue };
        // Two guesses often lead to one bar.
        let same = |b: &BarFound| {
            let (x, y) = (&b.reconstruction, &bar.reconstruction);
            let near = 0.01 * x.rim.a;
            let r = |q: &Reconstruction| q.bar_radius.unwrap_or(0.0);
            (x.rim.a - y.rim.a).abs() < near && (r(x) - r(y)).abs() < near
        };
        let plain = bar.scatter() <= PLAIN.0 && g.worth >= PLAIN.1 && bar.reconstruction.report.noise <= PLAIN.2;
        if !search.found.iter().any(same) {
            search.found.push(bar);
        }
        if plain {
            break;
        }
    }
    search
}

/// The best-supported thicknesses.
fn guesses(
    views: &[View<'_, '_>; 2],
    clicked: [&Contour; 2],
    (centre, normal, radius): (Vector3<f64>, Vector3<f64>, f64),
    options: &Options,
) -> (Vec<Guess>, usize) {
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
        let mut w = (WIDTH[0] * major).max(THIN_PX);
        while w < WIDTH[1] * major {
            widths.push(w);
            w += STEP.max(0.03 * w);
        }
    }
    let mut out: Vec<Guess> = Vec::new();
    let (thin, thick) = (widths.first().copied().unwrap_or(0.0), widths.last().copied().unwrap_or(0.0));
    for clicked_outer in [true, false] {
        // The pose that goes with a thickness changes slowly with it: a few fits, and straight lines between them.
        let knots: Vec<(f64, Torus)> = (0..KNOTS)
            .map(|k| thin + (thick - thin) * k as f64 / (KNOTS - 1) as f64)
            .filter_map(|w| {
                let bar = 0.5 * w * pixel;
                let core = if clicked_outer { radius - bar } else { radius + bar };
                let start = Torus { centre, normal, core, bar };
                fit(&all, &keep, &start, Free::KnownBar).map(|f| (w, f.torus))
            })
            .collect();
        let mut row: Vec<Guess> = Vec::new();
        for w in &widths {
            let Some(t) = between(&knots, *w, 0.5 * w * pixel) else { continue };
            let (worth, likely) = support(views, &t, clicked_outer, 2.0);
            row.push(Guess { torus: t, clicked_outer, worth, likely, usual: 0.0 });
        }
        let usual = median(row.iter().map(|g| g.worth).collect());
        row.iter_mut().for_each(|g| g.usual = usual);
        for k in 0..row.len() {
            let w = |k: Option<usize>| k.and_then(|k| row.get(k)).map_or(0.0, |g| g.likely);
            if let Some(g) = row
                .get(k)
                .filter(|g| g.worth >= 1.5 * FOLLOWED && g.likely > w(k.checked_sub(1)) && g.likely >= w(Some(k + 1)))
            {
                out.push(sharper(g, views, &knots, pixel));
            }
        }
    }
    out.sort_by(|a, b| b.likely.total_cmp(&a.likely));
    out.truncate(GUESSES);
    (out, widths.len())
}

/// The bar of some thickness from its neighbours among the fitted ones.
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

/// A guess with its thickness to a fraction of a pixel: the best-supported one near it, its pose fitted anew.
fn sharper(guess: &Guess, views: &[View<'_, '_>; 2], knots: &[(f64, Torus)], pixel: f64) -> Guess {
    let middle = 2.0 * guess.torus.bar / pixel;
    let mut best = (0.0, guess.torus);
    for k in -6..=6 {
        let w = middle + 0.5 * f64::from(k);
        let Some(t) = between(knots, w, 0.5 * w * pixel).filter(|t| t.bar > 0.0) else { continue };
        let likely = support(views, &t, guess.clicked_outer, 1.0).1;
        if likely > best.0 {
            best = (likely, t);
        }
    }
    Guess { torus: best.1, ..*guess }
}
