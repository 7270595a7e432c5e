//! A round bar looked for from one clicked outline a view: its other outline is where a bar of some thickness would show it in *both* views.
//!
//! One outline of a bar leaves its thickness open, but nothing else: for every thickness there is one bar that has the clicked outlines, and it says
//! where the other outline has to be in both pictures. So thickness is tried from thin to thick, and each is judged by the edges there. Around the best ones
//! all four outlines are followed along the curves that the bar predicts (an outline is no ellipse) and the bar is fitted to them, until it stands still.

use crate::offline::bar::torus::{Free, Ray, Torus, fit, outline, rays};
use crate::offline::contour::follow::{Place, STEP_PX, places};
use crate::offline::contour::{Contour, ViewEdges};
use crate::offline::rim::cone::{camera_centre, project};
use crate::offline::rim::model::{EdgePoint, Options, Outline, Projection, Reconstruction, RimChoice, RimModel};
use crate::offline::rim::reconstruct::reconstruct;
use nalgebra::Vector3;

/// A bar and its outlines.
#[derive(Clone, Debug)]
pub(in crate::offline) struct BarFound {
    /// Outer outlines, left and right.
    pub(in crate::offline) outer: [Contour; 2],
    /// Inner outlines, left and right.
    pub(in crate::offline) inner: [Contour; 2],
    /// Both outlines of both views as a round bar.
    pub(in crate::offline) reconstruction: Reconstruction,
    /// Support of the guess that led to it.
    pub(in crate::offline) support: f64,
}

/// What a search found.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Search {
    /// Bars whose four outlines are there.
    pub(in crate::offline) found: Vec<BarFound>,
    /// Support of the best guess, followed or not (1.5 where the other outline is seen whole in both views).
    pub(in crate::offline) support: f64,
    /// By how much a guess, followed or not, is better supported than most thicknesses are: above [`SUPPORTED`] a bar is not out of the question.
    pub(in crate::offline) excess: f64,
}

/// Excess of support from which the other outline of a bar seems to be there. Among much else in a picture any thickness has some support: a wheel's
/// flanges, tyre and brake give 0.7 of it on the median, and 1.3 at the flange; a bar's other outline stands out by more than one.
pub(in crate::offline) const SUPPORTED: f64 = 0.7;

/// Thinnest and thickest picture of a bar, in parts of the outline's semi-major axis.
const WIDTH: [f64; 2] = [0.05, 0.65];
/// Thinnest picture of a bar, pixels: what is thinner is a line.
const THIN_PX: f64 = 4.0;
/// Step of the search, pixels.
const STEP: f64 = 2.0;
/// Places at which a guess is tested.
const TESTED: usize = 72;
/// Least part of an outline that has to carry edges for a guess to be followed up.
const FOLLOWED: f64 = 0.3;
/// How far from parallel the planes of a flat ring's two edges may seem, radians (0.15 degrees).
const PARALLEL_RAD: f64 = 0.0026;
/// Thicknesses at which the pose is fitted.
const KNOTS: usize = 5;
/// Most that an outline may leave the bar, pixels (root mean square): more, and it is something else that was followed.
const MOST_SCATTER_PX: f64 = 0.45;
/// Most scatter about the fitted bar in units of the edges' own uncertainty.
const MOST_NOISE: f64 = 2.2;
/// A bar thinner than this part of its ring's radius is one outline taken for two.
const THINNEST: f64 = 0.015;
/// Scatter and support of a bar that makes further guesses needless.
const PLAIN: (f64, f64) = (0.3, 1.1);
/// Guesses followed up.
pub(in crate::offline) const GUESSES: usize = 3;
/// Corners of a predicted outline.
const CORNERS: usize = 720;

/// One view of the search.
struct View<'a, 'b> {
    edges: &'a ViewEdges<'b>,
    p: &'a Projection,
    eye: Vector3<f64>,
}

