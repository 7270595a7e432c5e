//! Fits the pixel-integrated disc to grey values: Gauss-Newton on the shift, the levels, the slope of the illumination
//! and, optionally, the blur and the shape.
//!
//! A pixel at `x` from the mark's centre is `(1 + slope·x) (outside + (inside - outside) c)`, with `c` the fraction of
//! it that the disc covers. The derivative of `c` with respect to the distance from the rim is the length of the rim
//! inside the pixel. The pixels that the rim crosses therefore contain the information about the shift; the flat pixels
//! determine the levels. docs/TRACKER.md derives the model.

use super::band::{Band, Pixels, four, put};
use super::coverage::{Cover, PointSpread, Profile, trapezoid};
use nalgebra::{SMatrix, SVector};
use wide::f32x4;

/// Number of unknowns of the plain model: shift (2), levels outside and inside, slope (2).
pub(crate) const PLAIN: usize = 6;
/// Number of unknowns of the full model: those of the plain model, variance of the blur, stretch (3).
pub(crate) const FULL: usize = 10;

/// Parameters of the fit.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Model {
    /// Shift relative to the outline for which the band was gathered, px.
    pub(crate) shift: [f32; 2],
    /// Grey values outside and inside.
    pub(crate) level: [f32; 2],
    /// Relative slope of the illumination, 1/px.
    pub(crate) slope: [f32; 2],
    pub(crate) psf: PointSpread,
    /// Symmetric stretch (xx, xy, yy) of that outline.
    pub(crate) stretch: [f32; 3],
}

impl Model {
    /// A model with the given blur and motion; all other parameters are zero.
    pub(crate) fn new(psf: PointSpread) -> Self {
        Self { shift: [0.0; 2], level: [0.0; 2], slope: [0.0; 2], psf, stretch: [0.0; 3] }
    }

    /// Grey difference inside minus outside.
    pub(crate) fn step(&self) -> f32 {
        self.level[1] - self.level[0]
    }

    /// Adds a solution in the order of the columns.
    pub(crate) fn add(&mut self, p: &[f64]) {
        let Self { shift: [sx, sy], level: [l0, l1], slope: [gx, gy], psf, stretch: [xx, xy, yy] } = self;
        for (v, p) in [sx, sy, l0, l1, gx, gy, &mut psf.variance, xx, xy, yy].into_iter().zip(p) {
            *v += *p as f32;
        }
    }
}

/// Normal equations, and the sums from which the noise is estimated.
#[derive(Clone, Debug)]
pub(crate) struct Equations<const N: usize> {
    pub(crate) matrix: SMatrix<f64, N, N>,
    pub(crate) right: SVector<f64, N>,
    /// Sum of squared residuals at the rim, weighted by the squared derivative of each.
    pub(crate) weighted_squares: f64,
    /// Sum of those weights, and of their squares.
    pub(crate) weights: f64,
    pub(crate) weights2: f64,
    /// Number of flat pixels in use, and the sum of their squared residuals.
    pub(crate) flat: (f64, f64),
}

/// Four rim pixels of a model: columns of derivatives and the residual.
struct Lane<const N: usize> {
    columns: [f32x4; N],
    residual: f32x4,
    /// Squared derivative with respect to the distance from the rim.
    gain2: f32x4,
}

#[inline(always)]
fn lane<const N: usize>(band: &Band, k: usize, m: &Model, profile: &Profile, sharp: bool) -> Lane<N> {
    let (x, y, grey) = (four(&band.rim.x, k), four(&band.rim.y, k), four(&band.rim.grey, k));
    let (nx, ny) = (four(&band.normal[0], k), four(&band.normal[1], k));
    let (d0, curvature) = (four(&band.depth, k), four(&band.curvature, k));
    let [sx, sy] = m.shift;
    let slip = ny * sx - nx * sy;
    let mut d = d0 + nx * sx + ny * sy - curvature * slip * slip * 0.5;
    let (qx, qy) = (x + nx * d0, y + ny * d0);
    if N > PLAIN {
        let [xx, xy, yy] = m.stretch;
        d += nx * (qx * xx + qy * xy) + ny * (qx * xy + qy * yy);
    }
    let Cover { fraction, chord, widen } =
        if sharp { trapezoid(d, nx.abs(), ny.abs(), curvature) } else { profile.cover(d, nx, ny, curvature) };
    let light = x * m.slope[0] + y * m.slope[1] + 1.0;
    let mean = fraction * m.step() + m.level[0];
    let step = light * m.step();
    let b = chord * step;
    let (bx, by) = (b * nx, b * ny);
    let inside = light * fraction;
    let all = [bx, by, light - inside, inside, mean * x, mean * y, widen * step, bx * qx, bx * qy + by * qx, by * qy];
    let mut columns = [f32x4::ZERO; N];
    for (c, a) in columns.iter_mut().zip(all) {
        *c = a;
    }
    Lane { columns, residual: grey - light * mean, gain2: b * b }
}

