//! Reasons for which a request is refused.

/// Why a request is refused. A refused request changes nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reject {
    /// Not possible in this mode.
    WrongMode,
    /// No set-point is loaded.
    NoSetPoint,
    /// Marks are not tracked.
    NoMarks,
    /// The robot is not ready: no link, no state, not running, no program.
    RobotNotReady,
    /// The cause of the fault is still present.
    CausePresent,
    /// A set-point cannot change while the arm moves.
    Moving,
    /// The set-point has a value that is not finite, or too few marks.
    BadSetPoint,
    /// The goal or the path to it is out of the arm's reach or joint range.
    OutOfReach,
    /// Too few marks stay in the images along the path.
    PathLeavesView,
    /// Images or robot state have not been good for long enough.
    Settling,
    /// A number in the request is not finite or out of range.
    BadValue,
    /// A camera was moved since the set-point was given.
    CameraMoved,
    /// Both views are configured and one shows too few marks.
    OneView,
    /// The controller leaves out too many of its state packages.
    StatesMissing,
    /// The gripper may hold something: open it before the arm moves away.
    GripperClosed,
}

impl Reject {
    /// The reason as text, with what to do.
    pub const fn reason(self) -> &'static str {
        match self {
            Reject::WrongMode => "not possible in this mode",
            Reject::NoSetPoint => "no set-point is loaded: send a plan first",
            Reject::NoMarks => "the marks are not tracked: check the images and the gripper file",
            Reject::RobotNotReady => "the robot is not ready: power on, release the brakes, start the control script",
            Reject::CausePresent => "the cause of the fault is still present: status shows it",
            Reject::Moving => "the set-point cannot change while the arm moves: stop first",
            Reject::BadSetPoint => "the set-point is incomplete or has too few marks: plan again",
            Reject::OutOfReach => "the goal or the path to it is out of the arm's reach: move the part or the arm",
            Reject::PathLeavesView => {
                "too few marks stay in the images along the path: move the arm closer, or move the rig"
            }
            Reject::Settling => "wait until images and robot state have been good for 200 ms",
            Reject::CameraMoved => {
                "a camera was moved after the set-point was given: check the calibration, take new images and plan again"
            }
            Reject::OneView => {
                "only one view shows the marks: clear the other, or check whether its camera was moved, or set servo.views to one view"
            }
            Reject::GripperClosed => "the gripper is closed, or its outputs do not show that it is open: open it first",
            Reject::StatesMissing => "the controller leaves out too many of its states: check its load and the network",
            Reject::BadValue => "a value of the request is out of range",
        }
    }
}
