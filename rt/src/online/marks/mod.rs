//! Measures marks in one image: predicts the outline of a mark and fits the pixel-integrated disc to the grey values
//! around its rim. If this fit does not explain the image, a coarse vote in a window and sub-pixel edges give a new
//! start, and the fit runs again. docs/TRACKER.md derives the model.
//!
//! The work per mark is bounded by constants (pixels in the band, iterations, samples in the vote, points on the
//! outline, samples along a normal), so an image with many blobs cannot delay a cycle.

mod band;
mod coarse;
mod coverage;
mod edge;
mod edge_fit;
mod estimate;
mod grey;
mod outline;
mod search;
mod sectors;
mod settle;

pub use outline::{Footprint, MAX_OUTLINE_POINTS, Outline, OutlinePoint, Quadratic, footprint, predict};

use crate::gripper::Mark;
use crate::image::ImageView;
use crate::math;
use crate::online::MarkObservation;
use band::Band;
use coverage::PointSpread;
use estimate::{Estimate, MAX_TRACKED_MISFIT_PX, track, track_occluded};
use nalgebra::{Matrix2, Vector2};
use settle::settle;

/// Limits on the image of a mark.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarkSettings {
    /// Search range around the prediction, pixels along each axis. Default 14.
    pub search_px: f64,
    /// Minimum grey difference between disc and surroundings. Default 12.
    pub min_contrast: f64,
    /// Minimum fraction of the rim that agrees with the fit, 0 to 1. Default 0.5; below about 0.4 the centre is
    /// unreliable.
    pub min_rim_fraction: f64,
    /// Minimum cosine between the disc's normal and the direction to the camera. Default 0.2 (78 degrees).
    pub min_facing: f64,
    /// Maximum relative stretch of the predicted shape. Default 0.25.
    pub max_stretch: f64,
    /// Minimum distance from the centre to a tangent of the rim, pixels; smaller or flatter images are rejected.
    /// Default 1.6.
    pub min_minor_px: f64,
}

impl Default for MarkSettings {
    fn default() -> Self {
        Self {
            search_px: 14.0,
            min_contrast: 12.0,
            min_rim_fraction: 0.5,
            min_facing: 0.2,
            max_stretch: 0.25,
            min_minor_px: 1.6,
        }
    }
}

/// Why a mark was not measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MarkMiss {
    /// The predicted disc is too flat, too small, or larger than the limit of the window.
    Size,
    /// The prediction is outside the image, or within two pixels of its border.
    Outside,
    /// The contrast of the window is too low: black, saturated or fogged.
    Contrast,
    /// No disc of this size and polarity in the window.
    NotFound,
    /// Too small a part of the rim agrees with one disc: occluded, merged, or of another shape.
    Shape,
}

/// Maximum predicted distance from centre to rim, px: marks of 60 px diameter, with margin.
const MAX_MAJOR_PX: f64 = 48.0;
/// Variance added to every covariance, px²: rounding to integer grey values and the error of the second-order map.
const CENTRE_FLOOR_PX2: f64 = 0.0003 * 0.0003;
/// Variance of the blur that is assumed before a mark has been measured, px² (0.6 px).
pub const DEFAULT_BLUR_PX2: f64 = 0.36;
/// Maximum misfit of a fit with free blur and shape, pixels of rim position: a real mark is not exactly round, and its
/// edge is not an exact step.
const MAX_SETTLED_MISFIT_PX: f64 = 0.06;
/// Maximum misfit after a search along the normals: constant part, px, and part per pixel of half width.
const MAX_SEARCHED_MISFIT_PX: (f64, f64) = (0.2, 0.02);

/// Prior knowledge of a mark's image, in addition to its outline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Expected {
    /// Search range around the prediction, pixels along each axis; used when the prediction does not explain the image.
    pub search_px: f64,
    /// Start value of the shift of the outline, pixels.
    pub start: Vector2<f64>,
    /// Variance of the lens's blur, px².
    pub blur: f64,
    /// Motion of the mark's image during the exposure, pixels.
    pub motion: Vector2<f64>,
}

/// A measured mark.
#[derive(Clone, Copy, Debug)]
pub struct Measured {
    /// Its position and covariance.
    pub observation: MarkObservation,
    /// Its shift from the predicted outline, pixels.
    pub shift: Vector2<f64>,
    /// Variance of the blur, px², if the fit estimated it.
    pub blur: Option<f64>,
}

/// Measures marks. Contains the pixel buffers of one mark, so that they are not initialised for each mark.
#[derive(Clone, Debug)]
pub struct MarkMeter {
    band: Band,
}

impl Default for MarkMeter {
    fn default() -> Self {
        Self::new()
    }
}

impl MarkMeter {
    /// A meter with empty buffers.
    pub const fn new() -> Self {
        Self { band: Band::new() }
    }