impl View<'_, '_> {
    /// Places along the outer and the inner outline where they are not hidden by the bar itself.
    fn outlines(&self, torus: &Torus, corners: usize, step: f64) -> [Vec<Place>; 2] {
        let mut curves = [Vec::with_capacity(corners), Vec::with_capacity(corners)];
        for k in 0..corners {
            let angle = std::f64::consts::TAU * k as f64 / corners as f64;
            let both = outline(torus, &self.eye, angle);
            for (i, curve) in curves.iter_mut().enumerate() {
                let x = both.map(|b| b[i]).filter(|x| !hidden(torus, &self.eye, x, angle));
                curve.push(x.map(|x| project(self.p, &x)).filter(|u| u.iter().all(|v| v.is_finite())));
            }
        }
        let middle = project(self.p, &torus.centre);
        curves.map(|c| places(&c, step, middle))
    }
}

/// Whether another part of the bar stands before a point of its outline at a core angle.
fn hidden(torus: &Torus, eye: &Vector3<f64>, x: &Vector3<f64>, angle: f64) -> bool {
    const AROUND: usize = 48;
    let sight = x - eye;
    let reach = sight.norm();
    let d = sight / reach;
    let f = crate::offline::rim::circle::frame_of(&torus.normal);
    let own = 3.0 * torus.bar / torus.core;
    (0..AROUND).any(|k| {
        let a = std::f64::consts::TAU * k as f64 / AROUND as f64;
        let apart = (a - angle + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
        if apart.abs() < own {
            return false;
        }
        let c = torus.centre + (f.column(0) * a.cos() + f.column(1) * a.sin()) * torus.core - eye;
        let along = c.dot(&d);
        // The chord between two of the core's points strays from it by a little.
        along < reach && (c - d * along).norm() < 0.97 * torus.bar
    })
}

/// A thickness that both views support.
#[derive(Clone, Copy, Debug)]
struct Guess {
    torus: Torus,
    /// Whether the clicked outline is the outer one.
    clicked_outer: bool,
    worth: f64,
    /// By how much it is worth more than the median thickness.
    excess: f64,
}

/// Looks for the bar whose outline was clicked. `plane` is what the contours are a picture of if they are a plane rim; with the bar's diameter known only that is tried.
pub(in crate::offline) fn find(
    views: [&ViewEdges<'_>; 2],
    clicked: [&Contour; 2],
    plane: (Vector3<f64>, Vector3<f64>, f64),
    p: [&Projection; 2],
    options: &Options,
    most: usize,
) -> Search {
    let mut search = Search { found: Vec::new(), support: 0.0, excess: 0.0 };
    let Some(eyes) = camera_centre(p[0]).zip(camera_centre(p[1])) else { return search };
    let views = [View { edges: views[0], p: p[0], eye: eyes.0 }, View { edges: views[1], p: p[1], eye: eyes.1 }];
    for g in guesses(&views, clicked, plane, options).into_iter().take(most) {
        search.support = search.support.max(g.worth);
        search.excess = search.excess.max(g.excess);
        let Some(bar) = settle(&views, &g, options) else { continue };
        // Two guesses often lead to one bar.
        let same = |b: &BarFound| {
            let (x, y) = (&b.reconstruction, &bar.reconstruction);
            let near = 0.01 * x.rim.a;
            let r = |q: &Reconstruction| q.bar_radius.unwrap_or(0.0);
            (x.rim.a - y.rim.a).abs() < near && (r(x) - r(y)).abs() < near
        };
        let plain = bar.scatter() <= PLAIN.0 && g.worth >= PLAIN.1;
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
) -> Vec<Guess> {
    let thin = |c: &Contour, v: &View<'_, '_>| -> Option<Vec<Ray>> {
        let step = (c.points.len() / 40).max(1);
        let points: Vec<EdgePoint> = c.points.iter().step_by(step).map(|p| p.edge).collect();
        rays(&points, v.p)
    };
    let (Some(l), Some(r)) = (thin(clicked[0], &views[0]), thin(clicked[1], &views[1])) else { return Vec::new() };
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
            let (least, sum) = support(views, &t, clicked_outer, 2.0);
            row.push(Guess { torus: t, clicked_outer, worth: least + 0.25 * sum, excess: 0.0 });
        }
        let usual = crate::offline::conic::robust::median(row.iter().map(|g| g.worth).collect());
        row.iter_mut().for_each(|g| g.excess = g.worth - usual);
        for k in 0..row.len() {
            let w = |k: Option<usize>| k.and_then(|k| row.get(k)).map_or(0.0, |g| g.worth);
            if let Some(g) = row
                .get(k)
                .filter(|g| g.worth >= 1.5 * FOLLOWED && g.worth > w(k.checked_sub(1)) && g.worth >= w(Some(k + 1)))
            {
                out.push(sharper(g, views, &knots, pixel));
            }
        }
    }
    out.sort_by(|a, b| b.worth.total_cmp(&a.worth));
    out.truncate(GUESSES);
    out
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
        let worth = support(views, &t, guess.clicked_outer, 1.0).1;
        if worth > best.0 {
            best = (worth, t);
        }
    }
    Guess { torus: best.1, ..*guess }
}

