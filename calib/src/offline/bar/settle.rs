//! From a hypothesis to a bar: its outlines are followed and the bar is fitted to them until it converges.

use crate::offline::bar::found::BarFound;
use crate::offline::bar::limb::{Limb, MIN_RADIUS_PX};
use crate::offline::bar::outlines::{View, support};
use crate::offline::bar::result::reconstruct_bar;
use crate::offline::bar::torus::{Free, Ray, Torus, fit, rays};
use crate::offline::contour::Contour;
use crate::offline::contour::follow::{RefineEdge, STEP_PX};
use crate::offline::edges::Refined;
use crate::offline::edges::separate::separate;
use crate::offline::rim::model::Options;
use crate::offline::statistics::median;
use crate::offline::types::{EdgePoint, Outline};
use graspd_rt::geom::Pixel;

/// Smallest bar radius as a fraction of the core radius: a thinner bar is one outline matched twice.
const MIN_BAR_FRACTION: f64 = 0.015;
/// Largest bar radius as a fraction of the core radius.
const MAX_BAR_FRACTION: f64 = 0.6;
/// Windows around the outlines in successive rounds of the approach, pixels.
const WINDOWS_PX: [f64; 6] = [3.0, 3.0, 2.5, 2.0, 1.5, 1.5];
/// Number of searches for a thicker bar around one that was found.
const THICKER_ROUNDS: usize = 2;
/// Step of that search, pixels.
const THICKER_STEP_PX: f64 = 0.75;
/// Steps of that search.
const THICKER_STEPS: i32 = 8;
/// Smallest likelihood of a thicker bar's outline, as a fraction of the found one's.
const MIN_THICKER_LIKELIHOOD: f64 = 0.7;
/// Standard deviation added to a limb whose fall-off is disturbed by something beside it, pixels.
const DISTURBED_LIMB_SIGMA_PX: f64 = 0.25;
/// Largest noise of detected edges about a bar that is refined further, in the edges' own standard deviations: limbs
/// beside paint reach seven.
const MAX_DETECTED_NOISE: f64 = 8.0;
/// Corners of a predicted outline's polygon.
const CORNERS: usize = 720;

/// Follows all four outlines of a hypothesis and fits the bar to them until it converges. `support` is the support of
/// the hypothesis.
pub(in crate::offline::bar) fn settle(
    views: &[View<'_, '_>; 2],
    hypothesis: Torus,
    support: f64,
    options: &Options,
) -> Option<BarFound> {
    let free = if options.bar_diameter.is_some() { Free::KnownBar } else { Free::All };
    let mut torus = approach(views, hypothesis, free, &WINDOWS_PX)?;
    // A bar of known diameter cannot be thicker.
    let outwards = if free == Free::All { THICKER_ROUNDS } else { 0 };
    for _ in 0..outwards {
        let Some(thicker) = outward(views, &torus).and_then(|t| approach(views, t, free, &WINDOWS_PX)) else { break };
        // The fit may return to the bar it started from.
        let grown = thicker.bar - torus.bar;
        if !(grown > 0.02 * torus.bar) {
            break;
        }
        torus = thicker;
    }
    follow(views, torus, support, options)
}

/// Fits the bar to the most likely edges beside its outlines, repeatedly, in narrowing windows.
fn approach(views: &[View<'_, '_>; 2], start: Torus, free: Free, windows: &[f64]) -> Option<Torus> {
    let mut torus = start;
    for tolerance in windows {
        let mut all: Vec<Ray> = Vec::new();
        for v in views {
            for points in v.outlines(&torus, CORNERS / 2, STEP_PX) {
                let (_, hits) = v.outline_edges(&points, *tolerance);
                // Every other edge is enough for the approach.
                let points: Vec<EdgePoint> = hits
                    .iter()
                    .flatten()
                    .step_by(2)
                    .filter_map(|k| v.edges.arcs.ideal.get(*k as usize))
                    .map(|i| EdgePoint::new(i.at.x, i.at.y, 0.1))
                    .collect();
                all.extend(rays(&points, v.p)?);
            }
        }
        let before = torus;
        let mut keep = vec![true; all.len()];
        for _ in 0..2 {
            torus = fit(&all, &keep, &torus, free)?.torus;
            let r: Vec<f64> = all.iter().map(|r| torus.residual(r).abs()).collect();
            let gate = (4.0 * 1.48 * median(r.clone())).max(0.25);
            keep = r.iter().map(|d| *d <= gate).collect();
        }
        if !(torus.bar > MIN_BAR_FRACTION * torus.core && torus.bar < MAX_BAR_FRACTION * torus.core) {
            return None;
        }
        let still = 1e-4 * torus.core;
        if (torus.core - before.core).abs() < still && (torus.bar - before.bar).abs() < still {
            break;
        }
    }
    Some(torus)
}

