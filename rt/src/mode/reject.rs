//! Reasons for which a request is refused.

/// Why a request is refused; nothing changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reject {
    /// Not in this mode.
    WrongMode,
    /// No set-point is loaded.
    NoSetPoint,
    /// Marks are not tracked.
    NoMarks,
    /// The robot is not ready: no link, no state, not running, no program.
    RobotNotReady,
    /// The fault's cause is still there.
    CausePresent,
    /// A set-point cannot change while the arm moves.
    Moving,
    /// The set-point is not made of finite numbers, or shows too few marks.
    BadSetPoint,
    /// The goal, or the way to it, is out of the arm's reach or range.
    OutOfReach,
    /// Too few marks stay in the images on the way.
    PathLeavesView,
    /// Data has not been good for long enough since the hold.
    Settling,
    /// A number in the request is not finite or out of range.
    BadValue,
    /// A camera was moved since the set-point was given.
    CameraMoved,
    /// Both views are to be used and one shows too few marks.
    OneView,
    /// The controller leaves out too many of its states.
    StatesMissing,
    /// The gripper is closed on something: open it before the arm may leave.
    GripperClosed,
}

impl Reject {
    /// In words, with what to do.
    pub const fn reason(self) -> &'static str {
        match self {
            Reject::WrongMode => "not possible in this mode",
            Reject::NoSetPoint => "no set-point is loaded: send a plan first",
            Reject::NoMarks => "the marks are not tracked: check the images and the gripper file",
            Reject::RobotNotReady => "the robot is not ready: power on, release the brakes, start the control script",
            Reject::CausePresent => "the cause of the fault is still there",
            Reject::Moving => "the set-point cannot change while the arm moves: stop first",
            Reject::BadSetPoint => "the set-point is incomplete or shows too few marks",
            Reject::OutOfReach => "the goal or the way to it is out of the arm's reach: move the part or the arm",
            Reject::PathLeavesView => "too few marks stay in the images on the way: move the arm closer or the rig",
            Reject::Settling => "wait until images and robot state have been good for 200 ms",
            Reject::CameraMoved => {
                "a camera was moved since the set-point was given: check the calibration, take new images and plan again"
            }
            Reject::OneView => {
                "only one view shows the marks: clear the other, or check whether its camera was moved; or set views to the one that does"
            }
            Reject::GripperClosed => {
                "the gripper is closed on something, or its outputs do not show that it is open: open it first"
            }
            Reject::StatesMissing => {
                "the controller leaves out too many of its states: look at its load and at the network"
            }
            Reject::BadValue => "a value of the request is out of range",
        }
    }
}
