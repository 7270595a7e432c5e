//! The off-line stage, one file per step of the paper: from edge points in two views to a rim in space and a grasp on it.

pub mod circle;
pub mod cone;
pub mod conic;
pub mod correspondence;
pub mod eigen;
pub mod handle;
mod levenberg;
pub mod ml;
pub mod model;
pub mod pencil;
pub mod planar;
pub mod plane;
pub mod reconstruct;
pub mod refusal;
pub mod robust;
pub mod sampson;
pub mod synthetic;
pub mod visibility;
