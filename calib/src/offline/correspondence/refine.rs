//! Sub-pixel refinement of a match: the patch of one image is shifted over the other until their grey values agree
//! best.

use crate::offline::edges::grey_image::GreyImage;
use graspd_rt::geom::Pixel;
use nalgebra::{Matrix4, Vector4};

/// Half the side of the patch, pixels.
const HALF: i32 = 6;
/// Largest error of the coarse match, pixels: one pixel of the halved image, with a margin.
const MAX_SHIFT_PX: f64 = 3.0;
/// Largest number of iterations.
const MAX_STEPS: usize = 12;
/// Step below which the iteration has converged, pixels.
const CONVERGED_PX: f64 = 0.01;
/// Largest unexplained fraction of the patch's variance: beyond it the views differ too much.
const MAX_UNEXPLAINED: f64 = 0.05;
/// Largest standard deviation of a match, pixels: beyond it the match adds nothing to the prior.
const MAX_SIGMA_PX: f64 = 0.5;

/// A refined match.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    /// Position in the second image, raw pixels.
    pub(super) at: Pixel,
    /// Its covariance, pixels squared.
    cov: nalgebra::Matrix2<f64>,
}

impl Found {
    /// Standard deviation along a unit direction.
    pub(super) fn sigma_along(&self, direction: Pixel) -> f64 {
        direction.dot(&(self.cov * direction)).max(0.0).sqrt()
    }
}

/// Refines a match of the point `from` of the first image, starting at `start` in the second, over shift, contrast and
/// brightness.
///
/// `None` where the patches do not agree or do not determine the shift.
pub(super) fn refine(images: [&GreyImage; 2], from: Pixel, start: Pixel, noise: f64) -> Option<Found> {
    let [a, b] = images;
    let margin = f64::from(HALF) + 2.0;
    let mut at = start;
    let template = patch(a, from)?;
    let mean = template.iter().sum::<f64>() / template.len() as f64;
    let variance = template.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / template.len() as f64;
    let mut last = None;
    for _ in 0..MAX_STEPS {
        if !b.contains(at, margin) || (at - start).norm() > MAX_SHIFT_PX {
            return None;
        }
        let (mut normal, mut right, mut square) = (Matrix4::zeros(), Vector4::zeros(), 0.0);
        let mut next = template.iter();
        // The grey value of the first image is contrast times that of the shifted second image plus brightness.
        for y in -HALF..=HALF {
            for x in -HALF..=HALF {
                let (v, dx, dy) = sample(b, at.x + f64::from(x), at.y + f64::from(y))?;
                let w = next.next()? - mean;
                let row = Vector4::new(dx, dy, v - mean, 1.0);
                normal += row * row.transpose();
                right += row * w;
                square += w * w;
            }
        }
        let solved = normal.cholesky()?;
        let s = solved.solve(&right);
        if !(s.z > 0.2) {
            return None;
        }
        let left = (square - s.dot(&right)).max(0.0) / template.len() as f64;
        // The coefficients of the derivatives are the shift times the contrast.
        let step = Pixel::new(s.x / s.z, s.y / s.z);
        if !(step.norm() < MAX_SHIFT_PX) {
            return None;
        }
        at += step;
        last = Some((left, solved.inverse().fixed_view::<2, 2>(0, 0) / (s.z * s.z)));
        if step.norm() < CONVERGED_PX {
            break;
        }
    }
    let (left, inverse) = last?;
    if left > MAX_UNEXPLAINED * variance + 2.0 * noise * noise {
        return None;
    }
    // Neighbouring residuals share one misfit rather than independent noise: they count as one row of the patch.
    let found = Found { at, cov: inverse * (left.max(noise * noise) * f64::from(2 * HALF + 1)) };
    (found.cov.trace().sqrt() < MAX_SIGMA_PX && (at - start).norm() <= MAX_SHIFT_PX).then_some(found)
}

fn patch(image: &GreyImage, at: Pixel) -> Option<Vec<f64>> {
    if !image.contains(at, f64::from(HALF) + 2.0) {
        return None;
    }
    let mut out = Vec::with_capacity(((2 * HALF + 1) * (2 * HALF + 1)) as usize);
    for y in -HALF..=HALF {
        for x in -HALF..=HALF {
            out.push(sample(image, at.x + f64::from(x), at.y + f64::from(y))?.0);
        }
    }
    Some(out)
}

/// Bilinear grey value and its derivatives.
fn sample(image: &GreyImage, x: f64, y: f64) -> Option<(f64, f64, f64)> {
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = (x - x0, y - y0);
    let k = x0 as usize;
    let two = |y: f64| -> Option<[f64; 2]> {
        let row = image.row(y as usize);
        Some([f64::from(*row.get(k)?), f64::from(*row.get(k + 1)?)])
    };
    let ([a, b], [c, d]) = (two(y0)?, two(y0 + 1.0)?);
    let (top, bottom) = (a + (b - a) * fx, c + (d - c) * fx);
    let dx = (b - a) * (1.0 - fy) + (d - c) * fy;
    Some((top + (bottom - top) * fy, dx, bottom - top))
}
