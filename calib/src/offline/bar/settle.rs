//! From a guess to a bar: its outlines are followed and the bar is fitted to them until it stands still.

use crate::offline::bar::found::BarFound;
use crate::offline::bar::limb::{Limb, THINNEST_PX};
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

/// A bar thinner than this part of its ring's radius is one outline taken for two.
const THINNEST: f64 = 0.015;
/// Rounds in which a guess may move before its outlines are followed, and the window of each, pixels.
const ROUNDS: [f64; 6] = [3.0, 3.0, 2.5, 2.0, 1.5, 1.5];
/// How often, and in steps of how many pixels, a thicker bar is looked for around one that was found.
const OUTWARD: usize = 2;
const OUTWARD_STEP: f64 = 0.75;
const OUTWARD_STEPS: i32 = 8;
/// Part of the found outline's edges that a thicker bar's has to have.
const AS_GOOD: f64 = 0.7;
/// What a limb's place is worth where its falling off is not seen undisturbed, pixels.
const SPOILT_PX: f64 = 0.25;
/// Noise about a bar (in the edges' own) of edges as they were detected, above which it is not worth another look: limbs beside paint reach seven.
const HOPELESS: f64 = 8.0;
/// Corners of a predicted outline.
const CORNERS: usize = 720;

/// Follows all four outlines of a guess and fits the bar to them until it stands still. `support` is what speaks for the guess.
pub(in crate::offline::bar) fn settle(
    views: &[View<'_, '_>; 2],
    guess: Torus,
    support: f64,
    options: &Options,
) -> Option<BarFound> {
    let free = if options.bar_diameter.is_some() { Free::KnownBar } else { Free::All };
    let mut torus = approach(views, guess, free, &ROUNDS)?;
    // A bar of known thickness cannot be thicker.
    let outwards = if free == Free::All { OUTWARD } else { 0 };
    for _ in 0..outwards {
        let Some(thicker) = outward(views, &torus).and_then(|t| approach(views, t, free, &ROUNDS)) else { break };
        // It may lead back to where it came from.
        let grown = thicker.bar - torus.bar;
        if !(grown > 0.02 * torus.bar) {
            break;
        }
        torus = thicker;
    }
    follow(views, torus, support, options)
}

/// Fits the bar to the likeliest edges beside its outlines, again and again in narrowing windows.
fn approach(views: &[View<'_, '_>; 2], start: Torus, free: Free, windows: &[f64]) -> Option<Torus> {
    let mut torus = start;
    for tolerance in windows {
        let mut all: Vec<Ray> = Vec::new();
        for v in views {
            for places in v.outlines(&torus, CORNERS / 2, STEP_PX) {
                let (_, hits) = v.outline_edges(&places, *tolerance);
                // Every other edge is enough to come near.
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
        if !(torus.bar > THINNEST * torus.core && torus.bar < 0.6 * torus.core) {
            return None;
        }
        let still = 1e-4 * torus.core;
        if (torus.core - before.core).abs() < still && (torus.bar - before.bar).abs() < still {
            break;
        }
    }
    Some(torus)
}

/// A thicker bar whose outlines have edges too: shading makes soft edges all along a bar, but inside its outlines only.
fn outward(views: &[View<'_, '_>; 2], torus: &Torus) -> Option<Torus> {
    let pixel = views.iter().map(|v| v.pixel_at(&torus.centre)).fold(f64::INFINITY, f64::min);
    if !pixel.is_finite() {
        return None;
    }
    let mut moved = *torus;
    for outer in [true, false] {
        let sign = if outer { 0.5 } else { -0.5 };
        let at = |steps: f64| {
            let out = steps * OUTWARD_STEP * pixel;
            Torus { core: torus.core + sign * out, bar: torus.bar + 0.5 * out, ..*torus }
        };
        let seen: Vec<(f64, f64)> =
            (0..=OUTWARD_STEPS).map(|k| support(views, &at(f64::from(k)), !outer, 1.0)).collect();
        let here = seen.first()?.1;
        // The farthest peak that is about as good.
        let peak = (2..seen.len() - 1).rev().find(|k| {
            let l = |k: usize| seen.get(k).map_or(0.0, |s| s.1);
            l(*k) >= l(k - 1) && l(*k) > l(k + 1) && l(*k) >= AS_GOOD * here && seen.get(*k).is_some_and(|s| s.0 >= 0.5)
        });
        if let Some(k) = peak {
            let t = at(k as f64);
            moved.core += t.core - torus.core;
            moved.bar += t.bar - torus.bar;
        }
    }
    (moved.bar > torus.bar && moved.bar < 0.6 * moved.core).then_some(moved)
}

/// How the edges of a followed outline are brought to their place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sharp {
    /// As they were detected.
    No,
    /// As a bar's limb; what is none is left out.
    Limb,
    /// As a bar's limb, and where something else beside it (paint, a spoke) disturbs its falling off, as an edge like others, known less well.
    Spoilt,
}

/// Follows the four outlines of a bar, tells their edges from their neighbours, and fits the bar to them.
fn follow(views: &[View<'_, '_>; 2], start: Torus, support: f64, options: &Options) -> Option<BarFound> {
    let (rough, torus) = followed(views, start, 1.5, Sharp::No, support, options)?;
    if rough.reconstruction.report.noise > HOPELESS {
        return None;
    }
    // A bar that is too thin for a limb has edges like others, and nothing to spoil.
    let thin = views.iter().all(|v| torus.bar < THINNEST_PX * v.pixel_at(&torus.centre));
    let ways: &[Sharp] = if thin { &[Sharp::Limb] } else { &[Sharp::Limb, Sharp::Spoilt] };
    ways.iter().find_map(|sharp| {
        let (bar, torus) = followed(views, torus, 1.0, *sharp, support, options)?;
        (bar.is_sound() && torus.bar > THINNEST * torus.core).then_some(bar)
    })
}

/// The edges within a tolerance of a bar's outlines, and the bar fitted to them.
fn followed(
    views: &[View<'_, '_>; 2],
    torus: Torus,
    tolerance: f64,
    sharp: Sharp,
    support: f64,
    options: &Options,
) -> Option<(BarFound, Torus)> {
    let outlines = |v: &View<'_, '_>| -> Option<[Contour; 2]> {
        let [outer, inner] = v.outlines(&torus, CORNERS, STEP_PX);
        let (noise, blur) = (v.edges.map.noise(), v.edges.blur());
        let limb = Limb::new(blur, torus.bar / v.pixel_at(&torus.centre));
        // Away from the bar is out of the outer outline, and into the inner one.
        let finish = |r: &Refined, out: Pixel| {
            let plain = || separate(v.edges.image, r, noise, blur);
            match &limb {
                Some(l) => l.place(v.edges.image, r, out, noise, blur).or_else(|| {
                    let r = if sharp == Sharp::Spoilt { plain()? } else { return None };
                    Some(Refined { sigma: r.sigma.hypot(SPOILT_PX), ..r })
                }),
                None => plain(),
            }
        };
        let inwards = |r: &Refined, out: Pixel| finish(r, -out);
        let [away, into]: [&RefineEdge<'_>; 2] = [&finish, &inwards];
        let wanted = sharp != Sharp::No;
        Some([
            v.edges.follow(&outer, tolerance, wanted.then_some(away))?,
            v.edges.follow(&inner, tolerance, wanted.then_some(into))?,
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
