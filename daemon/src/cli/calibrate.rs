//! `graspd calibrate`: calibrates the rig or the gripper, records the data for it, and checks a stored calibration.

use super::answer::finish;
use crate::exit::{Exit, Failure};
use clap::{Args, Subcommand};
use graspd_calib::commands::calibrate as command;
use graspd_calib::files::keep_apart;
use std::path::PathBuf;

/// Calibration subcommands.
#[derive(Debug, Subcommand)]
pub enum CalibrateCommand {
    /// Calibrate the stereo rig from image pairs of a target that is moved by hand
    Rig(Box<CalibrateRigArgs>),
    /// Calibrate the gripper from a recording: marks, mounting and the rig's pose; does not move the arm
    Gripper(super::calibrate_gripper::CalibrateGripperArgs),
    /// Record marks and joints from a running daemon whenever the arm is at rest; does not move the arm
    Record(super::calibrate_gripper::CalibrateRecordArgs),
    /// Check from a few image pairs of the target whether a stored rig calibration is still valid
    Check(CalibrateCheckArgs),
}

/// Image pairs of a target; shared by the subcommands that read images.
#[derive(Debug, Args)]
pub struct PairArgs {
    /// Images of the left camera: a quoted glob pattern ("left*.png") or a folder; sorted by name
    #[arg(long, value_name = "GLOB")]
    pub left: String,
    /// Images of the right camera: the same number, in the same order
    #[arg(long, value_name = "GLOB")]
    pub right: String,
    /// Target, lengths in metres: chessboard:COLSxROWS:SQUARE (inner corners),
    /// charuco:COLSxROWS:SQUARE:MARKER:DICTIONARY (squares), circles:COLSxROWS:SPACING:DIAMETER
    #[arg(long, value_name = "TARGET")]
    pub target: String,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// `graspd calibrate rig`.
#[derive(Debug, Args)]
pub struct CalibrateRigArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub pairs: PairArgs,
    /// Output file for the rig
    #[arg(long, value_name = "rig.toml")]
    pub out: Option<PathBuf>,
    /// Output file for a one-page HTML report
    #[arg(long, value_name = "rig.html")]
    pub report: Option<PathBuf>,
    /// Output file for the detected target points (JSON)
    #[arg(long, value_name = "FILE.json")]
    pub corners: Option<PathBuf>,
    /// Lens model: brown (k1 k2 p1 p2 k3) or rational (also k4 k5 k6)
    #[arg(long, value_name = "MODEL", default_value = "brown", value_parser = ["brown", "rational"])]
    pub lens: String,
    /// Distances of the task's marks from the left camera, NEAR,FAR in metres [default: the distances of the target in
    /// the images]
    #[arg(long, value_name = "NEAR,FAR")]
    pub volume: Option<String>,
    /// Position error of a mark that the task tolerates, millimetres
    #[arg(long, value_name = "MM", default_value_t = 2.0)]
    pub tolerance_mm: f64,
}

/// `graspd calibrate check`.
#[derive(Debug, Args)]
pub struct CalibrateCheckArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub pairs: PairArgs,
    /// Stored calibration
    #[arg(long, value_name = "rig.toml")]
    pub rig: PathBuf,
}

/// Runs a subcommand.
///
/// # Errors
/// Usage error (2), invalid images or files (3), a calibration that fails or is no longer valid (1).
pub fn calibrate(command: &CalibrateCommand) -> Result<Exit, Failure> {
    match command {
        CalibrateCommand::Rig(args) => rig(args),
        CalibrateCommand::Gripper(args) => super::calibrate_gripper::gripper(args),
        CalibrateCommand::Record(args) => super::calibrate_gripper::record(args),
        CalibrateCommand::Check(args) => check(args),
    }
}

fn rig(args: &CalibrateRigArgs) -> Result<Exit, Failure> {
    let outputs =
        [("--out", args.out.as_deref()), ("--report", args.report.as_deref()), ("--corners", args.corners.as_deref())];
    keep_apart(&outputs, &[]).map_err(|message| Failure { exit: Exit::Usage, message })?;
    let outcome = command::calibrate_rig(&command::RigRequest {
        left: args.pairs.left.clone(),
        right: args.pairs.right.clone(),
        target: args.pairs.target.clone(),
        rational: args.lens == "rational",
        volume: args.volume.clone(),
        tolerance_mm: args.tolerance_mm,
        out: args.out.clone(),
        report: args.report.clone(),
        corners: args.corners.clone(),
    });
    finish(args.pairs.json, outcome)
}

fn check(args: &CalibrateCheckArgs) -> Result<Exit, Failure> {
    let outcome = command::check_rig(&command::CheckRequest {
        left: args.pairs.left.clone(),
        right: args.pairs.right.clone(),
        target: args.pairs.target.clone(),
        rig: args.rig.clone(),
    });
    finish(args.pairs.json, outcome)
}
