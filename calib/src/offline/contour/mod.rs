//! A contour: the edge points of one ellipse, collected across gaps, spokes and occlusions.
//!
//! A seed edge and its arc are tried alone and together with every other arc of the image that could lie on the same
//! convex curve with the same side brighter ([`ViewEdges::trials`]). Each trial ellipse is scored by the fraction of
//! it that carries edges of the right direction. The best few are fitted again to their own edges until they stop
//! changing. The edges in a narrow band are then selected by consensus, thinned to independent ones and refined.
//!
//! [`select`] turns an operator's selection into candidate contours; `follow` collects edges along a curve that a
//! model predicts.

mod directions;
pub(in crate::offline) mod follow;
mod gather;
mod grow;
mod one_ellipse;
pub(in crate::offline) mod quick_fit;
pub mod select;
mod separated;
mod through;
mod view_edges;

pub(in crate::offline) use one_ellipse::alike;
pub use one_ellipse::{Contour, ContourPoint};
pub(in crate::offline) use separated::separate_pair;
pub use view_edges::ViewEdges;
