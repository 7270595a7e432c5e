//! Searches a mark that the prediction does not explain: a coarse vote in a window, then edges along the normals of its
//! outline.
//!
//! The result is accurate to a few hundredths of a pixel and is the start of the fit to the grey values.

use super::edge_fit::{self, Fit};
use super::outline::MAX_OUTLINE_POINTS;
use super::{MarkMiss, MarkSettings, Outline, coarse, edge};
use crate::image::ImageView;
use crate::math;

/// Searches for a mark within `search_px` of its predicted outline. `sign` is +1 for a dark mark, -1 for a light one.
///
/// The work is bounded by constants: samples in the vote, points on the outline, samples along a normal, rounds of the
/// fit.
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
    // The first pass has to cover the step of the vote and an error of the predicted size; later passes are narrow.
    let wide = (0.45 * outline.minor).clamp(1.5, 6.0);
    for (pass, reach) in [2.0 + wide, 3.0, 3.0, 3.0].into_iter().enumerate() {
        let mut edges = [None; MAX_OUTLINE_POINTS];
        let mut contrasts: heapless::Vec<f64, MAX_OUTLINE_POINTS> = heapless::Vec::new();
        for (p, e) in points.iter().zip(edges.iter_mut()) {
            let q = p.pixel - outline.centre;
            let shift = edge_fit::displacement(&fit, q);
            let inward = reach.min(0.85 * p.support);
            if let Some(found) = edge::find(image, p, shift, sign, inward, reach) {
                let _ = contrasts.push(found.contrast);
                *e = Some(found);
            }
        }
        let contrast = edge_fit::median(&mut contrasts);
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
        // The edge positions are linear around the outline: after a step below a twentieth of a pixel, another pass
        // gains nothing.
        if pass > 0 && (fit.shift - before).norm_squared() < 0.05 * 0.05 {
            break;
        }
    }
    if fit.fraction < settings.min_rim_fraction || fit.rms > 0.2 + 0.02 * outline.minor {
        return Err(MarkMiss::Shape);
    }
    Ok(fit)
}
