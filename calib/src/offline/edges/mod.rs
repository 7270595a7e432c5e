//! Sub-pixel edge points: Gaussian gradient, non-maximum suppression, and an exact step to the edge for the points
//! that are kept.
//!
//! Detection ([`EdgeMap`]) is Canny's with Devernay's parabola (INRIA RR-2724). It is accurate to about 0.1 px and
//! only finds contours. The geometry uses [`refine()`]: the zero of the second derivative along the edge's normal,
//! with the Gaussian derivatives evaluated at the sub-pixel position instead of interpolated between pixels. This
//! leaves no pattern of the pixel grid (below 0.01 px, tested). The standard deviation follows from the pixel noise
//! and the third derivative. The bias on a curved edge, `w^2 / (2 R)` towards the inside for an edge of width `w`
//! (Mendonca), is removed by [`Refined::straightened`] once the curvature is known. Edges that overlap their
//! neighbours are located by `separate`.

pub mod arcs;
mod gradient;
pub mod grey_image;
pub mod lens;
mod map;
mod refine;
pub(in crate::offline) mod separate;
pub(in crate::offline) mod slope;
mod steps;

pub use gradient::SCALE;
pub use map::{Edge, EdgeMap};
pub use refine::{Refined, refine};
