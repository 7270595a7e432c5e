//! The values of a reconstruction: rim models, options, result and report. Edge points are in
//! [`crate::offline::types`].
//!
//! The entry is [`crate::offline::decide::reconstruct::reconstruct`]:
//!
//! ```text
//! fn reconstruct(left: &[EdgePoint], p_left: &Projection, right: &[EdgePoint], p_right: &Projection, options: &Options)
//!     -> Result<Reconstruction, Refusal>
//! ```
//!
//! Lengths are in the unit of the projection matrices (metres in graspd, millimetres in the golden cases).

use crate::offline::types::{Ellipse2, Scatter};
use nalgebra::{Matrix2, Matrix3, Matrix3x2, Vector3};

/// The model of a rim.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum RimModel {
    /// A sharp or painted circle (6 parameters).
    Circle,
    /// A sharp or painted ellipse (8 parameters).
    Ellipse,
    /// A round bar bent to a circle, a torus (7 parameters, 6 when the bar's diameter is known).
    RoundBar,
}

/// The kind of rim that the operator specifies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum RimChoice {
    /// A plane edge: circle or ellipse by the information criterion.
    Edge,
    /// A plane circle.
    Circle,
    /// A plane ellipse.
    Ellipse,
    /// A round bar.
    RoundBar,
    /// Any: the smallest information criterion decides.
    #[default]
    Auto,
}

/// Source of the absolute scale of the noise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Noise {
    /// From the residuals of the fit alone; `EdgePoint::sigma` gives relative weights.
    #[default]
    FromFit,
    /// From the residuals, but not below the given `EdgePoint::sigma`.
    AtLeastGiven,
}

/// Assumptions and tolerances of a reconstruction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// The rim's kind.
    pub rim: RimChoice,
    /// The bar's diameter if the operator knows it, length units. With it the outer outlines alone determine a round
    /// bar.
    pub bar_diameter: Option<f64>,
    /// Scale of the noise.
    pub noise: Noise,
    /// Direction of the noise.
    pub scatter: Scatter,
    /// Whether to reject gross outliers: consensus in each view, then a redescending loss over both.
    pub robust: bool,
    /// The gate of the two-view test, in standard deviations.
    pub gate_sigmas: f64,
    /// Allowance for the rig's calibration error in the two-view test, pixels (0: trust the rig fully). A real rig
    /// needs 0.3 to 1.
    pub calibration_px: f64,
    /// Systematic error that edge points share along a contour, pixels (0: none, for points without an image).
    /// Detected edges have 0.05 to 0.1. An ellipse that this error could have made out of a circle is reported as a
    /// circle.
    pub edge_bias_px: f64,
    /// Largest standard deviation of the residuals, pixels.
    pub max_noise_px: f64,
    /// Smallest semi-minor axis of a rim's image, pixels: below it the rim is seen edge-on.
    pub min_minor_axis_px: f64,
    /// Largest standard deviation of the centre (length units); `None`: a tenth of the rim's radius.
    pub max_sigma_centre: Option<f64>,
    /// Largest standard deviation of the normal, radians. Default: 2 degrees.
    pub max_sigma_normal: f64,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            rim: RimChoice::Auto,
            bar_diameter: None,
            noise: Noise::FromFit,
            scatter: Scatter::Isotropic,
            robust: true,
            gate_sigmas: 4.0,
            calibration_px: 0.0,
            edge_bias_px: 0.0,
            max_noise_px: 3.0,
            min_minor_axis_px: 3.0,
            max_sigma_centre: None,
            max_sigma_normal: 2.0_f64.to_radians(),
        }
    }
}

impl Options {
    /// The same without limits on the uncertainty of the result.
    pub(in crate::offline) fn without_tolerance(self) -> Self {
        Self { max_sigma_centre: Some(f64::INFINITY), max_sigma_normal: f64::INFINITY, ..self }
    }
}

/// A rim in space: an ellipse, a circle, or the core circle of a bar.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rim {
    /// Centre in the frame of the projection matrices.
    pub centre: Vector3<f64>,
    /// Unit normal of its plane, towards the cameras.
    pub normal: Vector3<f64>,
    /// Semi-major axis; radius of a circle; core radius of a bar.
    pub a: f64,
    /// Semi-minor axis.
    pub b: f64,
    /// Unit direction of the major axis, its largest component positive. Arbitrary for a circle.
    pub axis_a: Vector3<f64>,
    /// `normal x axis_a`.
    pub axis_b: Vector3<f64>,
}

