//! From target points in both views to a calibrated rig that knows its own error.
//!
//! [`parameters`]: what is estimated, projection and its derivatives. [`bundle`]: the joint robust fit and its
//! covariance. [`initial`]: start values. [`pairs`]: which pairs cannot be what they claim to be, and why. [`holdout`]
//! and [`score`]: how good on images that were not used. [`predict`]: what the covariance means for a mark, and which
//! image would help most. [`coverage`], [`verdict`]: words. [`calibrate()`]: all of it.

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

/// A pair of images with the target's points in them.
#[derive(Clone, Debug, PartialEq)]
pub struct Pair {
    /// A name for people: the left image's.
    pub name: String,
    /// Points in the left and in the right image.
    pub seen: [Vec<Seen>; 2],
    /// Width of the edges in both, pixels.
    pub blur_px: [f64; 2],
}

/// Fewest pairs that are calibrated from: hold-out needs four groups, and fewer views leave lens and pose mixed up.
pub const LEAST_PAIRS: usize = 5;

/// Why there is no calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// Too few pairs.
    #[error(
        "only {found} pairs can be used, {LEAST_PAIRS} are needed and 15 to 30 are good: take more, with the target tilted by 20 to 45 degrees in different directions, and in all parts of the image"
    )]
    TooFew {
        /// Pairs that can be used.
        found: usize,
    },
    /// A camera alone cannot be calibrated.
    #[error(
        "the {side} camera cannot be calibrated from its images: no lens and poses explain the points; check --target, and tilt the target"
    )]
    Camera {
        /// Which one.
        side: &'static str,
    },
    /// The pairs do not agree on a rig.
    #[error(
        "the pairs do not agree on where the cameras stand (the median pair is off by {median_px:.0} px): {}",
        guess.unwrap_or("the images of a pair were not taken at the same time, the cameras moved between pairs, or the lists do not belong together")
    )]
    NoCommonRig {
        /// How far the median pair is off, pixels.
        median_px: f64,
        /// What would make them agree.
        guess: Option<&'static str>,
    },
    /// The fit does not come to an end.
    #[error("the joint fit does not converge: take more pairs, with the target tilted in different directions")]
    NoFit,
    /// The lens model folds.
    #[error(
        "the {side} lens model folds the image over itself: the target was not seen near the image's corners, where the coefficients run free; take images there"
    )]
    Folds {
        /// Which camera.
        side: &'static str,
    },
    /// Nothing is seen by both cameras there.
    #[error("nothing between {:.2} and {:.2} m is seen by both cameras: give --volume as NEAR,FAR in metres", range_m[0], range_m[1])]
    NoVolume {
        /// Distances, metres.
        range_m: [f64; 2],
    },
}