/// Derivatives and residuals of a model, with the normal matrix.
pub(crate) fn equations<const N: usize>(band: &Band, m: &Model) -> Equations<N> {
    let profile = Profile::new(&m.psf);
    let sharp = N == PLAIN && profile.is_sharp();
    let mut sum = [[f32x4::ZERO; N]; N];
    let mut right = [f32x4::ZERO; N];
    let (mut squares, mut weights, mut weights2) = (f32x4::ZERO, f32x4::ZERO, f32x4::ZERO);
    for k in (0..band.rim.len).step_by(4) {
        let l: Lane<N> = lane(band, k, m, &profile, sharp);
        let w = four(&band.rim.weight, k);
        for (i, (sums, right)) in sum.iter_mut().zip(&mut right).enumerate() {
            let c = l.columns[i] * w;
            for (s, other) in sums.iter_mut().zip(l.columns).take(i + 1) {
                *s += c * other;
            }
            *right += c * l.residual;
        }
        let g = l.gain2 * w;
        weights += g;
        weights2 += g * g;
        squares += g * l.residual * l.residual;
    }
    let mut e = Equations {
        matrix: SMatrix::zeros(),
        right: SVector::from_fn(|i, _| f64::from(right[i].reduce_add())),
        weighted_squares: f64::from(squares.reduce_add()),
        weights: f64::from(weights.reduce_add()),
        weights2: f64::from(weights2.reduce_add()),
        flat: (0.0, 0.0),
    };
    for (i, sums) in sum.iter().enumerate() {
        for (j, s) in sums.iter().enumerate().take(i + 1) {
            e.matrix[(i, j)] = f64::from(s.reduce_add());
        }
    }
    for side in 0..2 {
        flat(&band.flat[side], m, side, &mut e);
    }
    for i in 0..N {
        for j in 0..i {
            e.matrix[(j, i)] = e.matrix[(i, j)];
        }
    }
    e
}

/// Adds the flat pixels of one side: they depend on its level and the slope.
fn flat<const N: usize, const M: usize>(p: &Pixels<M>, m: &Model, side: usize, e: &mut Equations<N>) {
    let level = m.level[side];
    let mut s = [f32x4::ZERO; 11];
    for k in (0..p.len).step_by(4) {
        let (x, y, w) = (four(&p.x, k), four(&p.y, k), four(&p.weight, k));
        let light = x * m.slope[0] + y * m.slope[1] + 1.0;
        let r = (four(&p.grey, k) - light * level) * w;
        let (lx, ly) = (x * level, y * level);
        let (wx, wy, wl) = (lx * w, ly * w, light * w);
        let terms =
            [light * wl, light * wx, light * wy, lx * wx, lx * wy, ly * wy, light * r, lx * r, ly * r, r * r, w];
        for (s, t) in s.iter_mut().zip(terms) {
            *s += t;
        }
    }
    let s = s.map(|v| f64::from(v.reduce_add()));
    let at = 2 + side;
    e.matrix[(at, at)] += s[0];
    e.matrix[(4, at)] += s[1];
    e.matrix[(5, at)] += s[2];
    e.matrix[(4, 4)] += s[3];
    e.matrix[(5, 4)] += s[4];
    e.matrix[(5, 5)] += s[5];
    e.right[at] += s[6];
    e.right[4] += s[7];
    e.right[5] += s[8];
    e.flat = (e.flat.0 + s[10], e.flat.1 + s[9]);
}

/// Computes the residuals of a model, stores them in the band, and updates the right side and the sums of `e`. The
/// matrix of `e` is unchanged. This is half the work of [`equations`].
pub(crate) fn residuals<const N: usize>(band: &mut Band, m: &Model, e: &mut Equations<N>) {
    let profile = Profile::new(&m.psf);
    let sharp = N == PLAIN && profile.is_sharp();
    let mut right = [f32x4::ZERO; N];
    let (mut squares, mut weights, mut weights2) = (f32x4::ZERO, f32x4::ZERO, f32x4::ZERO);
    for k in (0..band.rim.len).step_by(4) {
        let l: Lane<N> = lane(band, k, m, &profile, sharp);
        let w = four(&band.rim.weight, k);
        let r = l.residual * w;
        for (s, c) in right.iter_mut().zip(l.columns) {
            *s += c * r;
        }
        let g = l.gain2 * w;
        weights += g;
        weights2 += g * g;
        squares += g * l.residual * l.residual;
        put(&mut band.rim.residual, k, l.residual);
    }
    e.right = SVector::from_fn(|i, _| f64::from(right[i].reduce_add()));
    e.weighted_squares = f64::from(squares.reduce_add());
    e.weights = f64::from(weights.reduce_add());
    e.weights2 = f64::from(weights2.reduce_add());
    e.flat = (0.0, 0.0);
    for side in 0..2 {
        let level = m.level[side];
        let mut s = [f32x4::ZERO; 5];
        let p = &mut band.flat[side];
        for k in (0..p.len).step_by(4) {
            let (x, y, w) = (four(&p.x, k), four(&p.y, k), four(&p.weight, k));
            let light = x * m.slope[0] + y * m.slope[1] + 1.0;
            let left = four(&p.grey, k) - light * level;
            let r = left * w;
            for (s, t) in s.iter_mut().zip([light * r, x * r * level, y * r * level, r * r, w]) {
                *s += t;
            }
            put(&mut p.residual, k, left);
        }
        let s = s.map(|v| f64::from(v.reduce_add()));
        e.right[2 + side] += s[0];
        e.right[4] += s[1];
        e.right[5] += s[2];
        e.flat = (e.flat.0 + s[4], e.flat.1 + s[3]);
    }
}
