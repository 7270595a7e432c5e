//! Input and output of one cycle of the command thread.

use super::grip::Grip;
use crate::arm::{ArmCommand, Joints, RobotState};
use crate::geom::{Pose, Twist};
use crate::guard::Held;
use crate::mode::{FaultCause, HoldCause, ModeName, Reject};
use crate::online::Vision;
use crate::setpoint::SetPoint;

/// State of the link to the robot in this cycle, from the code that owns the link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkStatus {
    /// Connected, recipes set up, control script started.
    pub connected: bool,
    /// Token of the control script's instance; 0 leaves the echoed token unchecked.
    pub token: i32,
    /// Consecutive set-points that could not be sent.
    pub blocked_sends: u32,
    /// State packages received in this session; wraps.
    pub states: u32,
    /// State packages that the controller left out, by its own clock; wraps.
    pub states_missing: u32,
}

/// An operator's request.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RequestKind {
    /// Allow `Servo`; moves nothing.
    Arm,
    /// Withdraw `Arm`.
    Disarm,
    /// Start the motion to the set-point.
    Servo,
    /// Ramp down; never refused.
    Stop,
    /// Clear a latched fault; moves nothing.
    Reset,
    /// Close or open the gripper; only at rest or converged.
    Gripper {
        /// `true` to close, `false` to open.
        close: bool,
    },
    /// Close the gripper and turn the valve about its axis by an angle (rad, right-handed about the normal towards the
    /// cameras).
    Turn {
        /// The angle, rad.
        angle_rad: f64,
    },
    /// Open the gripper and move back to the standoff.
    Retreat,
    /// The operator's lease expired: hold.
    LeaseLost,
}

/// A request with the number that its reply carries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommandRequest {
    /// Chosen by the caller.
    pub id: u64,
    /// The request.
    pub kind: RequestKind,
}

/// The reply to a request, in the same cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply {
    /// The request's number.
    pub id: u64,
    /// Granted, or the reason why not.
    pub result: Result<(), Reject>,
}

/// Input of one cycle.
#[derive(Clone, Copy, Debug)]
pub struct CommandInput<'a> {
    /// Now, CLOCK_MONOTONIC ns.
    pub now_ns: u64,
    /// The newest robot state received since the last cycle, if any.
    pub robot: Option<RobotState>,
    /// The link.
    pub link: LinkStatus,
    /// The newest vision result since the last cycle, if any.
    pub vision: Option<&'a Vision>,
    /// At most one request; the caller passes a stop before all others.
    pub request: Option<CommandRequest>,
    /// A set-point from the operator.
    pub setpoint: Option<&'a SetPoint>,
    /// A thread of the daemon ended or a defect was caught: stop.
    pub internal_fault: bool,
}

/// Part of the task that the gripper is moving through.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Stage {
    /// To the standoff pose (pre-grasp).
    #[default]
    Pregrasp = 0,
    /// From the standoff to the grasp.
    Grasp = 1,
    /// Turning the valve.
    Turn = 2,
    /// Back to the standoff.
    Retreat = 3,
}

/// A change of mode, for the log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// The mode before.
    pub from: ModeName,
    /// The mode after.
    pub to: ModeName,
    /// The cause.
    pub why: Why,
}

/// Why a mode changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Why {
    /// Marks and robot became ready, or are no longer.
    Readiness,
    /// An operator's request.
    Request(RequestKind),
    /// The goal was reached or left.
    Progress,
    /// The stop ramp has ended at rest.
    AtRest,
    /// A hold.
    Hold(HoldCause),
    /// A fault.
    Fault(FaultCause),
}

/// Counters since start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Cycles run.
    pub cycles: u64,
    /// Cycles missed.
    pub overruns: u64,
    /// Vision results used.
    pub frames: u64,
    /// Vision results refused (time stamps, order, skew, jumps, values that are not finite).
    pub frames_refused: u64,
    /// Robot states used.
    pub states: u64,
    /// Cycles in which the guard held the motion back.
    pub held: u64,
}

/// State and figures of one cycle: for telemetry, recordings and the fault dump.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CycleRecord {
    /// Time of the cycle, CLOCK_MONOTONIC ns.
    pub now_ns: u64,
    /// Time since the last cycle, ns.
    pub dt_ns: u64,
    /// Mode after the cycle.
    pub mode: ModeName,
    /// While the arm is not driven: the fault of the robot; in mode fault, the fault that would remain after a reset.
    pub lasting: Option<FaultCause>,
    /// Part of the task.
    pub stage: Stage,
    /// Whether the motion is in its slow probe.
    pub probing: bool,
    /// Progress along the current leg, 0 to 1.
    pub progress: f64,
    /// Sequence number of the image in use.
    pub vision_sequence: u64,
    /// Age of that image, ns; `u64::MAX` when there is none.
    pub vision_age_ns: u64,
    /// Age of robot state, ns; `u64::MAX` when there is none.
    pub state_age_ns: u64,
    /// Measured joint positions, rad.
    pub q: Joints,
    /// Measured joint velocities, rad/s.
    pub qd: Joints,
    /// Gripper pose in the rig now, predicted; `None` before the marks were seen.
    pub left_from_gripper: Option<Pose>,
    /// State of the gripper by its outputs.
    pub grip: Grip,
    /// Reference pose of the gripper in the rig, `left_from_gripper`.
    pub reference: Pose,
    /// Distance of the marks from the reference, pixels rms per coordinate; NaN while the law does not drive.
    pub error_px: f64,
    /// Part of `error_px` that no motion can remove, pixels: noise and calibration error; NaN while the law does not
    /// drive.
    pub residual_px: f64,
    /// Motion that would bring the marks onto the reference, gripper frame `[v; ω]` (m, rad).
    pub correction: Twist,
    /// Velocity screw that the law asks for, gripper frame `[v; ω]` (m/s, rad/s).
    pub screw: Twist,
    /// Joint rates before the guard, rad/s.
    pub wanted: Joints,
    /// The command that is sent.
    pub command: ArmCommand,
    /// Limits that held it back.
    pub held: Held,
    /// Fraction of the full speed in force (age of data, marks, singularity, guard), 0 to 1.
    pub scale: f64,
    /// Smallest singular value of the stacked interaction matrices, px/m; NaN while the law does not drive, as the next
    /// two.
    pub mark_sigma: f64,
    /// Condition number of the stacked interaction matrices.
    pub mark_condition: f64,
    /// Smallest singular value of the arm's Jacobian (unit-scaled), m/s per rad/s.
    pub arm_sigma: f64,
    /// Joint to move away from the nearest singularity, 0 to 5.
    pub arm_joint: u8,
    /// Counters since start.
    pub counters: Counters,
    /// Identity of the set-point; 0 without one.
    pub setpoint_id: u64,
}

/// Output of one cycle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommandOutput {
    /// For the arm.
    pub command: ArmCommand,
    /// For telemetry and recordings.
    pub record: CycleRecord,
    /// The first change of mode in this cycle.
    pub event: Option<Transition>,
    /// Reply to the request.
    pub reply: Option<Reply>,
    /// Whether the set-point was accepted.
    pub setpoint_reply: Option<Result<(), Reject>>,
}
