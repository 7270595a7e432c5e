//! Input and result of the likelihood.

use super::shape::Shape;
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::types::EdgePoint;
use crate::offline::types::projection::Projection;
use nalgebra::{DMatrix, DVector};

/// Largest distance of an inlier from the outline, in its own standard deviations. An outlier costs as much.
pub(in crate::offline) const OUTLIER_SIGMAS: f64 = 4.5;
/// Expected size of the smooth edge error, pixels.
pub(super) const USUAL_WAVE_PX: f64 = 0.07;

/// One contour's edge points.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Stretch {
    /// View, 0 or 1.
    pub(in crate::offline) view: usize,
    /// The points.
    pub(in crate::offline) points: Vec<EdgePoint>,
    /// Parameter of each point along the contour, radians.
    pub(in crate::offline) parameter: Vec<f64>,
    /// Which of the shapes it belongs to.
    pub(in crate::offline) shape: usize,
}

/// A model at its optimum.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Fitted {
    /// The shapes.
    pub(in crate::offline) shapes: Vec<Shape>,
    /// Logarithm of the evidence, up to a constant of the points.
    pub(in crate::offline) log_evidence: f64,
    /// Squared residuals in their own covariance, priors included: chi-squared with about `dof` degrees of freedom for
    /// a correct model.
    pub(in crate::offline) chi2: f64,
    /// Degrees of freedom.
    pub(in crate::offline) dof: f64,
    /// Noise of the points, in units of their own sigmas.
    pub(in crate::offline) kappa: f64,
    /// Size of the smooth edge error, pixels.
    pub(in crate::offline) wave_px: f64,
    /// Expected error of the rig, in units of the modes.
    pub(in crate::offline) phi: DVector<f64>,
    /// Covariance of the first shape (centre, normal in `frame_of`, shape; natural units), followed by the modes of
    /// the rig.
    pub(in crate::offline) cov: DMatrix<f64>,
    /// Number of the first shape's parameters.
    pub(in crate::offline) parameters: usize,
    /// Residual of each point for the corrected rig, pixels, and whether it was used; in the order of the stretches.
    pub(in crate::offline) residuals: Vec<(f64, bool)>,
}

/// A hypothesis about several contours: their shapes, and whether the right contour is another one than the left.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Hypothesis {
    /// The shapes that the stretches belong to.
    pub(in crate::offline) shapes: Vec<Shape>,
    /// Standard deviation, pixels, of the displacement of a contour in the right image from where the left one's shape
    /// predicts it, across the epipolar lines and in height over them. `None` if both are images of one shape.
    pub(in crate::offline) unrelated_px: Option<f64>,
}

impl Hypothesis {
    /// Number of parameters of that displacement.
    pub(super) fn displacements(&self) -> usize {
        if self.unrelated_px.is_some() { 2 * self.shapes.len() } else { 0 }
    }
}

/// A view's projection corrected by the expected error of the modes.
pub(in crate::offline) fn corrected(rig: &RigError, phi: &DVector<f64>, view: usize) -> Projection {
    let mut p = rig.p.get(view).copied().unwrap_or_default();
    for (mode, v) in rig.modes.iter().zip(phi.iter()) {
        p += mode.get(view).copied().unwrap_or_default() * *v;
    }
    p
}
