//! ERR

use crate::files::FileError;
use crate::offline::contour::select::SelectError;
use crate::offline::handle::grasp::GraspError;
use crate::offline::rim::refusal::Refusal;

/// Why there is no plan.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A file is wrong.
    #[error(transparent)]
    File(#[from] FileError),
    /// An image's size is not the camera's.
    #[error(
        "the {view} image is {width}x{height}, but the rig's {view} camera is {rig_width}x{rig_height}: give the image of that camera, unscaled, or the rig file of this size"
    )]
    ImageSize {
        /// "left" or "right".
        view: &'static str,
        /// Width of the image.
        width: usize,
        /// Height of the image.
        height: usize,
        /// Width in the rig file.
        rig_width: u32,
        /// Height in the rig file.
        rig_height: u32,
    },
    /// A selection leads nowhere.
    #[error(transparent)]
    Select(#[from] SelectError),
    /// The views are swapped.
    #[error(
        "the views are swapped: the contours do not fit one rim as given ({as_given}), but do with left and right exchanged: exchange the two images, or the cameras in the rig file"
    )]
    Swapped {
        /// Why they do not fit as given.
        as_given: Refusal,
    },
    /// The images are exchanged, by everything that is in them.
    #[error(
        "the views are swapped: of the distinct spots of the images {exchanged} lie where the rig wants them with left and right exchanged, {as_given} as given: exchange the two images, or the cameras in the rig file"
    )]
    Exchanged {
        /// Spots that speak for the order as given.
        as_given: usize,
        /// Spots that speak for the other.
        exchanged: usize,
    },
    /// No rim.
    #[error(transparent)]
    Rim(#[from] Refusal),
    /// No grasp.
    #[error(transparent)]
    Grasp(#[from] GraspError),
}

impl PlanError {
    /// A word for machines.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::File(_) => "file",
            Self::ImageSize { .. } => "image-size",
            Self::Select(_) => "selection",
            Self::Swapped { .. } | Self::Exchanged { .. } => "views-swapped",
            Self::Rim(_) => "rim",
            Self::Grasp(_) => "grasp",
        }
    }

    /// Whether the input itself is wrong (as against a rim or a grasp that the tests refuse).
    pub fn is_input(&self) -> bool {
        !matches!(self, Self::Rim(_) | Self::Grasp(_))
    }
}
