//! `graspd calibrate` and `graspd rig` without the command line: options in, files and figures out, every failure in words.

mod rig;

pub use rig::calibrate_rig;

use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// How it went; the daemon's exit codes follow from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// Done (exit code 0).
    Done,
    /// The input is good, but there is no calibration in it, or the stored one no longer holds (exit code 1).
    Refused,
    /// An option makes no sense (exit code 2).
    Usage,
    /// A file or image is wrong (exit code 3).
    Input,
}

/// What to print, and how it went.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// How it went.
    pub answer: Answer,
    /// For people: the figures, or what is wrong and what to do.
    pub text: String,
    /// For machines.
    pub json: Value,
}

/// What `graspd calibrate rig` is asked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RigRequest {
    /// Left images: glob pattern or folder.
    pub left: String,
    /// Right images.
    pub right: String,
    /// Target, as typed.
    pub target: String,
    /// Rational lens model.
    pub rational: bool,
    /// "NEAR,FAR" in metres.
    pub volume: Option<String>,
    /// Error of a mark's place that the task tolerates, millimetres.
    pub tolerance_mm: f64,
    /// Where to write the rig.
    pub out: Option<PathBuf>,
    /// Where to write the report.
    pub report: Option<PathBuf>,
    /// Where to write the points found.
    pub corners: Option<PathBuf>,
}

/// What `graspd calibrate check` is asked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CheckRequest {
    /// Left images: glob pattern or folder.
    pub left: String,
    /// Right images.
    pub right: String,
    /// Target, as typed.
    pub target: String,
    /// The stored calibration.
    pub rig: PathBuf,
}

/// What `graspd rig import` is asked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImportRequest {
    /// The other tool's files.
    pub files: Vec<PathBuf>,
    /// "auto" or a format's name.
    pub format: String,
    /// Unit of the translation.
    pub unit: Option<String>,
    /// "WxH".
    pub size: Option<String>,
    /// Where to write the rig.
    pub out: PathBuf,
}

/// What `graspd rig export` is asked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExportRequest {
    /// The rig.
    pub rig: PathBuf,
    /// A format's name.
    pub format: String,
    /// The file to write.
    pub out: PathBuf,
    /// Largest accepted loss, pixels.
    pub accept_loss_px: f64,
}

/// A failure: how it ended, a word for machines, a sentence for people.
struct Failure(Answer, &'static str, String);

impl From<Failure> for Outcome {
    fn from(Failure(answer, kind, text): Failure) -> Self {
        let json = json!({ "status": "error", "kind": kind, "reason": text });
        Self { answer, text, json }
    }
}

fn usage(text: impl Into<String>) -> Failure {
    Failure(Answer::Usage, "usage", text.into())
}

fn input(text: impl std::fmt::Display) -> Failure {
    Failure(Answer::Input, "input", text.to_string())
}

/// Runs `graspd calibrate check`.
pub fn check_rig(_request: &CheckRequest) -> Outcome {
    usage("calibrate check is not in this build").into()
}

/// Runs `graspd rig import`.
pub fn import_rig(_request: &ImportRequest) -> Outcome {
    usage("rig import is not in this build").into()
}

/// Runs `graspd rig export`.
pub fn export_rig(_request: &ExportRequest) -> Outcome {
    usage("rig export is not in this build").into()
}

/// Runs `graspd rig show`.
pub fn show_rig(_rig: &Path) -> Outcome {
    usage("rig show is not in this build").into()
}
