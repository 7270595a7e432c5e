//! Locates the edge of a disc along one normal of its outline to a few hundredths of a pixel.

use super::outline::OutlinePoint;
use crate::image::ImageView;
use nalgebra::Vector2;

/// Distance between samples along a normal, px.
const STEP_PX: f64 = 0.5;
const MAX_SAMPLES: usize = 64;
/// Number of samples on either side that measure a step; the levels are read beyond them.
const NEAR_SAMPLES: usize = 3;

/// An edge.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Edge {
    /// Offset from the outline along its outward normal, pixels.
    pub(crate) offset: f64,
    /// Grey difference outside minus inside, positive for the expected polarity.
    pub(crate) contrast: f64,
}

/// Finds the strongest edge of the expected polarity between `-inward` and `outward` pixels from the (shifted) outline
/// point.
///
/// The edge is where the grey value is half way between the levels on both sides. Blur and pixel area spread the step
/// symmetrically, so this point stays on the true edge.
pub(crate) fn find(
    image: &ImageView<'_>,
    point: &OutlinePoint,
    shift: Vector2<f64>,
    sign: f64,
    inward: f64,
    outward: f64,
) -> Option<Edge> {
    let base = point.pixel + shift;
    let count = (((inward + outward) / STEP_PX) as usize + 1).min(MAX_SAMPLES);
    if count < 2 * NEAR_SAMPLES + 1 {
        return None;
    }
    let mut v = [0.0_f64; MAX_SAMPLES];
    let v = v.get_mut(..count)?;
    let (from, step) = (base - point.normal * inward, point.normal * STEP_PX);
    if !image.profile(from.x, from.y, step.x, step.y, v) {
        return None;
    }
    if sign < 0.0 {
        for v in v.iter_mut() {
            *v = -*v;
        }
    }
    // The step between samples i and i + 1, from the NEAR_SAMPLES samples on either side.
    let (mut at, mut best) = (0, 0.0);
    for (i, w) in v.windows(2 * NEAR_SAMPLES).enumerate() {
        let [a, b, c, d, e, f] = w else { break };
        let step = (d + e + f) - (a + b + c);
        if step > best {
            (at, best) = (i + NEAR_SAMPLES - 1, step);
        }
    }
    if best <= 0.0 {
        return None;
    }
    // Levels from beyond the blurred step; near the ends of the profile from the samples that remain.
    let low_from = at.saturating_sub(NEAR_SAMPLES + 2);
    let low = mean(v.get(low_from..=at.saturating_sub(NEAR_SAMPLES).max(low_from + 1))?);
    let high_to = (at + NEAR_SAMPLES + 3).min(count - 1);
    let high = mean(v.get((at + 1 + NEAR_SAMPLES).min(high_to - 1)..=high_to)?);
    let contrast = high - low;
    if !(contrast > 0.0) {
        return None;
    }
    let middle = 0.5 * (low + high);
    let mut found: Option<f64> = None;
    let centre = at as f64 + 0.5;
    for i in at.saturating_sub(NEAR_SAMPLES)..(at + NEAR_SAMPLES).min(count - 1) {
        let (a, b) = (*v.get(i)?, *v.get(i + 1)?);
        if a <= middle && b > middle {
            let x = i as f64 + (middle - a) / (b - a);
            if found.is_none_or(|f| (x - centre) * (x - centre) < (f - centre) * (f - centre)) {
                found = Some(x);
            }
        }
    }
    found.map(|x| Edge { offset: x * STEP_PX - inward, contrast })
}

fn mean(v: &[f64]) -> f64 {
    v.iter().sum::<f64>() / v.len().max(1) as f64
}
