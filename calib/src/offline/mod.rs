//! The off-line stage, one file per step of the paper: from edge points in two views to a rim in space and a grasp on it.

pub mod arcs;
pub mod circle;
pub mod cone;
pub mod conic;
pub mod contour;
pub mod correspondence;
pub mod edges;
pub mod eigen;
pub mod grasp;
pub mod handle;
pub mod lens;
mod levenberg;
pub mod ml;
pub mod model;
pub mod pencil;
pub mod picture;
pub mod planar;
pub mod plane;
mod quick_fit;
pub mod reconstruct;
pub mod refusal;
pub mod robust;
pub mod sampson;
pub mod select;
pub mod setpoint;
pub mod synthetic;
pub mod visibility;
