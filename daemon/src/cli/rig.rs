//! `graspd rig`: prints the contents of a rig file.

use super::answer::finish;
use crate::exit::{Exit, Failure};
use clap::{Args, Subcommand};
use graspd_calib::commands::calibrate as command;
use std::path::PathBuf;

/// Commands on a rig file.
#[derive(Debug, Subcommand)]
pub enum RigCommand {
    /// Print a calibration: baseline, vergence, fields of view, stated errors
    Show(RigShowArgs),
}

/// `graspd rig show`.
#[derive(Debug, Args)]
pub struct RigShowArgs {
    /// Rig file
    #[arg(value_name = "rig.toml")]
    pub rig: PathBuf,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// Runs a command.
///
/// # Errors
/// The file is invalid or is not a rig file (3).
pub fn rig(command: &RigCommand) -> Result<Exit, Failure> {
    match command {
        RigCommand::Show(a) => finish(a.json, command::show_rig(&a.rig)),
    }
}
