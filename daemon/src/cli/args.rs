//! What can be typed.

use clap::{Args, Parser, Subcommand};
use std::path::PathBuf;

/// Guides a robot gripper onto a curved part, with two fixed cameras and no knowledge of where they stand.
#[derive(Debug, Parser)]
#[command(name = "graspd", version, propagate_version = true, max_term_width = 110)]
#[command(
    after_help = "Exit codes: 0 done, 1 not converged or refused, 2 usage, 3 input or configuration, 4 link, 5 fault.\n\
    Try it without a robot: graspd demo"
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the whole chain against a simulated robot and simulated cameras, as separate processes
    Demo(DemoArgs),
    /// Off line: from one click in each picture, or a CAD mesh, to a set-point (plan.toml) and an overlay
    Plan(Box<PlanArgs>),
    /// On line: the real-time daemon; frames in, robot commands out
    Run(RunArgs),
    /// What the daemon is doing
    Status(ClientArgs),
    /// Allow motion to be started; moves nothing
    Arm(ClientArgs),
    /// Start servoing to the set-point
    Servo(ClientArgs),
    /// Ramp down to rest. Not a safety function: the emergency stop is the robot's own button
    Stop(ClientArgs),
    /// Clear a latched fault once its cause is gone; moves nothing
    Reset(ClientArgs),
    /// Walk the controller out of a protective stop (close popup, unlock, power, brakes, script); ends idle
    Recover(ClientArgs),
    /// Close or open the gripper by its outputs; at rest or on the grasp only
    Gripper(GripperArgs),
    /// Offer a plan to the daemon as its set-point
    Setpoint(SetpointArgs),
    /// Reconstruct circles and ellipses from edge points in two views (JSON in, JSON out)
    Reconstruct(ReconstructArgs),
    /// Monte Carlo study of the off-line stage: errors against the Cramer-Rao bound
    Study(StudyArgs),
    /// Check a configuration and every file it names, and touch nothing
    Check(RunArgs),
    /// Calibrate from images of a target, or ask whether a stored calibration is still right
    #[command(subcommand)]
    Calibrate(super::calibrate::CalibrateCommand),
    /// What a rig file says, in words
    #[command(subcommand)]
    Rig(super::rig::RigCommand),
    /// The mock UR controller (also a program of its own: graspd-mock-ur)
    #[cfg(feature = "demo")]
    #[command(hide = true, disable_help_flag = true)]
    MockUr(PassThrough),
    /// The stereo scene simulator (also a program of its own: graspd-scene)
    #[cfg(feature = "demo")]
    #[command(hide = true, disable_help_flag = true)]
    Scene(PassThrough),
}

/// Arguments handed on unread.
#[derive(Debug, Args)]
pub struct PassThrough {
    /// Arguments of the program.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    pub args: Vec<String>,
}

/// `graspd run` and `graspd check`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// The machine's configuration
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
}

/// Verbs sent to a running daemon.
#[derive(Debug, Args)]
pub struct ClientArgs {
    /// The daemon's configuration file: tells which cell and which shared-memory root
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Cell name, where no configuration file is given
    #[arg(long, default_value = "cell")]
    pub cell: String,
    /// Shared-memory root folder, where no configuration file is given
    #[arg(long, value_name = "DIR")]
    pub shm_root: Option<PathBuf>,
    /// One JSON object instead of words
    #[arg(long)]
    pub json: bool,
    /// How long to wait for the daemon, seconds
    #[arg(long, default_value_t = 2.0)]
    pub timeout: f64,
}

/// `graspd gripper`.
#[derive(Debug, Args)]
pub struct GripperArgs {
    /// Which way
    #[arg(value_parser = ["close", "open"])]
    pub way: String,
    #[command(flatten)]
    #[allow(missing_docs)]
    pub client: ClientArgs,
}

/// `graspd setpoint`.
#[derive(Debug, Args)]
pub struct SetpointArgs {
    /// The plan to offer
    #[arg(value_name = "PLAN.toml")]
    pub plan: PathBuf,
    #[command(flatten)]
    #[allow(missing_docs)]
    pub client: ClientArgs,
}

/// `graspd reconstruct`.
#[derive(Debug, Args)]
pub struct ReconstructArgs {
    /// Cases: id, image_size, P_left, P_right, points_left, points_right, sigma_px, and the gripper
    #[arg(value_name = "CASES.json")]
    pub cases: PathBuf,
    /// Where to write the results
    #[arg(long, value_name = "RESULTS.json")]
    pub out: PathBuf,
}

/// `graspd study`.
#[derive(Debug, Args)]
pub struct StudyArgs {
    /// Trials a cell
    #[arg(long, default_value_t = 1000)]
    pub trials: usize,
    /// Seed of the study
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Only the cells whose name holds this text
    #[arg(long, value_name = "TEXT")]
    pub cell: Option<String>,
}

