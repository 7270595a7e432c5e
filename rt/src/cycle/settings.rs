//! All settings of the command cycle, with their defaults and reasons.

use crate::arm::{Dh, Model};
use crate::geom::Rig;
use crate::gripper::Gripper;
use crate::guard::LimitSettings;
use crate::online::path::PathSettings;
use crate::online::rates::RateSettings;
use crate::online::screw::LawSettings;

/// Tolerances within which the gripper is on a goal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConvergeSettings {
    /// Largest filtered correction, metres. Default 0.0003.
    pub position_m: f64,
    /// Largest filtered correction, rad. Default 0.002 (0.11 degrees).
    pub angle_rad: f64,
    /// Factor by which both tolerances may open where the noise of the marks requires it. Default 5.
    pub noise_factor: f64,
    /// Largest mark error, pixels rms: protects against a plan of another rig. Default 12.
    pub error_px: f64,
    /// Consecutive images within the tolerance at the grasp. Default 12.
    pub frames: u32,
    /// Factor on the tolerance at the pre-grasp pose. Default 4.
    pub pregrasp_factor: f64,
    /// Consecutive images within that tolerance at the pre-grasp pose. Default 3.
    pub pregrasp_frames: u32,
    /// Factor on the tolerance beyond which a converged gripper has left the goal. Default 6.
    pub leave_factor: f64,
}

impl Default for ConvergeSettings {
    fn default() -> Self {
        Self {
            position_m: 0.0003,
            angle_rad: 0.002,
            noise_factor: 5.0,
            error_px: 12.0,
            frames: 12,
            pregrasp_factor: 4.0,
            pregrasp_frames: 3,
            leave_factor: 6.0,
        }
    }
}

/// Limits of the supervision: what stops the arm, and after how long.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WatchSettings {
    /// Largest age of the robot state, ns. Default 20 ms.
    pub state_age_ns: u64,
    /// Smallest fraction of the controller's states that must arrive, over the last whole second. Default 0.8; with
    /// fewer, the delays are not those that the law is tuned for.
    pub state_share: f64,
    /// Age of the newest image at which the arm is stopped, ns; three frame periods if that is more. Default 100 ms.
    pub frame_age_ns: u64,
    /// Largest difference between the capture stamps of left and right, ns; a quarter of the frame period if that is
    /// less. Default 5 ms.
    pub skew_ns: u64,
    /// Longest time without a change of the echoed heartbeat, ns. Default 50 ms.
    pub echo_ns: u64,
    /// Longest time in which set-points cannot be sent, ns. Default 20 ms.
    pub blocked_ns: u64,
    /// Largest velocity error of a joint against its set-points, rad/s. Default 0.1.
    pub tracking_rad_per_s: f64,
    /// Longest time above `tracking_rad_per_s`, ns. Default 100 ms.
    pub tracking_ns: u64,
    /// Largest position error of a joint against its set-points, rad. Default 0.05.
    pub tracking_rad: f64,
    /// Largest velocity of a joint that is commanded to rest, rad/s. Default 0.02.
    pub uncommanded_rad_per_s: f64,
    /// Longest time above `uncommanded_rad_per_s`, ns. Default 30 ms.
    pub uncommanded_ns: u64,
    /// Allowed difference between the controller's speed of its tool point and the computed one, m/s. Default 0.01:
    /// three times the encoders' speed noise (0.003 rad/s) at one metre of arm.
    pub tool_m_per_s: f64,
    /// Additional allowed difference as a fraction of the faster of the two. Default 0.1: a session begins with
    /// kinematics that are off by 30 mm at most, 6 % of half a metre of arm; a limit of 0.25 m/s is then never exceeded
    /// by more than 0.04 m/s without a fault.
    pub tool_share: f64,
    /// Longest time above that difference, ns. Default 60 ms.
    pub tool_ns: u64,
    /// Time after the last set-point in which a joint may still move, ns. Default 250 ms.
    pub settle_ns: u64,
    /// Disagreement of images and joints between two images from which a result is refused, metres (unit-scaled).
    /// Default 0.012.
    pub jump_m: f64,
    /// Disagreement over six images that counts as a mismatch, metres (unit-scaled); `mismatch_share` of the motion if
    /// that is more. Default 0.005.
    pub mismatch_m: f64,
    /// See `mismatch_m`. Default 0.4.
    pub mismatch_share: f64,
    /// Consecutive images with a mismatch that are a fault. Default 6.
    pub mismatch_frames: u32,
    /// Missed cycles within one to two seconds above which the arm is held; 0 only counts them (a host without
    /// real-time scheduling). Default 5.
    pub overruns_per_s: u32,
    /// Longest time without a cycle, ns. Default 20 ms.
    pub stall_ns: u64,
    /// Time for which images and robot state must have been good before `servo`, ns. Default 200 ms.
    pub good_ns: u64,
    /// Longest time without progress, ns. Default 2 s.
    pub progress_ns: u64,
    /// Fraction of the speed caps during the probe at the start of each motion. Default 0.1.
    pub probe_share: f64,
    /// Commanded motion after which the probe decides, metres (unit-scaled). Default 0.003.
    pub probe_m: f64,
    /// Smallest fraction of the commanded motion that must be seen in the images, and largest fraction of it that may
    /// be seen across its direction. Default 0.4.
    pub probe_agreement: f64,
    /// Motion at which a probe that has not passed is a fault, metres (unit-scaled). Default 0.012.
    pub probe_limit_m: f64,
}

