//! Why there is no plan.

use crate::files::FileError;
use crate::offline::contour::select::SelectError;
use crate::offline::handle::grasp::GraspError;
use crate::offline::rim::refusal::Refusal;

/// Why there is no plan.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A file is invalid.
    #[error(transparent)]
    File(#[from] FileError),
    /// Image size mismatch between an image and the rig file.
    #[error(
        "{view} image size mismatch: got {width}x{height}, the rig file expects {rig_width}x{rig_height}: give the unscaled image of the {view} camera, or the rig file for this size"
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
    /// A selection gives no contour.
    #[error(transparent)]
    Select(#[from] SelectError),
    /// The views are swapped, by the contours.
    #[error(
        "the views are swapped: the contours fit one rim only with left and right exchanged (as given: {as_given}): exchange the two images, or the cameras in the rig file"
    )]
    Swapped {
        /// Why the contours do not fit as given.
        as_given: Refusal,
    },
    /// The views are swapped, by the spots of the images.
    #[error(
        "the views are swapped: {exchanged} distinctive spots of the images match the rig with left and right exchanged, {as_given} as given: exchange the two images, or the cameras in the rig file"
    )]
    Exchanged {
        /// Spots that match in the order as given.
        as_given: usize,
        /// Spots that match with left and right exchanged.
        exchanged: usize,
    },
    /// The selected contours give no rim.
    #[error(transparent)]
    Rim(#[from] Refusal),
    /// The rim cannot be grasped.
    #[error(transparent)]
    Grasp(#[from] GraspError),
}

impl PlanError {
    /// The kind of error as a machine-readable name.
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

    /// Whether the input is invalid (as opposed to a rim or a grasp that is refused).
    pub fn is_input(&self) -> bool {
        !matches!(self, Self::Rim(_) | Self::Grasp(_))
    }
}