/// Part of the other outline that carries edges: in the worse view, and in both.
fn support(views: &[View<'_, '_>; 2], t: &Torus, clicked_outer: bool, tolerance: f64) -> (f64, f64) {
    let (mut least, mut sum) = (f64::INFINITY, 0.0);
    for v in views {
        let [outer, inner] = v.outlines(t, TESTED, 0.0);
        let other = if clicked_outer { inner } else { outer };
        let c = v.edges.support(&other, tolerance, None).coverage();
        least = f64::min(least, c);
        sum += c;
    }
    (least, sum)
}

/// Follows all four outlines of a guess and fits the bar to them until it stands still.
fn settle(views: &[View<'_, '_>; 2], guess: &Guess, options: &Options) -> Option<BarFound> {
    let mut torus = guess.torus;
    let bar = Options { rim: RimChoice::RoundBar, ..*options };
    let free = if options.bar_diameter.is_some() { Free::KnownBar } else { Free::All };
    for tolerance in [2.5, 1.5] {
        let mut all: Vec<Ray> = Vec::new();
        for v in views {
            for places in v.outlines(&torus, CORNERS / 2, STEP_PX) {
                let s = v.edges.support(&places, tolerance, None);
                // Every other edge is enough to come near.
                let points: Vec<EdgePoint> = s
                    .hits
                    .iter()
                    .flatten()
                    .step_by(2)
                    .filter_map(|k| v.edges.arcs.ideal.get(*k as usize))
                    .map(|i| EdgePoint::new(i.at.x, i.at.y, 0.1))
                    .collect();
                all.extend(rays(&points, v.p)?);
            }
        }
        let mut keep = vec![true; all.len()];
        for _ in 0..2 {
            torus = fit(&all, &keep, &torus, free)?.torus;
            let r: Vec<f64> = all.iter().map(|r| torus.residual(r).abs()).collect();
            let gate = (4.0 * 1.48 * crate::offline::conic::robust::median(r.clone())).max(0.25);
            keep = r.iter().map(|d| *d <= gate).collect();
        }
        if !(torus.bar > THINNEST * torus.core && torus.bar < 0.6 * torus.core) {
            return None;
        }
    }
    let mut last = None;
    for (tolerance, sharp) in [(1.5, false), (1.0, true)] {
        let follow = |v: &View<'_, '_>| -> Option<[Contour; 2]> {
            let [outer, inner] = v.outlines(&torus, CORNERS, STEP_PX);
            Some([v.edges.follow(&outer, tolerance, sharp)?, v.edges.follow(&inner, tolerance, sharp)?])
        };
        let [lo, li] = follow(&views[0])?;
        let [ro, ri] = follow(&views[1])?;
        let points = |o: &Contour, i: &Contour| {
            let mut all = o.edge_points(Outline::Outer);
            all.extend(i.edge_points(Outline::Inner));
            all
        };
        let (l, r) = (points(&lo, &li), points(&ro, &ri));
        let found = reconstruct(&l, views[0].p, &r, views[1].p, &bar).ok()?;
        torus = Torus { centre: found.rim.centre, normal: found.rim.normal, core: found.rim.a, bar: found.bar_radius? };
        let (outer, inner) = ([lo, ro], [li, ri]);
        last = Some(BarFound { outer, inner, reconstruction: found, support: guess.worth });
    }
    last.filter(|b| b.is_sound() && torus.bar > THINNEST * torus.core)
}

