//! The slope profile across an edge: the derivative of the smoothed image along the gradient, sampled every half
//! pixel.

use crate::offline::edges::grey_image::GreyImage;
use graspd_rt::geom::Pixel;

/// Standard deviation of the smoothing, pixels: smaller than in detection, to keep neighbouring edges apart.
pub(in crate::offline) const SCALE_PX: f64 = 0.7;
/// Radius of the sampled kernel, pixels.
const RADIUS_PX: usize = 4;
/// The slope is sampled from minus to plus this many half pixels.
pub(in crate::offline) const REACH: i32 = 10;
/// Number of samples of a slope profile.
pub(in crate::offline) const SLOPES: usize = 2 * REACH as usize + 1;
/// Offsets along the edge whose slopes are averaged, pixels.
const ALONG_PX: [f64; 3] = [-1.0, 0.0, 1.0];
/// Variance along the edge that the averaging adds, pixels squared.
const ALONG_VARIANCE_PX2: f64 = 2.0 / 3.0;
/// Standard deviation of the averaged slope for a pixel noise of one grey level (by simulation of white noise).
pub(in crate::offline) const SLOPE_NOISE: f64 = 0.27;
/// Factor by which the correlation of neighbouring samples increases the variance of a fitted position (by the same
/// simulation, see the test of `separate`).
pub(in crate::offline) const CORRELATED: f64 = 4.2;

/// Slopes across an edge at every half pixel, [`REACH`] of them to either side, averaged along the edge. `None` at the
/// border of the image.
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

/// Standard deviation along the edge of the area that a slope is averaged over, pixels. It displaces the edge of a
/// curve towards the inside, like the width of an edge.
pub(in crate::offline) fn tangential_width(blur: f64) -> f64 {
    (SCALE_PX * SCALE_PX + ALONG_VARIANCE_PX2 + blur * blur).sqrt()
}

/// Slope of the smoothed image along a direction at a sub-pixel position.
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

/// Gaussian and derivative as correlation weights that reproduce a constant and a ramp exactly, at `first, first + 1,
/// ...` from the position.
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
