//! Causes that stop the loop and latch, with their evidence and stable codes.

/// Why the loop stopped and latched. To clear it, the cause must be gone and an operator must reset.
///
/// The codes are stable: logs, console and manual use them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FaultCause {
    /// F-CAM-01: no usable stereo pair for too long.
    FramesStale {
        /// Age of the newest result's image, ns.
        age_ns: u64,
        /// Largest allowed age, ns.
        limit_ns: u64,
    },
    /// F-CAM-02: capture stamps in the future or far in the past.
    FrameStamps {
        /// Consecutive refused results.
        count: u32,
    },
    /// F-MRK-01: the marks jumped farther than the arm can move.
    MarksJumped {
        /// Length of the jump, metres (unit-scaled).
        jump_m: f64,
        /// Largest possible motion, metres (unit-scaled).
        limit_m: f64,
    },
    /// F-CAM-03: a camera was moved after the set-point was given, so that the plan no longer fits the images.
    CameraMoved {
        /// Error of the gripper's position that this would cause, metres (unit-scaled).
        astray_m: f64,
    },
    /// F-MRK-02: images and joints disagree about the motion (frozen image, wrong camera, loose mounting).
    MotionMismatch {
        /// Motion by the joints over the window, metres (unit-scaled).
        joints_m: f64,
        /// Disagreement, metres (unit-scaled).
        difference_m: f64,
    },
    /// F-LAW-01: the gripper does not move as commanded: a sign, a frame or the mounting is wrong.
    WrongWay {
        /// Fraction of the intended motion that was seen: 1 is right, -1 is the opposite direction.
        agreement: f64,
        /// Motion since the start, metres (unit-scaled).
        moved_m: f64,
    },
    /// F-LAW-02: the law's rates are not finite or above a compiled ceiling: a defect of the program.
    LawBroken {
        /// Cycles with such rates since the last reset.
        cycles: u32,
    },
    /// F-ARM-01: the link to the robot is lost.
    LinkLost,
    /// F-ARM-02: robot state is too old.
    StateStale {
        /// Age, ns.
        age_ns: u64,
        /// Largest allowed age, ns.
        limit_ns: u64,
    },
    /// F-ARM-03: set-points do not arrive: the heartbeat that the control script echoes has stopped.
    EchoStopped {
        /// For how long, ns.
        for_ns: u64,
    },
    /// F-ARM-04: set-points cannot be sent.
    SendBlocked {
        /// Consecutive failed attempts.
        count: u32,
    },
    /// F-ARM-05: protective stop.
    ProtectiveStop,
    /// F-ARM-06: emergency stop.
    EmergencyStop,
    /// F-ARM-07: safeguard stop.
    SafeguardStop,
    /// F-ARM-08: the controller reports a safety violation or fault.
    SafetyFault {
        /// `safety_status_bits`.
        bits: u32,
    },
    /// F-ARM-09: the robot is not in mode running.
    NotRunning {
        /// `robot_mode`.
        mode: i32,
    },
    /// F-ARM-10: the control script was paused or stopped.
    ProgramStopped {
        /// `runtime_state`.
        runtime_state: u32,
    },
    /// F-ARM-11: the control script reports a fault.
    ScriptFault {
        /// Its number (docs/RTDE-REGISTERS.md).
        word: i32,
    },
    /// F-ARM-12: another program commands the robot.
    TokenChanged {
        /// Token of this session.
        expected: i32,
        /// Token that was echoed.
        found: i32,
    },
    /// F-ARM-13: the controller's clock went back: it restarted.
    ClockBack {
        /// Seconds it went back by.
        by_s: f64,
    },
    /// F-ARM-14: the arm does not follow its set-points.
    TrackingError {
        /// The worst joint, 0 to 5.
        joint: u8,
        /// Its velocity error, rad/s.
        velocity: f64,
        /// Its position error, rad.
        position: f64,
    },
    /// F-ARM-15: the arm moves without a command.
    Uncommanded {
        /// The fastest joint, 0 to 5.
        joint: u8,
        /// Its velocity, rad/s.
        velocity: f64,
    },
    /// F-ARM-16: a value of the robot state is NaN, out of range, or jumped.
    StateAbsurd {
        /// The joint, 0 to 5; 6 for a value that belongs to no joint.
        joint: u8,
        /// The value.
        value: f64,
    },
    /// F-ARM-17: the controller's speed of its tool point differs from the one computed here: the configured kinematics
    /// are not those of this arm.
    ToolSpeed {
        /// By the controller, m/s.
        controller_m_per_s: f64,
        /// By the configured kinematics, m/s.
        ours_m_per_s: f64,
    },
    /// F-TIM-01: the loop did not run for too long.
    Stalled {
        /// For how long, ns.
        for_ns: u64,
    },
    /// F-TIM-02: time went backwards.
    TimeBack,
    /// F-INT-01: a thread of the daemon ended or a defect was caught.
    Internal,
}