    /// Measures one mark in one image, from its predicted outline.
    ///
    /// The pixel of the result is the image of the disc's *centre* (distorted pixels): the predicted image of the
    /// centre plus the fitted shift.
    ///
    /// # Errors
    /// [`MarkMiss`] states why there is no measurement. This is a normal event, not a fault by itself.
    pub fn measure(
        &mut self,
        image: &ImageView<'_>,
        outline: &Outline,
        mark: &Mark,
        settings: &MarkSettings,
        expected: &Expected,
    ) -> Result<Measured, MarkMiss> {
        if !(outline.minor >= settings.min_minor_px && outline.major <= MAX_MAJOR_PX) {
            return Err(MarkMiss::Size);
        }
        let search_px = expected.search_px;
        let (w, h) = (image.width() as f64, image.height() as f64);
        let near = |c: f64, n: f64| c > -search_px && c < n + search_px;
        if !(near(outline.centre.x, w) && near(outline.centre.y, h)) {
            return Err(MarkMiss::Outside);
        }
        let (estimate, blur_estimated) = self.estimate(image, outline, mark, settings, expected)?;
        let contrast = math::fabs(estimate.step);
        if contrast < settings.min_contrast {
            return Err(MarkMiss::Contrast);
        }
        let limit = search_px + outline.minor;
        if !(math::fabs(estimate.shift.x) <= limit && math::fabs(estimate.shift.y) <= limit) {
            return Err(MarkMiss::NotFound);
        }
        let pixel = outline.centre + estimate.shift;
        if !(pixel.x > 2.0 && pixel.y > 2.0 && pixel.x < w - 3.0 && pixel.y < h - 3.0) {
            return Err(MarkMiss::Outside);
        }
        let covariance = estimate.covariance + Matrix2::identity() * CENTRE_FLOOR_PX2;
        let contrast_quality = (contrast / (4.0 * settings.min_contrast)).min(1.0);
        let shape_quality = 1.0 / (1.0 + math::sq(estimate.misfit_px / 0.15));
        let quality = (estimate.fraction.clamp(0.0, 1.0) * contrast_quality * shape_quality) as f32;
        let observation = MarkObservation { pixel, covariance, quality };
        Ok(Measured { observation, shift: estimate.shift, blur: blur_estimated.then_some(estimate.variance) })
    }

    /// The fit, and whether it estimated the blur.
    fn estimate(
        &mut self,
        image: &ImageView<'_>,
        outline: &Outline,
        mark: &Mark,
        settings: &MarkSettings,
        expected: &Expected,
    ) -> Result<(Estimate, bool), MarkMiss> {
        let sign = if mark.dark { 1.0 } else { -1.0 };
        let motion = [expected.motion.x as f32, expected.motion.y as f32];
        let psf = PointSpread { variance: expected.blur as f32, motion };
        let accepted = |e: &Estimate, limit: f64| {
            e.explains(limit)
                && e.fraction >= settings.min_rim_fraction
                && e.stretch.iter().all(|s| math::fabs(*s) <= settings.max_stretch)
        };
        let band = &mut self.band;
        let start = expected.start;
        if let Some(tracked) = track(band, image, outline, start, psf, sign)
            && accepted(&tracked, MAX_TRACKED_MISFIT_PX)
        {
            return Ok((tracked, false));
        }
        if let Some(tracked) = track_occluded(band, image, outline, start, psf, sign) {
            if accepted(&tracked, MAX_TRACKED_MISFIT_PX) {
                return Ok((tracked, false));
            }
            let settled = settle(band, image, outline, tracked.shift, psf, sign);
            if let Some(settled) = settled.filter(|e| accepted(e, MAX_SETTLED_MISFIT_PX)) {
                return Ok((settled, true));
            }
        }
        let found = search::search(image, outline, settings, expected.search_px, sign)?;

        let shape = outline.stretched(&found.stretch).ok_or(MarkMiss::Shape)?;
        let settled = settle(band, image, &shape, found.shift, psf, sign).ok_or(MarkMiss::Shape)?;

        let (base, slope) = MAX_SEARCHED_MISFIT_PX;
        let limit = base + slope * outline.minor;
        let disagree = (settled.shift - found.shift).norm_squared() > math::sq(limit + 0.3);
        if disagree || !accepted(&settled, limit) {
            return Err(MarkMiss::Shape);
        }
        Ok((settled, true))
    }
}

/// Measures one mark in one image from its outline alone: see [`MarkMeter::measure`].
///
/// # Errors
/// [`MarkMiss`] states why there is no measurement. This is a normal event, not a fault by itself.
pub fn measure(
    image: &ImageView<'_>,
    outline: &Outline,
    mark: &Mark,
    settings: &MarkSettings,
    search_px: f64,
) -> Result<MarkObservation, MarkMiss> {
    let expected = Expected { search_px, start: Vector2::zeros(), blur: DEFAULT_BLUR_PX2, motion: Vector2::zeros() };
    MarkMeter::new().measure(image, outline, mark, settings, &expected).map(|m| m.observation)
}
