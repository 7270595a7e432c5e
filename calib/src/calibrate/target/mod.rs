//! The calibration target: what is printed on it, and where its points stand in an image.

mod charuco;
mod chessboard;
mod circles;
mod collect;
mod images;
mod saddle;
mod spec;
#[cfg(test)]
mod tests;

pub use crate::offline::edges::grey_image::GreyImage;
pub use collect::{CollectError, Collected, FoundPair, collect};
pub use images::{ImageError, ImageFile, list_images, read_image};
pub use spec::{Kind, Target, TargetError};

use graspd_rt::geom::Pixel;
use nalgebra::Matrix2;

/// A target point seen in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Which point of the target, as [`Target::point`] counts them.
    pub index: usize,
    /// Where it is in the image, pixels, lens distortion included.
    pub at: Pixel,
    /// Covariance of that place, px squared.
    pub covariance: Matrix2<f64>,
}

/// A target found in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Its points, by index.
    pub points: Vec<Seen>,
    /// Width of the target's edges (one standard deviation of the blur), median over the points, pixels.
    pub blur_px: f64,
}

/// Why an image has no target in it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NotFound {
    /// Nothing like it.
    #[error("no {0} in it")]
    Nothing(&'static str),
    /// A grid of another size.
    #[error(
        "a grid of {found_cols}x{found_rows} points in it, but the target has {cols}x{rows}: part of the board is hidden or outside, or --target counts differently (it counts inner corners)"
    )]
    Size {
        /// Points across that were found.
        found_cols: usize,
        /// Points down that were found.
        found_rows: usize,
        /// Points across of the target.
        cols: usize,
        /// Points down of the target.
        rows: usize,
    },
    /// Too few of its points can be measured.
    #[error(
        "only {found} of the target's {expected} points can be measured: blurred, too dark, or too small in the image"
    )]
    Few {
        /// Points measured.
        found: usize,
        /// Points of the target.
        expected: usize,
    },
}

/// Finds the target in an image.
///
/// # Errors
/// Why not.
pub fn find(image: &GreyImage, target: &Target) -> Result<Found, NotFound> {
    let found = match &target.kind {
        Kind::Chessboard => chessboard::find(image, target),
        Kind::Charuco { .. } => charuco::find(image, target),
        Kind::Circles { .. } => circles::find(image, target),
    }?;
    let least = least_points(target);
    if found.points.len() < least {
        return Err(NotFound::Few { found: found.points.len(), expected: target.count() });
    }
    Ok(found)
}

/// Points without which a view is not used: a board's pose from fewer is hardly redundant (six unknowns, twelve
/// equations at six points); a chessboard and a circle grid of which half is missing were not found but guessed.
fn least_points(target: &Target) -> usize {
    match target.kind {
        Kind::Charuco { .. } => 8,
        Kind::Chessboard | Kind::Circles { .. } => (target.count() / 2).max(8),
    }
}
