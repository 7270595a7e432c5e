//! Marks in one image: predicted outline, fit of the pixel-integrated disc to the grey values about its rim; where that
//! does not explain the image, a coarse vote in a window and sub-pixel edges, and the fit again. docs/TRACKER.md
//! derives it.
//!
//! The work on a mark is bounded by constants (pixels in the band, looks at them, samples in the vote, points on the
//! outline, samples along a normal), so that no image, however full of blobs, makes a cycle late (fault M07).

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

pub use outline::{Footprint, MAX_OUTLINE, Outline, OutlinePoint, Quadratic, footprint, predict};

use crate::gripper::Mark;
use crate::image::ImageView;
use crate::math;
use crate::online::MarkObservation;
use band::Band;
use coverage::Smear;
use estimate::{EXPLAINED_PX, Estimate, track, track_carefully};
use nalgebra::{Matrix2, Vector2};
use settle::settle;

/// What a mark has to look like to be believed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarkSettings {
    /// Search range about the prediction, pixels along each axis. Default 14.
    pub search_px: f64,
    /// Smallest grey difference between disc and surroundings. Default 12.
    pub min_contrast: f64,
    /// Smallest share of the rim that must be found in place, 0 to 1. Default 0.5; below about 0.4 the centre is a
    /// guess.
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
/// Added to every covariance, px²: what rounding to whole grey values and the map's second order leave.
const CENTRE_FLOOR: f64 = 0.0003 * 0.0003;
/// Blur that is assumed until a mark has shown another, px² (0.6 px).
pub const USUAL_BLUR: f64 = 0.36;
/// Misfit of the rim, in pixels of its position, that is believed where blur and shape were fitted: a real mark is not
/// quite round, and its edge not quite a step.
const CLOSE_PX: f64 = 0.06;
/// The same where the edges along the normals were found first, at the rim and for each pixel of half width.
const FOUND_PX: (f64, f64) = (0.2, 0.02);

/// What is known of a mark's image before it is looked at, beside its outline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Expected {
    /// Search range about the prediction, pixels along each axis, where the prediction does not explain the image.
    pub search_px: f64,
    /// Shift of the outline to start from, pixels.
    pub start: Vector2<f64>,
    /// Variance of the lens's blur, px².
    pub blur: f64,
    /// Motion of the mark's image during the exposure, pixels.
    pub motion: Vector2<f64>,
}

/// A mark that was measured.
#[derive(Clone, Copy, Debug)]
pub struct Measured {
    /// Where it is.
    pub observation: MarkObservation,
    /// Its shift from the predicted outline, pixels.
    pub shift: Vector2<f64>,
    /// The blur's variance, px², if this mark was asked for it.
    pub blur: Option<f64>,
}

/// Measures marks; holds the pixels of the one at hand, so that nothing large is set up for each.
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
    /// An empty one.
    pub const fn new() -> Self {
        Self { band: Band::new() }
    }

    /// Measures one mark in one image, from its predicted outline.
    ///
    /// The result's pixel is the image of the disc's *centre* (distorted pixels): the fitted shift is applied to the
    /// predicted image of the centre.
    ///
    /// # Errors
    /// Says why there is no measurement; that is an ordinary event, never a fault by itself.
    pub fn measure(
        &mut self,
        image: &ImageView<'_>,
        outline: &Outline,
        mark: &Mark,
        settings: &MarkSettings,
        expected: &Expected,
    ) -> Result<Measured, MarkMiss> {
        if !(outline.minor >= settings.min_minor_px && outline.major <= MAX_MAJOR) {
            return Err(MarkMiss::Size);
        }
        let search_px = expected.search_px;
        let (w, h) = (image.width() as f64, image.height() as f64);
        let near = |c: f64, n: f64| c > -search_px && c < n + search_px;
        if !(near(outline.centre.x, w) && near(outline.centre.y, h)) {
            return Err(MarkMiss::Outside);
        }
        let (estimate, asked) = self.estimate(image, outline, mark, settings, expected)?;
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
        let covariance = estimate.covariance + Matrix2::identity() * CENTRE_FLOOR;
        let clear = (contrast / (4.0 * settings.min_contrast)).min(1.0);
        let round = 1.0 / (1.0 + math::sq(estimate.misfit_px / 0.15));
        let quality = (estimate.share.clamp(0.0, 1.0) * clear * round) as f32;
        let observation = MarkObservation { pixel, covariance, quality };
        Ok(Measured { observation, shift: estimate.shift, blur: asked.then_some(estimate.variance) })
    }

    /// The fit, and whether it was asked for the blur.
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
        let smear = Smear { variance: expected.blur as f32, motion };
        let believed = |e: &Estimate, limit: f64| {
            e.explains(limit)
                && e.share >= settings.min_share
                && e.stretch.iter().all(|s| math::fabs(*s) <= settings.max_stretch)
        };
        let band = &mut self.band;
        let start = expected.start;
        if let Some(tracked) = track(band, image, outline, start, smear, sign)
            && believed(&tracked, EXPLAINED_PX)
        {
            return Ok((tracked, false));
        }
        if let Some(tracked) = track_carefully(band, image, outline, start, smear, sign) {
            if believed(&tracked, EXPLAINED_PX) {
                return Ok((tracked, false));
            }
            let settled = settle(band, image, outline, tracked.shift, smear, sign);
            if let Some(settled) = settled.filter(|e| believed(e, CLOSE_PX)) {
                return Ok((settled, true));
            }
        }
        let found = search::search(image, outline, settings, expected.search_px, sign)?;

        let shape = outline.stretched(&found.stretch).ok_or(MarkMiss::Shape)?;
        let settled = settle(band, image, &shape, found.shift, smear, sign).ok_or(MarkMiss::Shape)?;

        let (base, slope) = FOUND_PX;
        let limit = base + slope * outline.minor;
        let apart = (settled.shift - found.shift).norm_squared() > math::sq(limit + 0.3);
        if apart || !believed(&settled, limit) {
            return Err(MarkMiss::Shape);
        }
        Ok((settled, true))
    }
}

/// Measures one mark in one image with nothing known but its outline: see [`MarkMeter::measure`].
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
    let expected = Expected { search_px, start: Vector2::zeros(), blur: USUAL_BLUR, motion: Vector2::zeros() };
    MarkMeter::new().measure(image, outline, mark, settings, &expected).map(|m| m.observation)
}
