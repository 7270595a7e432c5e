//! The simulated arm against the figures in docs/MOCK-UR.md: limits, lag, encoders, stops. Virtual clock.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::controller::{Command, MessageKind, RuntimeState, SafetyMode, Setup, Upload};
use graspd_hil::mock_arm::MockArm;
use graspd_hil::plant::Model;
use std::f64::consts::{PI, TAU};

const DT: f64 = 0.002;
/// Encoder counts per turn.
const COUNTS: f64 = 1_048_576.0;

fn arm() -> MockArm {
    MockArm::new(Setup::new(Model::by_name("ur5e").unwrap()), None)
}

/// An arm that runs a program with this body.
fn running(body: &str) -> MockArm {
    let mut a = arm();
    assert_eq!(a.upload(&format!("def t():\n{body}\nend\n")), Upload::Main);
    a
}

fn forever(call: &str) -> MockArm {
    running(&format!("while True:\n{call}\nend"))
}

fn largest(v: &[f64; 6]) -> f64 {
    v.iter().fold(0.0, |m, x| x.abs().max(m))
}

/// Error codes among the messages since the last call.
fn errors(a: &mut MockArm) -> Vec<i32> {
    a.robot_mut()
        .outbox
        .drain()
        .filter_map(|m| if let MessageKind::Error { code, .. } = m.kind { Some(code) } else { None })
        .collect()
}

#[test]
fn targets_accelerate_as_asked_on_the_leading_joint_and_never_above_40() {
    for (asked, expected) in [(2.0, 2.0), (15.0, 15.0), (1000.0, 40.0)] {
        let mut a = forever(&format!("speedj([0.6, -0.3, 0, 0, 0, 0.15], {asked}, get_steptime())"));
        let (mut lead, mut second) = (0.0f64, 0.0f64);
        for _ in 0..400 {
            a.step();
            let qdd = a.robot().truth.target_qdd;
            (lead, second) = (lead.max(qdd[0].abs()), second.max(qdd[1].abs()));
        }
        assert!((lead - expected).abs() < 1e-6, "{asked}: {lead}");
        assert!((second - expected / 2.0).abs() < 1e-6, "joints keep their proportion: {second}");
        assert!((a.robot().truth.target_qd[0] - 0.6).abs() < 1e-12);
    }
}

#[test]
fn drives_follow_within_80_rad_per_s2_and_lag_in_the_first_steps() {
    // The steepest ramp: 40 rad/s2.
    let mut a = forever("speedj([1.5, 0, 0, 0, 0, 0], 40, get_steptime())");
    let (mut lags, mut deviation, mut fastest) = (Vec::new(), 0.0f64, 0.0f64);
    for _ in 0..200 {
        a.step();
        let t = &a.robot().truth;
        assert!(largest(&t.actual_qdd) <= 80.0 + 1e-9);
        deviation = deviation.max((t.target_q[0] - t.actual_q[0]).abs());
        fastest = fastest.max(t.actual_qd[0]);
        if t.target_qd[0] > 1e-9 && lags.len() < 3 {
            // On a ramp the lag in time is the lag in speed divided by the acceleration.
            lags.push((t.target_qd[0] - t.actual_qd[0]) / 40.0 * 1e3);
        }
    }
    println!(
        "lag of the first steps {lags:.2?} ms, {:.3} mrad at most, overshoot {:.1} %",
        deviation * 1e3,
        (fastest / 1.5 - 1.0) * 100.0
    );
    assert!(lags[0] > 0.2 && lags[0] < 2.0, "{lags:?}");
    assert!(deviation < 3.5e-3, "{deviation}");
    assert!(fastest < 1.5 * 1.07, "{fastest}");
    assert!((a.robot().truth.actual_qd[0] - 1.5).abs() < 1e-4, "no lag at a constant speed");
    // The lag fault increases the lag accordingly.
    let mut a = forever("speedj([0.3, 0, 0, 0, 0, 0], 40, get_steptime())");
    a.command(Command::Lag { seconds: 0.1 }).unwrap();
    let reaches = |a: &mut MockArm| {
        (0..500)
            .position(|_| {
                a.step();
                a.robot().truth.actual_qd[0] > 0.15
            })
            .unwrap()
    };
    let steps = reaches(&mut a);
    assert!((20..=60).contains(&steps), "half speed after {steps} steps");
}

#[test]
fn positions_are_whole_counts_of_a_20_bit_encoder() {
    let mut a = forever("speedj([0.11, 0.07, -0.05, 0.03, 0.13, -0.17], 3, get_steptime())");
    let mut between = 0;
    for _ in 0..500 {
        a.step();
        let t = &a.robot().truth;
        for i in 0..6 {
            let counts = t.actual_q[i] * COUNTS / TAU;
            assert!((counts - counts.round()).abs() < 1e-6, "joint {i}: {counts} counts");
            between += u32::from((t.target_q[i] * COUNTS / TAU).fract().abs() > 0.01);
        }
    }
    assert!(between > 2000, "targets are not quantised");
}

