//! The edge of a disc along one normal of its outline, to a few hundredths of a pixel.

use super::outline::OutlinePoint;
use crate::image::ImageView;
use nalgebra::Vector2;

/// Distance between samples along a normal, pixels.
const STEP: f64 = 0.5;
const MAX_SAMPLES: usize = 64;
/// Samples on either side over which a step is judged, and beyond which its levels are read.
const NEAR: usize = 3;

/// One edge found.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Edge {
    /// Offset from the outline along its outward normal, pixels.
    pub(crate) offset: f64,
    /// Grey difference outside minus inside, positive for the wanted polarity.
    pub(crate) contrast: f64,
}

/// Finds the strongest edge of the wanted polarity between `-inward` and `outward` pixels of the (shifted) outline
/// point.
///
/// The position is where the grey is half way between its levels on both sides. Blur and the pixels' own area smear the
/// step evenly to both sides, so that this point stays on the true edge.
pub(crate) fn find(
    image: &ImageView<'_>,
    point: &OutlinePoint,
    shift: Vector2<f64>,
    sign: f64,
    inward: f64,
    outward: f64,
) -> Option<Edge> {
    let base = point.pixel + shift;
    let count = (((inward + outward) / STEP) as usize + 1).min(MAX_SAMPLES);
    if count < 2 * NEAR + 1 {
        return None;
    }
    let mut v = [0.0_f64; MAX_SAMPLES];
    let v = v.get_mut(..count)?;
    let (from, step) = (base - point.normal * inward, point.normal * STEP);
    if !image.profile(from.x, from.y, step.x, step.y, v) {
        return None;
    }
    if sign < 0.0 {
        for v in v.iter_mut() {
            *v = -*v;
        }
    }
    // The step between samples i and i + 1, from the NEAR samples on either side.
    let (mut at, mut best) = (0, 0.0);
    for (i, w) in v.windows(2 * NEAR).enumerate() {
        let [a, b, c, d, e, f] = w else { break };
        let step = (d + e + f) - (a + b + c);
        if step > best {
            (at, best) = (i + NEAR - 1, step);
        }
    }
    if best <= 0.0 {
        return None;
    }
    // Levels from beyond the smear; at the ends of the profile, from what there is.
    let low_from = at.saturating_sub(NEAR + 2);
    let low = mean(v.get(low_from..=at.saturating_sub(NEAR).max(low_from + 1))?);
    let high_to = (at + NEAR + 3).min(count - 1);
    let high = mean(v.get((at + 1 + NEAR).min(high_to - 1)..=high_to)?);
    let contrast = high - low;
    if !(contrast > 0.0) {
        return None;
    }
    let middle = 0.5 * (low + high);
    let mut found: Option<f64> = None;
    let centre = at as f64 + 0.5;
    for i in at.saturating_sub(NEAR)..(at + NEAR).min(count - 1) {
        let (a, b) = (*v.get(i)?, *v.get(i + 1)?);
        if a <= middle && b > middle {
            let x = i as f64 + (middle - a) / (b - a);
            if found.is_none_or(|f| (x - centre) * (x - centre) < (f - centre) * (f - centre)) {
                found = Some(x);
            }
        }
    }
    found.map(|x| Edge { offset: x * STEP - inward, contrast })
}

fn mean(v: &[f64]) -> f64 {
    v.iter().sum::<f64>() / v.len().max(1) as f64
}
