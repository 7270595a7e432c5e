//! graspd.toml as typed: every key, its unit, its default and what it does. docs/CONFIG.md is made from these comments' facts.

use serde::Deserialize;
use std::path::PathBuf;

/// The whole file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawConfig {
    /// Prefix of every shared-memory service, so that several cells share one PC: letters, digits, `-` and `_`.
    #[serde(default = "d_cell")]
    pub cell: String,
    /// Files made by other tools.
    pub files: RawFiles,
    /// Shared memory.
    #[serde(default)]
    pub shm: RawShm,
    /// The arm.
    pub arm: RawArm,
    /// The two real-time threads.
    #[serde(default, rename = "loop")]
    pub cycle: RawLoop,
    /// Frames and tracking.
    #[serde(default)]
    pub vision: RawVision,
    /// The control law.
    #[serde(default)]
    pub servo: RawServo,
    /// When the goal counts as reached.
    #[serde(default)]
    pub converged: RawConverged,
    /// Limits of the motion, below the arm's own.
    #[serde(default)]
    pub limits: RawLimits,
    /// The outputs that move the gripper's fingers.
    #[serde(default)]
    pub gripper: RawGripper,
}

/// `[files]`: paths, relative to the folder of graspd.toml.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawFiles {
    /// Rig calibration.
    pub rig: PathBuf,
    /// Gripper model.
    pub gripper: PathBuf,
}

/// `[shm]`
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawShm {
    /// Folder of the discovery files, owned by the daemon's user and private to it. Default: the user's runtime folder.
    pub root: Option<PathBuf>,
}

/// `[arm]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawArm {
    /// "rtde" (a UR controller, real or mock) or "mock" (an arm inside the daemon, for trying things without any robot).
    #[serde(default = "d_link")]
    pub link: String,
    /// The controller's address.
    #[serde(default = "d_address")]
    pub address: String,
    /// Added to every controller port; 0 on a real robot.
    #[serde(default)]
    pub port_offset: u16,
    /// ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e, ur20 or ur30.
    pub model: String,
    /// Where the arm's own Denavit-Hartenberg parameters come from: "controller", "nominal", or a file's path.
    #[serde(default = "d_dh")]
    pub kinematics: String,
    /// How motion is asked for: "velocity" (speedj) or "position" (servoj).
    #[serde(default = "d_motion")]
    pub motion: String,
    /// The robot stops by itself when it sees no cycle for this long, ms; 20 to 200.
    #[serde(default = "d_watchdog")]
    pub watchdog_ms: f64,
}

/// `[loop]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RawLoop {
    /// Rate of the command thread, Hz; 50 to 1000, or 0 for the controller's own: 500, CB3 125.
    pub rate_hz: f64,
    /// What starts a cycle: "timer", or "robot" (phase-locked to the controller's packages).
    pub clock: String,
    /// SCHED_FIFO priority of the command thread; 0 asks for none.
    pub command_priority: u8,
    /// SCHED_FIFO priority of the vision thread, below the command thread's.
    pub vision_priority: u8,
    /// CPU of the command thread.
    pub command_core: Option<usize>,
    /// CPU of the vision thread.
    pub vision_core: Option<usize>,
    /// Wake this much early and spin to the deadline, us; 0 sleeps to the deadline. At most a fifth of the period.
    pub spin_us: f64,
    /// Refuse to start on a host that does not give priority and locked memory.
    pub require_realtime: bool,
    /// Count missed cycles instead of holding the arm for them, and allow twice the delay before a fault: for a shared or ordinary
    /// host. Without real-time priority it is so in any case.
    pub best_effort: bool,
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
pub struct RawVision {
    /// How often the vision thread looks for a new pair, us.
    pub poll_us: f64,
    /// Expected pairs a second; ages and gates are measured in frames of it.
    pub frame_rate_hz: f64,
    /// Largest difference between the two eyes' exposures, ms.
    pub max_skew_ms: f64,
    /// Fewest marks (over both views, one mark in two views counts twice) that keep the motion going.
    pub min_observations: usize,
}

impl Default for RawVision {
    fn default() -> Self {
        Self { poll_us: 1000.0, frame_rate_hz: 60.0, max_skew_ms: 4.0, min_observations: 8 }
    }
}

/// `[servo]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RawServo {
    /// Which views close the loop: stereo, left, right or best.
    pub views: String,
    /// Where the image Jacobian is taken: current, desired or mean.
    pub jacobian: String,
    /// Gain far from the goal, 1/s.
    pub gain: f64,
    /// Gain close to the goal, 1/s.
    pub gain_near: f64,
    /// Speed along the path, m/s.
    pub path_speed_m_s: f64,
    /// Turning speed along the path, rad/s.
    pub path_speed_rad_s: f64,
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
pub struct RawConverged {
    /// Largest root mean square image error with which a goal may count as reached, px: guards against a plan of another rig.
    pub error_px: f64,
    /// Distance to the goal by the tracked marks, m.
    pub distance_m: f64,
    /// Angle to the goal by the tracked marks, rad.
    pub angle_rad: f64,
    /// Consecutive stereo pairs for which it must hold.
    pub frames: u32,
}

impl Default for RawConverged {
    fn default() -> Self {
        Self { error_px: 12.0, distance_m: 0.000_3, angle_rad: 0.002, frames: 12 }
    }
}

/// `[limits]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RawLimits {
    /// Joint speed, rad/s, one value for all joints.
    pub joint_speed_rad_s: f64,
    /// Joint acceleration, and the deceleration of every stop, rad/s².
    pub joint_accel_rad_s2: f64,
    /// Joint jerk, rad/s³.
    pub joint_jerk_rad_s3: f64,
    /// Speed of the gripper's origin, m/s.
    pub tcp_speed_m_s: f64,
    /// Distance kept from the arm's joint position limits, rad.
    pub joint_margin_rad: f64,
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
pub struct RawGripper {
    /// Outputs switched on to close the fingers.
    pub close_set: Vec<u8>,
    /// Outputs switched off to close them.
    pub close_clear: Vec<u8>,
    /// Outputs switched on to open them.
    pub open_set: Vec<u8>,
    /// Outputs switched off to open them.
    pub open_clear: Vec<u8>,
    /// How long the fingers take, ms.
    pub time_ms: f64,
    /// Close by itself when the grasp is reached; otherwise only when asked (`graspd gripper close`).
    pub close_on_arrival: bool,
}

impl Default for RawGripper {
    fn default() -> Self {
        let none = Vec::new;
        Self {
            close_set: none(),
            close_clear: none(),
            open_set: none(),
            open_clear: none(),
            time_ms: 800.0,
            close_on_arrival: false,
        }
    }
}

fn d_cell() -> String {
    "cell".into()
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
