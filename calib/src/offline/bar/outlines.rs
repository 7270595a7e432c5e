//! Predicted outlines of a bar in an image, and the edges that are likely to belong to them.

use crate::offline::bar::torus::{Torus, outline};
use crate::offline::contour::follow::{CurvePoint, curve_points};
use crate::offline::contour::{Contour, ContourPoint, ViewEdges};
use crate::offline::rim::circle::frame_of;
use crate::offline::statistics::median;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::project;
use graspd_rt::geom::Pixel;
use nalgebra::Vector3;

/// Strength of an edge with weight one half, as a fraction of the median along the clicked outline.
const HALF_WEIGHT_STRENGTH: f64 = 0.3;
/// Smallest cosine between an edge's gradient and the normal of an outline that it may belong to.
const MIN_COSINE: f64 = 0.93;
/// Points at which a hypothesis is tested.
const TEST_POINTS: usize = 72;

/// One view of the search.
pub(in crate::offline::bar) struct View<'a, 'b> {
    pub(in crate::offline::bar) edges: &'a ViewEdges<'b>,
    pub(in crate::offline::bar) p: &'a Projection,
    viewpoint: Vector3<f64>,
    /// Strength of an edge with weight one half, grey levels per pixel.
    half: f64,
}

impl<'a, 'b> View<'a, 'b> {
    pub(in crate::offline::bar) fn new(
        edges: &'a ViewEdges<'b>,
        clicked: &Contour,
        p: &'a Projection,
        viewpoint: Vector3<f64>,
    ) -> Self {
        let strength = |c: &ContourPoint| edges.map.near(c.raw, 1).map(|(_, e)| e.strength).fold(0.0, f64::max);
        let half = HALF_WEIGHT_STRENGTH * median(clicked.points.iter().map(strength).collect());
        Self { edges, p, viewpoint, half: if half.is_finite() { half.max(1.0) } else { 1.0 } }
    }

    /// Length of one pixel at a point in space, across the line of sight.
    pub(in crate::offline::bar) fn pixel_at(&self, x: &Vector3<f64>) -> f64 {
        let depth = (x - self.viewpoint).norm();
        let across = frame_of(&(x - self.viewpoint));
        let step = 1e-3 * depth;
        let here = project(self.p, x);
        let px = (0..2).map(|k| (project(self.p, &(x + across.column(k) * step)) - here).norm()).fold(0.0, f64::max);
        step / px
    }

    /// The most likely edge at each point of a predicted outline, and the mean weight along it, from 0 to 1.
    ///
    /// An outline is the strongest step there is. The shading of a bar makes weaker ones beside it all the way around.
    /// So the strong edge wins, not the nearest.
    pub(in crate::offline::bar) fn outline_edges(
        &self,
        points: &[CurvePoint],
        tolerance: f64,
    ) -> (f64, Vec<Option<u32>>) {
        let (mut sum, mut seen, mut hits) = (0.0, 0usize, Vec::with_capacity(points.len()));
        for p in points {
            let raw = self.edges.lens.raw(p.at);
            if !self.edges.image.contains(raw, 6.0) {
                continue;
            }
            seen += 1;
            let mut best = (0.0, None);
            self.edges.map.near(raw, tolerance.ceil() as i32).for_each(|(k, e)| {
                let Some(i) = self.edges.arcs.ideal.get(k) else { return };
                let d = i.at - p.at;
                let off = d.dot(&p.normal).abs() / tolerance;
                if i.towards_bright.dot(&p.normal).abs() <= MIN_COSINE || off > 1.0 || d.norm() > tolerance + 1.5 {
                    return;
                }
                let weight = e.strength / (e.strength + self.half) * (1.0 - 0.5 * off * off);
                if weight > best.0 {
                    best = (weight, Some(k as u32));
                }
            });
            sum += best.0;
            hits.push(best.1);
        }
        (sum / seen.max(1) as f64, hits)
    }

    /// Points along the outer and the inner outline where the bar itself does not hide them.
    pub(in crate::offline::bar) fn outlines(&self, torus: &Torus, corners: usize, step: f64) -> [Vec<CurvePoint>; 2] {
        let bar = Bar::new(torus, &self.viewpoint);
        [0, 1].map(|k| self.points(&bar, k, corners, step))
    }

    /// Points along one outline: 0 is the outer one.
    fn points(&self, bar: &Bar<'_>, which: usize, corners: usize, step: f64) -> Vec<CurvePoint> {
        let corner = |k: usize| {
            let angle = std::f64::consts::TAU * k as f64 / corners as f64;
            let x = *outline(bar.torus, bar.viewpoint, angle)?.get(which)?;
            let u = project(self.p, &x);
            (!bar.hides(&x, angle) && u.iter().all(|v| v.is_finite())).then_some(u)
        };
        let curve: Vec<Option<Pixel>> = (0..corners).map(corner).collect();
        curve_points(&curve, step, project(self.p, &bar.torus.centre))
    }
}

/// Points of the core circle that are tested for occlusion.
const AROUND: usize = 48;

/// A bar seen from a projection centre.
struct Bar<'a> {
    torus: &'a Torus,
    viewpoint: &'a Vector3<f64>,
    /// Points of the core circle relative to the projection centre, with their squared distance.
    core: [(Vector3<f64>, f64); AROUND],
}

impl<'a> Bar<'a> {
    fn new(torus: &'a Torus, viewpoint: &'a Vector3<f64>) -> Self {
        let f = frame_of(&torus.normal);
        let core = std::array::from_fn(|k| {
            let (sin, cos) = Self::angle(k).sin_cos();
            let c = torus.centre + (f.column(0) * cos + f.column(1) * sin) * torus.core - viewpoint;
            (c, c.norm_squared())
        });
        Self { torus, viewpoint, core }
    }

    fn angle(k: usize) -> f64 {
        std::f64::consts::TAU * k as f64 / AROUND as f64
    }

    /// Whether another part of the bar hides a point of its outline at a core angle.
    fn hides(&self, x: &Vector3<f64>, angle: f64) -> bool {
        let sight = x - self.viewpoint;
        let reach = sight.norm();
        let d = sight / reach;
        // The chord between two core points deviates slightly from the circle.
        let near = (0.97 * self.torus.bar).powi(2);
        let own = 3.0 * self.torus.bar / self.torus.core;
        self.core.iter().enumerate().any(|(k, (c, square))| {
            let along = c.dot(&d);
            along < reach && square - along * along < near && {
                let apart = (Self::angle(k) - angle).abs();
                apart.min(std::f64::consts::TAU - apart) >= own
            }
        })
    }
}

/// Fraction of the other outline that carries edges, with the worse view weighted most: any edges, and edges by their
/// weight.
pub(in crate::offline::bar) fn support(
    views: &[View<'_, '_>; 2],
    t: &Torus,
    clicked_outer: bool,
    tolerance: f64,
) -> (f64, f64) {
    let (mut least, mut sum) = ([f64::INFINITY; 2], [0.0; 2]);
    for v in views {
        let other = v.points(&Bar::new(t, &v.viewpoint), usize::from(clicked_outer), TEST_POINTS, 0.0);
        let (likely, hits) = v.outline_edges(&other, tolerance);
        let any = hits.iter().flatten().count() as f64 / hits.len().max(1) as f64;
        for (k, c) in [any, likely].into_iter().enumerate() {
            least[k] = f64::min(least[k], c);
            sum[k] += c;
        }
    }
    (least[0] + 0.25 * sum[0], least[1] + 0.25 * sum[1])
}
