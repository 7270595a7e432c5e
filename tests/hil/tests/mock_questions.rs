//! Query functions of scripts: limits, contact, joint history, temperatures. Virtual clock.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::controller::{Command, MessageKind, RuntimeState, Setup, Upload};
use graspd_hil::mock_arm::MockArm;
use graspd_hil::plant::Model;

fn arm() -> MockArm {
    MockArm::new(Setup::new(Model::by_name("ur5e").unwrap()), Some((0.5, 4.0)))
}

/// Runs a program on the whole controller and returns what it logged.
fn messages(body: &str, orders: &[Command], seconds: f64) -> Vec<String> {
    let mut a = arm();
    a.step_until(0.1, |_| false);
    for order in orders {
        a.command(order.clone()).unwrap();
    }
    a.step_until(0.02, |_| false);
    let text = format!("def t():\n{body}\nend\n");
    assert_eq!(a.upload(&text), Upload::Main, "{body}");
    a.step_until(seconds, |r| r.runtime == RuntimeState::Stopped);
    let messages: Vec<_> = a.robot_mut().outbox.drain().map(|m| m.kind).collect();
    messages
        .into_iter()
        .filter_map(|kind| match kind {
            MessageKind::Text(t) => Some(t),
            MessageKind::Runtime { line, text, .. } => Some(format!("line {line}: {text}")),
            _ => None,
        })
        .collect()
}

#[test]
fn questions_about_the_controller_are_answered() {
    for (expression, expected) in [
        ("is_within_safety_limits([0, -1, 1, 0, 0, 0])", "True"),
        ("is_within_safety_limits([0, -1, 1, 0, 0, 6.4])", "False"),
        ("is_within_safety_limits(p[0.3, 0.2, 0.4, 0, 3.1, 0])", "True"),
        ("is_within_safety_limits(p[3, 0, 0, 0, 0, 0], qnear=[0, 0, 0, 0, 0, 0])", "False"),
        ("get_freedrive_status()", "0"),
        ("get_target_payload_inertia()", "[0, 0, 0, 0, 0, 0]"),
        ("tool_contact()", "0"),
        ("get_actual_joint_positions_history(5) == get_actual_joint_positions()", "True"),
        ("get_joint_positions() == get_actual_joint_positions()", "True"),
        ("get_target_joint_accelerations()", "[0, 0, 0, 0, 0, 0]"),
        ("get_joint_temp(5) > 20", "True"),
        ("get_controller_temp() > 20", "True"),
        ("random() < 1", "True"),
        ("get_flag(3)", "False"),
        ("make_list(3, 0.5)", "[0.5, 0.5, 0.5]"),
        ("wrench_trans(p[0, 0, 0.1, 0, 0, 0], [1, 0, 0, 0, 0, 0])", "[1, 0, 0, 0, -0.1, 0]"),
    ] {
        assert_eq!(messages(&format!("textmsg({expression})"), &[], 0.1), [expected], "{expression}");
    }
    assert!(messages("get_joint_temp(6)", &[], 0.1)[0].starts_with("line 2: get_joint_temp"));
    assert!(messages("get_actual_joint_positions_history(-1)", &[], 0.1)[0].contains("steps"));
    assert!(messages("is_within_safety_limits(1)", &[], 0.1)[0].contains("six joint positions"));
    let shown = messages("set_flag(7, True)\ntextmsg(get_flag(7))", &[], 0.1);
    assert_eq!(shown, ["True"]);
}

#[test]
fn contact_is_detected_and_the_joint_history_is_kept() {
    // A force against the motion is detected by its direction; the result is the number of steps since it began.
    let push = |body: &str| {
        let mut a = arm();
        a.robot_mut().external_wrench = [-20.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        for _ in 0..10 {
            a.step();
        }
        assert_eq!(a.upload(&format!("def t():\n{body}\nend\n")), Upload::Main);
        a.step();
        a.robot().outputs.ints[0]
    };
    let reg = |call: &str| format!("write_output_integer_register(0, {call})");
    assert_eq!(push(&reg("tool_contact()")), 10);
    assert_eq!(push(&reg("tool_contact(direction=[1, 0, 0, 0, 0, 0])")), 10);
    assert_eq!(push(&reg("tool_contact(direction=p[-1, 0, 0, 0, 0, 0])")), 0);
    // The history contains the path backwards.
    let mut a = arm();
    a.upload("def t():\n  while True:\n    speedj([0.5, 0, 0, 0, 0, 0], 5, get_steptime())\n    write_output_float_register(0, get_actual_joint_positions_history(100)[0])\n  end\nend\n");
    let mut seen = Vec::new();
    for _ in 0..400 {
        a.step();
        seen.push(a.robot().truth.actual_q[0]);
    }
    let told = a.robot().outputs.doubles[0];
    let nearest = seen.iter().rposition(|q| (q - told).abs() < 1e-12).unwrap();
    assert!((98..=102).contains(&(seen.len() - 1 - nearest)), "{}", seen.len() - 1 - nearest);
}
