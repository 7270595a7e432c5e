//! `graspd rig`: what a rig file says.

use super::answer::finish;
use crate::exit::{Exit, Failure};
use clap::{Args, Subcommand};
use graspd_calib::calibrate::command;
use std::path::PathBuf;

/// What can be done with a rig file.
#[derive(Debug, Subcommand)]
pub enum RigCommand {
    /// Show a calibration in words: baseline, vergence, angles of view, stated errors
    Show(RigShowArgs),
}

/// `graspd rig show`.
#[derive(Debug, Args)]
pub struct RigShowArgs {
    /// The rig
    #[arg(value_name = "rig.toml")]
    pub rig: PathBuf,
    /// One JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// Runs one of them.
///
/// # Errors
/// A file that is wrong or not what it was taken for (3).
pub fn rig(command: &RigCommand) -> Result<Exit, Failure> {
    match command {
        RigCommand::Show(a) => finish(a.json, command::show_rig(&a.rig)),
    }
}
