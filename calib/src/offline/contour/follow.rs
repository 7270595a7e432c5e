//! Edge points along a curve that a model predicts.
//!
//! Growing a contour asks which edges lie on one ellipse. Here the curve is given (the outline of a bar is not an
//! ellipse). Only the edges next to it are collected, one for each stretch that is independent of its neighbours,
//! separated from nearby edges and refined.

use crate::offline::contour::one_ellipse::{Contour, ContourPoint, FLOOR_PX, INDEPENDENT_PX, MIN_COVERAGE};
use crate::offline::contour::quick_fit::{Sums, Walk};
use crate::offline::contour::view_edges::ViewEdges;
use crate::offline::edges::Refined;
use crate::offline::types::{EdgePoint, Outline};
use graspd_rt::geom::Pixel;

/// A point of a predicted curve, ideal pixels.
#[derive(Clone, Copy, Debug)]
pub(in crate::offline) struct CurvePoint {
    pub(in crate::offline) at: Pixel,
    /// Unit normal, towards the outside of the outline.
    pub(in crate::offline) normal: Pixel,
    /// Signed radius of curvature, positive where the centre of curvature is opposite to the normal.
    pub(in crate::offline) radius: f64,
}

/// Refines an edge, given the edge and the direction out of the curve (raw pixels); `None` where it cannot be located.
pub(in crate::offline) type RefineEdge<'f> = dyn Fn(&Refined, Pixel) -> Option<Refined> + 'f;

/// The edges along a curve.
#[derive(Clone, Debug, Default)]
pub(in crate::offline) struct Support {
    /// Number of points inside the image.
    pub(in crate::offline) seen: usize,
    /// Edge found at each point, if any.
    pub(in crate::offline) hits: Vec<Option<u32>>,
}

/// Points along a closed polygon of ideal pixels, spaced by about one `step`. The neighbourhood of missing corners is
/// left out.
pub(in crate::offline) fn curve_points(polygon: &[Option<Pixel>], step: f64, inside: Pixel) -> Vec<CurvePoint> {
    let n = polygon.len();
    let get = |k: usize| polygon.get(k % n.max(1)).copied().flatten();
    let mut out = Vec::new();
    let mut since = f64::INFINITY;
    for k in 0..n {
        let (Some(p), Some(q), Some(o)) = (get(k + n - 1), get(k), get(k + 1)) else {
            since = f64::INFINITY;
            continue;
        };
        since += (q - p).norm();
        if since < step {
            continue;
        }
        let along = o - p;
        let Some(t) = along.try_normalize(1e-6) else { continue };
        let mut normal = Pixel::new(t.y, -t.x);
        if normal.dot(&(q - inside)) < 0.0 {
            normal = -normal;
        }
        // The circle through three neighbours.
        let area = 0.5 * ((q - p).x * (o - p).y - (q - p).y * (o - p).x);
        let sides = (q - p).norm() * (o - q).norm() * along.norm();
        let towards = (p + o) * 0.5 - q;
        let sign = if towards.dot(&normal) < 0.0 { 1.0 } else { -1.0 };
        let radius = if area.abs() > 1e-12 { sign * sides / (4.0 * area.abs()) } else { f64::INFINITY };
        out.push(CurvePoint { at: q, normal, radius });
        since = 0.0;
    }
    out
}

