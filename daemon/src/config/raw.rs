//! graspd.toml as serde reads it: every key with its unit, default and effect. docs/CONFIG.md states the same facts.

use super::names::DEFAULT_CELL;
use serde::Deserialize;
use std::path::PathBuf;

/// The file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawConfig {
    /// Prefix of every shared-memory service, so that several cells share one PC: letters, digits, `-` and `_`.
    #[serde(default = "d_cell")]
    pub(super) cell: String,
    /// Calibration and gripper files.
    pub(super) files: RawFiles,
    /// Shared memory.
    #[serde(default)]
    pub(super) shm: RawShm,
    /// The arm.
    pub(super) arm: RawArm,
    /// The two real-time threads.
    #[serde(default, rename = "loop")]
    pub(super) cycle: RawLoop,
    /// Frames and tracking.
    #[serde(default)]
    pub(super) vision: RawVision,
    /// The control law.
    #[serde(default)]
    pub(super) servo: RawServo,
    /// When the goal counts as reached.
    #[serde(default)]
    pub(super) converged: RawConverged,
    /// Limits of the motion, below the arm's own.
    #[serde(default)]
    pub(super) limits: RawLimits,
    /// The outputs that move the gripper's fingers.
    #[serde(default)]
    pub(super) gripper: RawGripper,
}

/// `[files]`: paths, relative to the folder of graspd.toml.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawFiles {
    /// Rig calibration.
    pub(super) rig: PathBuf,
    /// Gripper model.
    pub(super) gripper: PathBuf,
}

/// `[shm]`
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawShm {
    /// Folder of the discovery files; only the daemon's user may have access. Default: the user's runtime folder.
    pub(super) root: Option<PathBuf>,
}

/// `[arm]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RawArm {
    /// "rtde" (a UR controller, real or mock) or "mock" (an arm inside the daemon, for trials without a robot).
    #[serde(default = "d_link")]
    pub(super) link: String,
    /// The controller's address.
    #[serde(default = "d_address")]
    pub(super) address: String,
    /// Added to every controller port; 0 on a real robot.
    #[serde(default)]
    pub(super) port_offset: u16,
    /// ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e, ur20 or ur30.
    pub(super) model: String,
    /// Source of the arm's Denavit-Hartenberg parameters: "controller", "nominal", or the path of a file.
    #[serde(default = "d_dh")]
    pub(super) kinematics: String,
    /// How motion is commanded: "velocity" (speedj) or "position" (servoj).
    #[serde(default = "d_motion")]
    pub(super) motion: String,
    /// The robot stops by itself when no command came for this long, ms; 20 to 200.
    #[serde(default = "d_watchdog")]
    pub(super) watchdog_ms: f64,
}

/// `[loop]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawLoop {
    /// Rate of the command thread, Hz; 50 to 1000, or 0 for the controller's rate: 500, CB3 125.
    pub(super) rate_hz: f64,
    /// What starts a cycle: "timer", or "robot" (phase-locked to the controller's packages).
    pub(super) clock: String,
    /// SCHED_FIFO priority of the command thread; 0 leaves it under the ordinary scheduler.
    pub(super) command_priority: u8,
    /// SCHED_FIFO priority of the vision thread, lower than the command thread's.
    pub(super) vision_priority: u8,
    /// CPU of the command thread.
    pub(super) command_core: Option<usize>,
    /// CPU of the vision thread.
    pub(super) vision_core: Option<usize>,
    /// Wake this much early and spin to the deadline, us; 0 sleeps to the deadline. At most a fifth of the period.
    pub(super) spin_us: f64,
    /// Refuse to start on a host that refuses priority or locked memory.
    pub(super) require_realtime: bool,
    /// Count missed cycles instead of holding the arm for them, and allow twice the delay before a fault: for a shared
    /// or ordinary host. Always the case without real-time priority.
    pub(super) best_effort: bool,
}

impl Default for RawLoop {
    fn default() -> Self {
        Self {
            rate_hz: 0.0,
            clock: "timer".into(),
            command_priority: 80,
            vision_priority: 70,
            command_core: None,
            vision_core: None,
            spin_us: 0.0,
            require_realtime: false,
            best_effort: false,
        }
    }
}

