//! The command line.

use super::client_args::ClientArgs;
use clap::{Args, Parser, Subcommand};
use std::path::PathBuf;

/// Guides a robot gripper onto a curved part with two fixed cameras whose pose relative to the robot is unknown.
#[derive(Debug, Parser)]
#[command(name = "graspd", version, propagate_version = true, max_term_width = 110)]
#[command(
    after_help = "Exit codes: 0 done, 1 not converged or refused, 2 usage, 3 input or configuration, 4 link, 5 fault.\n\
    Try it without a robot: graspd demo"
)]
pub struct Cli {
    /// The subcommand.
    #[command(subcommand)]
    pub command: Command,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the whole chain against a simulated robot and simulated cameras, as separate processes
    Demo(DemoArgs),
    /// Off-line stage: from one click in each image, or a CAD mesh, to a set-point (plan.toml) and an overlay
    Plan(Box<PlanArgs>),
    /// On-line stage: the real-time daemon; frames in, robot commands out
    Run(RunArgs),
    /// Show the state of the daemon
    Status(ClientArgs),
    /// Allow motion to be started; the arm does not move
    Arm(ClientArgs),
    /// Start servoing to the set-point
    Servo(ClientArgs),
    /// Ramp down to rest. Not a safety function: the emergency stop is the robot's own button
    Stop(ClientArgs),
    /// Clear a latched fault once its cause is removed; the arm does not move
    Reset(ClientArgs),
    /// Recover the controller from a protective stop (close popup, unlock, power, brakes, script); ends idle
    Recover(ClientArgs),
    /// Close or open the gripper by its outputs; only at rest or on the grasp
    Gripper(GripperArgs),
    /// Send a plan to the daemon as its set-point
    Setpoint(SetpointArgs),
    /// Reconstruct circles and ellipses from edge points in two views (JSON in, JSON out)
    Reconstruct(ReconstructArgs),
    /// Monte Carlo study of the off-line stage: errors against the Cramer-Rao bound
    Study(StudyArgs),
    /// Time and accuracy of a stage on recorded data
    Bench(BenchArgs),
    /// Check a configuration and every file it names; changes nothing
    Check(RunArgs),
    /// Calibrate from images of a target, or ask whether a stored calibration is still right
    #[command(subcommand)]
    Calibrate(super::calibrate::CalibrateCommand),
    /// What a rig file says, in words
    #[command(subcommand)]
    Rig(super::rig::RigCommand),
    /// The mock UR controller (also a separate program: graspd-mock-ur)
    #[cfg(feature = "demo")]
    #[command(hide = true, disable_help_flag = true)]
    MockUr(PassThrough),
    /// The stereo scene simulator (also a separate program: graspd-scene)
    #[cfg(feature = "demo")]
    #[command(hide = true, disable_help_flag = true)]
    Scene(PassThrough),
}

/// Arguments that are passed on.
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

/// `graspd gripper`.
#[derive(Debug, Args)]
pub struct GripperArgs {
    /// Motion of the fingers
    #[arg(value_name = "MOTION", value_parser = ["close", "open"])]
    pub motion: String,
    #[command(flatten)]
    #[allow(missing_docs)]
    pub client: ClientArgs,
}

/// `graspd setpoint`.
#[derive(Debug, Args)]
pub struct SetpointArgs {
    /// The plan to send
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
    /// Only the cells whose name contains this text
    #[arg(long, value_name = "TEXT")]
    pub cell: Option<String>,
}

/// `graspd bench`.
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// Which stage.
    #[command(subcommand)]
    pub stage: BenchCommand,
}

/// The stages that can be measured.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// The tracker on a recorded stereo sequence with known truth
    Track(BenchTrackArgs),
}

/// `graspd bench track`.
#[derive(Debug, Args)]
pub struct BenchTrackArgs {
    /// Folder of the sequence: scene.json, cameras.csv, marks.csv, poses.csv, goal_pose.csv, truth.csv and the images
    #[arg(value_name = "SEQ")]
    pub sequence: PathBuf,
    /// Only this condition
    #[arg(long, value_name = "NAME")]
    pub condition: Option<String>,
    /// How often the sequence is played, forward and backward in turn
    #[arg(long, default_value_t = 4)]
    pub passes: usize,
    /// Predict each frame by the true motion, as a robot's encoders would; without, by the motion of the frames before
    #[arg(long)]
    pub encoders: bool,
    /// One JSON object for each condition
    #[arg(long)]
    pub json: bool,
}

