//! The text of a refused request: its reason, the current mode and the next step.

use graspd_rt::cycle::RequestKind;
use graspd_rt::mode::{ModeName, Reject};

/// The command that makes a request.
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

/// The text of a refusal.
pub(super) fn refusal_text(kind: RequestKind, mode: ModeName, reject: Reject) -> String {
    if reject != Reject::WrongMode {
        return reject.reason().to_owned();
    }
    let next = match (mode, kind) {
        (ModeName::Fault, _) => "`graspd reset` once its cause is removed",
        (_, RequestKind::Reset) => "there is no fault to clear",
        (ModeName::Idle, _) => {
            "wait until the marks are tracked and the robot is ready; `graspd status` shows what is missing"
        }
        (ModeName::Tracking, RequestKind::Servo) => "`graspd arm` first",
        (ModeName::Armed, RequestKind::Arm) => "`graspd servo` starts the motion, `graspd stop` disarms",
        (ModeName::Converged, RequestKind::Servo) => {
            "the gripper is on the grasp already; `graspd stop` before another motion"
        }
        (ModeName::Servoing | ModeName::Converged, _) => "`graspd stop` first",
        (ModeName::Stopping, _) => "wait until the arm is at rest",
        (ModeName::Tracking | ModeName::Armed, _) => "`graspd servo` first",
    };
    format!("`{}` is not possible in mode {}: {next}", verb(kind), mode.as_str())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_for_the_wrong_mode_names_the_mode_and_the_next_step() {
        use ModeName::{Armed, Converged, Fault, Idle, Servoing, Stopping, Tracking};
        for mode in [Idle, Tracking, Armed, Servoing, Converged, Stopping, Fault] {
            for kind in [RequestKind::Arm, RequestKind::Servo, RequestKind::Reset, RequestKind::Gripper { close: true }]
            {
                let text = refusal_text(kind, mode, Reject::WrongMode);
                assert!(text.contains(mode.as_str()) && text.contains(verb(kind)), "{text}");
            }
        }
        assert!(refusal_text(RequestKind::Servo, Tracking, Reject::WrongMode).contains("graspd arm"));
        assert!(refusal_text(RequestKind::Arm, Fault, Reject::WrongMode).contains("graspd reset"));
        assert_eq!(refusal_text(RequestKind::Arm, Idle, Reject::NoMarks), Reject::NoMarks.reason());
    }
}