impl BarFound {
    /// Root mean square by which the outlines leave the bar, pixels: the worst of the four.
    pub(in crate::offline) fn scatter(&self) -> f64 {
        self.outer.iter().chain(&self.inner).map(|c| c.rms_px).fold(0.0, f64::max)
    }

    /// All points of a view, the outer outline first.
    pub(in crate::offline) fn points(&self, view: usize) -> Vec<EdgePoint> {
        let mut all = self.outer.get(view).map(|c| c.edge_points(Outline::Outer)).unwrap_or_default();
        all.extend(self.inner.get(view).iter().flat_map(|c| c.edge_points(Outline::Inner)));
        all
    }

    /// Whether the four outlines are those of one bar: they keep to it, and so do nearly all of their edges.
    fn is_sound(&self) -> bool {
        let r = &self.reconstruction.report;
        let (used, all) = r.inliers.iter().flatten().fold((0, 0), |(u, n), k| (u + usize::from(*k), n + 1));
        self.scatter() <= MOST_SCATTER_PX && r.noise <= MOST_NOISE && used * 10 >= all * 7
    }

    /// By how much the information criterion of two plane rims, one an outline, exceeds that of the bar on the same points: positive for a bar.
    pub(in crate::offline) fn evidence(&self, p: [&Projection; 2], options: &Options) -> f64 {
        let r = &self.reconstruction;
        let sigmas = [self.points(0), self.points(1)];
        let bar: Vec<f64> =
            (0..2).flat_map(|k| r.report.residuals[k].iter().zip(&sigmas[k]).map(|(d, q)| d / q.sigma)).collect();
        // Each outline a rim of its own, whatever the rig's doubt: it is the shape that is compared.
        let lenient = Options { rim: RimChoice::Edge, calibration_px: 20.0, max_noise_px: 3.0, ..*options };
        let mut flat = Vec::new();
        let mut parameters = 0u32;
        let mut normals = Vec::new();
        for (contours, kind) in [(&self.outer, Outline::Outer), (&self.inner, Outline::Outer)] {
            let [a, b] = [0, 1].map(|k| contours[k].edge_points(kind));
            let Ok(rim) = reconstruct(&a, p[0], &b, p[1], &lenient) else { return f64::INFINITY };
            normals.push((rim.rim.normal, rim.report.sigma_normal));
            parameters += if rim.model == RimModel::Circle { 6 } else { 8 };
            for (k, points) in [a, b].iter().enumerate() {
                flat.extend(rim.report.residuals[k].iter().zip(points).map(|(d, q)| d / q.sigma));
            }
        }
        let scale = |v: &[f64]| 1.48 * crate::offline::conic::robust::median(v.iter().map(|d| d.abs()).collect());
        let noise = scale(&bar).min(scale(&flat)).max(1e-6);
        let most = crate::offline::conic::robust::GATE * noise;
        let sum = |v: &[f64]| -> f64 {
            v.iter().map(|d| if d.is_finite() { d.abs().min(most).powi(2) } else { most * most }).sum::<f64>()
                / (noise * noise)
        };
        let each = (bar.len().max(1) as f64).ln();
        // The edges of a flat ring lie in parallel planes; the outlines of a bar seem to lie in planes tipped opposite ways.
        let tipped = match normals.as_slice() {
            [(n, s), (m, t)] => (n.angle(m) / s.hypot(*t).hypot(PARALLEL_RAD)).powi(2),
            _ => 0.0,
        };
        (sum(&flat) + tipped + f64::from(parameters) * each) - (sum(&bar) + 7.0 * each)
    }
}
