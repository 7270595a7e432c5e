//! Errors and findings of a gripper calibration. Each message states what to change.

/// Why a gripper calibration failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GripperError {
    /// The file cannot be opened, or is too large to be a recording.
    #[error(
        "{path}: cannot be read: {reason}; give a file written by `graspd calibrate record`, or one of the same format"
    )]
    Read {
        /// The file.
        path: String,
        /// Why it cannot be read.
        reason: String,
    },
    /// The text is not a JSON recording.
    #[error("{path}:{line}:{column}: {problem}; the format is described in docs/CALIBRATION.md, section Gripper")]
    Syntax {
        /// The file.
        path: String,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// The syntax error.
        problem: String,
    },
    /// A value is invalid for its key.
    #[error("{path}: `{key}`: {problem}; {fix}")]
    Value {
        /// The file.
        path: String,
        /// The key, with its path in the file.
        key: String,
        /// Why the value is invalid.
        problem: String,
        /// What to do.
        fix: String,
    },
    /// The recording has too few usable rests.
    #[error("{problem}; {fix}")]
    TooLittle {
        /// What is missing, with numbers.
        problem: String,
        /// What to record.
        fix: String,
    },
    /// The recording contradicts an assumption about it.
    #[error("{}", .0.iter().map(|f| f.message.as_str()).collect::<Vec<_>>().join("\n"))]
    Contradiction(Vec<Finding>),
    /// The fit did not converge.
    #[error("the fit did not converge: {0}; check that images and arm poses belong to the same recording")]
    NotConverged(String),
}

/// A problem of the recording, with its evidence.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// Stable machine-readable code: `marks-order`, `marks-mirrored`, `marks-unit`, and others; the list is in
    /// docs/CALIBRATION.md.
    pub code: &'static str,
    /// What was found, the evidence in numbers, and the fix.
    pub message: String,
    /// Strength: misfit as given divided by misfit of the explanation; 0 if there was no comparison.
    pub strength: f64,
}

impl Finding {
    /// Creates a finding.
    pub fn new(code: &'static str, strength: f64, message: impl Into<String>) -> Self {
        Self { code, message: message.into(), strength }
    }
}
