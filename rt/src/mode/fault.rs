//! What stops the loop, with its evidence and a stable code.

use core::fmt;

/// Why the loop stopped and latched: each needs its cause gone and an operator's reset.
///
/// The codes are stable: logs, console and manual use them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FaultCause {
    /// F-CAM-01: no usable stereo pair for too long.
    FramesStale {
        /// Age of the newest result's image, ns.
        age_ns: u64,
        /// Greatest allowed age, ns.
        limit_ns: u64,
    },
    /// F-CAM-02: stamps from the future, or far in the past.
    FrameStamps {
        /// Results refused in a row.
        count: u32,
    },
    /// F-MRK-01: the marks jumped further than the arm can move.
    MarksJumped {
        /// Length of the jump, metres (unit-scaled).
        jump_m: f64,
        /// Greatest possible, metres.
        limit_m: f64,
    },
    /// F-CAM-03: a camera was moved since the set-point was given: what was planned is no longer where the images say.
    CameraMoved {
        /// How far that leads the gripper astray, metres (unit-scaled).
        astray_m: f64,
    },
    /// F-MRK-02: the images and the joints disagree about the motion (frozen image, wrong camera, slipping mount).
    MotionMismatch {
        /// Motion by the joints over the window, metres (unit-scaled).
        joints_m: f64,
        /// Disagreement, metres (unit-scaled).
        difference_m: f64,
    },
    /// F-LAW-01: the gripper does not go where it is sent: a sign, frame or mounting is wrong.
    WrongWay {
        /// Share of the intended motion that was seen; 1 is right, -1 the opposite.
        agreement: f64,
        /// Motion since the start, metres (unit-scaled).
        moved_m: f64,
    },
    /// F-LAW-02: the law's own numbers are not finite, or were far above its caps for long.
    LawBroken {
        /// Cycles with such numbers in the last second.
        cycles: u32,
    },
    /// F-ARM-01: the link to the robot is lost.
    LinkLost,
    /// F-ARM-02: robot state is too old.
    StateStale {
        /// Age, ns.
        age_ns: u64,
        /// Greatest allowed age, ns.
        limit_ns: u64,
    },
    /// F-ARM-03: our set-points do not arrive: the heartbeat echoed by the control script stopped.
    EchoStopped {
        /// How long, ns.
        for_ns: u64,
    },
    /// F-ARM-04: set-points cannot be sent.
    SendBlocked {
        /// Attempts in a row.
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
    /// F-ARM-11: the control script reported a fault of its own.
    ScriptFault {
        /// Its fault word.
        word: i32,
    },
    /// F-ARM-12: another program commands the robot.
    TokenChanged {
        /// Our session's token.
        expected: i32,
        /// What was echoed.
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
    /// F-ARM-15: the arm moves without being told to.
    Uncommanded {
        /// The fastest joint, 0 to 5.
        joint: u8,
        /// Its velocity, rad/s.
        velocity: f64,
    },
    /// F-ARM-16: a robot value is not a number, out of range, or jumped.
    StateAbsurd {
        /// The joint, 0 to 5; 6 where it is no joint's value.
        joint: u8,
        /// The value.
        value: f64,
    },
    /// F-ARM-17: the controller's own speed of its tool point is another than ours: our kinematics are not this arm's.
    ToolSpeed {
        /// By the controller, m/s.
        controller_m_per_s: f64,
        /// By our kinematics, m/s.
        ours_m_per_s: f64,
    },
    /// F-TIM-01: the loop was not run for too long.
    Stalled {
        /// How long, ns.
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

/// The control script's fault words (docs/RTDE-REGISTERS.md).
const fn script_fault(word: i32) -> &'static str {
    match word {
        1 => "a joint rate is not a number or above its limit",
        2 => "the acceleration is not a number or out of range",
        3 => "unknown mode word",
        4 => "it heard no new set-point in time: check the network",
        5 => "somebody else writes its registers",
        6 => "the outputs word means nothing",
        7 => "a joint target is not a number or too far away",
        8 => "nobody shook hands in time",
        _ => "a fault that this version does not know",
    }
}

/// In words, with the figures, and what to do. Formatting happens outside the loop.
impl fmt::Display for FaultCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |ns: &u64| *ns as f64 * 1e-6;
        match self {
            FaultCause::FramesStale { age_ns, limit_ns } => write!(
                f,
                "the newest usable image is {:.0} ms old (limit {:.0} ms): check the cameras",
                ms(age_ns),
                ms(limit_ns)
            ),
            FaultCause::FrameStamps { count } => {
                write!(f, "{count} images in a row with impossible time stamps: check the camera driver's clock")
            }
            FaultCause::CameraMoved { astray_m } => write!(
                f,
                "a camera was moved since the set-point was given, which would lead the gripper {:.1} mm astray: fix the camera, check the calibration, take new images and plan again",
                astray_m * 1e3
            ),
            FaultCause::MarksJumped { jump_m, limit_m } => write!(
                f,
                "the marks jumped by {:.1} mm, more than the arm can move ({:.1} mm)",
                jump_m * 1e3,
                limit_m * 1e3
            ),
            FaultCause::MotionMismatch { joints_m, difference_m } => write!(
                f,
                "the arm moved by {:.1} mm and the images disagree by {:.1} mm: an image stands still, or the gripper's mounting is wrong",
                joints_m * 1e3,
                difference_m * 1e3
            ),
            FaultCause::WrongWay { agreement, moved_m } => write!(
                f,
                "the gripper does not go where it is sent (agreement {agreement:.2} after {:.1} mm): check flange_from_gripper, the arm's model and the marks",
                moved_m * 1e3
            ),
            FaultCause::LawBroken { cycles } => {
                write!(f, "the law gave unusable numbers in {cycles} cycles of one second")
            }
            FaultCause::LinkLost => write!(f, "the link to the robot is lost"),
            FaultCause::StateStale { age_ns, limit_ns } => {
                write!(f, "robot state is {:.1} ms old (limit {:.1} ms): check the network", ms(age_ns), ms(limit_ns))
            }
            FaultCause::EchoStopped { for_ns } => {
                write!(f, "the control script has not seen a new set-point for {:.0} ms", ms(for_ns))
            }
            FaultCause::SendBlocked { count } => write!(f, "{count} set-points in a row could not be sent"),
            FaultCause::ProtectiveStop => write!(f, "protective stop: look at the pendant, then recover"),
            FaultCause::EmergencyStop => write!(f, "emergency stop: release it on purpose, then recover"),
            FaultCause::SafeguardStop => write!(f, "safeguard stop: clear the safeguard, then recover"),
            FaultCause::SafetyFault { bits } => write!(f, "the controller reports a safety fault (bits {bits:#x})"),
            FaultCause::NotRunning { mode } => write!(f, "the robot left mode running (robot_mode {mode})"),
            FaultCause::ProgramStopped { runtime_state } => {
                write!(f, "the control script was stopped or paused (runtime_state {runtime_state})")
            }
            FaultCause::ScriptFault { word } => {
                write!(f, "the control script reports fault {word}: {}", script_fault(*word))
            }
            FaultCause::TokenChanged { expected, found } => {
                write!(f, "another program commands the robot (token {found}, ours is {expected})")
            }
            FaultCause::ClockBack { by_s } => {
                write!(f, "the controller's clock went back by {by_s:.3} s: it restarted")
            }
            FaultCause::TrackingError { joint, velocity, position } => {
                write!(f, "joint {joint} does not follow: {velocity:.3} rad/s, {position:.3} rad off its set-points")
            }
            FaultCause::Uncommanded { joint, velocity } => {
                write!(f, "joint {joint} moves at {velocity:.3} rad/s without being told to")
            }
            FaultCause::StateAbsurd { joint, value } => write!(f, "robot value of joint {joint} is absurd: {value}"),
            FaultCause::ToolSpeed { controller_m_per_s, ours_m_per_s } => write!(
                f,
                "the controller says that its TCP moves at {controller_m_per_s:.3} m/s, by our kinematics it is {ours_m_per_s:.3} m/s: \
                 arm.kinematics is not this arm's"
            ),
            FaultCause::Stalled { for_ns } => write!(f, "the loop stood still for {:.1} ms", ms(for_ns)),
            FaultCause::TimeBack => write!(f, "the monotonic clock went back"),
            FaultCause::Internal => write!(f, "a defect was caught inside the daemon; see the log"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_all_different() {
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
            assert!(faults[..i].iter().all(|b| a.code() != b.code()), "{}", a.code());
        }
    }
}