/// A thicker bar whose outlines also have edges: shading makes weak edges along a bar, but only inside its outlines.
fn outward(views: &[View<'_, '_>; 2], torus: &Torus) -> Option<Torus> {
    let pixel = views.iter().map(|v| v.pixel_at(&torus.centre)).fold(f64::INFINITY, f64::min);
    if !pixel.is_finite() {
        return None;
    }
    let mut moved = *torus;
    for outer in [true, false] {
        let sign = if outer { 0.5 } else { -0.5 };
        let at = |steps: f64| {
            let out = steps * THICKER_STEP_PX * pixel;
            Torus { core: torus.core + sign * out, bar: torus.bar + 0.5 * out, ..*torus }
        };
        let seen: Vec<(f64, f64)> =
            (0..=THICKER_STEPS).map(|k| support(views, &at(f64::from(k)), !outer, 1.0)).collect();
        let here = seen.first()?.1;
        // The farthest peak that is nearly as good.
        let peak = (2..seen.len() - 1).rev().find(|k| {
            let l = |k: usize| seen.get(k).map_or(0.0, |s| s.1);
            l(*k) >= l(k - 1)
                && l(*k) > l(k + 1)
                && l(*k) >= MIN_THICKER_LIKELIHOOD * here
                && seen.get(*k).is_some_and(|s| s.0 >= 0.5)
        });
        if let Some(k) = peak {
            let t = at(k as f64);
            moved.core += t.core - torus.core;
            moved.bar += t.bar - torus.bar;
        }
    }
    (moved.bar > torus.bar && moved.bar < MAX_BAR_FRACTION * moved.core).then_some(moved)
}

/// How the edges of a followed outline are located.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Location {
    /// As detected.
    Detected,
    /// As the limb of a bar; other edges are left out.
    Limb,
    /// As the limb of a bar. Where something beside it (paint, a spoke) disturbs its fall-off, as a step with a larger
    /// standard deviation.
    LimbOrStep,
}

/// Follows the four outlines of a bar, separates their edges from neighbours, and fits the bar to them.
fn follow(views: &[View<'_, '_>; 2], start: Torus, support: f64, options: &Options) -> Option<BarFound> {
    let (rough, torus) = followed(views, start, 1.5, Location::Detected, support, options)?;
    if rough.reconstruction.report.noise > MAX_DETECTED_NOISE {
        return None;
    }
    // The outlines of a bar too thin for a limb are located as steps, which nothing can disturb.
    let thin = views.iter().all(|v| torus.bar < MIN_RADIUS_PX * v.pixel_at(&torus.centre));
    let locations: &[Location] = if thin { &[Location::Limb] } else { &[Location::Limb, Location::LimbOrStep] };
    locations.iter().find_map(|location| {
        let (bar, torus) = followed(views, torus, 1.0, *location, support, options)?;
        (bar.is_sound() && torus.bar > MIN_BAR_FRACTION * torus.core).then_some(bar)
    })
}

/// The edges within a tolerance of a bar's outlines, and the bar fitted to them.
fn followed(
    views: &[View<'_, '_>; 2],
    torus: Torus,
    tolerance: f64,
    location: Location,
    support: f64,
    options: &Options,
) -> Option<(BarFound, Torus)> {
    let outlines = |v: &View<'_, '_>| -> Option<[Contour; 2]> {
        let [outer, inner] = v.outlines(&torus, CORNERS, STEP_PX);
        let (noise, blur) = (v.edges.map.noise(), v.edges.blur());
        let limb = Limb::new(blur, torus.bar / v.pixel_at(&torus.centre));
        // Away from the bar is outward on the outer outline, and inward on the inner one.
        let locate = |r: &Refined, out: Pixel| {
            let plain = || separate(v.edges.image, r, noise, blur);
            match &limb {
                Some(l) => l.locate(v.edges.image, r, out, noise, blur).or_else(|| {
                    let r = if location == Location::LimbOrStep { plain()? } else { return None };
                    Some(Refined { sigma: r.sigma.hypot(DISTURBED_LIMB_SIGMA_PX), ..r })
                }),
                None => plain(),
            }
        };
        let inwards = |r: &Refined, out: Pixel| locate(r, -out);
        let [away, into]: [&RefineEdge<'_>; 2] = [&locate, &inwards];
        let refined = location != Location::Detected;
        Some([
            v.edges.follow(&outer, tolerance, refined.then_some(away))?,
            v.edges.follow(&inner, tolerance, refined.then_some(into))?,
        ])
    };
    let [lo, li] = outlines(&views[0])?;
    let [ro, ri] = outlines(&views[1])?;
    let points = |o: &Contour, i: &Contour| {
        let mut all = o.edge_points(Outline::Outer);
        all.extend(i.edge_points(Outline::Inner));
        all
    };
    let (l, r) = (points(&lo, &li), points(&ro, &ri));
    let found = reconstruct_bar([&l, &r], [views[0].p, views[1].p], options).ok()?;
    let torus = Torus { centre: found.rim.centre, normal: found.rim.normal, core: found.rim.a, bar: found.bar_radius? };
    Some((BarFound { outer: [lo, ro], inner: [li, ri], reconstruction: found, support }, torus))
}
