//! Sub-pixel edge points: Gaussian gradient, non-maximum suppression, and an exact step to the edge for the points that are kept.
//!
//! Detection is Canny's with Devernay's parabola (INRIA RR-2724), good to about 0.1 px and used only to find contours. What goes
//! into the geometry is [`refine`]: the zero of the second derivative along the edge's normal, with the Gaussian derivatives evaluated *at* the
//! sub-pixel place instead of interpolated between pixels, so that no pattern of the pixel grid is left in it (below 0.01 px, tested). Its standard
//! deviation follows from the pixel noise and the third derivative; its bias on a curved edge, `w^2 / (2 R)` towards the inside for an
//! edge of width `w` (Mendonca), is removed by [`Refined::straightened`] once the curvature is known.

pub mod arcs;
mod gradient;
pub mod grey_image;
pub mod lens;
pub mod sharpen;

use crate::offline::edges::gradient::{GradientRow, GradientRows};
use crate::offline::edges::grey_image::GreyImage;
use graspd_rt::geom::Pixel;

/// Standard deviation of the Gaussian whose derivatives are taken, pixels.
pub const SCALE: f64 = 1.0;
/// Radius of the sampled kernel, pixels.
const RADIUS: usize = 4;

/// A detected edge point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// Sub-pixel place.
    pub at: Pixel,
    /// Unit gradient, towards the brighter side.
    pub towards_bright: Pixel,
    /// Gradient magnitude, grey levels per pixel.
    pub strength: f64,
}

/// Pixels of a row that share an entry of the index.
const BLOCK: usize = 16;

/// Every edge point of an image, and which ones lie near a place.
#[derive(Clone, Debug)]
pub struct EdgeMap {
    width: usize,
    height: usize,
    edges: Vec<Edge>,
    /// Column of the pixel that each edge point was found in.
    columns: Vec<u32>,
    /// Index of the first edge point in or after each block, block by block in raster order, and the number of points at the end.
    /// An image has few edge points: a word for each pixel would be as large as all the rest, and cost its page faults.
    starts: Vec<u32>,
    noise: f64,
}

impl EdgeMap {
    /// Detects the edges of a whole image.
    pub fn detect(image: &GreyImage) -> Self {
        let noise = image.noise();
        // The gradient's own noise is noise / (sqrt(8 pi) SCALE^2); five times that is left to chance once in a million pixels.
        let threshold = (5.0 * noise / (8.0 * std::f64::consts::PI).sqrt() / (SCALE * SCALE)).max(1.2) as f32;
        let (w, h) = (image.width(), image.height());
        let mut map = Self { width: w, height: h, edges: Vec::new(), columns: Vec::new(), starts: Vec::new(), noise };
        if let Some(mut rows) = GradientRows::new(image) {
            while let Some((y, three)) = rows.step() {
                map.scan(y, three, threshold);
            }
        }
        map.index_to(h * w.div_ceil(BLOCK));
        map
    }

    /// Takes the edge points of a row from its gradient and its neighbours'.
    fn scan(&mut self, y: usize, [above, row, below]: [&GradientRow; 3], threshold: f32) {
        // A little lower than the threshold, so that only candidates need their root.
        let candidate = threshold * threshold * 0.999;
        for (i, square) in row.square.iter().enumerate() {
            if *square < candidate {
                continue;
            }
            let m = square.sqrt();
            if m < threshold {
                continue;
            }
            let at = |r: &[f32], k: usize| r.get(k).copied().unwrap_or(0.0);
            let (dx, dy) = (at(&row.x, i), at(&row.y, i));
            let horizontal = dx.abs() >= dy.abs();
            let (a, b) = if horizontal {
                (i.checked_sub(1).map_or(0.0, |k| at(&row.square, k)), at(&row.square, i + 1))
            } else {
                (at(&above.square, i), at(&below.square, i))
            };
            let (a, b) = (a.sqrt(), b.sqrt());
            if !(m > a && m >= b) {
                continue;
            }
            let (a, b, m) = (f64::from(a), f64::from(b), f64::from(m));
            let s = (0.5 * (a - b) / (a - 2.0 * m + b)).clamp(-0.5, 0.5);
            let (u, v) = if horizontal { (s, 0.0) } else { (0.0, s) };
            let n = Pixel::new(f64::from(dx), f64::from(dy)).normalize();
            let x = i + RADIUS;
            self.index_to(y * self.width.div_ceil(BLOCK) + x / BLOCK);
            self.edges.push(Edge { at: Pixel::new(x as f64 + u, y as f64 + v), towards_bright: n, strength: m });
            self.columns.push(x as u32);
        }
    }

