//! `graspd calibrate`: one subcommand a thing that is calibrated, and one that asks whether a calibration still holds.

use super::answer::finish;
use crate::exit::{Exit, Failure};
use clap::{Args, Subcommand};
use graspd_calib::calibrate::command;
use graspd_calib::files::keep_apart;
use std::path::PathBuf;

/// What can be calibrated.
#[derive(Debug, Subcommand)]
pub enum CalibrateCommand {
    /// The stereo rig, from image pairs of a target that is moved by hand
    Rig(Box<CalibrateRigArgs>),
    /// The gripper at the arm: marks, mounting and the rig's pose, from a recording; moves nothing
    Gripper(super::calibrate_gripper::CalibrateGripperArgs),
    /// Record marks and joints whenever the arm is at rest, from a running daemon; moves nothing
    Record(super::calibrate_gripper::CalibrateRecordArgs),
    /// Is a stored rig calibration still right? From a few image pairs of the target
    Check(CalibrateCheckArgs),
}

/// Image pairs of a target, the same for every subcommand that takes them.
#[derive(Debug, Args)]
pub struct PairArgs {
    /// Images of the left camera: a glob pattern in quotes ("left*.png") or a folder; sorted by name
    #[arg(long, value_name = "GLOB")]
    pub left: String,
    /// Images of the right camera, as many, in the same order
    #[arg(long, value_name = "GLOB")]
    pub right: String,
    /// The target, lengths in metres: chessboard:COLSxROWS:SQUARE (inner corners),
    /// charuco:COLSxROWS:SQUARE:MARKER:DICTIONARY (squares), circles:COLSxROWS:SPACING:DIAMETER
    #[arg(long, value_name = "TARGET")]
    pub target: String,
    /// One JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

/// `graspd calibrate rig`.
#[derive(Debug, Args)]
pub struct CalibrateRigArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub pairs: PairArgs,
    /// Where to write the rig
    #[arg(long, value_name = "rig.toml")]
    pub out: Option<PathBuf>,
    /// Where to write a one-page report
    #[arg(long, value_name = "rig.html")]
    pub report: Option<PathBuf>,
    /// Where to write the target's points as they were found (JSON), for other tools
    #[arg(long, value_name = "FILE.json")]
    pub corners: Option<PathBuf>,
    /// Lens model: brown (k1 k2 p1 p2 k3) or rational (k4 k5 k6 as well)
    #[arg(long, value_name = "MODEL", default_value = "brown", value_parser = ["brown", "rational"])]
    pub lens: String,
    /// Distance from the left camera at which the task's marks will be, NEAR,FAR in metres [default: that of the
    /// target]
    #[arg(long, value_name = "NEAR,FAR")]
    pub volume: Option<String>,
    /// Error of a mark's place that the task tolerates, millimetres
    #[arg(long, value_name = "MM", default_value_t = 2.0)]
    pub tolerance_mm: f64,
}

/// `graspd calibrate check`.
#[derive(Debug, Args)]
pub struct CalibrateCheckArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub pairs: PairArgs,
    /// The stored calibration
    #[arg(long, value_name = "rig.toml")]
    pub rig: PathBuf,
}

/// Runs one of them.
///
/// # Errors
/// Usage (2), images or files that are wrong (3), a calibration that cannot be made or no longer holds (1).
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
