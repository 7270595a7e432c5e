//! `graspd rig`: rig calibrations in the formats of other tools.

use super::calibrate::finish;
use crate::exit::{Exit, Failure};
use clap::{Args, Subcommand};
use graspd_calib::calibrate::command;
use std::path::PathBuf;

/// What can be done with a rig file.
#[derive(Debug, Subcommand)]
pub enum RigCommand {
    /// Make a rig.toml from another tool's calibration
    Import(RigImportArgs),
    /// Write a rig.toml in another tool's format
    Export(RigExportArgs),
    /// Show a calibration in words: baseline, vergence, angles of view, stated errors
    Show(RigShowArgs),
}

/// `graspd rig import`.
#[derive(Debug, Args)]
pub struct RigImportArgs {
    /// The other tool's file or files: one that holds the pair, or left then right, or intrinsics then extrinsics
    #[arg(value_name = "FILE", required = true, num_args = 1..=3)]
    pub files: Vec<PathBuf>,
    /// Format: auto, opencv, ros, kalibr, mrcal, matlab
    #[arg(long, default_value = "auto")]
    pub format: String,
    /// Unit of the translation where the file does not say it: m, mm, cm, inch
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<String>,
    /// Image size where the file does not say it
    #[arg(long, value_name = "WxH")]
    pub size: Option<String>,
    /// Where to write the rig
    #[arg(long, value_name = "rig.toml")]
    pub out: PathBuf,
    /// One JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// `graspd rig export`.
#[derive(Debug, Args)]
pub struct RigExportArgs {
    /// The rig
    #[arg(value_name = "rig.toml")]
    pub rig: PathBuf,
    /// Format: opencv-yaml, opencv-xml, opencv-json, ros, kalibr, mrcal, matlab
    #[arg(long)]
    pub format: String,
    /// The file to write; formats of one file a camera put -left and -right before the extension
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Largest loss in pixels that is accepted where the format cannot hold the lens model
    #[arg(long, value_name = "PX", default_value_t = 0.0)]
    pub accept_loss_px: f64,
    /// One JSON object on standard output
    #[arg(long)]
    pub json: bool,
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
/// Usage (2), a file that is wrong or not what it was taken for (3), a loss that was not accepted (1).
pub fn rig(command: &RigCommand) -> Result<Exit, Failure> {
    match command {
        RigCommand::Import(a) => finish(
            a.json,
            command::import_rig(&command::ImportRequest {
                files: a.files.clone(),
                format: a.format.clone(),
                unit: a.unit.clone(),
                size: a.size.clone(),
                out: a.out.clone(),
            }),
        ),
        RigCommand::Export(a) => finish(
            a.json,
            command::export_rig(&command::ExportRequest {
                rig: a.rig.clone(),
                format: a.format.clone(),
                out: a.out.clone(),
                accept_loss_px: a.accept_loss_px,
            }),
        ),
        RigCommand::Show(a) => finish(a.json, command::show_rig(&a.rig)),
    }
}
