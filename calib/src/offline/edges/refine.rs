//! Refinement of an edge point to the zero of the second derivative along its gradient.

use crate::offline::edges::gradient::{RADIUS, SCALE};
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::map::Edge;
use graspd_rt::geom::Pixel;

/// An edge point refined to the zero of the second derivative.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refined {
    /// Sub-pixel position.
    pub at: Pixel,
    /// Unit gradient, towards the brighter side.
    pub towards_bright: Pixel,
    /// Standard deviation across the edge due to the pixel noise, pixels.
    pub sigma: f64,
    /// Standard deviation of the edge's profile (lens, pixel and detector together), pixels.
    pub width: f64,
}

impl Refined {
    /// The point with the bias of the smoothing towards the inside of a curve removed. `radius` is the radius of
    /// curvature in pixels, `outward` the unit normal away from the centre of curvature.
    pub fn straightened(mut self, outward: Pixel, radius: f64) -> Self {
        if radius > 2.0 {
            self.at += outward * (0.5 * self.width * self.width / radius).min(0.3);
        }
        self
    }
}

/// Moves an edge point to the zero of the second derivative along its gradient (Newton's method). `noise` is in grey
/// levels.
///
/// `None` when there is no edge within 1.5 px or the image ends.
pub fn refine(image: &GreyImage, start: &Edge, noise: f64) -> Option<Refined> {
    let mut p = start.at;
    for _ in 0..8 {
        let d = Derivatives::at(image, p)?;
        let g = Pixel::new(d.x, d.y);
        let m = g.norm();
        // The direction may turn as the position improves, but not change to another edge.
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

/// Derivatives of the smoothed image at a sub-pixel position.
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
        // Rows first: the four derivatives along x of every row, then those along y.
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

/// Gaussian and its first three derivatives, as correlation weights at `first, first + 1, ...` from the sub-pixel
/// position.
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
    use crate::offline::edges::map::EdgeMap;
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    /// A sharp disc, blurred by a Gaussian lens of 0.6 px and integrated over pixels, by dense sampling.
    fn disc(side: usize, c: Pixel, radius: f64, noise: f64, seed: u64) -> GreyImage {
        const SUB: usize = 6;
        let n = side * SUB;
        let position = |k: usize| (k as f64 + 0.5) / SUB as f64 - 0.5;
        let sharp: Vec<f32> = (0..n * n)
            .map(|i| {
                let d = radius - (position(i % n) - c.x).hypot(position(i / n) - c.y);
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
