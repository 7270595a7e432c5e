//! Calibration of the rig, with its uncertainty, from target points in both views.
//!
//! [`parameters`]: the estimated parameters, projection and its derivatives. [`bundle`]: the joint robust fit and its
//! covariance. [`initial`]: start values. [`pairs`]: rejection of inconsistent pairs, with the reason. [`holdout`] and
//! [`score`]: accuracy on images that were not in the fit. [`predict`]: the mark error that follows from the
//! covariance, and the most useful additional image. [`coverage`], [`verdict`]: the assessment of the result.
//! [`check`]: test of a stored calibration. [`calibrate()`] runs the entire estimate.

pub mod bundle;
mod calibration;
pub mod check;
mod consensus;
pub mod coverage;
pub mod holdout;
mod initial;
pub mod pairs;
pub mod parameters;
pub mod predict;
pub mod score;
pub mod solve;
#[cfg(test)]
pub(crate) mod synthetic;
#[cfg(test)]
mod tests;
pub mod verdict;

pub use calibration::{Calibration, Options, calibrate};

use crate::calibrate::target::Seen;

/// Target points of a pair of images.
#[derive(Clone, Debug, PartialEq)]
pub struct Pair {
    /// Display name: that of the left image.
    pub name: String,
    /// Points in the left and in the right image, sorted by index.
    pub seen: [Vec<Seen>; 2],
    /// Blur of the edges in both images, pixels.
    pub blur_px: [f64; 2],
}

/// Minimum number of pairs. The hold-out needs four groups, and fewer views do not separate the lens from the poses.
pub const MIN_PAIRS: usize = 5;

/// Reason why the calibration failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// Too few pairs.
    #[error(
        "only {found} pairs can be used, at least {MIN_PAIRS} are needed and 15 to 30 are recommended: take more pairs with the target tilted by 20 to 45 degrees in different directions, and in all parts of the image"
    )]
    TooFew {
        /// Number of usable pairs.
        found: usize,
    },
    /// The calibration of a single camera failed.
    #[error(
        "calibration of the {side} camera alone failed: no lens and target poses explain the points; check --target, and tilt the target"
    )]
    Camera {
        /// Name of the camera.
        side: &'static str,
    },
    /// The pairs do not agree on a relative pose of the cameras.
    #[error(
        "the pairs do not agree on the relative pose of the cameras (median disagreement {median_px:.0} px): {}",
        guess.unwrap_or("the images of a pair were not taken at the same time, the cameras moved between pairs, or the lists are not from the same recording")
    )]
    NoCommonRig {
        /// Median disagreement of the pairs, pixels.
        median_px: f64,
        /// Change of the input under which the pairs agree.
        guess: Option<&'static str>,
    },
    /// The joint fit does not converge.
    #[error("the joint fit does not converge: take more pairs, with the target tilted in different directions")]
    NoFit,
    /// The lens model is not one-to-one over the image.
    #[error(
        "the lens model of the {side} camera is not one-to-one over the image: its coefficients are undetermined without target points near the image corners; take images with the target there"
    )]
    Folds {
        /// Name of the camera.
        side: &'static str,
    },
    /// The views of the cameras do not overlap in the volume.
    #[error("the views of the two cameras do not overlap between {:.2} and {:.2} m: give --volume as NEAR,FAR in metres", range_m[0], range_m[1])]
    NoVolume {
        /// Distances, metres.
        range_m: [f64; 2],
    },
}
