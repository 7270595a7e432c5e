//! What keeps a gripper calibration from being made, said so that the reader knows what to change.

/// Why there is no calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GripperError {
    /// The file cannot be opened, or is too large to be a recording.
    #[error("{path}: cannot be read: {reason}; name a file that `graspd calibrate record` wrote, or one of its form")]
    Read {
        /// The file.
        path: String,
        /// What stands in the way.
        reason: String,
    },
    /// The text is no JSON of this form.
    #[error("{path}:{line}:{column}: {problem}; the form is described in docs/CALIBRATION.md, section Gripper")]
    Syntax {
        /// The file.
        path: String,
        /// Line, counted from 1.
        line: usize,
        /// Column, counted from 1.
        column: usize,
        /// What is wrong there.
        problem: String,
    },
    /// A value cannot be what its key says.
    #[error("{path}: `{key}`: {problem}; {fix}")]
    Value {
        /// The file.
        path: String,
        /// The key, with its place.
        key: String,
        /// What is wrong with it.
        problem: String,
        /// What to do.
        fix: String,
    },
    /// There is not enough in the recording to start from.
    #[error("{problem}; {fix}")]
    TooLittle {
        /// What is missing, in figures.
        problem: String,
        /// What to record.
        fix: String,
    },
    /// What was recorded contradicts what was assumed about it.
    #[error("{}", .0.iter().map(|f| f.words.as_str()).collect::<Vec<_>>().join("\n"))]
    Contradiction(Vec<Finding>),
    /// The fit did not come to rest at a minimum.
    #[error("the fit did not converge: {0}; check that images and arm poses belong to each other")]
    NotConverged(String),
}

/// Something about the recording that a person has to know, with its evidence.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// A stable word for programs: `marks-order`, `marks-mirrored`, `marks-unit`, and so on.
    pub code: &'static str,
    /// What was found, the evidence in figures, what to do.
    pub words: String,
    /// How strong: the misfit as given over the misfit of the explanation; 0 where nothing was compared.
    pub strength: f64,
}

impl Finding {
    /// A finding.
    pub fn new(code: &'static str, strength: f64, words: impl Into<String>) -> Self {
        Self { code, words: words.into(), strength }
    }
}
