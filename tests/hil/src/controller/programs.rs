//! The programs that a controller holds, and the outcome of an upload.

use crate::urscript::Machine;

/// Secondary programs (`sec`) that may run at a time; further ones are refused.
pub(super) const MAX_SECONDARY: usize = 8;

/// The main program and those beside it.
#[derive(Default)]
pub(super) struct Programs {
    pub(super) main: Option<Machine>,
    /// Whether the main program is under way; false as soon as it is ended, even from inside its own step.
    pub(super) active: bool,
    pub(super) secondary: Vec<Machine>,
    /// Name and text of the program that `play` starts.
    pub(super) loaded: Option<(String, String)>,
}

/// What became of a text sent to ports 30001 to 30003.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Upload {
    /// It replaces the main program.
    Main,
    /// It runs beside the main program.
    Secondary,
    /// Refused, with the reason that the robot shows.
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