    /// Ends every block up to and with the one before this, so that the next edge point lies in it.
    fn index_to(&mut self, block: usize) {
        let n = self.edges.len() as u32;
        self.starts.resize(self.starts.len().max(block + 1), n);
    }

    /// The edge points in raster order.
    pub fn edges(&self) -> &[Edge] {
        &self.edges
    }

    /// Width of the image, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height of the image, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Standard deviation of the pixel noise, grey levels.
    pub fn noise(&self) -> f64 {
        self.noise
    }

    /// Edge points found in the pixels at most `radius` away, with their index, in raster order.
    pub fn near(&self, p: Pixel, radius: i32) -> impl Iterator<Item = (usize, &Edge)> {
        let ((x0, x1), ys) = self.rows_within(p, p, radius);
        ys.flat_map(move |y| {
            let (from, columns, edges) = self.blocks(y, x0, x1);
            let inside = columns.iter().zip(edges).enumerate().filter(move |(_, (x, _))| x0 <= **x && **x <= x1);
            inside.map(move |(k, (_, e))| (from + k, e))
        })
    }

    /// The same for all pixels from one corner of a rectangle to the other, given to a function by index, column and row: for where most time is spent.
    pub(in crate::offline) fn within(
        &self,
        first: Pixel,
        last: Pixel,
        radius: i32,
        mut take: impl FnMut(usize, usize, usize),
    ) {
        let ((x0, x1), ys) = self.rows_within(first, last, radius);
        for y in ys {
            let (from, columns, _) = self.blocks(y, x0, x1);
            for (k, x) in columns.iter().enumerate() {
                if x0 <= *x && *x <= x1 {
                    take(from + k, *x as usize, y);
                }
            }
        }
    }

    /// Columns from and to, and rows, of the pixels at most `radius` from a rectangle; no rows where the image does not reach.
    fn rows_within(&self, first: Pixel, last: Pixel, radius: i32) -> ((u32, u32), std::ops::Range<usize>) {
        let span = |first: f64, last: f64, size: usize| {
            let end = i32::try_from(size).unwrap_or(i32::MAX) - 1;
            let (from, to) = (first.round() as i32, last.round() as i32);
            (from.saturating_sub(radius).max(0), to.saturating_add(radius).min(end))
        };
        let ((x0, x1), (y0, y1)) = (span(first.x, last.x, self.width), span(first.y, last.y, self.height));
        if x0 > x1 || y0 > y1 {
            return ((0, 0), 0..0);
        }
        ((x0 as u32, x1 as u32), y0 as usize..y1 as usize + 1)
    }

    /// The edge points of a row's blocks from one column to another: the first's index, their columns, and they.
    fn blocks(&self, y: usize, x0: u32, x1: u32) -> (usize, &[u32], &[Edge]) {
        let row = y * self.width.div_ceil(BLOCK);
        let (from, to) =
            match (self.starts.get(row + x0 as usize / BLOCK), self.starts.get(row + x1 as usize / BLOCK + 1)) {
                (Some(a), Some(b)) => (*a as usize, *b as usize),
                _ => (0, 0),
            };
        (from, self.columns.get(from..to).unwrap_or(&[]), self.edges.get(from..to).unwrap_or(&[]))
    }
}

/// An edge point brought to the zero of the second derivative.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refined {
    /// Sub-pixel place.
    pub at: Pixel,
    /// Unit gradient, towards the brighter side.
    pub towards_bright: Pixel,
    /// Standard deviation across the edge from the pixel noise, pixels.
    pub sigma: f64,
    /// Standard deviation of the edge's profile (lens, pixel and detector together), pixels.
    pub width: f64,
}

