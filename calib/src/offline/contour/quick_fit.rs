//! A direct ellipse fit from accumulated sums, for the thousands of trial ellipses of a growing contour.
//!
//! The method is that of Halir and Flusser. The sums of two arcs add, so that trying a pair of arcs costs one small
//! eigenproblem. The fit only finds contours; reported ellipses are fitted again by maximum likelihood.

use crate::offline::types::Ellipse2;
use graspd_rt::geom::Pixel;
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use std::cell::OnceCell;

/// Sums of products of `(x^2, xy, y^2, x, y, 1)` over points, relative to an origin and in a chosen unit.
#[derive(Clone, Copy, Debug)]
pub(in crate::offline) struct Sums {
    origin: Pixel,
    unit: f64,
    m: Matrix6<f64>,
}

impl Sums {
    /// Empty sums. Origin and unit should be close to the position and size of the ellipse, for a good condition
    /// number.
    pub(in crate::offline) fn new(origin: Pixel, unit: f64) -> Self {
        Self { origin, unit: unit.max(1e-9), m: Matrix6::zeros() }
    }

    /// Adds a point with a weight.
    pub(in crate::offline) fn add(&mut self, p: Pixel, weight: f64) {
        let q = (p - self.origin) / self.unit;
        let d = Vector6::new(q.x * q.x, q.x * q.y, q.y * q.y, q.x, q.y, 1.0);
        self.m += d * d.transpose() * weight;
    }

    /// Adds other sums made with the same origin and unit.
    pub(in crate::offline) fn plus(&self, other: &Self) -> Self {
        Self { m: self.m + other.m, ..*self }
    }

    /// The least-squares ellipse; `None` when the points do not determine one.
    pub(in crate::offline) fn ellipse(&self) -> Option<Ellipse2> {
        let s1: Matrix3<f64> = self.m.fixed_view::<3, 3>(0, 0).into_owned();
        let s2: Matrix3<f64> = self.m.fixed_view::<3, 3>(0, 3).into_owned();
        let s3: Matrix3<f64> = self.m.fixed_view::<3, 3>(3, 3).into_owned();
        let t = -s3.try_inverse()? * s2.transpose();
        let mut m = s1 + s2 * t;
        m = (m + m.transpose()) * 0.5;
        let ridge = 1e-13 * m.trace().abs() + 1e-300;
        m += Matrix3::identity() * ridge;
        // M a = l C a with one positive eigenvalue of C: in the basis of the Cholesky factor the problem is symmetric.
        let c = Matrix3::new(0.0, 0.0, 2.0, 0.0, -1.0, 0.0, 2.0, 0.0, 0.0);
        let l = m.cholesky()?.l();
        let li = l.try_inverse()?;
        let k = li * c * li.transpose();
        let e = ((k + k.transpose()) * 0.5).try_symmetric_eigen(1e-14, 60)?;
        let best = e.eigenvalues.imax();
        if !(e.eigenvalues.get(best).copied()? > 0.0) {
            return None;
        }
        let a1: Vector3<f64> = li.transpose() * e.eigenvectors.column(best);
        let a2 = t * a1;
        let local = from_coefficients(a1.x, a1.y, a1.z, a2.x, a2.y, a2.z)?;
        Some(Ellipse2 {
            centre: self.origin + local.centre * self.unit,
            a: local.a * self.unit,
            b: local.b * self.unit,
            theta: local.theta,
        })
    }
}

/// Ellipse of `A x^2 + B xy + C y^2 + D x + E y + F = 0`.
fn from_coefficients(a: f64, b: f64, c: f64, d: f64, e: f64, f: f64) -> Option<Ellipse2> {
    let det = 4.0 * a * c - b * b;
    if !(det > 0.0) {
        return None;
    }
    let centre = Pixel::new((b * e - 2.0 * c * d) / det, (b * d - 2.0 * a * e) / det);
    let f0 = f + 0.5 * (d * centre.x + e * centre.y);
    let s = ((a - c).powi(2) + b * b).sqrt();
    let (l1, l2) = (0.5 * (a + c + s), 0.5 * (a + c - s));
    let (q1, q2) = (-f0 / l1, -f0 / l2);
    if !(q1 > 0.0 && q2 > 0.0) {
        return None;
    }
    let (r1, r2) = (q1.sqrt(), q2.sqrt());
    // The eigenvector of l1 makes the angle phi with x.
    let phi = 0.5 * b.atan2(a - c);
    let (big, small, theta) = if r1 >= r2 { (r1, r2, phi) } else { (r2, r1, phi + std::f64::consts::FRAC_PI_2) };
    let ok = big.is_finite() && centre.x.is_finite() && centre.y.is_finite();
    ok.then(|| Ellipse2 { centre, a: big, b: small, theta: theta.rem_euclid(std::f64::consts::PI) })
}

