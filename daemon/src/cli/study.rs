//! `graspd study`: Monte Carlo over the accuracy study's scenes.

use super::args::StudyArgs;
use crate::exit::{Exit, Failure};

/// Runs it and prints the table.
///
/// # Errors
/// Usage.
pub fn study(args: &StudyArgs) -> Result<Exit, Failure> {
    if args.trials == 0 || args.trials > 1_000_000 {
        return Err(Failure { exit: Exit::Usage, message: format!("--trials {}: give 1 to 1000000", args.trials) });
    }
    let table = graspd_calib::montecarlo::table(args.trials, args.seed, |cell| eprintln!("{cell}"));
    print!("{table}");
    Ok(Exit::Done)
}
