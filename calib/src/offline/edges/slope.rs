//! SLOPE

use crate::offline::edges::grey_image::GreyImage;
use graspd_rt::geom::Pixel;

/// Smoothing of the slope, pixels: less than in detection, to keep neighbours apart.
pub(in crate::offline) const SCALE_PX: f64 = 0.7;
/// Radius of the sampled kernel, pixels.
const RADIUS_PX: usize = 4;
/// The slope is sampled from minus to plus this many half pixels.
pub(in crate::offline) const REACH: i32 = 10;
/// Samples of a slope.
pub(in crate::offline) const SLOPES: usize = 2 * REACH as usize + 1;
/// Places along the edge whose slopes are averaged, pixels.
const ALONG_PX: [f64; 3] = [-1.0, 0.0, 1.0];
/// Variance along the edge that the averaging adds.
const ALONG_VARIANCE_PX2: f64 = 2.0 / 3.0;
/// Standard deviation of the averaged slope for a pixel noise of one grey level (by simulation of white noise).
pub(in crate::offline) const SLOPE_NOISE: f64 = 0.27;
/// What the correlation of neighbouring samples adds to the variance of a fitted place (by the same simulation, in the test below).
pub(in crate::offline) const CORRELATED: f64 = 4.2;

/// Slopes across an edge at every half pixel, [`REACH`] of them to each side, averaged along it; `None` at the image's border.
pub(in crate::offline) fn slopes(image: &GreyImage, at: Pixel, n: Pixel) -> Option<[f64; SLOPES]> {
    let along = Pixel::new(-n.y, n.x);
    let mut slope = [0.0; SLOPES];
    for (k, s) in slope.iter_mut().enumerate() {
        let t = 0.5 * (k as f64 - f64::from(REACH));
        for a in ALONG_PX {
            *s += slope_at(image, at + n * t + along * a, n)?;
        }
        *s /= ALONG_PX.len() as f64;
    }
    Some(slope)
}

/// Standard deviation along the edge of what a slope is averaged over, pixels: a curve is seen that much nearer to its inside.
pub(in crate::offline) fn tangential_width(blur: f64) -> f64 {
    (SCALE_PX * SCALE_PX + ALONG_VARIANCE_PX2 + blur * blur).sqrt()
}

/// Slope of the smoothed image along a direction at a sub-pixel place.
fn slope_at(image: &GreyImage, p: Pixel, n: Pixel) -> Option<f64> {
    const N: usize = 2 * RADIUS_PX + 1;
    let r = RADIUS_PX as f64;
    if !image.contains(p, r + 1.0) {
        return None;
    }
    let (x0, y0) = ((p.x.round() - r) as usize, (p.y.round() - r) as usize);
    let (ku, kv) = (kernel(x0 as f64 - p.x), kernel(y0 as f64 - p.y));
    let (mut dx, mut dy) = (0.0, 0.0);
    for (j, (gv, sv)) in kv.iter().enumerate() {
        let row = image.row(y0 + j).get(x0..x0 + N)?;
        let (mut smooth, mut gradient) = (0.0, 0.0);
        for (v, (g, s)) in row.iter().zip(&ku) {
            let v = f64::from(*v);
            smooth += g * v;
            gradient += s * v;
        }
        dx += gv * gradient;
        dy += sv * smooth;
    }
    Some(dx * n.x + dy * n.y)
}

/// Gaussian and derivative as correlation weights that keep a constant and a ramp exactly, at `first, first + 1, ...` from the place.
fn kernel(first: f64) -> [(f64, f64); 2 * RADIUS_PX + 1] {
    let s2 = SCALE_PX * SCALE_PX;
    let mut k: [(f64, f64); 2 * RADIUS_PX + 1] = std::array::from_fn(|i| {
        let t = first + i as f64;
        let g = (-0.5 * t * t / s2).exp();
        (g, t * g)
    });
    let sum: f64 = k.iter().map(|(g, _)| g).sum();
    let zero: f64 = k.iter().map(|(_, s)| s).sum::<f64>() / sum;
    for (g, s) in &mut k {
        *s -= zero * *g;
        *g /= sum;
    }
    let gain: f64 = k.iter().enumerate().map(|(i, (_, s))| (first + i as f64) * s).sum();
    k.iter_mut().for_each(|(_, s)| *s /= gain);
    k
}
