//! `graspd study`: Monte Carlo simulation of the accuracy study.

use super::args::StudyArgs;
use crate::exit::{Exit, Failure};

/// Runs the study and prints its table.
///
/// # Errors
/// Usage.
pub fn study(args: &StudyArgs) -> Result<Exit, Failure> {
    if args.trials == 0 || args.trials > 1_000_000 {
        return Err(Failure { exit: Exit::Usage, message: format!("--trials {}: give 1 to 1000000", args.trials) });
    }
    let all = graspd_calib::commands::study::cells();
    let cells: Vec<_> = match &args.cell {
        Some(name) => all.iter().filter(|c| c.name.contains(name.as_str())).copied().collect(),
        None => all.clone(),
    };
    if cells.is_empty() {
        let names: Vec<&str> = all.iter().map(|c| c.name).collect();
        let pattern = args.cell.as_deref().unwrap_or_default();
        return Err(Failure {
            exit: Exit::Usage,
            message: format!("--cell {pattern}: no such cell; the cells are {}", names.join("; ")),
        });
    }
    let table = graspd_calib::commands::study::table(&cells, args.trials, args.seed, |cell| eprintln!("{cell}"));
    print!("{table}");
    Ok(Exit::Done)
}
