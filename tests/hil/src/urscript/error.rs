//! What can go wrong with a script: at upload, at run time, and in the host that it calls.

use thiserror::Error;

/// A program that is not URScript: refused at upload, nothing has run.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("line {line}: {message}")]
pub struct ScriptError {
    /// Line of the uploaded text, from 1.
    pub line: u32,
    /// What is wrong and what was expected.
    pub message: String,
}

impl ScriptError {
    pub(crate) fn new(line: u32, message: impl Into<String>) -> Self {
        Self { line, message: message.into() }
    }
}

/// A program that failed while it ran; the controller stops it and shows a runtime exception.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("runtime exception in line {line}: {message}")]
pub struct RuntimeError {
    /// Line of the uploaded text, from 1.
    pub line: u32,
    /// What happened.
    pub message: String,
}

/// A refusal by the host, which becomes a [`RuntimeError`] at the line of the call.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum HostError {
    /// The host has no function of this name.
    #[error("function '{0}' is not known to this controller")]
    UnknownFunction(String),
    /// The function exists; this call of it cannot be carried out.
    #[error("{0}")]
    Refused(String),
}
