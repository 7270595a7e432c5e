//! `graspd calibrate` and `graspd rig` without the command line: options in, files and figures out, every failure in
//! words.

mod check;
mod rig;
mod show;

pub use check::check_rig;
pub use rig::calibrate_rig;
pub use show::show_rig;

use serde_json::{Value, json};
use std::path::PathBuf;

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
