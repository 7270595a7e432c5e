//! Fits a shift and a small deformation of the predicted outline to the edges.

use super::Outline;
use super::edge::Edge;
use super::outline::{MAX_OUTLINE_POINTS, OutlinePoint};
use crate::math;
use nalgebra::{Matrix5, Vector2, Vector5};

/// Prior of the shape: standard deviation of the relative stretch. With this prior a small arc still gives a centre,
/// with the predicted shape.
const SHAPE_SIGMA: f64 = 0.05;
/// Minimum standard deviation of an edge, px: pixels have structure that noise models do not contain.
const EDGE_FLOOR_PX: f64 = 0.015;

/// Shift and symmetric stretch (xx, xy, yy), relative to the predicted outline.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Fit {
    pub(crate) shift: Vector2<f64>,
    pub(crate) stretch: [f64; 3],
    /// Weighted root mean square distance of the used edges, pixels.
    pub(crate) rms: f64,
    /// Sum of the weights divided by the number of outline points: the fraction of the rim that agrees with the fit.
    pub(crate) fraction: f64,
}

/// Displacement by a fit of an outline point at `q` from the centre.
pub(crate) fn displacement(fit: &Fit, q: Vector2<f64>) -> Vector2<f64> {
    let [xx, xy, yy] = fit.stretch;
    fit.shift + Vector2::new(xx * q.x + xy * q.y, xy * q.x + yy * q.y)
}

/// Observation equation of an edge: its row of derivatives, and the measured offset.
#[derive(Clone, Copy)]
struct Line {
    a: [f64; 5],
    offset: f64,
}

type Lines = heapless::Vec<Line, MAX_OUTLINE_POINTS>;

impl Line {
    fn residual(&self, x: &Vector5<f64>) -> f64 {
        let [a, b, c, d, e] = self.a;
        self.offset - (a * x[0] + b * x[1] + c * x[2] + d * x[3] + e * x[4])
    }
}

/// Refines `from` by robust (Tukey) least squares. The edges are measured relative to the outline moved by `from`.
pub(crate) fn refine(
    outline: &Outline,
    points: &[OutlinePoint],
    edges: &[Option<Edge>; MAX_OUTLINE_POINTS],
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
        let converged = (next - x).norm_squared() < 1e-6;
        x = next;
        let mut left: heapless::Vec<f64, MAX_OUTLINE_POINTS> = heapless::Vec::new();
        for l in &lines {
            let _ = left.push(math::fabs(l.residual(&x)));
        }
        let found = (1.4826 * median(&mut left)).max(2.0 * EDGE_FLOOR_PX);
        if round > 0 && (converged || round == 4) {
            let fit = Fit {
                shift: from.shift + Vector2::new(x[0], x[1]),
                stretch: [from.stretch[0] + x[2], from.stretch[1] + x[3], from.stretch[2] + x[4]],
                ..Fit::default()
            };
            return evaluate(fit, points.len(), &lines, &x, found);
        }
        spread = found;
    }
    None
}

/// Normal equations of the shift and the stretch, with the prior that the shape is as predicted.
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

/// Adds the agreeing fraction of the rim and the spread to a solution; `None` if fewer than five edges agree.
fn evaluate(fit: Fit, points: usize, lines: &Lines, x: &Vector5<f64>, spread: f64) -> Option<Fit> {
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
    Some(Fit { rms: math::sqrt(swr2 / sw), fraction: sw / points as f64, ..fit })
}

fn row(n: Vector2<f64>, q: Vector2<f64>) -> [f64; 5] {
    [n.x, n.y, n.x * q.x, n.x * q.y + n.y * q.x, n.y * q.y]
}

fn initial_spread(lines: &Lines) -> f64 {
    let mut offsets: heapless::Vec<f64, MAX_OUTLINE_POINTS> = heapless::Vec::new();
    for l in lines {
        let _ = offsets.push(l.offset);
    }
    let m = median(&mut offsets);
    for o in &mut offsets {
        *o = math::fabs(*o - m);
    }
    (1.4826 * median(&mut offsets)).clamp(0.1, 2.0)
}

/// Median of an unsorted list; 0 if it is empty.
pub(crate) fn median(v: &mut [f64]) -> f64 {
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