/// `graspd plan`.
#[derive(Debug, Args)]
pub struct PlanArgs {
    /// Left image (PNG, JPEG, PGM)
    #[arg(long, value_name = "L.png", required_unless_present = "mesh", requires = "right")]
    pub left: Option<PathBuf>,
    /// Right image
    #[arg(long, value_name = "R.png", required_unless_present = "mesh", requires = "left")]
    pub right: Option<PathBuf>,
    /// Rig calibration
    #[arg(long, value_name = "rig.toml")]
    pub rig: PathBuf,
    /// Gripper model
    #[arg(long, value_name = "gripper.toml")]
    pub gripper: PathBuf,
    /// Selection in the left image: one click "U,V", several points "U,V;U,V;...", or a box "U0,V0,U1,V1"
    #[arg(long, value_name = "U,V", allow_hyphen_values = true)]
    pub select_left: Option<String>,
    /// Selection in the right image
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
    /// Bar diameter in metres, if known (round-bar rims)
    #[arg(long, value_name = "M")]
    pub bar_diameter: Option<f64>,
    /// Distance of the pre-grasp pose from the object's plane, metres [default: 0.12, for a mesh 0.08 before the grasp]
    #[arg(long, value_name = "M")]
    pub pregrasp: Option<f64>,
    /// Distance of the grasp pose from the object's plane, metres
    #[arg(long, value_name = "M", default_value_t = 0.0, allow_hyphen_values = true)]
    pub standoff: f64,
    /// Maximum standard deviation of the position, millimetres [default: 2, for a mesh 3]
    #[arg(long, value_name = "MM")]
    pub tolerance_mm: Option<f64>,
    /// Maximum standard deviation of the axis, degrees [default: 1, for a mesh 2]
    #[arg(long, value_name = "DEG")]
    pub tolerance_deg: Option<f64>,
    /// Present pose of the gripper in the left camera's frame: a pose file, or X,Y,Z,RX,RY,RZ (metres, rotation vector
    /// in radians). The plan checks the visibility along the path, and chooses angles that the marks leave open by the
    /// smallest turn
    #[arg(long, value_name = "POSE", allow_hyphen_values = true)]
    pub present: Option<String>,
    /// Maximum turn from the present pose, degrees
    #[arg(long, value_name = "DEG", requires = "present")]
    pub max_turn: Option<f64>,
    /// Standard deviation of the epipolar error of the rig file, pixels [default: the rig file's stated quality]
    #[arg(long, value_name = "PX")]
    pub calibration_px: Option<f64>,
    /// Where to write the plan
    #[arg(long, value_name = "plan.toml")]
    pub out: Option<PathBuf>,
    /// Where to write a drawing of both views with ellipse, normal and predicted gripper
    #[arg(long, value_name = "plan.png")]
    pub overlay: Option<PathBuf>,
    /// Where to write a one-page report
    #[arg(long, value_name = "plan.html")]
    pub report: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    #[allow(missing_docs)]
    pub part: super::mesh_args::MeshArgs,
}

/// `graspd demo`.
#[derive(Debug, Clone, Args)]
pub struct DemoArgs {
    /// Run without progress display and images, and print the result
    #[arg(long)]
    pub headless: bool,
    /// Seed of the world: valve, start pose, rig and noise are drawn from it
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Print one JSON object
    #[arg(long)]
    pub json: bool,
    /// Folder for images, plan and recordings
    #[arg(long, value_name = "DIR", default_value = "graspd-demo")]
    pub out: PathBuf,
    /// Views that close the loop; "best" is the paper's monocular mode: the one view that shows the marks best
    #[arg(long, default_value = "stereo", value_parser = ["stereo", "left", "right", "best"])]
    pub views: String,
    /// Frame rate of the simulated cameras, stereo pairs a second
    #[arg(long, value_name = "HZ", default_value_t = 60.0)]
    pub frame_rate: f64,
    /// Error of the arm's kinematic model: MM,DEG on every link
    #[arg(long, value_name = "MM,DEG")]
    pub kinematics_error: Option<String>,
    /// Error of the rig calibration that both stages use: FOCAL_PERCENT,DEG of relative rotation
    #[arg(long, value_name = "PERCENT,DEG")]
    pub rig_error: Option<String>,
    /// Stop at the pre-grasp pose instead of continuing to the grasp
    #[arg(long)]
    pub pregrasp_only: bool,
    /// Timeout, seconds
    #[arg(long, default_value_t = 60.0)]
    pub timeout: f64,
}
