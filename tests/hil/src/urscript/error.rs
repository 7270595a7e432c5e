//! Errors of a script: at upload, at run time, and in the host.

use thiserror::Error;

/// A program that is refused at upload; nothing has run.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("line {line}: {message}")]
pub struct ScriptError {
    /// Line of the uploaded text, from 1.
    pub line: u32,
    /// What is wrong.
    pub message: String,
}

impl ScriptError {
    pub(crate) fn new(line: u32, message: impl Into<String>) -> Self {
        Self { line, message: message.into() }
    }
}

/// A program that failed at run time; the controller stops it and reports a runtime exception.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("runtime exception in line {line}: {message}")]
pub struct RuntimeError {
    /// Line of the uploaded text, from 1.
    pub line: u32,
    /// What is wrong.
    pub message: String,
}

/// An error of the host; it becomes a [`RuntimeError`] at the line of the call.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum HostError {
    /// The host has no function of this name.
    #[error("function '{0}' is not known to this controller")]
    UnknownFunction(String),
    /// The call cannot be executed.
    #[error("{0}")]
    Refused(String),
}
