//! Round-bar rims: the fit of a torus to the outer and inner outlines of both views, started from the closed form of the outlines.
//!
//! Both outlines of both views determine everything at the level of a plane circle. The outer outlines alone confuse core and bar radius
//! and tip the normal: then the bar's diameter has to be known, or the result is refused by its own covariance.

pub(crate) mod fit;
pub(in crate::offline) mod found;
pub(in crate::offline) mod limb;
pub(in crate::offline) mod outlines;
pub(crate) mod result;
pub(in crate::offline) mod search;
pub(in crate::offline) mod settle;
pub mod torus;
