//! Round-bar rims: the fit of a torus to the outer and inner outlines of both views, started from the closed form of
//! the outlines.
//!
//! Both outlines in both views determine a bar as well as a plane circle. The outer outlines alone confuse core and
//! bar radius and tilt the normal: the bar's diameter then has to be known, or the result is refused by its own
//! covariance.
//!
//! [`torus`] is the model, `fit` and `result` reconstruct a bar from points. `search` looks for a bar in the images
//! from one clicked outline per view; `outlines`, `limb`, `settle` and `found` are its steps.

pub(crate) mod fit;
pub(in crate::offline) mod found;
pub(in crate::offline) mod limb;
pub(in crate::offline) mod outlines;
pub(crate) mod result;
pub(in crate::offline) mod search;
pub(in crate::offline) mod settle;
pub mod torus;
