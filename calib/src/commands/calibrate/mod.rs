//! `graspd calibrate` and `graspd rig`.

mod check;
mod gripper;
mod rig;
mod show;

pub use check::check_rig;
pub use gripper::{GripperRequest, calibrate_gripper};
pub use rig::calibrate_rig;
pub use show::show_rig;

use super::{Class, Failure, Outcome, input, progress, usage};
use std::path::PathBuf;

/// Options of `graspd calibrate rig`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RigRequest {
    /// Left images: glob pattern or folder.
    pub left: String,
    /// Right images.
    pub right: String,
    /// Text of `--target`.
    pub target: String,
    /// Rational lens model.
    pub rational: bool,
    /// "NEAR,FAR" in metres.
    pub volume: Option<String>,
    /// Position error of a mark that the task tolerates, millimetres.
    pub tolerance_mm: f64,
    /// Output file for the rig.
    pub out: Option<PathBuf>,
    /// Output file for the report.
    pub report: Option<PathBuf>,
    /// Output file for the detected points.
    pub corners: Option<PathBuf>,
}

/// Options of `graspd calibrate check`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CheckRequest {
    /// Left images: glob pattern or folder.
    pub left: String,
    /// Right images.
    pub right: String,
    /// Text of `--target`.
    pub target: String,
    /// The stored calibration.
    pub rig: PathBuf,
}
