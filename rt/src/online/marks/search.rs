//! A mark that the prediction does not explain: a coarse vote in a window, then edges along the normals of its outline.
//!
//! What it finds is good to a few hundredths of a pixel, which is where the fit to the grey values starts.

use super::edge_fit::{self, Fit};
use super::outline::MAX_OUTLINE;
use super::{MarkMiss, MarkSettings, Outline, coarse, edge};
use crate::image::ImageView;
use crate::math;

/// Looks for a mark within `search_px` of its predicted outline. `sign` is +1 for a dark mark, -1 for a light one.
///
/// Also returns the edges' contrast. The work is bounded by constants: samples in the vote, points on the outline,
/// samples along a normal, rounds of the fit.
pub(crate) fn search(
    image: &ImageView<'_>,
    outline: &Outline,
    settings: &MarkSettings,
    search_px: f64,
    sign: f64,
) -> Result<Fit, MarkMiss> {
    let points = outline.rim();
    let start =
        coarse::search(image, outline, &points, sign, search_px, settings.min_contrast).ok_or(MarkMiss::Contrast)?;
    if start.score < 0.3 {
        return Err(MarkMiss::NotFound);
    }
    let mut fit = Fit { shift: start.shift, ..Fit::default() };
    // The first pass has to bridge the vote's step and an error of the predicted size; later ones look closely.
    let wide = (0.45 * outline.minor).clamp(1.5, 6.0);
    for (pass, reach) in [2.0 + wide, 3.0, 3.0, 3.0].into_iter().enumerate() {
        let mut edges = [None; MAX_OUTLINE];
        let mut contrasts: heapless::Vec<f64, MAX_OUTLINE> = heapless::Vec::new();
        for (p, e) in points.iter().zip(edges.iter_mut()) {
            let q = p.pixel - outline.centre;
            let shift = edge_fit::moved(&fit, q);
            let inward = reach.min(0.85 * p.support);
            if let Some(found) = edge::find(image, p, shift, sign, inward, reach) {
                let _ = contrasts.push(found.contrast);
                *e = Some(found);
            }
        }
        let contrast = edge_fit::middle(&mut contrasts);
        if contrast < settings.min_contrast {
            return Err(MarkMiss::Contrast);
        }
        // An edge much fainter than the others is a shadow or a reflection, not this disc's rim.
        for e in &mut edges {
            if e.is_some_and(|e| e.contrast < 0.4 * contrast) {
                *e = None;
            }
        }
        let before = fit.shift;
        fit = edge_fit::refine(outline, &points, &edges, &fit).ok_or(MarkMiss::Shape)?;
        if fit.stretch.iter().any(|s| math::fabs(*s) > settings.max_stretch) {
            return Err(MarkMiss::Shape);
        }
        // Edges are read linearly about the outline: a step of less than a twentieth of a pixel leaves nothing to be
        // gained.
        if pass > 0 && (fit.shift - before).norm_squared() < 0.05 * 0.05 {
            break;
        }
    }
    if fit.share < settings.min_share || fit.rms > 0.2 + 0.02 * outline.minor {
        return Err(MarkMiss::Shape);
    }
    Ok(fit)
}