impl Refined {
    /// The same point with the smoothing's pull towards the inside of a curve of radius `radius` (pixels) removed;
    /// `outward` is the unit normal away from the centre of curvature.
    pub fn straightened(mut self, outward: Pixel, radius: f64) -> Self {
        if radius > 2.0 {
            self.at += outward * (0.5 * self.width * self.width / radius).min(0.3);
        }
        self
    }
}

/// Steps from an edge point to the place where the second derivative along its gradient vanishes.
///
/// `None` when there is no edge within a pixel and a half, or the image ends. `noise` is in grey levels.
pub fn refine(image: &GreyImage, start: &Edge, noise: f64) -> Option<Refined> {
    let mut p = start.at;
    for _ in 0..8 {
        let d = Derivatives::at(image, p)?;
        let g = Pixel::new(d.x, d.y);
        let m = g.norm();
        // The direction may turn with the better place, not swing to another edge.
        if !(m > 1e-3) || g.dot(&start.towards_bright) < 0.8 * m {
            return None;
        }
        let n = g / m;
        let second = d.xx * n.x * n.x + 2.0 * d.xy * n.x * n.y + d.yy * n.y * n.y;
        let third =
            d.xxx * n.x.powi(3) + 3.0 * d.xxy * n.x * n.x * n.y + 3.0 * d.xyy * n.x * n.y * n.y + d.yyy * n.y.powi(3);
        if !(third < -1e-6) {
            return None;
        }
        let step = (-second / third).clamp(-0.7, 0.7);
        p += n * step;
        if (p - start.at).norm() > 1.5 {
            return None;
        }
        if step.abs() < 1e-4 {
            // The norm of the second-derivative kernel of a Gaussian is sqrt(3 / (16 pi)) / s^3.
            let kernel = (3.0 / (16.0 * std::f64::consts::PI)).sqrt() / SCALE.powi(3);
            let width = (m / -third).sqrt().clamp(SCALE, 4.0);
            return Some(Refined {
                at: p,
                towards_bright: n,
                sigma: (noise * kernel / -third).clamp(0.01, 2.0),
                width,
            });
        }
    }
    None
}

/// Derivatives of the smoothed image at a sub-pixel place.
struct Derivatives {
    x: f64,
    y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
    xxx: f64,
    xxy: f64,
    xyy: f64,
    yyy: f64,
}

impl Derivatives {
    fn at(image: &GreyImage, p: Pixel) -> Option<Self> {
        const N: usize = 2 * RADIUS + 3;
        let r = (RADIUS + 1) as f64;
        if !image.contains(p, r + 1.0) {
            return None;
        }
        let (x0, y0) = ((p.x.round() - r) as usize, (p.y.round() - r) as usize);
        let (ku, kv) = (kernels(x0 as f64 - p.x), kernels(y0 as f64 - p.y));
        // Rows first: the four derivatives along x of every row, then along y.
        let mut d = [[0.0f64; 4]; 4];
        for (j, wv) in kv.iter().enumerate() {
            let row = image.row(y0 + j).get(x0..x0 + N)?;
            let mut a = [0.0f64; 4];
            for (v, wu) in row.iter().zip(&ku) {
                let v = f64::from(*v);
                a.iter_mut().zip(wu).for_each(|(a, w)| *a += w * v);
            }
            for (dv, w) in d.iter_mut().zip(wv) {
                dv.iter_mut().zip(&a).for_each(|(d, a)| *d += w * a);
            }
        }
        let [[_, x, xx, xxx], [y, xy, xxy, _], [yy, xyy, _, _], [yyy, _, _, _]] = d;
        Some(Self { x, y, xx, xy, yy, xxx, xxy, xyy, yyy })
    }
}

