//! Every knob of the command cycle, with its default and why.

use crate::arm::{Dh, Model};
use crate::geom::Rig;
use crate::gripper::Gripper;
use crate::guard::LimitSettings;
use crate::online::path::PathSettings;
use crate::online::rates::RateSettings;
use crate::online::screw::LawSettings;

/// When the gripper counts as being on a goal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConvergeSettings {
    /// Filtered correction left, metres. Default 0.0003.
    pub position_m: f64,
    /// Filtered correction left, rad. Default 0.002 (0.11 degrees).
    pub angle_rad: f64,
    /// How much coarser both may become where the marks' noise allows no better. Default 5.
    pub noise_factor: f64,
    /// Greatest mark error, pixels rms: a guard against a plan of another rig. Default 12.
    pub error_px: f64,
    /// Images in a row on the grasp. Default 12.
    pub frames: u32,
    /// How much coarser the pre-grasp pose may be passed. Default 4.
    pub pregrasp_factor: f64,
    /// Images in a row on the pre-grasp pose. Default 3.
    pub pregrasp_frames: u32,
    /// Times the tolerance at which a converged gripper counts as having left. Default 6.
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

/// What is watched, and when it stops the arm. The figures are those of the fault catalogue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WatchSettings {
    /// Greatest age of robot state, ns. Default 20 ms.
    pub state_age_ns: u64,
    /// Least share of the controller's states that must come, over one second to two. Default 0.8, as the fault
    /// catalogue has it; below it every delay that the law is tuned for is another one.
    pub state_share: f64,
    /// Least age of an image at which the arm is stopped, ns; three frame periods if that is more. Default 100 ms.
    pub frame_age_ns: u64,
    /// Greatest difference of the two eyes' stamps, ns; a quarter of the frame period if that is less. Default 5 ms.
    pub skew_ns: u64,
    /// Longest time the echoed heartbeat may stand still, ns. Default 50 ms.
    pub echo_ns: u64,
    /// Longest time set-points may fail to be sent, ns. Default 20 ms.
    pub blocked_ns: u64,
    /// Velocity error of a joint against its set-points, rad/s. Default 0.1.
    pub tracking_rad_per_s: f64,
    /// How long that may last, ns. Default 100 ms.
    pub tracking_ns: u64,
    /// Position error of a joint against its set-points, rad. Default 0.05.
    pub tracking_rad: f64,
    /// Velocity of a joint that was told to rest, rad/s. Default 0.02.
    pub uncommanded_rad_per_s: f64,
    /// How long that may last, ns. Default 30 ms.
    pub uncommanded_ns: u64,
    /// Difference between the controller's speed of its tool point and ours that is always allowed, m/s. Default 0.01:
    /// the encoders' noise in speed (0.003 rad/s) on a metre of arm, three times.
    pub tool_m_per_s: f64,
    /// Share of the faster of the two that is allowed besides. Default 0.1: a session begins with a table that is 30 mm
    /// off at most, which is 6 % of half a metre of arm; a limit of 0.25 m/s is never passed by more than 0.04 m/s
    /// unnoticed.
    pub tool_share: f64,
    /// How long that may last, ns. Default 60 ms.
    pub tool_ns: u64,
    /// How long after the last set-point a joint may still be moving, ns. Default 250 ms.
    pub settle_ns: u64,
    /// Disagreement of images and joints from one image to the next that is refused, metres (unit-scaled). Default 0.012.
    pub jump_m: f64,
    /// Disagreement over six images that counts, metres (unit-scaled); or `mismatch_share` of the motion if that is more. Default 0.005.
    pub mismatch_m: f64,
    /// See `mismatch_m`. Default 0.4.
    pub mismatch_share: f64,
    /// Images in a row with such a disagreement. Default 6.
    pub mismatch_frames: u32,
    /// Missed cycles within a second that hold the arm; 0 only counts them (a host without real-time scheduling). Default 5.
    pub overruns_per_s: u32,
    /// Longest time without a cycle, ns. Default 20 ms.
    pub stall_ns: u64,
    /// How long data must have been good before a held motion may go on, ns. Default 200 ms.
    pub good_ns: u64,
    /// Longest time without progress, ns. Default 2 s.
    pub progress_ns: u64,
    /// Share of the speed caps during the probe at the start of each motion. Default 0.1.
    pub probe_share: f64,
    /// Intended motion after which the probe judges, metres (unit-scaled). Default 0.003.
    pub probe_m: f64,
    /// Share of the intended motion that must be seen in the images, and greatest share seen across it. Default 0.4.
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
    /// For a host without real-time scheduling: missed cycles are counted and hold nothing, and robot state, images and the
    /// loop itself may be twice as late. The robot-side watchdog of 50 ms stays what it is.
    pub fn best_effort() -> Self {
        let d = Self::default();
        Self {
            overruns_per_s: 0,
            stall_ns: 2 * d.stall_ns,
            state_age_ns: 2 * d.state_age_ns,
            // A simulated controller on the same busy host leaves some out as well.
            state_share: 0.5,
            frame_age_ns: 2 * d.frame_age_ns,
            ..d
        }
    }
}

/// What happens at the valve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TaskSettings {
    /// Output bits that close the gripper: mask in the upper 16 bits, values in the lower 16; 0 if there are none. Default 0.
    pub close_outputs: u32,
    /// Output bits that open it. Default 0.
    pub open_outputs: u32,
    /// Time that closing or opening takes, ns. Default 800 ms.
    pub grip_ns: u64,
    /// Close as soon as the gripper is on the grasp, without being asked. Default false.
    pub close_on_arrival: bool,
    /// Greatest angle of one turn, rad. Default 1.6 (a quarter turn and a little).
    pub max_turn_rad: f64,
    /// Speed share of turning and of the retreat, 0 to 1. Default 0.5.
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
    /// The cycle, ns. Default 2 ms.
    pub period_ns: u64,
    /// Expected time between images, ns, until it has been measured. Default 16.7 ms.
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

/// What the cycle is built from. Where the rig stands relative to the robot is not among it.
#[derive(Clone, Debug)]
pub struct CycleConfig {
    /// The arm's model: joint ranges and speeds.
    pub model: Model,
    /// Its kinematics, nominal or the unit's own.
    pub dh: Dh,
    /// The cameras.
    pub rig: Rig,
    /// Marks and mounting.
    pub gripper: Gripper,
    /// Everything else.
    pub settings: CycleSettings,
}
