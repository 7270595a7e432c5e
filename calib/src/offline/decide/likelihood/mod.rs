//! The one likelihood by which every model of every set of contours is fitted, tested and compared.
//!
//! The distance of edge point `i` from the predicted outline is
//!
//! ```text
//! r_i(theta, phi) = e_i + B_i a,    e_i ~ N(0, kappa^2 sigma_i^2),    a ~ N(0, s^2),    phi ~ N(0, I)
//! ```
//!
//! `theta` is the shape, `phi` the unknown error of the rig
//! ([`RigError::modes`](crate::offline::correspondence::rig_error::RigError)), and `B a` the part of the edge error
//! that varies smoothly along a contour (blur, shading, a neighbouring edge), as a short Fourier series for each
//! contour. `kappa` and `s` are estimated with the rest, under a prior. The model is linear at the optimum, so that
//! one normal matrix gives the estimate, the joint covariance of shape and rig, chi-squared and the evidence `p(points
//! | model)` by Laplace's method. Derived in `docs/PAPER.md`, "One likelihood".

mod fit;
mod linear;
mod model;
mod shape;
mod solve;

pub(in crate::offline) use fit::fit;
pub(in crate::offline) use model::{Fitted, Hypothesis, Stretch, corrected};
pub(in crate::offline) use shape::Shape;
