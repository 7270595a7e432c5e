//! Motion commands, and the reasons for which the controller itself stops the arm.

use super::Joints;

/// Largest acceleration of a joint target, rad/s^2: the largest that Universal Robots' own control script requests.
pub(super) const MAX_TARGET_ACCEL: f64 = 40.0;
/// Deceleration of the leading joint in a stop by the safety system, rad/s^2.
pub(super) const SAFETY_DECEL: f64 = 20.0;
/// Largest linear (m/s^2) and angular (rad/s^2) acceleration of the tool in `speedl` and `stopl`.
pub(super) const MAX_TOOL_ACCEL: f64 = 150.0;
/// Fraction of the joint speed limits that is left in reduced mode.
pub(super) const REDUCED_SPEED_FRACTION: f64 = 0.5;

/// A motion command, with the arguments of the URScript call of the same name.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    /// `speedj`: reach and KEEP these joint speeds until another motion; the leading axis accelerates at `accel`.
    SpeedJ {
        /// Joint speeds, rad/s.
        qd: Joints,
        /// Acceleration of the leading axis, rad/s^2.
        accel: f64,
    },
    /// `speedl`: reach and keep this tool velocity (linear then angular, base frame).
    SpeedL {
        /// m/s and rad/s.
        twist: [f64; 6],
        /// Linear acceleration, m/s^2.
        accel: f64,
        /// Angular acceleration, rad/s^2.
        rot_accel: f64,
    },
    /// `servoj`: follow a joint position with a delay of about `lookahead`.
    Servo {
        /// Joint positions, rad.
        q: Joints,
        /// Smoothing time, s.
        lookahead: f64,
        /// Proportional gain; URScript's default is 300.
        gain: f64,
    },
    /// `movej`: move to joint positions, linearly in joint space.
    MoveJ {
        /// Joint positions, rad.
        q: Joints,
        /// rad/s^2.
        accel: f64,
        /// rad/s.
        speed: f64,
        /// Duration, s; 0 if the speed determines it.
        duration: f64,
    },
    /// `movel` and `movep`: move the tool to a pose (x, y, z, rotation vector) along a straight line.
    MoveL {
        /// Tool pose in the base frame.
        pose: [f64; 6],
        /// m/s^2.
        accel: f64,
        /// m/s.
        speed: f64,
        /// Duration, s; 0 if the speed determines it.
        duration: f64,
    },
    /// `movec`: move the tool along the circle through `via`.
    MoveC {
        /// A pose on the circle; only its position is used.
        via: [f64; 6],
        /// Tool pose at the end, base frame.
        pose: [f64; 6],
        /// m/s^2.
        accel: f64,
        /// m/s.
        speed: f64,
    },
    /// `stopj`: decelerate the joints to rest.
    StopJ {
        /// rad/s^2.
        decel: f64,
    },
    /// `stopl`: decelerate the tool to rest along its direction.
    StopL {
        /// m/s^2.
        decel: f64,
        /// rad/s^2.
        rot_decel: f64,
    },
}

/// Why the controller itself stops the arm.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum StopCause {
    /// A joint target exceeds the speed limit.
    #[error("joint {joint}: target speed {speed:.3} rad/s exceeds the limit of {limit:.3} rad/s")]
    JointSpeed {
        /// 0 is the base.
        joint: usize,
        /// rad/s.
        speed: f64,
        /// rad/s.
        limit: f64,
    },
    /// A joint could not stop before its position limit.
    #[error("joint {joint}: position {position:.4} rad is too close to its limit")]
    JointPosition {
        /// 0 is the base.
        joint: usize,
        /// rad.
        position: f64,
    },
    /// A joint deviates too far from its target.
    #[error("joint {joint}: position deviates from its target by {deviation:.4} rad")]
    PathDeviation {
        /// 0 is the base.
        joint: usize,
        /// rad.
        deviation: f64,
    },
    /// A tool path leaves the workspace of the arm.
    #[error("the path to the target pose has a point without inverse kinematics solution")]
    Unreachable,
}
