//! Values that the on-line stage passes from one of its files to another.

use crate::geom::Pixel;
use nalgebra::Matrix2;

/// One mark seen in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarkObservation {
    /// Image of the disc's centre, pixels with lens distortion; the perspective bias of the disc's centroid is already removed.
    pub pixel: Pixel,
    /// Covariance of `pixel`, px².
    pub covariance: Matrix2<f64>,
    /// 0 (barely a mark) to 1 (all of the disc seen, good contrast).
    pub quality: f32,
}

/// The rig as the marks show it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RigHealth {
    /// How far off the rig seems, in deviations of its stated error (root of the sum of squares over its unknowns).
    pub offset_sigmas: f64,
    /// Encoders and images disagree as if a camera had moved; at rest it will be known.
    pub suspicious: bool,
    /// How many times a camera was found moved since the start. A plan is good for one such number.
    pub moves: u32,
    /// How many smaller changes were noticed, which lead the gripper astray by less than matters.
    pub shakes: u32,
    /// How far the last of either leads the gripper astray, metres (unit-scaled).
    pub astray_m: f64,
    /// Evidence of a change: of one step in this frame, and of the window against the start, as shares of what is
    /// significant.
    pub evidence: [f64; 2],
}
