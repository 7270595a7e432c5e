//! Output and exit code of the off-line commands.

use crate::exit::{Exit, Failure};
use graspd_calib::commands::{Class, Outcome};
use std::io::Write;

/// Prints the outcome and maps its class to an exit code. A closed pipe (`| head`) is not an error: the files are
/// written by then.
pub(super) fn finish(json: bool, outcome: Outcome) -> Result<Exit, Failure> {
    if json {
        let _ = writeln!(std::io::stdout(), "{}", outcome.json);
    } else if outcome.class == Class::Done {
        let _ = writeln!(std::io::stdout(), "{}", outcome.text);
    }
    let exit = match outcome.class {
        Class::Done => return Ok(Exit::Done),
        Class::Refused => Exit::NotConverged,
        Class::Usage => Exit::Usage,
        Class::Input => Exit::Input,
    };
    Err(Failure { exit, message: outcome.text })
}
