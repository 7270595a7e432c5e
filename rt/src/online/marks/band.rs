//! The pixels of a mark that enter the fit: rim pixels around its predicted rim, which determine the position, and flat
//! pixels on either side, which determine the levels.
//!
//! They are gathered row by row into contiguous arrays, ordered by sector of the rim. The fit processes four at a time,
//! and a sector with an occluded rim can be excluded. The number of pixels is bounded for every size of mark: of a
//! longer rim only every second or third row is read.

use super::Outline;
use crate::image::ImageView;
use crate::math;
use nalgebra::Vector2;
use wide::{f32x4, f32x8, i32x4};

/// Maximum number of rim pixels.
pub(crate) const MAX_RIM_PIXELS: usize = 896;
/// Maximum number of flat pixels on either side.
const MAX_FLAT_PIXELS: usize = 512;
/// Number of sectors of the rim: six bands of rows, left and right.
pub(crate) const SECTORS: usize = 12;
const BLOCKS: usize = SECTORS / 2;
/// Maximum number of rows that are read.
const MAX_ROWS: usize = 112;
/// Minimum number of rows for which flat pixels are read in every second row only: the levels need no more.
const MIN_SPARSE_ROWS: usize = 18;
/// Width of each flat band, px.
const FLAT_WIDTH_PX: f64 = 1.8;
/// Maximum width that is read outside the rim, as a fraction of the half width: a mark needs this margin around it.
const MAX_MARGIN_FRACTION: f64 = 0.5;
/// Minimum width that is read outside the rim, px: small marks.
const MIN_MARGIN_PX: f64 = 1.2;