/// `[vision]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawVision {
    /// Period with which the vision thread polls for a new pair, us.
    pub(super) poll_us: f64,
    /// Expected pairs a second; age limits and gates are multiples of this frame period.
    pub(super) frame_rate_hz: f64,
    /// Maximum time between the exposures of the two views, ms.
    pub(super) max_skew_ms: f64,
    /// Minimum number of marks with which the motion continues, summed over both views: a mark seen in both counts
    /// twice.
    pub(super) min_observations: usize,
}

impl Default for RawVision {
    fn default() -> Self {
        Self { poll_us: 1000.0, frame_rate_hz: 60.0, max_skew_ms: 4.0, min_observations: 8 }
    }
}

/// `[servo]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawServo {
    /// Views that close the loop: stereo, left, right or best.
    pub(super) views: String,
    /// Where the image Jacobian is evaluated: current, desired or mean.
    pub(super) jacobian: String,
    /// Gain far from the goal, 1/s.
    pub(super) gain: f64,
    /// Gain close to the goal, 1/s.
    pub(super) gain_near: f64,
    /// Speed along the path, m/s.
    pub(super) path_speed_m_s: f64,
    /// Turning speed along the path, rad/s.
    pub(super) path_speed_rad_s: f64,
}

impl Default for RawServo {
    fn default() -> Self {
        Self {
            views: "stereo".into(),
            jacobian: "mean".into(),
            gain: 1.0,
            gain_near: 2.5,
            path_speed_m_s: 0.15,
            path_speed_rad_s: 0.35,
        }
    }
}

/// `[converged]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawConverged {
    /// Maximum root mean square image error at which a goal counts as reached, px: detects a plan that was made with
    /// another rig.
    pub(super) error_px: f64,
    /// Distance to the goal by the tracked marks, m.
    pub(super) distance_m: f64,
    /// Angle to the goal by the tracked marks, rad.
    pub(super) angle_rad: f64,
    /// Consecutive stereo pairs that must satisfy these bounds.
    pub(super) frames: u32,
}

impl Default for RawConverged {
    fn default() -> Self {
        Self { error_px: 12.0, distance_m: 0.000_3, angle_rad: 0.002, frames: 12 }
    }
}

/// `[limits]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawLimits {
    /// Maximum joint speed, rad/s, the same for all joints.
    pub(super) joint_speed_rad_s: f64,
    /// Maximum joint acceleration, and the deceleration of every stop, rad/s².
    pub(super) joint_accel_rad_s2: f64,
    /// Maximum joint jerk, rad/s³.
    pub(super) joint_jerk_rad_s3: f64,
    /// Maximum speed of the gripper's origin, m/s.
    pub(super) tcp_speed_m_s: f64,
    /// Distance kept from the arm's joint position limits, rad.
    pub(super) joint_margin_rad: f64,
}

impl Default for RawLimits {
    fn default() -> Self {
        Self {
            joint_speed_rad_s: 0.5,
            joint_accel_rad_s2: 4.0,
            joint_jerk_rad_s3: 800.0,
            tcp_speed_m_s: 0.25,
            joint_margin_rad: 0.1,
        }
    }
}

/// `[gripper]`: outputs by number, 0 to 7 the controller's digital outputs, 8 and 9 the tool's.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RawGripper {
    /// Outputs switched on to close the fingers.
    pub(super) close_set: Vec<u8>,
    /// Outputs switched off to close them.
    pub(super) close_clear: Vec<u8>,
    /// Outputs switched on to open them.
    pub(super) open_set: Vec<u8>,
    /// Outputs switched off to open them.
    pub(super) open_clear: Vec<u8>,
    /// Time that the fingers take to move, ms.
    pub(super) time_ms: f64,
    /// Close the fingers when the grasp is reached; otherwise only on request (`graspd gripper close`).
    pub(super) close_on_arrival: bool,
}

impl Default for RawGripper {
    fn default() -> Self {
        Self {
            close_set: Vec::new(),
            close_clear: Vec::new(),
            open_set: Vec::new(),
            open_clear: Vec::new(),
            time_ms: 800.0,
            close_on_arrival: false,
        }
    }
}

fn d_cell() -> String {
    DEFAULT_CELL.into()
}
fn d_link() -> String {
    "rtde".into()
}
fn d_address() -> String {
    "127.0.0.1".into()
}
fn d_dh() -> String {
    "controller".into()
}
fn d_motion() -> String {
    "velocity".into()
}
fn d_watchdog() -> f64 {
    50.0
}