/// `graspd plan`.
#[derive(Debug, Args)]
pub struct PlanArgs {
    /// Left picture (PNG, JPEG, PGM)
    #[arg(long, value_name = "L.png", required_unless_present = "mesh", requires = "right")]
    pub left: Option<PathBuf>,
    /// Right picture
    #[arg(long, value_name = "R.png", required_unless_present = "mesh", requires = "left")]
    pub right: Option<PathBuf>,
    /// Rig calibration
    #[arg(long, value_name = "rig.toml")]
    pub rig: PathBuf,
    /// Gripper model
    #[arg(long, value_name = "gripper.toml")]
    pub gripper: PathBuf,
    /// Selection in the left picture: one click "U,V", several points "U,V;U,V;...", or a box "U0,V0,U1,V1"
    #[arg(long, value_name = "U,V", allow_hyphen_values = true)]
    pub select_left: Option<String>,
    /// Selection in the right picture
    #[arg(long, value_name = "U,V", allow_hyphen_values = true)]
    pub select_right: Option<String>,
    /// Propose ellipses instead of taking a selection, list them and draw them numbered
    #[arg(long, conflicts_with_all = ["select_left", "select_right"])]
    pub auto: bool,
    /// With --auto: plan for this proposal
    #[arg(long, value_name = "N", requires = "auto")]
    pub pick: Option<usize>,
    /// Rim model: auto, edge, circle, ellipse, round-bar
    #[arg(long, default_value = "auto")]
    pub rim: String,
    /// Bar diameter in metres, where the operator knows it (round-bar rims)
    #[arg(long, value_name = "M")]
    pub bar_diameter: Option<f64>,
    /// Distance of the pre-grasp pose from the object's plane, metres [default: 0.12, for a mesh 0.08 before the grasp]
    #[arg(long, value_name = "M")]
    pub pregrasp: Option<f64>,
    /// Distance of the grasp pose from the object's plane, metres
    #[arg(long, value_name = "M", default_value_t = 0.0, allow_hyphen_values = true)]
    pub standoff: f64,
    /// Uncertainty of the place that the task tolerates (one sigma), millimetres [default: 2, for a mesh 3]
    #[arg(long, value_name = "MM")]
    pub tolerance_mm: Option<f64>,
    /// Uncertainty of the axis that the task tolerates (one sigma), degrees [default: 1, for a mesh 2]
    #[arg(long, value_name = "DEG")]
    pub tolerance_deg: Option<f64>,
    /// Where the gripper is now in the left camera's frame: a pose file, or X,Y,Z,RX,RY,RZ (metres, rotation vector in
    /// radians). Checks the path's visibility, and decides angles that the marks leave open by the smallest turn
    #[arg(long, value_name = "POSE", allow_hyphen_values = true)]
    pub present: Option<String>,
    /// Largest turn from the present pose, degrees
    #[arg(long, value_name = "DEG", requires = "present")]
    pub max_turn: Option<f64>,
    /// Epipolar displacement that the rig file may have wrong, pixels (one sigma) [default: the rig file's stated quality]
    #[arg(long, value_name = "PX")]
    pub calibration_px: Option<f64>,
    /// Where to write the plan
    #[arg(long, value_name = "plan.toml")]
    pub out: Option<PathBuf>,
    /// Where to draw both views with ellipse, normal and predicted gripper
    #[arg(long, value_name = "plan.png")]
    pub overlay: Option<PathBuf>,
    /// Where to write a one-page report
    #[arg(long, value_name = "plan.html")]
    pub report: Option<PathBuf>,
    /// One JSON object on standard output
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    #[allow(missing_docs)]
    pub part: super::mesh::MeshArgs,
}

/// `graspd demo`.
#[derive(Debug, Clone, Args)]
pub struct DemoArgs {
    /// No progress, no pictures: run, print the result, end
    #[arg(long)]
    pub headless: bool,
    /// Which world: valve, start, rig and noise are drawn from this number
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// One JSON object on standard output
    #[arg(long)]
    pub json: bool,
    /// Where pictures, plan and recordings go
    #[arg(long, value_name = "DIR", default_value = "graspd-demo")]
    pub out: PathBuf,
    /// Views that close the loop; best is the paper's: the one view that shows the marks best
    #[arg(long, default_value = "stereo", value_parser = ["stereo", "left", "right", "best"])]
    pub views: String,
    /// Stereo pairs a second that the simulated cameras take
    #[arg(long, value_name = "HZ", default_value_t = 60.0)]
    pub frame_rate: f64,
    /// The arm's true kinematics differ from the model: MM,DEG on every link
    #[arg(long, value_name = "MM,DEG")]
    pub kinematics_error: Option<String>,
    /// The rig calibration given to both stages is wrong: FOCAL_PERCENT,DEG of relative rotation
    #[arg(long, value_name = "PERCENT,DEG")]
    pub rig_error: Option<String>,
    /// Stop at the pre-grasp pose instead of going on to the grasp
    #[arg(long)]
    pub pregrasp_only: bool,
    /// Give up after this many seconds
    #[arg(long, default_value_t = 60.0)]
    pub timeout: f64,
}
