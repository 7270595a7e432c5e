//! Shift and small deformation that carry the predicted outline onto the edges found.

use super::Outline;
use super::edge::Edge;
use super::outline::MAX_OUTLINE;
use crate::math;
use nalgebra::{Matrix2, Matrix5, Vector2, Vector5};

/// How far the shape may be from the prediction before edges tell (one sigma of a relative stretch): a small arc then still
/// gives a centre, with the prediction's shape.
const SHAPE_SIGMA: f64 = 0.05;
/// Nothing is believed to be better than this, pixels: pixels have structure that noise models do not know.
const EDGE_FLOOR: f64 = 0.015;

/// Shift and symmetric stretch (xx, xy, yy), relative to the predicted outline.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Fit {
    pub(crate) shift: Vector2<f64>,
    pub(crate) stretch: [f64; 3],
    pub(crate) covariance: Matrix2<f64>,
    /// Weighted root mean square distance of the used edges, pixels.
    pub(crate) rms: f64,
    /// Sum of the weights over the number of outline points: the share of the rim that agrees.
    pub(crate) share: f64,
}

/// Where a point of the outline goes under a fit, as a shift of that point.
pub(crate) fn moved(fit: &Fit, q: Vector2<f64>) -> Vector2<f64> {
    let [xx, xy, yy] = fit.stretch;
    fit.shift + Vector2::new(xx * q.x + xy * q.y, xy * q.x + yy * q.y)
}

/// Refines `from` by edges measured relative to the outline as `from` moved it; robust (Tukey) least squares.
pub(crate) fn refine(outline: &Outline, edges: &[Option<Edge>; MAX_OUTLINE], from: &Fit) -> Option<Fit> {
    let mut spread = initial_spread(edges)?;
    let mut x = Vector5::zeros();
    let mut result = None;
    for round in 0..5 {
        let mut n = Matrix5::zeros();
        let mut g = Vector5::zeros();
        let inv_var = 1.0 / (spread * spread);
        for (p, e) in outline.points.iter().zip(edges) {
            let Some(e) = e else { continue };
            let a = row(p.normal, p.pixel - outline.centre);
            let r = e.offset - a.dot(&x);
            let w = if round == 0 { huber(r / spread) } else { tukey(r / spread) } * inv_var;
            n.ger(w, &a, &a, 1.0);
            g.axpy(w * e.offset, &a, 1.0);
        }
        for (k, s) in from.stretch.iter().enumerate() {
            let prior = 1.0 / (SHAPE_SIGMA * SHAPE_SIGMA);
            *n.get_mut((k + 2, k + 2))? += prior;
            *g.get_mut(k + 2)? -= prior * s;
        }
        let inverse = n.cholesky()?.inverse();
        x = inverse * g;
        if !x.iter().all(|v| v.is_finite()) {
            return None;
        }
        // Weights and spread of what is left, for the next round and for the covariance.
        let (mut sw, mut swr2, mut median) = (0.0, 0.0, heapless::Vec::<f64, MAX_OUTLINE>::new());
        for (p, e) in outline.points.iter().zip(edges) {
            let Some(e) = e else { continue };
            let r = e.offset - row(p.normal, p.pixel - outline.centre).dot(&x);
            let w = tukey(r / spread);
            sw += w;
            swr2 += w * r * r;
            let _ = median.push(math::fabs(r));
        }
        if sw < 5.0 {
            return None;
        }
        let rms = math::sqrt(swr2 / sw);
        let sigma = math::sqrt(swr2 / (sw - 4.0).max(1.0)).max(EDGE_FLOOR);
        result = Some(Fit {
            shift: from.shift + Vector2::new(x[0], x[1]),
            stretch: [from.stretch[0] + x[2], from.stretch[1] + x[3], from.stretch[2] + x[4]],
            covariance: inverse.fixed_view::<2, 2>(0, 0) * (sigma * sigma * inv_var),
            rms,
            share: sw / outline.points.len() as f64,
        });
        spread = (1.4826 * middle(&mut median)).max(2.0 * EDGE_FLOOR);
    }
    result
}

fn row(n: Vector2<f64>, q: Vector2<f64>) -> Vector5<f64> {
    Vector5::new(n.x, n.y, n.x * q.x, n.x * q.y + n.y * q.x, n.y * q.y)
}

fn initial_spread(edges: &[Option<Edge>; MAX_OUTLINE]) -> Option<f64> {
    let mut offsets: heapless::Vec<f64, MAX_OUTLINE> = heapless::Vec::new();
    for e in edges.iter().flatten() {
        let _ = offsets.push(e.offset);
    }
    if offsets.len() < 5 {
        return None;
    }
    let m = middle(&mut offsets);
    for o in &mut offsets {
        *o = math::fabs(*o - m);
    }
    Some((1.4826 * middle(&mut offsets)).clamp(0.1, 2.0))
}

fn middle(v: &mut [f64]) -> f64 {
    v.sort_unstable_by(f64::total_cmp);
    v.get(v.len() / 2).copied().unwrap_or(0.0)
}

fn huber(z: f64) -> f64 {
    let a = math::fabs(z);
    if a <= 1.345 { 1.0 } else { 1.345 / a }
}

fn tukey(z: f64) -> f64 {
    let u = 1.0 - math::sq(z / 4.685);
    if u > 0.0 { u * u } else { 0.0 }
}
