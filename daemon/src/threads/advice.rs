//! What a refusal says besides its reason: the mode that stands in the way, and the next step out of it.

use graspd_rt::cycle::RequestKind;
use graspd_rt::mode::{ModeName, Reject};

/// The command that a request came by.
fn verb(kind: RequestKind) -> &'static str {
    match kind {
        RequestKind::Arm => "arm",
        RequestKind::Disarm => "disarm",
        RequestKind::Servo => "servo",
        RequestKind::Stop => "stop",
        RequestKind::Reset => "reset",
        RequestKind::Gripper { close: true } => "gripper close",
        RequestKind::Gripper { close: false } => "gripper open",
        RequestKind::Turn { .. } => "turn",
        RequestKind::Retreat => "retreat",
        RequestKind::LeaseLost => "the lease",
    }
}

/// A refusal in words.
pub(super) fn refusal(kind: RequestKind, mode: ModeName, reject: Reject) -> String {
    if reject != Reject::WrongMode {
        return reject.reason().to_owned();
    }
    let next = match (mode, kind) {
        (ModeName::Fault, _) => "`graspd reset` once its cause is gone",
        (_, RequestKind::Reset) => "there is no fault to clear",
        (ModeName::Idle, _) => {
            "wait until the marks are tracked and the robot is ready; `graspd status` says what is missing"
        }
        (ModeName::Tracking, RequestKind::Servo) => "`graspd arm` first",
        (ModeName::Armed, RequestKind::Arm) => "`graspd servo` starts the motion, `graspd stop` disarms",
        (ModeName::Converged, RequestKind::Servo) => {
            "the gripper is on the grasp already; `graspd stop` before another motion"
        }
        (ModeName::Servoing | ModeName::Converged, _) => "`graspd stop` first",
        (ModeName::Stopping, _) => "wait until the arm rests",
        (ModeName::Tracking | ModeName::Armed, _) => "`graspd servo` first",
    };
    format!("`{}` is not possible in mode {}: {next}", verb(kind), mode.as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_mode_is_named_with_the_next_step() {
        use ModeName::{Armed, Converged, Fault, Idle, Servoing, Stopping, Tracking};
        for mode in [Idle, Tracking, Armed, Servoing, Converged, Stopping, Fault] {
            for kind in [RequestKind::Arm, RequestKind::Servo, RequestKind::Reset, RequestKind::Gripper { close: true }]
            {
                let words = refusal(kind, mode, Reject::WrongMode);
                assert!(words.contains(mode.as_str()) && words.contains(verb(kind)), "{words}");
            }
        }
        assert!(refusal(RequestKind::Servo, Tracking, Reject::WrongMode).contains("graspd arm"));
        assert!(refusal(RequestKind::Arm, Fault, Reject::WrongMode).contains("graspd reset"));
        assert_eq!(refusal(RequestKind::Arm, Idle, Reject::NoMarks), Reject::NoMarks.reason());
    }
}
