//! `graspd calibrate` and `graspd rig` without command-line parsing: each function takes the options, writes the files
//! and returns the text, the JSON object and the kind of result.

mod check;
mod rig;
mod show;

pub use check::check_rig;
pub use rig::calibrate_rig;
pub use show::show_rig;

use serde_json::{Value, json};
use std::path::PathBuf;

/// Kind of result; determines the exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// Done (exit code 0).
    Done,
    /// The input is valid, but it does not determine a calibration, or it refutes the stored one (exit code 1).
    Refused,
    /// An option is invalid (exit code 2).
    Usage,
    /// A file or an image is invalid (exit code 3).
    Input,
}

/// Output of a command and the kind of its result.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// Kind of result.
    pub answer: Answer,
    /// Text output: the figures, or the error and its remedy.
    pub text: String,
    /// JSON output.
    pub json: Value,
}

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

/// A failure: kind of result, identifier for the JSON output, message.
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
