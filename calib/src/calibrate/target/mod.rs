//! The calibration target: the printed pattern, and detection of its points in an image.

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

/// A target point detected in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seen {
    /// Index of the point, as in [`Target::point`].
    pub index: usize,
    /// Position in the image including lens distortion, pixels.
    pub at: Pixel,
    /// Covariance of the position, px squared.
    pub covariance: Matrix2<f64>,
}

/// A target detected in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Points, sorted by index.
    pub points: Vec<Seen>,
    /// Blur of the target's edges (one standard deviation), median over the points, pixels.
    pub blur_px: f64,
}

/// Reason why no target was detected in an image.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NotFound {
    /// No target of the kind.
    #[error("no {0} detected")]
    Nothing(&'static str),
    /// A grid of a different size.
    #[error(
        "detected a grid of {found_cols}x{found_rows} points, but the target has {cols}x{rows}: part of the board is hidden or outside the image, or --target has wrong counts (a chessboard counts inner corners)"
    )]
    Size {
        /// Columns of points detected.
        found_cols: usize,
        /// Rows of points detected.
        found_rows: usize,
        /// Columns of points of the target.
        cols: usize,
        /// Rows of points of the target.
        rows: usize,
    },
    /// Too few points of the target can be measured.
    #[error(
        "only {found} of the target's {expected} points can be measured: the image is blurred or too dark, or the target is too small in it"
    )]
    Few {
        /// Points measured.
        found: usize,
        /// Points of the target.
        expected: usize,
    },
}

/// Detects the target in an image.
///
/// # Errors
/// The reason why it was not detected.
pub fn find(image: &GreyImage, target: &Target) -> Result<Found, NotFound> {
    let found = match &target.kind {
        Kind::Chessboard => chessboard::find(image, target),
        Kind::Charuco { .. } => charuco::find(image, target),
        Kind::Circles { .. } => circles::find(image, target),
    }?;
    let min = min_points(target);
    if found.points.len() < min {
        return Err(NotFound::Few { found: found.points.len(), expected: target.count() });
    }
    Ok(found)
}

/// Minimum number of points of a view. With fewer points the pose of a board has little redundancy (six unknowns,
/// twelve equations at six points). A chessboard or a circle grid with half of its points missing is not a reliable
/// detection.
fn min_points(target: &Target) -> usize {
    match target.kind {
        Kind::Charuco { .. } => 8,
        Kind::Chessboard | Kind::Circles { .. } => (target.count() / 2).max(8),
    }
}
