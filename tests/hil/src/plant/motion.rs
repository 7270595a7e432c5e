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

/// A motion command, as the URScript call of the same name gives it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    /// `speedj`: reach and KEEP these joint rates (rad/s) until another motion; the leading axis accelerates at `accel`.
    SpeedJ {
        /// Joint rates, rad/s.
        qd: Joints,
        /// Acceleration of the leading axis, rad/s^2.
        accel: f64,
    },
    /// `speedl`: reach and keep this tool velocity (linear then angular, base).
    SpeedL {
        /// m/s and rad/s.
        twist: [f64; 6],
        /// Linear acceleration, m/s^2.
        accel: f64,
        /// Angular acceleration, rad/s^2.
        rot_accel: f64,
    },
    /// `servoj`: follow a joint position with about `lookahead` seconds of delay.
    Servo {
        /// Joint positions, rad.
        q: Joints,
        /// Smoothing time, s.
        lookahead: f64,
        /// Proportional gain; 300 is the default.
        gain: f64,
    },
    /// `movej`: to joint positions, straight in joint space.
    MoveJ {
        /// Joint positions, rad.
        q: Joints,
        /// rad/s^2.
        accel: f64,
        /// rad/s.
        speed: f64,
        /// s; 0 leaves `speed` in charge.
        duration: f64,
    },
    /// `movel` and `movep`: the tool to a pose (x, y, z, rotation vector), straight in space.
    MoveL {
        /// Tool pose in base.
        pose: [f64; 6],
        /// m/s^2.
        accel: f64,
        /// m/s.
        speed: f64,
        /// s; 0 leaves `speed` in charge.
        duration: f64,
    },
    /// `movec`: the tool along the circle through `via`.
    MoveC {
        /// A pose on the way; only its position counts.
        via: [f64; 6],
        /// Tool pose at the end, base.
        pose: [f64; 6],
        /// m/s^2.
        accel: f64,
        /// m/s.
        speed: f64,
    },
    /// `stopj`: joints to rest.
    StopJ {
        /// rad/s^2.
        decel: f64,
    },
    /// `stopl`: tool to rest along its direction.
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
    /// A joint was asked to turn faster than it may.
    #[error("joint {joint} asked to turn at {speed:.3} rad/s, limit {limit:.3}")]
    JointSpeed {
        /// 0 is the base.
        joint: usize,
        /// rad/s.
        speed: f64,
        /// rad/s.
        limit: f64,
    },
    /// A joint is about to run into its end stop.
    #[error("joint {joint} at {position:.4} rad is close to its limit")]
    JointPosition {
        /// 0 is the base.
        joint: usize,
        /// rad.
        position: f64,
    },
    /// A joint does not follow its target.
    #[error("position of joint {joint} deviates from path by {deviation:.4} rad")]
    PathDeviation {
        /// 0 is the base.
        joint: usize,
        /// rad.
        deviation: f64,
    },
    /// A tool path leaves the reach of the arm.
    #[error("no inverse kinematics on the way to the target pose")]
    Unreachable,
}
