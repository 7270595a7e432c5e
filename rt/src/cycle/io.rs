//! What goes into a cycle of the command cycle and what comes out of it.

use super::grip::Grip;
use crate::arm::{ArmCommand, Joints, RobotState};
use crate::geom::{Pose, Twist};
use crate::guard::Held;
use crate::mode::{FaultCause, HoldCause, ModeName, Reject};
use crate::online::Vision;
use crate::setpoint::SetPoint;

/// The link to the robot as its owner sees it this cycle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkStatus {
    /// Connected, recipes set up, control script started.
    pub connected: bool,
    /// Token given to our script's instance; 0 leaves the echoed token unchecked.
    pub token: i32,
    /// Set-points in a row that could not be sent.
    pub blocked_sends: u32,
    /// State packages of this session that came, and those that the controller left out by its own clock; both wrap.
    pub states: u32,
    /// See `states`.
    pub states_missing: u32,
}

/// What an operator can ask for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RequestKind {
    /// Allow motion to be asked for.
    Arm,
    /// Take that back.
    Disarm,
    /// Go to the set-point.
    Servo,
    /// Ramp down; never refused.
    Stop,
    /// Clear a latched fault; moves nothing.
    Reset,
    /// Close or open the gripper; only at rest or converged.
    Gripper {
        /// Close, or open.
        close: bool,
    },
    /// Close the gripper and turn the valve about its axis by an angle (rad, right-handed about the normal towards the cameras).
    Turn {
        /// The angle, rad.
        angle_rad: f64,
    },
    /// Open the gripper and go back to the standoff.
    Retreat,
    /// The operator's lease ran out: hold.
    LeaseLost,
}

/// A request with the number that its answer carries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommandRequest {
    /// Chosen by who asks.
    pub id: u64,
    /// What for.
    pub kind: RequestKind,
}

/// The answer to a request, in the same cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply {
    /// The request's number.
    pub id: u64,
    /// Done, or why not.
    pub result: Result<(), Reject>,
}

/// Everything one cycle is told.
#[derive(Clone, Copy, Debug)]
pub struct CommandInput<'a> {
    /// Now, CLOCK_MONOTONIC ns.
    pub now_ns: u64,
    /// The newest robot state that came since the last cycle, if one did.
    pub robot: Option<RobotState>,
    /// The link.
    pub link: LinkStatus,
    /// The newest vision result since the last cycle, if there is one.
    pub vision: Option<&'a Vision>,
    /// At most one request; a stop goes before all others.
    pub request: Option<CommandRequest>,
    /// A set-point offered by the operator.
    pub setpoint: Option<&'a SetPoint>,
    /// A thread of the daemon ended or a defect was caught: stop.
    pub internal_fault: bool,
}

/// Which part of the way the gripper is on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Stage {
    /// To the standoff pose.
    #[default]
    Pregrasp = 0,
    /// From there to the grasp.
    Grasp = 1,
    /// Turning the valve.
    Turn = 2,
    /// Back to the standoff.
    Retreat = 3,
}

/// Something that happened in this cycle and belongs in the log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// The mode before.
    pub from: ModeName,
    /// The mode after.
    pub to: ModeName,
    /// Why.
    pub why: Why,
}

/// Why a mode changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Why {
    /// Readiness came or went.
    Readiness,
    /// An operator asked.
    Request(RequestKind),
    /// The goal was reached, or left.
    Progress,
    /// A stop came to rest.
    AtRest,
    /// A hold.
    Hold(HoldCause),
    /// A fault.
    Fault(FaultCause),
}

/// Counts since start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Cycles run.
    pub cycles: u64,
    /// Cycles missed.
    pub overruns: u64,
    /// Vision results used.
    pub frames: u64,
    /// Vision results refused (stamps, order, skew, jumps, not finite).
    pub frames_refused: u64,
    /// Robot states used.
    pub states: u64,
    /// Cycles in which the guard held the motion back.
    pub held: u64,
}

/// What the loop knew and did in one cycle: for telemetry, recordings and the fault dump.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CycleRecord {
    /// When, CLOCK_MONOTONIC ns.
    pub now_ns: u64,
    /// Real time since the last cycle, ns.
    pub dt_ns: u64,
    /// Mode after the cycle.
    pub mode: ModeName,
    /// While the arm is not driven: what is wrong with the robot; in a fault, what still would be after a reset.
    pub lasting: Option<FaultCause>,
    /// Part of the way.
    pub stage: Stage,
    /// Whether the motion is still in its slow probe.
    pub probing: bool,
    /// Progress along the present leg, 0 to 1.
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
    /// Gripper in the rig now, predicted; `None` before the marks were seen.
    pub left_from_gripper: Option<Pose>,
    /// The gripper by its outputs.
    pub grip: Grip,
    /// The reference, in the rig.
    pub reference: Pose,
    /// Mark error against the reference, pixels rms; NaN while the law does not drive.
    pub error_px: f64,
    /// What no motion can remove of it, pixels: at rest the rig's health figure; NaN while the law does not drive.
    pub residual_px: f64,
    /// Motion that would bring the marks onto the reference, gripper frame.
    pub correction: Twist,
    /// Velocity screw asked for, gripper frame.
    pub screw: Twist,
    /// Joint rates before the guard, rad/s.
    pub wanted: Joints,
    /// What is sent.
    pub command: ArmCommand,
    /// What held it back.
    pub held: Held,
    /// Speed share in force (age of data, marks, singularity, guard), 0 to 1.
    pub scale: f64,
    /// Smallest singular value of the mark stack, px/m; NaN while the law does not drive, as the next two.
    pub mark_sigma: f64,
    /// Condition number of the mark stack.
    pub mark_condition: f64,
    /// Smallest singular value of the arm, m/s per rad/s.
    pub arm_sigma: f64,
    /// Joint to bend away, 0 to 5.
    pub arm_joint: u8,
    /// Counts since start.
    pub counters: Counters,
    /// Identity of the set-point, 0 for none.
    pub setpoint_id: u64,
}

/// Everything one cycle says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommandOutput {
    /// What goes to the arm.
    pub command: ArmCommand,
    /// What goes to telemetry.
    pub record: CycleRecord,
    /// A change of mode with its cause.
    pub event: Option<Transition>,
    /// Answer to the request.
    pub reply: Option<Reply>,
    /// Answer to the offered set-point.
    pub setpoint_reply: Option<Result<(), Reject>>,
}
