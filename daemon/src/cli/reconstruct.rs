//! `graspd reconstruct`: circles and ellipses in space from edge points in two views.

use super::args::ReconstructArgs;
use crate::exit::{Exit, Failure};

/// Reconstructs every case of a file.
///
/// # Errors
/// A file that cannot be read, parsed or written. A refused case is not an error: its result has the reason.
pub fn reconstruct(args: &ReconstructArgs) -> Result<Exit, Failure> {
    let (from, to) = (args.cases.display(), args.out.display());
    graspd_calib::files::keep_apart(&[("--out", Some(&args.out))], &[("CASES.json", Some(&args.cases))])
        .map_err(|message| Failure { exit: Exit::Usage, message })?;
    let text = std::fs::read_to_string(&args.cases)
        .map_err(|e| Failure::input(format!("{from}: cannot be read ({e}); give a file of cases (docs/FILES.md)")))?;
    let results = graspd_calib::commands::reconstruct::reconstruct_file(&text)
        .map_err(|e| Failure::input(format!("{from}: {e}")))?;
    std::fs::write(&args.out, results)
        .map_err(|e| Failure::input(format!("{to}: cannot be written ({e}); choose another file with --out")))?;
    Ok(Exit::Done)
}