/// An ellipse with the sine and cosine of its direction, for walking along it and measuring distances from it.
#[derive(Clone, Copy, Debug)]
pub(in crate::offline) struct Walk {
    e: Ellipse2,
    ct: f64,
    st: f64,
}

impl Walk {
    pub(in crate::offline) fn new(e: &Ellipse2) -> Self {
        let (st, ct) = e.theta.sin_cos();
        Self { e: *e, ct, st }
    }

    fn out(&self, x: f64, y: f64) -> Pixel {
        Pixel::new(self.ct * x - self.st * y, self.st * x + self.ct * y)
    }

    /// Point and outward unit normal at the parameter `t`.
    pub(in crate::offline) fn at(&self, t: f64) -> (Pixel, Pixel) {
        let (s, c) = t.sin_cos();
        self.at_sin_cos(s, c)
    }

    fn at_sin_cos(&self, s: f64, c: f64) -> (Pixel, Pixel) {
        let n = self.out(self.e.b * c, self.e.a * s);
        (self.e.centre + self.out(self.e.a * c, self.e.b * s), n / n.norm().max(1e-12))
    }

    /// Signed distance (first order, positive outside), outward unit normal, and parameter of a point.
    pub(in crate::offline) fn measure(&self, p: Pixel) -> (f64, Pixel, f64) {
        let d = p - self.e.centre;
        let (x, y) = (self.ct * d.x + self.st * d.y, self.ct * d.y - self.st * d.x);
        let (u, v) = (x / self.e.a, y / self.e.b);
        let r = u.hypot(v).max(1e-9);
        let g = self.out(u / self.e.a, v / self.e.b);
        let gn = g.norm().max(1e-12);
        // F = r - 1 has the gradient g / r: closer to the true distance far from the curve than the quadratic form.
        ((r - 1.0) * r / gn, g / gn, v.atan2(u))
    }

    /// Radius of curvature at the parameter `t`.
    pub(in crate::offline) fn radius(&self, t: f64) -> f64 {
        let (s, c) = t.sin_cos();
        let q = (self.e.a * s).powi(2) + (self.e.b * c).powi(2);
        q.powf(1.5) / (self.e.a * self.e.b)
    }

    /// Length of the whole curve (Ramanujan).
    pub(in crate::offline) fn perimeter(&self) -> f64 {
        let (a, b) = (self.e.a, self.e.b);
        std::f64::consts::PI * (3.0 * (a + b) - ((3.0 * a + b) * (a + 3.0 * b)).sqrt())
    }

    /// Parameters at equal arc lengths of about `step` pixels, at most `most` of them.
    pub(in crate::offline) fn parameters(&self, step: f64, most: usize) -> Vec<f64> {
        let n = self.count(step, most);
        self.evenly(n, &Turn::new(n)).into_iter().map(|p| p.t).collect()
    }

    /// Points and outward unit normals at equal arc lengths of about `step` pixels, at most as many as `turns`
    /// provides.
    pub(in crate::offline) fn points(&self, step: f64, turns: &Turns) -> Vec<(Pixel, Pixel)> {
        let n = self.count(step, turns.most());
        let parameters = turns.with(n, |turn| self.evenly(n, turn));
        parameters.into_iter().map(|p| self.at_sin_cos(p.sin, p.cos)).collect()
    }

    fn count(&self, step: f64, most: usize) -> usize {
        ((self.perimeter() / step) as usize).clamp(16, most.max(16))
    }

    fn evenly(&self, n: usize, turn: &Turn) -> Vec<Parameter> {
        let mut length = Vec::with_capacity(turn.fine.len());
        length.extend(turn.fine.iter().map(|p| ((self.e.a * p.sin).powi(2) + (self.e.b * p.cos).powi(2)).sqrt()));
        let mut total = 0.0;
        for l in &mut length {
            total += *l;
            *l = total;
        }
        let mut out = Vec::with_capacity(n);
        let middle = |k: usize| total * (k as f64 + 0.5) / n as f64;
        let mut next = middle(0);
        for (done, p) in length.iter().zip(&turn.fine) {
            if *done >= next && out.len() < n {
                out.push(*p);
                next = middle(out.len());
            }
        }
        out
    }
}

