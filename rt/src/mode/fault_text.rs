//! The texts of faults.

use super::FaultCause;
use core::fmt;

/// Text of a fault number of the control script (docs/RTDE-REGISTERS.md).
const fn script_fault(word: i32) -> &'static str {
    match word {
        1 => "a joint rate is NaN or above its limit",
        2 => "the acceleration is NaN or out of range",
        3 => "unknown mode number",
        4 => "it received no new set-point in time: check the network",
        5 => "another program writes its registers",
        6 => "the output bits are not valid",
        7 => "a joint target is NaN or too far away",
        8 => "no handshake came in time",
        _ => "a fault number that this version does not know",
    }
}

/// Text with the figures and what to do. It is formatted outside the loop.
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
                write!(f, "{count} consecutive images have impossible time stamps: check the camera driver's clock")
            }
            FaultCause::CameraMoved { astray_m } => write!(
                f,
                "a camera was moved after the set-point was given, which puts the gripper {:.1} mm off its goal: fix the camera, check \
                 the calibration, take new images and plan again",
                astray_m * 1e3
            ),
            FaultCause::MarksJumped { jump_m, limit_m } => write!(
                f,
                "the marks jumped by {:.1} mm, more than the arm can move ({:.1} mm): check for reflections and for other marks in view",
                jump_m * 1e3,
                limit_m * 1e3
            ),
            FaultCause::MotionMismatch { joints_m, difference_m } => write!(
                f,
                "the arm moved by {:.1} mm and the images disagree by {:.1} mm: check for a frozen image and check the gripper's mounting \
                 (flange_from_gripper)",
                joints_m * 1e3,
                difference_m * 1e3
            ),
            FaultCause::WrongWay { agreement, moved_m } => write!(
                f,
                "the gripper does not move as commanded (agreement {agreement:.2} after {:.1} mm): check flange_from_gripper, the arm's \
                 model and the marks",
                moved_m * 1e3
            ),
            FaultCause::LawBroken { cycles } => {
                write!(
                    f,
                    "the law computed unusable rates in {cycles} cycles: a defect of the program, please report it"
                )
            }
            FaultCause::Stalled { for_ns } => write!(
                f,
                "the loop did not run for {:.1} ms: check the host's load and the real-time settings",
                ms(for_ns)
            ),
            FaultCause::TimeBack => write!(f, "the monotonic clock went back: check the host"),
            FaultCause::Internal => write!(f, "a defect inside the daemon was caught: see the log"),
            arm => arm_text(arm, f),
        }
    }
}

/// Text of the faults of the arm and its link.
fn arm_text(cause: &FaultCause, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    let ms = |ns: &u64| *ns as f64 * 1e-6;
    match cause {
        FaultCause::LinkLost => write!(f, "the link to the robot is lost: check the network and the controller"),
        FaultCause::StateStale { age_ns, limit_ns } => {
            write!(f, "robot state is {:.1} ms old (limit {:.1} ms): check the network", ms(age_ns), ms(limit_ns))
        }
        FaultCause::EchoStopped { for_ns } => {
            write!(f, "the control script has not received a new set-point for {:.0} ms: check the network", ms(for_ns))
        }
        FaultCause::SendBlocked { count } => {
            write!(f, "{count} consecutive set-points could not be sent: check the network and the controller's load")
        }
        FaultCause::ProtectiveStop => write!(f, "protective stop: read the pendant's message, then recover"),
        FaultCause::EmergencyStop => {
            write!(f, "emergency stop: make sure that it is safe, release it, then recover")
        }
        FaultCause::SafeguardStop => write!(f, "safeguard stop: clear the safeguard, then recover"),
        FaultCause::SafetyFault { bits } => {
            write!(f, "the controller reports a safety fault (bits {bits:#x}): read the pendant's message")
        }
        FaultCause::NotRunning { mode } => {
            write!(f, "the robot is not in mode running (robot_mode {mode}): power on and release the brakes")
        }
        FaultCause::ProgramStopped { runtime_state } => {
            write!(f, "the control script was stopped or paused (runtime_state {runtime_state}): check the pendant")
        }
        FaultCause::ScriptFault { word } => {
            write!(f, "the control script reports fault {word}: {}", script_fault(*word))
        }
        FaultCause::TokenChanged { expected, found } => {
            write!(f, "another program commands the robot (token {found}, expected {expected}): stop it")
        }
        FaultCause::ClockBack { by_s } => {
            write!(f, "the controller's clock went back by {by_s:.3} s: it restarted")
        }
        FaultCause::TrackingError { joint, velocity, position } => {
            write!(
                f,
                "joint {joint} does not follow its set-points: off by {velocity:.3} rad/s and {position:.3} rad; check for contact and payload"
            )
        }
        FaultCause::Uncommanded { joint, velocity } => {
            write!(
                f,
                "joint {joint} moves at {velocity:.3} rad/s without a command: check for another program and for freedrive"
            )
        }
        FaultCause::StateAbsurd { joint, value } => {
            write!(f, "the robot state is not plausible: value {value} of joint {joint} (6: of none)")
        }
        FaultCause::ToolSpeed { controller_m_per_s, ours_m_per_s } => write!(
            f,
            "the controller reports {controller_m_per_s:.3} m/s for its TCP, the configured kinematics give {ours_m_per_s:.3} m/s: \
                 arm.kinematics is not that of this arm"
        ),
        // All others have their text above.
        _ => Ok(()),
    }
}
