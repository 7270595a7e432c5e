//! Locates a mark in its window to within a fraction of its radius, by a vote of ring samples.
//!
//! For each shift of the predicted outline and each direction, the vote compares the grey value just inside the rim
//! with the one just outside. A disc of another size has a low score, because one of its two rings is wrong everywhere.
//! A half occluded disc still peaks at the correct position. The number of samples is fixed and does not depend on the
//! image content.

use super::Outline;
use super::outline::OutlinePoint;
use crate::image::ImageView;
use crate::math;
use nalgebra::Vector2;

const MAX_DIRECTIONS: usize = 16;
/// Maximum number of shifts that are tried along each axis.
const MAX_SHIFTS: usize = 21;

/// Best shift of the outline and its score.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Coarse {
    pub(crate) shift: Vector2<f64>,
    /// 1 for an undisturbed disc of the expected polarity, about 0 without a disc, negative for the opposite polarity.
    pub(crate) score: f64,
}

struct Ring {
    inner: Vector2<f64>,
    outer: Vector2<f64>,
}

struct Vote<'a, 'b> {
    image: &'b ImageView<'a>,
    rings: heapless::Vec<Ring, MAX_DIRECTIONS>,
    sign: f64,
    contrast: f64,
}

impl Vote<'_, '_> {
    fn grey(&self, p: Vector2<f64>) -> Option<f64> {
        let (x, y) = (p.x + 0.5, p.y + 0.5);
        if !(x >= 0.0 && y >= 0.0 && x < self.image.width() as f64 && y < self.image.height() as f64) {
            return None;
        }
        Some(f64::from(self.image.at(x as usize, y as usize)))
    }

    fn score(&self, shift: Vector2<f64>) -> f64 {
        let mut sum = 0.0;
        for r in &self.rings {
            if let (Some(i), Some(o)) = (self.grey(r.inner + shift), self.grey(r.outer + shift)) {
                sum += (self.sign * (o - i) / self.contrast).clamp(-1.0, 1.0);
            }
        }
        sum / self.rings.len() as f64
    }
}

/// Searches shifts up to `range` pixels along each axis. `sign` is +1 for a dark mark, -1 for a light one.
///
/// Returns the prediction without a search if it already has a high score.
pub(crate) fn search(
    image: &ImageView<'_>,
    outline: &Outline,
    points: &[OutlinePoint],
    sign: f64,
    range: f64,
    min_contrast: f64,
) -> Option<Coarse> {
    let every = points.len().div_ceil(MAX_DIRECTIONS).max(1);
    let gap = (0.25 * outline.minor).clamp(1.5, 4.0);
    let mut rings = heapless::Vec::new();
    for p in points.iter().step_by(every) {
        let radial = p.pixel - outline.centre;
        let _ = rings.push(Ring { inner: outline.centre + radial * 0.65, outer: p.pixel + p.normal * gap });
    }
    if rings.is_empty() {
        return None;
    }
    let contrast = contrast(image, outline, range)?;
    if contrast < min_contrast {
        return None;
    }
    let vote = Vote { image, rings, sign, contrast: 0.6 * contrast };
    let predicted = Coarse { shift: Vector2::zeros(), score: vote.score(Vector2::zeros()) };
    if predicted.score > 0.9 || range <= 0.0 {
        return Some(predicted);
    }
    let step = (0.5 * outline.minor).clamp(1.0, 8.0).max(2.0 * range / (MAX_SHIFTS - 1) as f64);
    let side = ((range / step) as i32).min((MAX_SHIFTS as i32 - 1) / 2);
    // Of shifts with equal scores, the one nearest to the prediction ranks first.
    let rank = |c: &Coarse| c.score - 0.1 * c.shift.norm_squared() / (range * range);
    let mut best = predicted;
    for j in -side..=side {
        for i in -side..=side {
            let shift = Vector2::new(f64::from(i) * step, f64::from(j) * step);
            let c = Coarse { shift, score: vote.score(shift) };
            if rank(&c) > rank(&best) {
                best = c;
            }
        }
    }
    let mut fine = 0.5 * step;
    for _ in 0..2 {
        let base = best.shift;
        for j in -1..=1 {
            for i in -1..=1 {
                let shift = base + Vector2::new(f64::from(i) * fine, f64::from(j) * fine);
                let c = Coarse { shift, score: vote.score(shift) };
                if rank(&c) > rank(&best) {
                    best = c;
                }
            }
        }
        fine *= 0.5;
    }
    Some(best)
}

/// Difference between the 98 % and the 2 % quantile of the grey values in a subsampled window.
fn contrast(image: &ImageView<'_>, outline: &Outline, range: f64) -> Option<f64> {
    let half = outline.major + range + 2.0;
    let lo = |c: f64, n: usize| math::floor(c - half).clamp(0.0, n as f64 - 1.0) as usize;
    let hi = |c: f64, n: usize| math::ceil(c + half).clamp(0.0, n as f64 - 1.0) as usize;
    let (x0, x1) = (lo(outline.centre.x, image.width()), hi(outline.centre.x, image.width()));
    let (y0, y1) = (lo(outline.centre.y, image.height()), hi(outline.centre.y, image.height()));
    if x1 <= x0 || y1 <= y0 {
        return None;
    }
    let (sx, sy) = (((x1 - x0) / 24).max(1), ((y1 - y0) / 24).max(1));
    let mut histogram = [0_u16; 256];
    let mut total = 0_u32;
    for y in (y0..=y1).step_by(sy) {
        for &v in image.row(y).get(x0..=x1).unwrap_or(&[]).iter().step_by(sx) {
            if let Some(h) = histogram.get_mut(usize::from(v)) {
                *h = h.saturating_add(1);
                total += 1;
            }
        }
    }
    let tail = total / 50;
    let low = percentile(histogram.iter(), tail);
    let high = 255 - percentile(histogram.iter().rev(), tail);
    (high > low).then(|| f64::from(high - low))
}

fn percentile<'h>(bins: impl Iterator<Item = &'h u16>, tail: u32) -> i32 {
    let mut sum = 0;
    for (level, n) in bins.enumerate() {
        sum += u32::from(*n);
        if sum > tail {
            return level as i32;
        }
    }
    255
}