impl ViewEdges<'_> {
    /// The edges next to points of a curve. `bright_inside` selects the brighter side; `None` accepts either.
    pub(in crate::offline) fn support(
        &self,
        curve: &[CurvePoint],
        tolerance: f64,
        bright_inside: Option<bool>,
    ) -> Support {
        let mut out = Support::default();
        for p in curve {
            let raw = self.lens.raw(p.at);
            if !self.image.contains(raw, 6.0) {
                continue;
            }
            out.seen += 1;
            let mut best = (tolerance, None);
            self.map.near(raw, tolerance.ceil() as i32).for_each(|(k, _)| {
                let Some(i) = self.arcs.ideal.get(k) else { return };
                let d = i.at - p.at;
                let along = i.towards_bright.dot(&p.normal);
                let side_fits = bright_inside.is_none_or(|inside| (along < 0.0) == inside);
                let off = d.dot(&p.normal).abs();
                if side_fits && along.abs() > 0.93 && off < best.0 && d.norm() < tolerance + 1.5 {
                    best = (off, Some(k as u32));
                }
            });
            out.hits.push(best.1);
        }
        out
    }

    /// The contour along a curve: its edges within a tolerance, refined by `finish` if given. Its ellipse is only the
    /// best approximation. `None` when fewer than 12 edges or too little of the curve is found.
    pub(in crate::offline) fn follow(
        &self,
        curve: &[CurvePoint],
        tolerance: f64,
        finish: Option<&RefineEdge<'_>>,
    ) -> Option<Contour> {
        let any = self.support(curve, tolerance, None);
        let bright = |k: u32, p: &CurvePoint| {
            self.arcs.ideal.get(k as usize).is_some_and(|i| i.towards_bright.dot(&p.normal) < 0.0)
        };
        let seen: Vec<&CurvePoint> = curve.iter().filter(|p| self.image.contains(self.lens.raw(p.at), 6.0)).collect();
        let (mut inside, mut outside) = (0usize, 0usize);
        for (h, p) in any.hits.iter().zip(&seen) {
            if let Some(k) = h {
                *(if bright(*k, p) { &mut inside } else { &mut outside }) += 1;
            }
        }
        // One side is brighter nearly everywhere, unless the background behind a bar changes.
        let bright_inside = inside > outside;
        let mixed = inside.min(outside) * 4 > inside.max(outside);
        let support = self.support(curve, tolerance, (!mixed).then_some(bright_inside));
        let mut points = Vec::new();
        let mut rejected = Vec::new();
        let mut used = std::collections::BTreeSet::new();
        for (h, p) in support.hits.iter().zip(&seen) {
            let Some(k) = h.filter(|k| used.insert(*k)) else { continue };
            let Some(edge) = self.map.edges().get(k as usize) else { continue };
            let Some(r) = self.refine(k) else {
                rejected.push(edge.at);
                continue;
            };
            let r = if let Some(finish) = finish {
                let ahead = self.lens.raw(p.at + p.normal * 0.5) - self.lens.raw(p.at - p.normal * 0.5);
                let Some(out) = ahead.try_normalize(1e-9) else { continue };
                let sign = if r.towards_bright.dot(&p.normal) < 0.0 { -1.0 } else { 1.0 };
                match finish(&Refined { towards_bright: out * sign, ..r }, out) {
                    Some(r) => r,
                    None => {
                        rejected.push(edge.at);
                        continue;
                    }
                }
            } else {
                r
            };
            let outward = if p.radius < 0.0 { -p.normal } else { p.normal };
            let r = r.straightened(outward, p.radius.abs());
            let Some(ideal) = self.lens.ideal(r.at) else { continue };
            let residual = (ideal - p.at).dot(&p.normal);
            let edge = EdgePoint { uv: ideal, sigma: r.sigma.hypot(FLOOR_PX), outline: Outline::Outer };
            points.push(ContourPoint { raw: r.at, edge, residual, parameter: 0.0 });
        }
        if points.len() < 12 {
            return None;
        }
        let first = points.first()?.edge.uv;
        let mut sums = Sums::new(first, 50.0);
        points.iter().for_each(|p| sums.add(p.edge.uv, 1.0));
        let ellipse = sums.ellipse()?;
        let w = Walk::new(&ellipse);
        for p in &mut points {
            p.parameter = w.measure(p.edge.uv).2;
        }
        points.sort_by(|a, b| a.parameter.total_cmp(&b.parameter));
        let n = points.len() as f64;
        let rms_px = (points.iter().map(|p| p.residual * p.residual).sum::<f64>() / n).sqrt();
        let coverage = (n / support.seen.max(1) as f64).min(1.0);
        let good = coverage >= MIN_COVERAGE;
        good.then_some(Contour { ellipse, bright_inside, points, rejected, coverage, rms_px })
    }
}

/// Spacing of the points of a followed curve, pixels.
pub(in crate::offline) const STEP_PX: f64 = INDEPENDENT_PX;