#[test]
fn an_arm_that_leaves_its_path_by_5_degrees_is_stopped() {
    let mut a = forever("speedj([0.5, 0, 0, 0, 0, 0], 4, get_steptime())");
    a.step_until(0.5, |_| false);
    a.command(Command::Stuck { joint: 0 }).unwrap();
    let mut worst = 0.0f64;
    let stopped = a.step_until(2.0, |r| {
        worst = worst.max((r.truth.target_q[0] - r.truth.actual_q[0]).abs());
        r.safety == SafetyMode::ProtectiveStop
    });
    assert!(stopped);
    // The deviation may exceed the limit by one step when it is detected.
    assert!(worst > 0.087 - 1e-9 && worst < 0.087 + 0.5 * DT + 1e-3, "{worst}");
    assert_eq!(errors(&mut a), [153]);
    assert!(!a.robot().is_program_running());
}

#[test]
fn the_arm_stops_before_it_exceeds_joint_limits() {
    // Position limit, at various speeds: the arm stops before 360 degrees.
    for rate in [0.3, 1.0, 2.5] {
        let mut a = forever(&format!("speedj([{rate}, 0, 0, 0, 0, 0], 20, get_steptime())"));
        a.robot_mut().teleport([TAU - 0.9, -1.57, 1.57, -1.57, -1.57, 0.0]);
        assert!(a.step_until(6.0, |r| r.safety == SafetyMode::ProtectiveStop), "{rate}");
        a.step_until(1.0, |_| false);
        let q = a.robot().truth.actual_q[0];
        assert!(q < TAU && q > TAU - 0.2, "{rate}: stopped at {q}");
        assert_eq!(errors(&mut a), [157]);
    }
    // Speed limit: 180 degrees per second.
    let mut a = forever("speedj([0, 0, 0, 0, 3.3, 0], 40, get_steptime())");
    let mut fastest = 0.0f64;
    assert!(a.step_until(1.0, |r| {
        fastest = fastest.max(r.truth.actual_qd[4].abs());
        r.safety == SafetyMode::ProtectiveStop
    }));
    println!("fastest joint when asked beyond its limit: {fastest:.4} rad/s, limit {PI:.4}");
    assert!(fastest <= PI + 1e-9, "{fastest}");
    assert_eq!(errors(&mut a), [171]);
    assert_eq!(a.summary().limit_violations, 0, "{:?}", a.summary().violations);
}

#[test]
fn a_program_ends_at_4_rad_per_s2_and_the_safety_system_stops_at_20() {
    for (command, decel) in [(Command::StopProgram, 4.0), (Command::ProtectiveStop, 20.0)] {
        let mut a = forever("speedj([0.8, 0, 0, 0, 0, 0], 10, get_steptime())");
        a.step_until(0.5, |_| false);
        a.command(command).unwrap();
        let (mut most, mut steps) = (0.0f64, 0);
        while largest(&a.robot().truth.target_qd) > 1e-9 {
            a.step();
            most = most.max(largest(&a.robot().truth.target_qdd));
            steps += 1;
            assert!(steps < 500);
        }
        assert!((most - decel).abs() < 1e-6, "{most} where {decel} is stated");
        assert!((f64::from(steps) * DT - 0.8 / decel).abs() <= DT + 1e-9, "{steps} steps");
        a.step_until(0.1, |_| false);
        assert_eq!(a.robot().runtime, RuntimeState::Stopped);
    }
}

#[test]
fn reduced_mode_halves_the_joint_speeds_and_keeps_the_direction() {
    let mut a = forever("speedj([3, 1.5, 0, 0, 0, 0], 20, get_steptime())");
    a.command(Command::Reduced { on: true }).unwrap();
    a.step_until(0.5, |_| false);
    let t = a.robot().truth.target_qd;
    assert!((t[0] - PI / 2.0).abs() < 1e-9 && (t[1] - PI / 4.0).abs() < 1e-9, "{t:?}");
    assert_eq!(a.robot().safety.bits(), 0b10);
    a.command(Command::Reduced { on: false }).unwrap();
    a.step_until(0.3, |_| false);
    assert!((a.robot().truth.target_qd[0] - 3.0).abs() < 1e-9);
}

