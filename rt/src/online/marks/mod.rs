//! Marks in one image: predicted outline, coarse vote in a window, sub-pixel edges, fitted shift.
//!
//! The work on a mark is bounded by constants (samples in the vote, points on the outline, samples along a normal, rounds of the
//! fit), so that no image, however full of blobs, makes a cycle late (fault M07).

mod coarse;
mod edge;
mod fit;
mod outline;

pub use outline::{MAX_OUTLINE, Outline, OutlinePoint, predict};

use crate::gripper::Mark;
use crate::image::ImageView;
use crate::math;
use crate::online::MarkObservation;
use fit::Fit;
use nalgebra::Matrix2;

/// What a mark has to look like to be believed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarkSettings {
    /// Search range about the prediction, pixels along each axis. Default 14.
    pub search_px: f64,
    /// Smallest grey difference between disc and surroundings. Default 12.
    pub min_contrast: f64,
    /// Smallest share of the rim that must be found in place, 0 to 1. Default 0.5; below about 0.4 the centre is a guess.
    pub min_share: f64,
    /// Smallest cosine between the disc's normal and the direction to the camera. Default 0.2 (78 degrees).
    pub min_facing: f64,
    /// Largest relative stretch against the predicted shape. Default 0.25.
    pub max_stretch: f64,
    /// Smallest distance from the centre to the rim's tangent, pixels: flatter images are refused. Default 1.6.
    pub min_minor_px: f64,
}

impl Default for MarkSettings {
    fn default() -> Self {
        Self {
            search_px: 14.0,
            min_contrast: 12.0,
            min_share: 0.5,
            min_facing: 0.2,
            max_stretch: 0.25,
            min_minor_px: 1.6,
        }
    }
}

/// Why a mark was not measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MarkMiss {
    /// The predicted disc is too flat, too small, or larger than the window cap allows.
    Size,
    /// The prediction lies outside the image, or within two pixels of its border.
    Outside,
    /// The window holds too little contrast: black, saturated, fogged.
    Contrast,
    /// Nothing in the window looks like this disc.
    NotFound,
    /// Too little of the rim is where one disc would have it: occluded, merged, or of another shape.
    Shape,
}

/// Largest predicted distance from centre to rim, pixels: 60 px marks with room to spare.
const MAX_MAJOR: f64 = 48.0;
/// Added to every covariance, px²: what pixel structure and lens model leave behind.
const CENTRE_FLOOR: f64 = 0.008 * 0.008;

/// Measures one mark in one image, from its predicted outline.
///
/// The result's pixel is the image of the disc's *centre* (distorted pixels): the fitted shift is applied to the predicted
/// image of the centre. `search_px` overrides the settings' range, so that a second look may be narrow.
///
/// # Errors
/// Says why there is no measurement; that is an ordinary event, never a fault by itself.
pub fn measure(
    image: &ImageView<'_>,
    outline: &Outline,
    mark: &Mark,
    settings: &MarkSettings,
    search_px: f64,
) -> Result<MarkObservation, MarkMiss> {
    if !(outline.minor >= settings.min_minor_px && outline.major <= MAX_MAJOR) {
        return Err(MarkMiss::Size);
    }
    let (w, h) = (image.width() as f64, image.height() as f64);
    let near = |c: f64, n: f64| c > -search_px && c < n + search_px;
    if !(near(outline.centre.x, w) && near(outline.centre.y, h)) {
        return Err(MarkMiss::Outside);
    }
    let sign = if mark.dark { 1.0 } else { -1.0 };
    let start = coarse::search(image, outline, sign, search_px, settings.min_contrast).ok_or(MarkMiss::Contrast)?;
    if start.score < 0.3 {
        return Err(MarkMiss::NotFound);
    }
    let mut fit = Fit { shift: start.shift, ..Fit::default() };
    // The first pass has to bridge the vote's step and an error of the predicted size; later ones look closely.
    let wide = (0.45 * outline.minor).clamp(1.5, 6.0);
    let mut contrast = 0.0;
    for (pass, reach) in [2.0 + wide, 3.0, 3.0, 3.0].into_iter().enumerate() {
        let mut edges = [None; MAX_OUTLINE];
        let mut contrasts: heapless::Vec<f64, MAX_OUTLINE> = heapless::Vec::new();
        for (p, e) in outline.points.iter().zip(edges.iter_mut()) {
            let q = p.pixel - outline.centre;
            let shift = fit::moved(&fit, q);
            let inward = reach.min(0.85 * p.support);
            if let Some(found) = edge::find(image, p, shift, sign, inward, reach) {
                let _ = contrasts.push(found.contrast);
                *e = Some(found);
            }
        }
        contrast = fit::middle(&mut contrasts);
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
        fit = fit::refine(outline, &edges, &fit).ok_or(MarkMiss::Shape)?;
        if fit.stretch.iter().any(|s| math::fabs(*s) > settings.max_stretch) {
            return Err(MarkMiss::Shape);
        }
        // Edges are read linearly about the outline: a step of less than a twentieth of a pixel leaves nothing to be gained.
        if pass > 0 && (fit.shift - before).norm_squared() < 0.05 * 0.05 {
            break;
        }
    }
    if fit.share < settings.min_share || fit.rms > 0.2 + 0.02 * outline.minor {
        return Err(MarkMiss::Shape);
    }
    let limit = search_px + outline.minor;
    if !(math::fabs(fit.shift.x) <= limit && math::fabs(fit.shift.y) <= limit) {
        return Err(MarkMiss::NotFound);
    }
    let pixel = outline.centre + fit.shift;
    if !(pixel.x > 2.0 && pixel.y > 2.0 && pixel.x < w - 3.0 && pixel.y < h - 3.0) {
        return Err(MarkMiss::Outside);
    }
    let covariance = fit.covariance + Matrix2::identity() * CENTRE_FLOOR;
    let clear = (contrast / (4.0 * settings.min_contrast)).min(1.0);
    let round = 1.0 / (1.0 + math::sq(fit.rms / 0.15));
    Ok(MarkObservation { pixel, covariance, quality: (fit.share.min(1.0) * clear * round) as f32 })
}