impl Default for WatchSettings {
    fn default() -> Self {
        const MS: u64 = 1_000_000;
        Self {
            state_age_ns: 20 * MS,
            state_share: 0.8,
            frame_age_ns: 100 * MS,
            skew_ns: 5 * MS,
            echo_ns: 50 * MS,
            blocked_ns: 20 * MS,
            tracking_rad_per_s: 0.1,
            tracking_ns: 100 * MS,
            tracking_rad: 0.05,
            uncommanded_rad_per_s: 0.02,
            uncommanded_ns: 30 * MS,
            tool_m_per_s: 0.01,
            tool_share: 0.1,
            tool_ns: 60 * MS,
            settle_ns: 250 * MS,
            jump_m: 0.012,
            mismatch_m: 0.005,
            mismatch_share: 0.4,
            mismatch_frames: 6,
            overruns_per_s: 5,
            stall_ns: 20 * MS,
            good_ns: 200 * MS,
            progress_ns: 2000 * MS,
            probe_share: 0.1,
            probe_m: 0.003,
            probe_agreement: 0.4,
            probe_limit_m: 0.012,
        }
    }
}

impl WatchSettings {
    /// For a host without real-time scheduling: missed cycles are only counted, and robot state, images and the loop
    /// may be twice as late. The robot-side watchdog of 50 ms is unchanged.
    pub fn best_effort() -> Self {
        let d = Self::default();
        Self {
            overruns_per_s: 0,
            stall_ns: 2 * d.stall_ns,
            state_age_ns: 2 * d.state_age_ns,
            // A simulated controller on the same host also leaves some states out.
            state_share: 0.5,
            frame_age_ns: 2 * d.frame_age_ns,
            ..d
        }
    }
}

/// Gripper outputs, and the motions after convergence.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TaskSettings {
    /// Output bits that close the gripper: mask in the upper 16 bits, values in the lower 16; 0 for no output. Default
    /// 0.
    pub close_outputs: u32,
    /// Output bits that open it, likewise. Default 0.
    pub open_outputs: u32,
    /// Duration of closing or opening, ns. Default 800 ms.
    pub grip_ns: u64,
    /// Whether the gripper closes on the grasp without a request. Default false.
    pub close_on_arrival: bool,
    /// Largest angle of one turn, rad. Default 1.6, a little more than a quarter turn.
    pub max_turn_rad: f64,
    /// Fraction of the path's speed for turn and retreat, 0 to 1. Default 0.5.
    pub speed_share: f64,
}

impl Default for TaskSettings {
    fn default() -> Self {
        Self {
            close_outputs: 0,
            open_outputs: 0,
            grip_ns: 800_000_000,
            close_on_arrival: false,
            max_turn_rad: 1.6,
            speed_share: 0.5,
        }
    }
}

/// All settings of the cycle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CycleSettings {
    /// Period of the command thread, ns. Default 2 ms.
    pub period_ns: u64,
    /// Time between images, ns, until it has been measured. Default 16.7 ms.
    pub frame_period_ns: u64,
    /// The law.
    pub law: LawSettings,
    /// The path.
    pub path: PathSettings,
    /// The inversion of the arm's Jacobian.
    pub rates: RateSettings,
    /// The limits.
    pub limits: LimitSettings,
    /// Convergence.
    pub converge: ConvergeSettings,
    /// Supervision.
    pub watch: WatchSettings,
    /// After convergence.
    pub task: TaskSettings,
}

impl Default for CycleSettings {
    fn default() -> Self {
        Self {
            period_ns: 2_000_000,
            frame_period_ns: 16_666_667,
            law: LawSettings::default(),
            path: PathSettings::default(),
            rates: RateSettings::default(),
            limits: LimitSettings::default(),
            converge: ConvergeSettings::default(),
            watch: WatchSettings::default(),
            task: TaskSettings::default(),
        }
    }
}

/// Everything that a cycle is built from. The pose of the rig relative to the robot is not part of it: the loop does
/// not need it.
#[derive(Clone, Debug)]
pub struct CycleConfig {
    /// The arm's model: joint ranges and speeds.
    pub model: Model,
    /// Its kinematics, nominal or calibrated.
    pub dh: Dh,
    /// The cameras.
    pub rig: Rig,
    /// Marks and mounting.
    pub gripper: Gripper,
    /// All settings.
    pub settings: CycleSettings,
}