/// A parameter with its sine and cosine.
#[derive(Clone, Copy, Debug)]
struct Parameter {
    t: f64,
    sin: f64,
    cos: f64,
}

/// Tables of one full turn, by number of points, each computed on first use.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Turns(Vec<OnceCell<Turn>>);

impl Turns {
    /// Tables for up to `most` points.
    pub(in crate::offline) fn new(most: usize) -> Self {
        Self(vec![OnceCell::new(); most + 1])
    }

    fn most(&self) -> usize {
        self.0.len().saturating_sub(1)
    }

    /// Calls `take` with points and outward unit normals of a full turn: `4 n` at equal parameters.
    pub(in crate::offline) fn round(&self, walk: Walk, n: usize, mut take: impl FnMut(Pixel, Pixel)) {
        self.with(n, |turn| {
            for p in &turn.fine {
                let (at, normal) = walk.at_sin_cos(p.sin, p.cos);
                take(at, normal);
            }
        });
    }

    fn with<T>(&self, n: usize, use_it: impl FnOnce(&Turn) -> T) -> T {
        match self.0.get(n) {
            Some(kept) => use_it(kept.get_or_init(|| Turn::new(n))),
            None => use_it(&Turn::new(n)),
        }
    }
}

/// Fine parameters of one full turn for a number of points.
#[derive(Clone, Debug)]
struct Turn {
    fine: Vec<Parameter>,
}

impl Turn {
    fn new(n: usize) -> Self {
        let dt = std::f64::consts::TAU / (4 * n) as f64;
        let fine = (0..4 * n).map(|k| {
            let t = (k as f64 + 0.5) * dt;
            let (sin, cos) = t.sin_cos();
            Parameter { t, sin, cos }
        });
        Self { fine: fine.collect() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exact_points_reproduce_the_ellipse() {
        for k in 0..40 {
            let th = 0.08 * f64::from(k);
            let e = Ellipse2 {
                centre: Pixel::new(300.0 + th, 200.0),
                a: 90.0,
                b: 20.0 + 1.5 * f64::from(k),
                theta: th % 3.1,
            };
            let w = Walk::new(&e);
            let mut s = Sums::new(Pixel::new(250.0, 230.0), 100.0);
            for i in 0..40 {
                s.add(w.at(f64::from(i) * 0.1 + th).0, 1.0);
            }
            let f = s.ellipse().unwrap();
            assert!(
                (f.centre - e.centre).norm() < 1e-4 && (f.a - e.a).abs() < 1e-4 && (f.b - e.b).abs() < 1e-4,
                "{f:?} {e:?}"
            );
            assert!((0.5 * (2.0 * (f.theta - e.theta)).sin()).abs() < 1e-4);
        }
    }

    #[test]
    fn points_distances_and_arc_length_agree() {
        let e = Ellipse2 { centre: Pixel::new(10.0, 20.0), a: 50.0, b: 20.0, theta: 0.7 };
        let w = Walk::new(&e);
        for t in w.parameters(2.0, 1000) {
            let (p, n) = w.at(t);
            let (d, m, u) = w.measure(p + n * 0.3);
            assert!((d - 0.3).abs() < 0.01 && m.dot(&n) > 0.999);
            assert!(((u - t) * 0.5).sin().abs() < 0.02);
        }
        let t = w.parameters(1.0, 1000);
        let steps: Vec<f64> = t.windows(2).map(|p| (w.at(p[1]).0 - w.at(p[0]).0).norm()).collect();
        assert!(steps.iter().all(|s| (0.6..1.5).contains(s)));
        assert!((w.radius(0.0) - 8.0).abs() < 1e-9);
    }

    #[test]
    fn a_line_gives_no_plausible_ellipse() {
        let mut s = Sums::new(Pixel::zeros(), 100.0);
        for i in 0..30 {
            s.add(Pixel::new(f64::from(i), 2.0 * f64::from(i)), 1.0);
        }
        assert!(s.ellipse().is_none_or(|e| e.b < 1.0 || e.a > 1e4));
    }
}
