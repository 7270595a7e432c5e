//! Values that the on-line stage passes from one of its files to another.

use crate::geom::Pixel;
use nalgebra::Matrix2;

/// One mark measured in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarkObservation {
    /// Image of the disc's centre, pixels with lens distortion. The perspective bias of the disc's centroid is removed.
    pub pixel: Pixel,
    /// Covariance of `pixel`, px².
    pub covariance: Matrix2<f64>,
    /// 0 (hardly a mark) to 1 (complete disc, good contrast).
    pub quality: f32,
}

/// State of the rig by the marks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RigHealth {
    /// Estimated offset of the rig in standard deviations of its stated error (root of the sum of squares over the
    /// unknowns).
    pub offset_sigmas: f64,
    /// Encoders and images disagree as if a camera had moved; this is decided at rest.
    pub suspicious: bool,
    /// Number of camera moves detected since the start. A plan is valid for one value of it.
    pub moves: u32,
    /// Number of smaller changes detected, too small to put the gripper off its goal.
    pub shakes: u32,
    /// Error of the gripper's pose that the last change would cause, metres (unit-scaled).
    pub astray_m: f64,
    /// Evidence of a change as a fraction of the significance limit: of a step in this frame, and of the window against
    /// the start.
    pub evidence: [f64; 2],
}