#[test]
fn the_slider_scales_every_motion_and_stretches_moves() {
    for (call, joint, full) in [
        ("speedj([0.4, 0, 0, 0, 0, 0], 4, get_steptime())", 0, 0.4),
        ("speedl([0, 0, 0.05, 0, 0, 0], 1, get_steptime())", 6, 0.05),
    ] {
        let mut a = forever(call);
        a.command(Command::SpeedSlider { fraction: 0.25 }).unwrap();
        a.step_until(0.6, |_| false);
        let t = &a.robot().truth;
        let speed = if joint == 6 { t.target_tcp_speed[2] } else { t.target_qd[joint] };
        assert!((speed - 0.25 * full).abs() < 1e-4 * full + 1e-6, "{call}: {speed}");
        // Clients multiply the limiter's fraction and the slider.
        assert!((t.speed_scaling - 1.0).abs() < 1e-9 && (a.robot().slider - 0.25).abs() < 1e-12);
        // The scaling changes by 5 per second at most.
        a.command(Command::SpeedSlider { fraction: 1.0 }).unwrap();
        a.step();
        assert!((a.robot().truth.speed_scaling - 0.26).abs() < 1e-9, "{}", a.robot().truth.speed_scaling);
    }
    let time = |fraction: f64| {
        let mut a = running("movej([0.5, -1.57, 1.57, -1.57, -1.57, 0], a=2, v=0.5)");
        a.command(Command::SpeedSlider { fraction }).unwrap();
        a.step_until(0.2, |_| false); // the slider settles while the move begins
        let mut t = 0.2;
        while a.robot().is_program_running() {
            a.step();
            t += DT;
            assert!(t < 20.0);
        }
        t
    };
    let (one, half) = (time(1.0), time(0.5));
    // 0.5 rad at 0.5 rad/s and 2 rad/s2: 1.25 s.
    assert!((one - 1.25).abs() < 0.02, "{one}");
    assert!((half / one - 2.0).abs() < 0.1, "{half} against {one}");
    // At zero the arm waits; it continues when the slider is raised.
    let mut a = running("movej([0.5, -1.57, 1.57, -1.57, -1.57, 0], a=2, v=0.5)");
    a.step_until(0.4, |_| false);
    a.command(Command::SpeedSlider { fraction: 0.0 }).unwrap();
    a.step_until(0.5, |_| false);
    let q = a.robot().truth.target_q[0];
    a.step_until(1.0, |_| false);
    assert!(q > 0.05 && q < 0.45 && (a.robot().truth.target_q[0] - q).abs() < 1e-12 && a.robot().is_program_running());
    a.command(Command::SpeedSlider { fraction: 1.0 }).unwrap();
    assert!(a.step_until(3.0, |r| !r.is_program_running()));
    assert!((a.robot().truth.target_q[0] - 0.5).abs() < 1e-9);
}

#[test]
fn the_payload_changes_the_joint_torques() {
    // A stretched arm: shoulder, elbow and wrist 1 carry the load, the base does not.
    let at = |kg: f64| {
        let mut setup = Setup::new(Model::by_name("ur5e").unwrap());
        setup.start_joints = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let mut a = MockArm::new(setup, None);
        a.command(Command::Payload { kg }).unwrap();
        a.step();
        a.robot().truth.target_moment
    };
    let (empty, loaded) = (at(0.0), at(2.0));
    let lever = 0.425 + 0.3922;
    let expected = 2.0 * 9.82 * lever;
    let felt = (loaded[1] - empty[1]).abs();
    assert!((felt - expected).abs() < 0.15 * expected, "{felt} Nm, {expected} Nm by hand");
    assert!((loaded[0] - empty[0]).abs() < 1e-9);
    // 2 kg is within the payload of 5 kg; 50 kg is refused with the limit.
    let mut a = running("set_payload(50)");
    a.step();
    let told: Vec<_> = a.robot_mut().outbox.drain().map(|m| m.kind).collect();
    assert!(
        told.iter().any(|k| matches!(k, MessageKind::Runtime { line: 2, text, .. } if text.contains("5 kg"))),
        "{told:?}"
    );
}

#[test]
fn brakes_hold_and_powering_on_takes_time() {
    let mut a = forever("speedj([0.5, 0, 0, 0, 0, 0], 4, get_steptime())");
    a.step_until(0.4, |_| false);
    a.command(Command::PowerOff).unwrap();
    assert!(a.step_until(0.05, |r| r.at_rest()), "brakes stop the arm immediately");
    let q = a.robot().truth.actual_q;
    a.step_until(1.0, |_| false);
    assert_eq!(a.robot().truth.actual_q, q);
    assert!(a.robot_mut().power_on() && a.robot_mut().brake_release());
    let mut t = 0.0;
    while a.robot().truth.actual_q == q && a.robot().mode != graspd_hil::controller::RobotMode::Running {
        a.step();
        t += DT;
        assert!(t < 5.0);
    }
    assert!(t > 0.5, "power and brakes take a second, not {t}");
}
