//! The off-line stage, one file per step of the paper: from edge points in two views to a rim in space and a grasp on it.

pub mod circle;
pub mod cone;
pub mod conic;
pub mod correspondence;
pub mod eigen;
mod levenberg;
pub mod model;
pub mod pencil;
pub mod plane;
pub mod refusal;
pub mod sampson;
