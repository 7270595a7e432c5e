//! The off-line sub-commands of `graspd`, found by their names: a request with paths and options in; files, figures and
//! text out.
//!
//! The command-line parser and the exit codes are the daemon's. A command reads its files itself, so that every failure
//! is one sentence that names the file, the key or the option.

pub mod calibrate;
pub mod mesh;
pub mod plan;
mod progress;
pub mod reconstruct;
pub mod study;

use crate::files::{FileError, PoseFile};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::UnitQuaternion;
use serde_json::{Value, json};
use std::path::Path;

/// The result class of a command; the daemon maps it to an exit code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// Done (exit code 0).
    Done,
    /// The input is valid, but the tests refuse the rim or the grasp (exit code 1).
    Refused,
    /// An option is invalid (exit code 2).
    Usage,
    /// A file, image or selection is wrong (exit code 3).
    Input,
}

/// What a command prints, and its result class.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// The result class.
    pub class: Class,
    /// Text for people: the figures, or one sentence that says what is wrong and what to do.
    pub text: String,
    /// The same for machines.
    pub json: Value,
}

/// Why a command ends without a result.
struct Failure {
    class: Class,
    /// Value of the JSON key `kind`.
    kind: &'static str,
    /// Value of the JSON key `reason`, and the text.
    reason: String,
}

impl From<Failure> for Outcome {
    fn from(f: Failure) -> Self {
        let json = json!({ "status": "error", "kind": f.kind, "reason": f.reason });
        Self { class: f.class, text: f.reason, json }
    }
}

impl From<FileError> for Failure {
    fn from(e: FileError) -> Self {
        Self { class: Class::Input, kind: "file", reason: e.to_string() }
    }
}

/// An option is missing or invalid.
fn usage(reason: impl Into<String>) -> Failure {
    Failure { class: Class::Usage, kind: "usage", reason: reason.into() }
}

/// A file or a value in it is wrong.
fn input(reason: impl std::fmt::Display) -> Failure {
    Failure { class: Class::Input, kind: "input", reason: reason.to_string() }
}

/// Checks the value of a numeric option against its range; an option that was not given passes.
fn in_range(option: &str, value: Option<f64>, min: f64, max: f64) -> Result<Option<f64>, Failure> {
    match value {
        Some(v) if !(v >= min && v <= max) => {
            Err(usage(format!("--{option} {v}: give a number between {min} and {max}")))
        }
        v => Ok(v),
    }
}

/// Checks an option that counts from 1.
fn counts_from_one(option: &str, value: Option<usize>) -> Result<(), Failure> {
    if value == Some(0) { Err(usage(format!("--{option} 0: counting starts at 1"))) } else { Ok(()) }
}

/// Reads the pose given to an option: six numbers (metres and a rotation vector in radians, as the robot's pendant
/// shows them) or a pose file with the pose called `key`.
///
/// # Errors
/// Names the option or the file, and the accepted forms.
pub fn parse_pose(option: &str, text: &str, key: &'static str) -> Result<Pose, FileError> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|n| n.trim().parse::<f64>().ok().filter(|v| v.is_finite() && v.abs() < 100.0)).collect();
    match numbers.as_deref() {
        Some([x, y, z, a, b, c]) => {
            Ok(Pose::from_parts(Vec3::new(*x, *y, *z).into(), UnitQuaternion::from_scaled_axis(Vec3::new(*a, *b, *c))))
        }
        Some(_) => Err(FileError::Read {
            path: format!("{option} {text}"),
            reason: format!("it has {} numbers, not 6", text.split(',').count()),
            fix: "give X,Y,Z,RX,RY,RZ (metres, rotation vector in radians) or a pose file (docs/FILES.md)".to_owned(),
        }),
        None => PoseFile::load(Path::new(text), key).map(|f| f.pose),
    }
}

/// Writes an overlay or a report; `None` is a drawing that exceeds the largest image.
fn write_bytes(path: &Path, bytes: Option<&[u8]>) -> Result<(), Failure> {
    let error = |reason: String| FileError::Write { path: path.display().to_string(), reason };
    let bytes = bytes.ok_or_else(|| error("the drawing is too large".to_owned()))?;
    Ok(std::fs::write(path, bytes).map_err(|e| error(e.to_string()))?)
}