/// Fit and information criterion of one model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Score {
    /// The model.
    pub model: RimModel,
    /// Weighted sum of squared residuals (pixels squared when all sigmas are 1).
    pub chi2: f64,
    /// Number of parameters.
    pub parameters: usize,
    /// Bayesian information criterion for the noise of the best model; the smallest wins.
    pub bic: f64,
    /// Why the model is excluded although it was fitted.
    pub excluded: Option<&'static str>,
}

/// How well the geometry determines the result.
#[derive(Clone, Debug, PartialEq)]
pub struct Report {
    /// Square root of the trace of the centre's covariance, length units.
    pub sigma_centre: f64,
    /// Square root of the trace of the normal's covariance, radians.
    pub sigma_normal: f64,
    /// The same *in the images*: of the centre relative to a gripper whose marks are at their predicted positions in
    /// both images. A loop closed in both images reaches this accuracy whatever the rig error, which displaces rim and
    /// marks alike. Length units.
    pub sigma_centre_in_images: f64,
    /// The same for the normal, radians.
    pub sigma_normal_in_images: f64,
    /// Size of the edge error that varies smoothly along the contours, pixels.
    pub smooth_px: f64,
    /// Semi-minor axes of the rim's images, left and right, pixels.
    pub minor_axis_px: [f64; 2],
    /// Angle between the two viewing rays of the centre, radians.
    pub vergence: f64,
    /// Largest eigenvalue that should be zero over the smaller of the two others (paper's method; 0 is perfect).
    pub rank2: f64,
    /// Smaller over larger of the two non-zero eigenvalues.
    pub separation: f64,
    /// Scale-free form of the paper's condition (equation 4): `1 - 4 I1 I3 / I2^2`.
    pub delta: f64,
    /// Epipolar tangency gaps in the right image, pixels; NaN when the epipole lies inside the ellipse.
    pub gap_px: [f64; 2],
    /// Predicted standard deviation of the gaps from the two fits, pixels.
    pub gap_sigma_px: [f64; 2],
    /// Excess of the two-view fit over the two one-view fits in units of the noise variance: chi-squared with 2
    /// degrees of freedom for a match.
    pub excess: f64,
    /// Angle between the planes of the paper's method and of the camera-symmetric closed form, radians.
    pub routes_differ: f64,
    /// Weighted sum of squared residuals of the chosen model.
    pub chi2: f64,
    /// Its degrees of freedom.
    pub dof: usize,
    /// Noise standard deviation used in the covariances, in units of `EdgePoint::sigma`.
    pub noise: f64,
    /// Every model that was fitted.
    pub scores: Vec<Score>,
    /// Fitted ellipses in the images (of the outer outlines), left and right.
    pub image_ellipse: [Ellipse2; 2],
    /// Residual of every input point for the chosen model, pixels, positive outside; in input order.
    pub residuals: [Vec<f64>; 2],
    /// Whether each input point was used.
    pub inliers: [Vec<bool>; 2],
}

/// A rim in space with its uncertainty.
#[derive(Clone, Debug, PartialEq)]
pub struct Reconstruction {
    /// The model that was chosen.
    pub model: RimModel,
    /// The rim itself; for a round bar its core circle.
    pub rim: Rim,
    /// Radius of the bar, for a round bar.
    pub bar_radius: Option<f64>,
    /// Covariance of the centre, length units squared.
    pub cov_centre: Matrix3<f64>,
    /// Covariance of the normal, radians squared, in the columns `e1, e2` of [`crate::offline::rim::circle::frame_of`]
    /// the normal.
    pub cov_normal: Matrix2<f64>,
    /// Cross-covariance of the centre (rows) and the normal (columns `e1, e2`).
    pub cov_centre_normal: Matrix3x2<f64>,
    /// Covariance of `(a, b)`; of `(R, r)` for a round bar.
    pub cov_axes: Matrix2<f64>,
    /// Quality figures.
    pub report: Report,
}

impl Reconstruction {
    /// Half the width that a gripper has to span along the major and the minor axis, including the bar's radius.
    pub fn half_widths(&self) -> (f64, f64) {
        let r = self.bar_radius.unwrap_or(0.0);
        (self.rim.a + r, self.rim.b + r)
    }

    /// Whether the rim has no preferred direction, so that the grasp has a free angle about the axis.
    pub fn is_round(&self) -> bool {
        !matches!(self.model, RimModel::Ellipse)
    }
}
