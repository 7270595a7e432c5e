//! Output and exit code of the calibration commands.

use crate::exit::{Exit, Failure};
use graspd_calib::calibrate::command::{Answer, Outcome};
use std::io::Write;

/// Prints the outcome and maps it to an exit code.
pub(super) fn finish(json: bool, outcome: Outcome) -> Result<Exit, Failure> {
    if json {
        let _ = writeln!(std::io::stdout(), "{}", outcome.json);
    } else if outcome.answer == Answer::Done {
        let _ = writeln!(std::io::stdout(), "{}", outcome.text);
    }
    let exit = match outcome.answer {
        Answer::Done => return Ok(Exit::Done),
        Answer::Refused => Exit::NotConverged,
        Answer::Usage => Exit::Usage,
        Answer::Input => Exit::Input,
    };
    Err(Failure { exit, message: outcome.text })
}
