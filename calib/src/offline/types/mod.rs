//! Value types that several stages share: edge points, ellipses and camera projections.
//!
//! They depend on nothing else in this crate, so that every stage may use them.

pub mod projection;

use nalgebra::Vector2;

/// The outline of a rim that an edge point belongs to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Outline {
    /// The only outline of a sharp or painted edge, or the outer one of a bar.
    #[default]
    Outer,
    /// The inner outline of a round bar.
    Inner,
}

/// An edge point in the ideal pixels of a pinhole (distortion removed), with its standard deviation across the edge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EdgePoint {
    /// Undistorted pixel.
    pub uv: Vector2<f64>,
    /// Standard deviation across the edge, pixels. Only the ratios matter unless [`Noise::AtLeastGiven`] is chosen.
    ///
    /// [`Noise::AtLeastGiven`]: crate::offline::rim::model::Noise::AtLeastGiven
    pub sigma: f64,
    /// The outline it lies on.
    pub outline: Outline,
}

impl EdgePoint {
    /// A point on the (outer) outline.
    pub fn new(u: f64, v: f64, sigma: f64) -> Self {
        Self { uv: Vector2::new(u, v), sigma, outline: Outline::Outer }
    }

    /// A point on the inner outline of a round bar.
    pub fn inner(u: f64, v: f64, sigma: f64) -> Self {
        Self { uv: Vector2::new(u, v), sigma, outline: Outline::Inner }
    }
}

/// Direction in which edge points scatter about the contour. The two models differ by `kappa sigma^2 / 2`, which is
/// below 0.003 px on ordinary edges.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Scatter {
    /// Equally in all directions: first-order distances are unbiased.
    #[default]
    Isotropic,
    /// Across the edge only, like the sub-pixel step of an edge detector along the gradient: orthogonal distances are
    /// unbiased.
    Across,
}

/// An ellipse in an image or in a plane: centre, semi-axes `a >= b > 0`, direction of `a` in `[0, pi)` from x towards
/// y.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ellipse2 {
    /// Centre.
    pub centre: Vector2<f64>,
    /// Semi-major axis.
    pub a: f64,
    /// Semi-minor axis.
    pub b: f64,
    /// Direction of the major axis, radians.
    pub theta: f64,
}
