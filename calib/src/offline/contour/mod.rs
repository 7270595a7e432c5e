//! A contour: the edge points of one ellipse, gathered through gaps, spokes and occlusions.
//!
//! A seed edge and its arc are tried alone and with every other arc of the image that could lie on the same convex curve with the same brighter side;
//! each trial ellipse is judged by how much of it carries edges of the right direction. The best few are fitted again to the edges they gathered until
//! they stop changing, then the edges in a narrow band are taken by consensus, thinned to independent ones and refined.

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
pub(in crate::offline) use separated::told_apart;
pub use view_edges::ViewEdges;
