//! Shift and small deformation that carry the predicted outline onto the edges found.

use super::Outline;
use super::edge::Edge;
use super::outline::{MAX_OUTLINE, OutlinePoint};
use crate::math;
use nalgebra::{Matrix5, Vector2, Vector5};

/// How far the shape may be from the prediction before edges tell (one sigma of a relative stretch): a small arc then
/// still gives a centre, with the prediction's shape.
const SHAPE_SIGMA: f64 = 0.05;
/// Nothing is believed to be better than this, pixels: pixels have structure that noise models do not know.
const EDGE_FLOOR: f64 = 0.015;

/// Shift and symmetric stretch (xx, xy, yy), relative to the predicted outline.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Fit {
    pub(crate) shift: Vector2<f64>,
    pub(crate) stretch: [f64; 3],
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

/// An edge's equation: its row of derivatives, and the offset found.
#[derive(Clone, Copy)]
struct Line {
    a: [f64; 5],
    offset: f64,
}

type Lines = heapless::Vec<Line, MAX_OUTLINE>;

impl Line {
    fn residual(&self, x: &Vector5<f64>) -> f64 {
        let [a, b, c, d, e] = self.a;
        self.offset - (a * x[0] + b * x[1] + c * x[2] + d * x[3] + e * x[4])
    }
}

/// Refines `from` by edges measured relative to the outline as `from` moved it; robust (Tukey) least squares.
pub(crate) fn refine(
    outline: &Outline,
    points: &[OutlinePoint],
    edges: &[Option<Edge>; MAX_OUTLINE],
    from: &Fit,
) -> Option<Fit> {
    let mut lines = Lines::new();
    for (p, e) in points.iter().zip(edges) {
        let Some(e) = e else { continue };
        let _ = lines.push(Line { a: row(p.normal, p.pixel - outline.centre), offset: e.offset });
    }
    if lines.len() < 5 {
        return None;
    }
    let mut spread = initial_spread(&lines);
    let mut x = Vector5::zeros();
    for round in 0..5 {
        let (n, g) = equations(&lines, &x, spread, round == 0, from);
        let factor = n.cholesky()?;
        let next = factor.solve(&g);
        if !next.iter().all(|v| v.is_finite()) {
            return None;
        }
        let settled = (next - x).norm_squared() < 1e-6;
        x = next;
        let mut left: heapless::Vec<f64, MAX_OUTLINE> = heapless::Vec::new();
        for l in &lines {
            let _ = left.push(math::fabs(l.residual(&x)));
        }
        let found = (1.4826 * middle(&mut left)).max(2.0 * EDGE_FLOOR);
        if round > 0 && (settled || round == 4) {
            let fit = Fit {
                shift: from.shift + Vector2::new(x[0], x[1]),
                stretch: [from.stretch[0] + x[2], from.stretch[1] + x[3], from.stretch[2] + x[4]],
                ..Fit::default()
            };
            return judged(fit, points.len(), &lines, &x, found);
        }
        spread = found;
    }
    None
}

/// Normal equations of the shift and the stretch, with the prior that the shape is the predicted one.
fn equations(lines: &Lines, x: &Vector5<f64>, spread: f64, early: bool, from: &Fit) -> (Matrix5<f64>, Vector5<f64>) {
    let (inv, inv_var) = (1.0 / spread, 1.0 / (spread * spread));
    let mut n = Matrix5::zeros();
    let mut g = Vector5::zeros();
    for l in lines {
        let z = l.residual(x) * inv;
        let w = if early { huber(z) } else { tukey(z) } * inv_var;
        for i in 0..5 {
            let wa = w * l.a[i];
            for j in 0..=i {
                n[(i, j)] += wa * l.a[j];
            }
            g[i] += wa * l.offset;
        }
    }
    let prior = 1.0 / (SHAPE_SIGMA * SHAPE_SIGMA);
    for (k, s) in from.stretch.iter().enumerate() {
        n[(k + 2, k + 2)] += prior;
        g[k + 2] -= prior * s;
    }
    for i in 0..5 {
        for j in 0..i {
            n[(j, i)] = n[(i, j)];
        }
    }
    (n, g)
}

/// Share of the rim and spread of a solution.
fn judged(fit: Fit, points: usize, lines: &Lines, x: &Vector5<f64>, spread: f64) -> Option<Fit> {
    let (mut sw, mut swr2) = (0.0, 0.0);
    for l in lines {
        let r = l.residual(x);
        let w = tukey(r / spread);
        sw += w;
        swr2 += w * r * r;
    }
    if sw < 5.0 {
        return None;
    }
    Some(Fit { rms: math::sqrt(swr2 / sw), share: sw / points as f64, ..fit })
}

fn row(n: Vector2<f64>, q: Vector2<f64>) -> [f64; 5] {
    [n.x, n.y, n.x * q.x, n.x * q.y + n.y * q.x, n.y * q.y]
}

fn initial_spread(lines: &Lines) -> f64 {
    let mut offsets: heapless::Vec<f64, MAX_OUTLINE> = heapless::Vec::new();
    for l in lines {
        let _ = offsets.push(l.offset);
    }
    let m = middle(&mut offsets);
    for o in &mut offsets {
        *o = math::fabs(*o - m);
    }
    (1.4826 * middle(&mut offsets)).clamp(0.1, 2.0)
}

/// The middle value of a list, in any order; 0 of none.
pub(crate) fn middle(v: &mut [f64]) -> f64 {
    if v.is_empty() {
        return 0.0;
    }
    let at = v.len() / 2;
    *v.select_nth_unstable_by(at, f64::total_cmp).1
}

fn huber(z: f64) -> f64 {
    let a = math::fabs(z);
    if a <= 1.345 { 1.0 } else { 1.345 / a }
}

fn tukey(z: f64) -> f64 {
    let u = 1.0 - math::sq(z / 4.685);
    if u > 0.0 { u * u } else { 0.0 }
}
