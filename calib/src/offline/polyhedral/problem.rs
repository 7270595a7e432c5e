//! What is wrong with the content of a mesh file.

/// The problem, its position in the file, and the fix.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Problem {
    pub(super) reason: String,
    pub(super) fix: String,
}

impl Problem {
    pub(super) fn new(reason: impl Into<String>, fix: impl Into<String>) -> Self {
        Self { reason: reason.into(), fix: fix.into() }
    }
}