/// Gaussian and its first three derivatives (as correlation weights) at `first, first + 1, ...` from the sub-pixel place.
fn kernels(first: f64) -> [[f64; 4]; 2 * RADIUS + 3] {
    let s2 = SCALE * SCALE;
    let norm = 1.0 / (2.0 * std::f64::consts::PI * s2).sqrt();
    std::array::from_fn(|i| {
        let t = first + i as f64;
        let g = norm * (-0.5 * t * t / s2).exp();
        let u = t / s2;
        [g, u * g, (u * u - 1.0 / s2) * g, (u * u * u - 3.0 * u / s2) * g]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    /// A sharp disc, blurred in the plane by a Gaussian lens of 0.6 px and integrated over pixels, by dense sampling.
    fn disc(side: usize, c: Pixel, radius: f64, noise: f64, seed: u64) -> GreyImage {
        const SUB: usize = 6;
        let n = side * SUB;
        let place = |k: usize| (k as f64 + 0.5) / SUB as f64 - 0.5;
        let sharp: Vec<f32> = (0..n * n)
            .map(|i| {
                let d = radius - (place(i % n) - c.x).hypot(place(i / n) - c.y);
                (d * SUB as f64 + 0.5).clamp(0.0, 1.0) as f32
            })
            .collect();
        // Lens and pixel in one separable kernel.
        let reach = 4 * SUB as i32;
        let kernel: Vec<f32> = (-reach..=reach)
            .map(|k| {
                let f = |t: f64| (-0.5 * (t / 0.6).powi(2)).exp();
                (0..SUB).map(|q| f((f64::from(k) + q as f64 + 1.0) / SUB as f64 - 0.5)).sum::<f64>() as f32
            })
            .collect();
        let total: f32 = kernel.iter().sum();
        let blur = |src: &[f32], w: usize, out_w: usize| -> Vec<f32> {
            // Samples along rows at pixel centres only, transposed for the second pass.
            let rows = src.len() / w;
            let mut out = vec![0.0; out_w * rows];
            for y in 0..rows {
                for x in 0..out_w {
                    let middle = (x * SUB) as i32 + SUB as i32 / 2;
                    let mut sum = 0.0;
                    for (k, c) in (-reach..=reach).zip(&kernel) {
                        let q = (middle + k).clamp(0, w as i32 - 1) as usize;
                        sum += c * src[y * w + q];
                    }
                    out[x * rows + y] = sum / total;
                }
            }
            out
        };
        let once = blur(&sharp, n, side);
        let twice = blur(&once, n, side);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let normal = Normal::new(0.0, noise.max(1e-9)).unwrap();
        let grey = |v: &f32| (60.0 + 130.0 * f64::from(*v) + normal.sample(&mut rng)).round().clamp(0.0, 255.0) as u8;
        GreyImage::new(side, side, twice.iter().map(grey).collect()).unwrap()
    }

    fn errors(image: &GreyImage, c: Pixel, radius: f64) -> Vec<(f64, f64)> {
        let map = EdgeMap::detect(image);
        map.edges()
            .iter()
            .filter(|e| ((e.at - c).norm() - radius).abs() < 2.0)
            .filter_map(|e| refine(image, e, map.noise()))
            .map(|r| {
                let q = r.straightened((r.at - c).normalize(), radius);
                ((q.at - c).norm() - radius, q.sigma)
            })
            .collect()
    }

    #[test]
    fn bias_is_below_a_hundredth_of_a_pixel_on_every_curvature() {
        for (k, radius) in [6.0, 12.0, 25.0, 60.0].into_iter().enumerate() {
            let c = Pixel::new(80.3 + 0.17 * k as f64, 79.6);
            let e = errors(&disc(160, c, radius, 0.0, 1), c, radius);
            assert!(e.len() as f64 > 5.0 * radius, "{}", e.len());
            let mean = e.iter().map(|x| x.0).sum::<f64>() / e.len() as f64;
            let worst = e.iter().map(|x| (x.0 - mean).abs()).fold(0.0, f64::max);
            assert!(mean.abs() < 0.01, "radius {radius}: bias {mean}");
            assert!(worst < 0.03, "radius {radius}: grid pattern {worst}");
        }
    }

    #[test]
    fn the_stated_sigma_is_the_scatter() {
        let (mut sum, mut n, mut stated) = (0.0, 0, 0.0);
        for seed in 0..4 {
            let c = Pixel::new(80.3, 79.6);
            for (d, s) in errors(&disc(160, c, 55.0, 4.0, seed), c, 55.0) {
                sum += d * d;
                stated += s * s;
                n += 1;
            }
        }
        let ratio = (sum / f64::from(n)).sqrt() / (stated / f64::from(n)).sqrt();
        assert!((0.85..1.2).contains(&ratio), "{ratio}");
    }
}