/// Column offsets of eight consecutive pixels.
const EIGHT: f32x8 = f32x8::new([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);

/// Pixels of one kind, as arrays; positions are relative to the mark's predicted centre.
#[derive(Clone, Debug)]
pub(crate) struct Pixels<const N: usize> {
    pub(crate) x: [f32; N],
    pub(crate) y: [f32; N],
    pub(crate) grey: [f32; N],
    /// 1 for a pixel in use, 0 for an excluded one and for the padding beyond `len`.
    pub(crate) weight: [f32; N],
    /// Residual of the last fit, grey values.
    pub(crate) residual: [f32; N],
    pub(crate) len: usize,
    /// Index of the first pixel of each sector, and the end.
    pub(crate) sector: [usize; SECTORS + 1],
}

impl<const N: usize> Pixels<N> {
    const fn new() -> Self {
        let zero = [0.0; N];
        Self { x: zero, y: zero, grey: zero, weight: zero, residual: zero, len: 0, sector: [0; SECTORS + 1] }
    }

    /// Appends `count` pixels of a row, starting at column `from`. The first one is at (`x`, `y`). Pixels beyond the
    /// capacity are dropped.
    ///
    /// Pixels are written in groups of eight; the next call overwrites the excess of the last group.
    #[inline(always)]
    fn push(&mut self, row: &[u8], from: usize, count: usize, x: f32, y: f32) {
        let (mut from, mut count, mut x) = (from, count, x);
        while count > 0 {
            let k = self.len;
            let (Some(px), Some(py), Some(g)) =
                (self.x.get_mut(k..k + 8), self.y.get_mut(k..k + 8), self.grey.get_mut(k..k + 8))
            else {
                return;
            };
            px.copy_from_slice(&(EIGHT + f32x8::splat(x)).to_array());
            py.fill(y);
            if let Some(v) = row.get(from..from + 8) {
                for (g, v) in g.iter_mut().zip(v) {
                    *g = f32::from(*v);
                }
            } else {
                for (g, v) in g.iter_mut().zip(row.get(from..).unwrap_or(&[])) {
                    *g = f32::from(*v);
                }
            }
            let n = count.min(8);
            self.len += n;
            (from, count, x) = (from + n, count - n, x + 8.0);
        }
    }

    /// Sets all weights to 1 and pads the last group of four with copies of weight 0.
    fn close(&mut self) {
        self.weight[..self.len].fill(1.0);
        for k in self.len..self.len.next_multiple_of(4).min(N) {
            (self.x[k], self.y[k], self.grey[k]) = (self.x[k - 1], self.y[k - 1], self.grey[k - 1]);
            self.weight[k] = 0.0;
        }
    }

    /// Includes (1) or excludes (0) a sector.
    pub(crate) fn weigh_sector(&mut self, k: usize, weight: f32) {
        let (from, to) = (self.sector[k], self.sector[k + 1]);
        self.weight[from..to].fill(weight);
    }

    /// Number of pixels of a sector, and the sum of their squared residuals.
    pub(crate) fn squares(&self, k: usize) -> (f32, f32) {
        let (from, to) = (self.sector[k], self.sector[k + 1]);
        ((to - from) as f32, self.residual[from..to].iter().map(|r| r * r).sum())
    }
}

/// Flat pixels of one side.
pub(crate) type Flat = Pixels<MAX_FLAT_PIXELS>;

/// The pixels of one mark, and their geometry relative to its predicted rim.
#[derive(Clone, Debug)]
pub(crate) struct Band {
    pub(crate) rim: Pixels<MAX_RIM_PIXELS>,
    /// Flat pixels outside and inside.
    pub(crate) flat: [Flat; 2],
    /// Distance from the rim, positive inside, px.
    pub(crate) depth: [f32; MAX_RIM_PIXELS],
    /// Outward unit normal of the rim.
    pub(crate) normal: [[f32; MAX_RIM_PIXELS]; 2],
    /// Curvature of the rim, 1/px.
    pub(crate) curvature: [f32; MAX_RIM_PIXELS],
    /// Number of rim pixels without clipping at the image border.
    pub(crate) unclipped: usize,
    /// Sum of the prefetched pixels; it keeps the compiler from removing the loads.
    touched: u8,
}

/// Column boundaries in one row: start of outer flat, rim, inner flat and core; middle; then the mirrored ends, core
/// first.
type Row = [i32; 9];

impl Band {
    pub(crate) const fn new() -> Self {
        Self {
            rim: Pixels::new(),
            flat: [Pixels::new(), Pixels::new()],
            depth: [0.0; MAX_RIM_PIXELS],
            normal: [[0.0; MAX_RIM_PIXELS]; 2],
            curvature: [0.0; MAX_RIM_PIXELS],
            unclipped: 0,
            touched: 0,
        }
    }

    /// Reads the pixels around `outline` shifted by `shift`: rim pixels up to `reach` px on either side, and flat
    /// pixels beyond.
    pub(crate) fn gather(&mut self, image: &ImageView<'_>, outline: &Outline, shift: Vector2<f64>, reach: f64) {
        let limits = limits(outline, reach);
        let centre = outline.centre + shift;
        let base = Vector2::new(math::floor(centre.x), math::floor(centre.y));
        let offset = centre - base;
        let rows = Rows::new(outline, &limits, offset);
        self.rim.len = 0;
        self.flat[0].len = 0;
        self.flat[1].len = 0;
        self.unclipped = 0;
        let count = rows.count;
        let mut bounds = [[0_i32; 9]; MAX_ROWS];
        for (i, b) in bounds.iter_mut().take(count).enumerate() {
            let row = rows.first + i as i32 * rows.step;
            *b = rows.bounds(row);
            // Prefetch all rows first: serialised cache misses would dominate the run time.
            let y = base.y as i64 + i64::from(row);
            let pixels = if y >= 0 { image.row(y as usize) } else { &[] };
            for end in [b[0], b[8]] {
                let v = pixels.get((base.x as i64 + i64::from(end)).max(0) as usize);
                self.touched = self.touched.wrapping_add(v.copied().unwrap_or(0));
            }
        }
        for block in 0..BLOCKS {
            let (from, to) = (block * count / BLOCKS, (block + 1) * count / BLOCKS);
            for side in 0..2 {
                self.mark_sector(2 * block + side);
                for (i, b) in bounds.iter().enumerate().take(to).skip(from) {
                    let row = rows.first + i as i32 * rows.step;
                    let y = base.y as i64 + i64::from(row);
                    let pixels = if y >= 0 { image.row(y as usize) } else { &[] };
                    self.take(
                        pixels,
                        base.x as i64,
                        b,
                        (side, count < MIN_SPARSE_ROWS || i % 2 == 0),
                        [offset.x as f32, f64::from(row) as f32 - offset.y as f32],
                    );
                }
            }
        }
        self.mark_sector(SECTORS);
        self.rim.close();
        self.flat[0].close();
        self.flat[1].close();
        self.compute_distances(outline);
    }

    fn mark_sector(&mut self, k: usize) {
        self.rim.sector[k] = self.rim.len;
        for f in &mut self.flat {
            f.sector[k] = f.len;
        }
    }

    /// Appends one side of a row; flat pixels only if `flat` is set. `at` is (column of the centre relative to `base`,
    /// row relative to the centre).
    #[inline]
    fn take(&mut self, pixels: &[u8], base: i64, b: &Row, (side, flat): (usize, bool), at: [f32; 2]) {
        let [a0, a1, a2, a3, middle, b3, b2, b1, b0] = *b;
        let pieces =
            if side == 0 { [(a0, a1), (a1, a2), (a2, a3.min(middle))] } else { [(b1, b0), (b2, b1), (b3, b2)] };
        let width = pixels.len() as i64;
        for (kind, (from, to)) in pieces.into_iter().enumerate() {
            if to <= from || !(flat || kind == 1) {
                continue;
            }
            let (lo, hi) = ((base + i64::from(from)).clamp(0, width), (base + i64::from(to)).clamp(0, width));
            let (first, count) = (lo as usize, (hi - lo) as usize);
            let x = (lo - base) as f32 - at[0];
            match kind {
                0 => self.flat[0].push(pixels, first, count, x, at[1]),
                1 => {
                    self.rim.push(pixels, first, count, x, at[1]);
                    self.unclipped += (to - from) as usize;
                }
                _ => self.flat[1].push(pixels, first, count, x, at[1]),
            }
        }
    }

    /// Distance, normal and curvature of the predicted rim at each rim pixel.
    ///
    /// With `u` the pixel in disc coordinates and `J` the derivative of the map, the gradient of |u| is `Jᵀu/|u|`. The
    /// distance to the rim, |u| = 1, along this gradient is computed to second order. It is exact for a circle.
    fn compute_distances(&mut self, outline: &Outline) {
        let l = outline.disc_from_pixel.linear.map(|v| f32x4::splat(v as f32));
        let q = outline.disc_from_pixel.square.map(|v| f32x4::splat(v as f32));
        let (l00, l01, l10, l11) = (l[(0, 0)], l[(0, 1)], l[(1, 0)], l[(1, 1)]);
        let ([q0, q1, q2], [p0, p1, p2]) = ([q[(0, 0)], q[(0, 1)], q[(0, 2)]], [q[(1, 0)], q[(1, 1)], q[(1, 2)]]);
        let one = f32x4::ONE;
        for k in (0..self.rim.len).step_by(4) {
            let (x, y) = (four(&self.rim.x, k), four(&self.rim.y, k));
            // The map and its derivative.
            let (qx, qy, px, py) = (q0 * x + q1 * y, q2 * y, p0 * x + p1 * y, p2 * y);
            let (u, v) = (l00 * x + l01 * y + qx * x + qy * y, l10 * x + l11 * y + px * x + py * y);
            let (jux, juy) = (l00 + qx + q0 * x, l01 + q1 * x + qy + qy);
            let (jvx, jvy) = (l10 + px + p0 * x, l11 + p1 * x + py + py);
            let rho2 = (u * u + v * v).fast_max(f32x4::splat(1e-4));
            let rho = rho2.sqrt();
            let inv = one / rho;
            let (u, v) = (u * inv, v * inv);
            let (gx, gy) = (jux * u + jvx * v, juy * u + jvy * v);
            let g2 = (gx * gx + gy * gy).fast_max(f32x4::splat(1e-8));
            let g = one / g2.sqrt();
            let (nx, ny) = (gx * g, gy * g);
            let d = (one - rho) * g;
            // Rotation of the radial direction per unit length along the normal, and along the tangent.
            let (wn, wt) = (
                (jvx * nx + jvy * ny) * u - (jux * nx + juy * ny) * v,
                (jvy * nx - jvx * ny) * u - (juy * nx - jux * ny) * v,
            );
            let c = inv * g;
            let d = d - wn * wn * c * d * d * 0.5;
            put(&mut self.depth, k, d);
            put(&mut self.normal[0], k, nx);
            put(&mut self.normal[1], k, ny);
            put(&mut self.curvature, k, wt * wt * c);
        }
    }
}

/// Four values starting at `k`.
#[inline(always)]
pub(crate) fn four<const N: usize>(a: &[f32; N], k: usize) -> f32x4 {
    match a.get(k..k + 4) {
        Some([a, b, c, d]) => f32x4::new([*a, *b, *c, *d]),
        _ => f32x4::ZERO,
    }
}

#[inline(always)]
pub(crate) fn put<const N: usize>(a: &mut [f32; N], k: usize, v: f32x4) {
    if let Some(a) = a.get_mut(k..k + 4) {
        a.copy_from_slice(&v.to_array());
    }
}

/// Boundary radii in disc coordinates: outer flat, rim outside, rim inside, inner flat.
fn limits(outline: &Outline, reach: f64) -> [f64; 4] {
    let minor = outline.minor.max(0.5);
    // Deviation of the rim from the first-order ellipse.
    let bend = math::sqrt(outline.pixel_from_disc.square.norm_squared());
    let reach = reach + bend;
    let margin = (MAX_MARGIN_FRACTION * minor).max(MIN_MARGIN_PX);
    let outside = reach.min(margin);
    [
        1.0 + (outside + FLAT_WIDTH_PX).min(margin) / minor,
        1.0 + outside / minor,
        (1.0 - reach / minor).max(0.0),
        (1.0 - (reach + FLAT_WIDTH_PX) / minor).max(0.0),
    ]
}

/// The rows that cross a mark, and their intersections with the four ellipses.
struct Rows {
    first: i32,
    step: i32,
    count: usize,
    /// `f² / α` of the four ellipses.
    radii: f32x4,
    /// `det² / α²` and `-β / α` of the quadratic form.
    squash: f32,
    lean: f32,
    offset: [f32; 2],
}

impl Rows {
    fn new(outline: &Outline, limits: &[f64; 4], offset: Vector2<f64>) -> Self {
        // |A δ|² = α x² + 2 β x y + ...
        let a = &outline.disc_from_pixel.linear;
        let (c0, c1) = (a.column(0), a.column(1));
        let (alpha, beta) = (c0.norm_squared().max(1e-9), c0.dot(&c1));
        let det = a.determinant();
        let rim = core::f64::consts::PI * outline.major * outline.minor * (math::sq(limits[1]) - math::sq(limits[2]));
        let half = limits[0] * math::sqrt(alpha) / math::fabs(det).max(1e-9);
        let half = half.min(4.0 * MAX_ROWS as f64);
        let first = math::ceil(offset.y - half);
        let span = (math::floor(offset.y + half) - first + 1.0).max(0.0);
        let step = math::ceil(1.05 * rim / MAX_RIM_PIXELS as f64).max(math::ceil(span / MAX_ROWS as f64)).max(1.0);
        Self {
            first: first as i32,
            step: step as i32,
            count: (math::ceil(span / step) as usize).min(MAX_ROWS),
            radii: f32x4::new(limits.map(|f| (f * f / alpha) as f32)),
            squash: (det * det / (alpha * alpha)) as f32,
            lean: (-beta / alpha) as f32,
            offset: [offset.x as f32, offset.y as f32],
        }
    }

    fn bounds(&self, row: i32) -> Row {
        /// Offset that makes every column positive, so that truncation rounds down.
        const UP: f32 = 1024.0;
        let y = row as f32 - self.offset[1];
        let middle = self.offset[0] + self.lean * y;
        let half = (self.radii - self.squash * y * y).fast_max(f32x4::ZERO).sqrt();
        let m = (middle + UP + 1.0) as i32 - UP as i32;
        let (middle, up, limit) = (f32x4::splat(middle + UP + 1.0), i32x4::splat(UP as i32), i32x4::splat(m));
        let [a0, a1, a2, a3] = ((middle - half).fast_trunc_int() - up).min(limit).to_array();
        let [b0, b1, b2, b3] = ((middle + half).fast_trunc_int() - up).max(limit).to_array();
        [a0, a1, a2, a3, m, b3, b2, b1, b0]
    }
}
