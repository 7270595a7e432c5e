//! The programs that a controller holds, and the outcome of an upload.

use crate::urscript::Machine;

/// Secondary programs (`sec`) that may run at a time; further ones are refused.
pub(super) const MAX_SECONDARY: usize = 8;

/// The main program and the secondary programs.
#[derive(Default)]
pub(super) struct Programs {
    pub(super) main: Option<Machine>,
    /// Whether the main program is active; false as soon as it is ended, even from within its own step.
    pub(super) active: bool,
    pub(super) secondary: Vec<Machine>,
    /// Name and text of the program started by `play`.
    pub(super) loaded: Option<(String, String)>,
}

/// Outcome of a text sent to ports 30001 to 30003.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Upload {
    /// It replaced the main program.
    Main,
    /// It runs as a secondary program.
    Secondary,
    /// Refused, with the reason.
    Refused(String),
}

impl Upload {
    /// An error with the reason for a refused text.
    pub(super) fn accepted(self) -> Result<(), String> {
        match self {
            Upload::Main | Upload::Secondary => Ok(()),
            Upload::Refused(reason) => Err(reason),
        }
    }
}
