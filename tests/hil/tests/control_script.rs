//! The daemon's control script in the interpreter: handshake, rates, refusals, a heartbeat that stops.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod desk;

use desk::Desk;
use graspd_hil::urscript::{Machine, Motion, StepOutcome, WatchdogAction};

const TOKEN: i32 = 77;
const PATIENCE: usize = 5;

/// The template with the daemon's values filled in.
fn script() -> String {
    let mut text = include_str!("../../../daemon/dist/graspd_control.script").to_owned();
    for (key, value) in [
        ("TOKEN", "77"),
        ("SPEED_LIMITS", "[1, 1, 1, 1, 1, 1]"),
        ("ACCELERATION_LIMIT", "5"),
        ("STOP_ACCELERATION", "4"),
        ("POSITION_STEP", "0.05"),
        ("PATIENCE_STEPS", "5"),
        ("HANDSHAKE_STEPS", "50"),
        ("WATCHDOG_HZ", "20"),
        ("LOOKAHEAD", "0.1"),
        ("GAIN", "300"),
    ] {
        text = text.replace(&format!("{{{{{key}}}}}"), value);
    }
    assert!(
        text.lines().all(|l| l.trim_start().starts_with('#') || !l.contains("{{")),
        "a placeholder of the template is not known here"
    );
    text
}

/// One step with a new heartbeat.
fn cycle(m: &mut Machine, desk: &mut Desk) {
    desk.ints[25] += 1;
    assert_eq!(m.step(desk), StepOutcome::Running);
}

fn ready() -> (Machine, Desk) {
    let mut m = Machine::load(&script()).expect("the script is URScript");
    let mut desk = Desk::default();
    desk.ints[26] = TOKEN;
    for _ in 0..6 {
        cycle(&mut m, &mut desk);
    }
    assert_eq!(desk.out_ints[25], 2, "idle after the handshake");
    (m, desk)
}

fn last_rates(desk: &Desk) -> [f64; 6] {
    match desk.motions.last() {
        Some(Motion::SpeedJ { qd, .. }) => *qd,
        other => panic!("{other:?}"),
    }
}

#[test]
fn nothing_moves_without_the_token() {
    let mut m = Machine::load(&script()).unwrap();
    let mut desk = Desk::default();
    let mut outcome = StepOutcome::Running;
    for _ in 0..100 {
        desk.ints[25] += 1;
        outcome = m.step(&mut desk);
    }
    assert_eq!(outcome, StepOutcome::Finished);
    assert_eq!((desk.out_ints[25], desk.out_ints[26]), (8, 8));
    assert!(desk.motions.iter().all(|m| matches!(m, Motion::StopJ { .. })), "{:?}", desk.motions);
}

#[test]
fn rates_reach_the_arm_and_the_heartbeat_is_echoed() {
    let (mut m, mut desk) = ready();
    assert_eq!(desk.watchdog, Some(("input_int_register_25".into(), 20.0, WatchdogAction::Stop)));
    desk.ints[24] = 1;
    desk.floats[30] = 3.0;
    desk.floats[26] = -0.5;
    cycle(&mut m, &mut desk);
    cycle(&mut m, &mut desk);
    assert_eq!(last_rates(&desk), [0.0, 0.0, -0.5, 0.0, 0.0, 0.0]);
    assert_eq!((desk.out_ints[24], desk.out_ints[25]), (desk.ints[25], 3));
}

#[test]
fn a_rate_above_the_limit_or_nan_is_refused_and_the_arm_stopped() {
    for bad in [1.5, -1.5, f64::NAN, f64::INFINITY] {
        let (mut m, mut desk) = ready();
        desk.ints[24] = 1;
        desk.floats[30] = 3.0;
        desk.floats[24] = bad;
        cycle(&mut m, &mut desk);
        cycle(&mut m, &mut desk);
        assert_eq!((desk.out_ints[25], desk.out_ints[26]), (7, 1), "{bad}");
        assert_eq!(last_rates(&desk), [0.0; 6], "{bad}");
    }
}

#[test]
fn a_missing_heartbeat_stops_the_arm_within_the_stated_time() {
    let (mut m, mut desk) = ready();
    desk.ints[24] = 1;
    desk.floats[30] = 3.0;
    desk.floats[24] = 0.5;
    cycle(&mut m, &mut desk);
    cycle(&mut m, &mut desk);
    assert_eq!(last_rates(&desk)[0], 0.5);
    let mut steps = 0;
    while last_rates(&desk) != [0.0; 6] {
        assert_eq!(m.step(&mut desk), StepOutcome::Running);
        steps += 1;
        assert!(steps <= PATIENCE + 1, "still moving {steps} steps after the last cycle");
    }
    assert_eq!((desk.out_ints[25], desk.out_ints[26]), (7, 4));
}

#[test]
fn outputs_follow_the_word() {
    let (mut m, mut desk) = ready();
    desk.ints[27] = (0b10_0000_0101 << 16) | 0b10_0000_0001;
    cycle(&mut m, &mut desk);
    cycle(&mut m, &mut desk);
    let mut set = desk.out_bits.clone();
    set.sort_unstable();
    assert_eq!(set, [(1000, true), (1001, true), (1002, false)]);
}