impl FaultCause {
    /// The stable code.
    pub const fn code(&self) -> &'static str {
        match self {
            FaultCause::FramesStale { .. } => "F-CAM-01",
            FaultCause::FrameStamps { .. } => "F-CAM-02",
            FaultCause::CameraMoved { .. } => "F-CAM-03",
            FaultCause::MarksJumped { .. } => "F-MRK-01",
            FaultCause::MotionMismatch { .. } => "F-MRK-02",
            FaultCause::WrongWay { .. } => "F-LAW-01",
            FaultCause::LawBroken { .. } => "F-LAW-02",
            FaultCause::LinkLost => "F-ARM-01",
            FaultCause::StateStale { .. } => "F-ARM-02",
            FaultCause::EchoStopped { .. } => "F-ARM-03",
            FaultCause::SendBlocked { .. } => "F-ARM-04",
            FaultCause::ProtectiveStop => "F-ARM-05",
            FaultCause::EmergencyStop => "F-ARM-06",
            FaultCause::SafeguardStop => "F-ARM-07",
            FaultCause::SafetyFault { .. } => "F-ARM-08",
            FaultCause::NotRunning { .. } => "F-ARM-09",
            FaultCause::ProgramStopped { .. } => "F-ARM-10",
            FaultCause::ScriptFault { .. } => "F-ARM-11",
            FaultCause::TokenChanged { .. } => "F-ARM-12",
            FaultCause::ClockBack { .. } => "F-ARM-13",
            FaultCause::TrackingError { .. } => "F-ARM-14",
            FaultCause::Uncommanded { .. } => "F-ARM-15",
            FaultCause::StateAbsurd { .. } => "F-ARM-16",
            FaultCause::ToolSpeed { .. } => "F-ARM-17",
            FaultCause::Stalled { .. } => "F-TIM-01",
            FaultCause::TimeBack => "F-TIM-02",
            FaultCause::Internal => "F-INT-01",
        }
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::format;

    #[test]
    fn codes_are_unique_and_have_a_text() {
        let faults = [
            FaultCause::FramesStale { age_ns: 0, limit_ns: 0 },
            FaultCause::FrameStamps { count: 0 },
            FaultCause::CameraMoved { astray_m: 0.0 },
            FaultCause::MarksJumped { jump_m: 0.0, limit_m: 0.0 },
            FaultCause::MotionMismatch { joints_m: 0.0, difference_m: 0.0 },
            FaultCause::WrongWay { agreement: 0.0, moved_m: 0.0 },
            FaultCause::LawBroken { cycles: 0 },
            FaultCause::LinkLost,
            FaultCause::StateStale { age_ns: 0, limit_ns: 0 },
            FaultCause::EchoStopped { for_ns: 0 },
            FaultCause::SendBlocked { count: 0 },
            FaultCause::ProtectiveStop,
            FaultCause::EmergencyStop,
            FaultCause::SafeguardStop,
            FaultCause::SafetyFault { bits: 0 },
            FaultCause::NotRunning { mode: 0 },
            FaultCause::ProgramStopped { runtime_state: 0 },
            FaultCause::ScriptFault { word: 0 },
            FaultCause::TokenChanged { expected: 0, found: 0 },
            FaultCause::ClockBack { by_s: 0.0 },
            FaultCause::TrackingError { joint: 0, velocity: 0.0, position: 0.0 },
            FaultCause::Uncommanded { joint: 0, velocity: 0.0 },
            FaultCause::StateAbsurd { joint: 0, value: 0.0 },
            FaultCause::ToolSpeed { controller_m_per_s: 0.0, ours_m_per_s: 0.0 },
            FaultCause::Stalled { for_ns: 0 },
            FaultCause::TimeBack,
            FaultCause::Internal,
        ];
        for (i, a) in faults.iter().enumerate() {
            assert!(!format!("{a}").is_empty(), "{} has no text", a.code());
            assert!(faults[..i].iter().all(|b| a.code() != b.code()), "{}", a.code());
        }
    }
}
