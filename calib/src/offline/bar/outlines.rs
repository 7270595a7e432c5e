//! Where a bar's outlines are in an image, and which edges there are likely to be theirs.

use crate::offline::bar::torus::{Torus, outline};
use crate::offline::contour::follow::{CurvePoint, curve_points};
use crate::offline::contour::{Contour, ContourPoint, ViewEdges};
use crate::offline::rim::circle::frame_of;
use crate::offline::statistics::median;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::project;
use graspd_rt::geom::Pixel;
use nalgebra::Vector3;

/// Strength of an edge that is half believed, in parts of the median along the clicked outline.
const HALF_BELIEVED: f64 = 0.3;
/// Least cosine between an edge's gradient and the normal of an outline that it may belong to.
const ALIGNED: f64 = 0.93;
/// Places at which a guess is tested.
const TESTED: usize = 72;

/// One view of the search.
pub(in crate::offline::bar) struct View<'a, 'b> {
    pub(in crate::offline::bar) edges: &'a ViewEdges<'b>,
    pub(in crate::offline::bar) p: &'a Projection,
    eye: Vector3<f64>,
    /// Strength of an edge that is half believed to be an outline, grey levels per pixel.
    half: f64,
}

impl<'a, 'b> View<'a, 'b> {
    pub(in crate::offline::bar) fn new(
        edges: &'a ViewEdges<'b>,
        clicked: &Contour,
        p: &'a Projection,
        eye: Vector3<f64>,
    ) -> Self {
        let strength = |c: &ContourPoint| edges.map.near(c.raw, 1).map(|(_, e)| e.strength).fold(0.0, f64::max);
        let half = HALF_BELIEVED * median(clicked.points.iter().map(strength).collect());
        Self { edges, p, eye, half: if half.is_finite() { half.max(1.0) } else { 1.0 } }
    }

    /// Length of a pixel at a place in space, across the line of sight.
    pub(in crate::offline::bar) fn pixel_at(&self, x: &Vector3<f64>) -> f64 {
        let depth = (x - self.eye).norm();
        let across = frame_of(&(x - self.eye));
        let step = 1e-3 * depth;
        let here = project(self.p, x);
        let px = (0..2).map(|k| (project(self.p, &(x + across.column(k) * step)) - here).norm()).fold(0.0, f64::max);
        step / px
    }

    /// The likeliest edge of an outline at each place in the image, and how likely the whole is, from 0 to 1.
    ///
    /// An outline is the sharpest step there is; a bar's shading makes softer ones of its own beside it, all the way round. So the strong edge wins, not the
    /// nearest.
    pub(in crate::offline::bar) fn outline_edges(
        &self,
        places: &[CurvePoint],
        tolerance: f64,
    ) -> (f64, Vec<Option<u32>>) {
        let (mut sum, mut seen, mut hits) = (0.0, 0usize, Vec::with_capacity(places.len()));
        for p in places {
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
                if i.towards_bright.dot(&p.normal).abs() <= ALIGNED || off > 1.0 || d.norm() > tolerance + 1.5 {
                    return;
                }
                let worth = e.strength / (e.strength + self.half) * (1.0 - 0.5 * off * off);
                if worth > best.0 {
                    best = (worth, Some(k as u32));
                }
            });
            sum += best.0;
            hits.push(best.1);
        }
        (sum / seen.max(1) as f64, hits)
    }

    /// Places along the outer and the inner outline where they are not hidden by the bar itself.
    pub(in crate::offline::bar) fn outlines(&self, torus: &Torus, corners: usize, step: f64) -> [Vec<CurvePoint>; 2] {
        let bar = Bar::new(torus, &self.eye);
        [0, 1].map(|k| self.places(&bar, k, corners, step))
    }

    /// The same along one of them: 0 is the outer one.
    fn places(&self, bar: &Bar<'_>, which: usize, corners: usize, step: f64) -> Vec<CurvePoint> {
        let corner = |k: usize| {
            let angle = std::f64::consts::TAU * k as f64 / corners as f64;
            let x = *outline(bar.torus, bar.eye, angle)?.get(which)?;
            let u = project(self.p, &x);
            (!bar.hides(&x, angle) && u.iter().all(|v| v.is_finite())).then_some(u)
        };
        let curve: Vec<Option<Pixel>> = (0..corners).map(corner).collect();
        curve_points(&curve, step, project(self.p, &bar.torus.centre))
    }
}

/// Points of the core at which a bar may stand before its own outline.
const AROUND: usize = 48;

/// A bar seen from a place.
struct Bar<'a> {
    torus: &'a Torus,
    eye: &'a Vector3<f64>,
    /// Points of the core from the eye, with their squared distance.
    core: [(Vector3<f64>, f64); AROUND],
}

impl<'a> Bar<'a> {
    fn new(torus: &'a Torus, eye: &'a Vector3<f64>) -> Self {
        let f = frame_of(&torus.normal);
        let core = std::array::from_fn(|k| {
            let (sin, cos) = Self::angle(k).sin_cos();
            let c = torus.centre + (f.column(0) * cos + f.column(1) * sin) * torus.core - eye;
            (c, c.norm_squared())
        });
        Self { torus, eye, core }
    }

    fn angle(k: usize) -> f64 {
        std::f64::consts::TAU * k as f64 / AROUND as f64
    }

    /// Whether another part of the bar stands before a point of its outline at a core angle.
    fn hides(&self, x: &Vector3<f64>, angle: f64) -> bool {
        let sight = x - self.eye;
        let reach = sight.norm();
        let d = sight / reach;
        // The chord between two of the core's points strays from it by a little.
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

/// How much of the other outline carries edges, the worse view counting most: whatever edges, and by how likely they are an outline.
pub(in crate::offline::bar) fn support(
    views: &[View<'_, '_>; 2],
    t: &Torus,
    clicked_outer: bool,
    tolerance: f64,
) -> (f64, f64) {
    let (mut least, mut sum) = ([f64::INFINITY; 2], [0.0; 2]);
    for v in views {
        let other = v.places(&Bar::new(t, &v.eye), usize::from(clicked_outer), TESTED, 0.0);
        let (likely, hits) = v.outline_edges(&other, tolerance);
        let any = hits.iter().flatten().count() as f64 / hits.len().max(1) as f64;
        for (k, c) in [any, likely].into_iter().enumerate() {
            least[k] = f64::min(least[k], c);
            sum[k] += c;
        }
    }
    (least[0] + 0.25 * sum[0], least[1] + 0.25 * sum[1])
}
