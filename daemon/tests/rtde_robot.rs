//! The UR link and the recovery against the mock controller: CB3 at 125 Hz, protocol version 1, inputs that are held or
//! unknown, outputs of the gripper, every refusal of a recovery, and the controller's messages about a stop.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

use graspd::arm::{
    ArmError, ArmLink, MessageKind, MessageListener, Motion, RecoverTimes, UrConfig, UrLink, check_model,
    read_identity, recover, render, walk_out,
};
use graspd::realtime::now_ns;
use graspd::threads::{CommandWorker, Shared};
use graspd_hil::controller::{Command, Hosted, Port, RobotMode, Setup};
use graspd_hil::plant::Model as Plant;
use graspd_hil::scenario::{Options, Scenario};
use graspd_rt::arm::{ArmCommand, ArmMode, Dh, Model, RobotState};
use graspd_rt::cycle::{CommandCycle, CycleConfig, CycleSettings};
use graspd_rt::rtde::{Version, script_state};
use std::time::{Duration, Instant};

const LIMIT: Duration = Duration::from_secs(20);
const QUICK: RecoverTimes = RecoverTimes { power_up: Duration::from_millis(600), unlock: Duration::from_millis(300) };

fn mock(model: &str, power_time_s: f64) -> (Hosted, UrConfig) {
    let setup = Setup { power_time_s, ..Setup::new(Plant::by_name(model).unwrap()) };
    let mock = Hosted::start(setup, None, None).unwrap();
    let mut config = UrConfig::new(mock.address.to_string(), Model::from_name(model).unwrap());
    config.cycle_hz = if config.model.is_e_series() { 500.0 } else { 125.0 };
    // A stalled host must not look like a dead client here; other tests use the default watchdog.
    config.watchdog_ms = 1000.0;
    (mock, config)
}

/// Sends a command for each of the controller's packages until `done`.
fn drive(link: &mut UrLink, mode: ArmMode, rate: f64, outputs: u32, done: impl Fn(&RobotState) -> bool) -> RobotState {
    let start = Instant::now();
    let mut cycle = link.state().map_or(0, |s| s.echo);
    while start.elapsed() < LIMIT {
        link.wait(now_ns() + 40_000_000);
        let poll = link.poll(now_ns());
        assert_eq!(poll.fault, None);
        cycle = cycle.wrapping_add(1);
        link.send(&ArmCommand { mode, rates: [0.0, 0.0, 0.0, 0.0, 0.0, rate], heartbeat: cycle, outputs }).unwrap();
        if let Some(state) = poll.state.filter(&done) {
            return state;
        }
    }
    panic!("not reached within {LIMIT:?}: {:?}", link.state());
}

/// Receives without sending until `done`.
fn receive(link: &mut UrLink, done: impl Fn(&RobotState) -> bool) -> RobotState {
    let start = Instant::now();
    while start.elapsed() < LIMIT {
        link.wait(now_ns() + 40_000_000);
        if let Some(state) = link.poll(now_ns()).state.filter(&done) {
            return state;
        }
    }
    panic!("not reached within {LIMIT:?}: {:?}", link.state());
}

fn at_rest(s: &RobotState) -> bool {
    s.qd.iter().chain(&s.target_qd).all(|v| v.abs() < 1e-3)
}

/// Session, script, motion, end of the heartbeat, rest: at the controller's rate.
fn complete_session(mock: &mut Hosted, config: &UrConfig, version: Version, hz: f64) {
    let identity = read_identity(config).unwrap();
    check_model(&identity, config.model).unwrap();
    let mut link = UrLink::connect(config).unwrap();
    assert_eq!(link.version(), version);
    assert_eq!((link.rate_hz(), link.step_s()), (hz, 1.0 / hz));
    link.bring_up(config).unwrap();
    drive(&mut link, ArmMode::Idle, 0.0, 0, |s| s.script_state == script_state::IDLE);
    let q0 = link.state().unwrap().q[5];
    let moved = drive(&mut link, ArmMode::Velocity, 0.4, 0, |s| s.q[5] - q0 > 0.1);
    assert_eq!((moved.script_fault, moved.qd[5] > 0.2), (0, true), "{moved:?}");
    let rest = receive(&mut link, |s| at_rest(s) && s.robot_status_bits & 2 == 0);
    assert!(rest.timestamp_s > moved.timestamp_s);
    let summary = mock.ask(&Command::Summary).unwrap();
    let last = summary["episodes"].as_array().unwrap().last().unwrap().clone();
    assert!(last["peak_rate"].as_f64().unwrap() > 0.2 && last["rest_ns"].as_u64().unwrap() > 0, "{last}");
    assert_eq!(summary["limit_violations"].as_u64(), Some(0));
}

#[test]
fn cb3_runs_at_125_hz_in_both_motions() {
    for motion in [Motion::Velocity, Motion::Position] {
        let (mut mock, mut config) = mock("ur5", 0.05);
        config.motion = motion;
        complete_session(&mut mock, &config, Version::V2, 125.0);
    }
    // The heartbeat timeout of 40 ms is five of its steps, and the watchdog is two steps later.
    let usual = UrConfig { cycle_hz: 125.0, ..UrConfig::new("localhost", Model::Ur5) };
    let text = render(&usual, 1, 0.008).unwrap();
    assert!(text.contains("PATIENCE_STEPS = 5\n") && text.contains("17.857"), "{text}");
}

#[test]
fn a_controller_of_protocol_version_1_is_supported() {
    for (model, hz) in [("ur5", 125.0), ("ur10", 125.0), ("ur5e", 500.0)] {
        let (mut mock, config) = mock(model, 0.05);
        mock.ask(&Command::RefuseV2 { on: true }).unwrap();
        complete_session(&mut mock, &config, Version::V1, hz);
    }
}

#[test]
fn recovery_uses_the_step_of_the_controllers_software() {
    // The software version decides, not the configured model.
    for (model, other, step_s) in [("ur5", Model::Ur5e, 0.008), ("ur5e", Model::Ur5, 0.002)] {
        let (_mock, mut config) = mock(model, 0.05);
        config.model = other;
        assert_eq!(walk_out(&config, QUICK, &mut |_| {}).unwrap(), step_s);
    }
    let (mut mock, config) = mock("ur3", 0.05);
    mock.ask(&Command::PowerOff).unwrap();
    let mut steps = Vec::new();
    recover(&config, 5, |step| steps.push(step.command)).unwrap();
    assert_eq!(
        steps,
        ["close safety popup", "close popup", "safetymode", "power on", "brake release", "robotmode", "upload"]
    );
    let mut link = UrLink::connect(&config).unwrap();
    let state = receive(&mut link, |s| s.script_token == 5);
    assert!(at_rest(&state) && state.script_state == script_state::WAITING);
}

#[test]
fn held_and_unknown_variables_are_named_with_their_likely_owner() {
    let (mut mock, config) = mock("ur5e", 0.05);
    let first = UrLink::connect(&config).unwrap();
    let text = UrLink::connect(&config).unwrap_err().to_string();
    assert!(text.contains("`input_int_register_24` is held by another RTDE client (IN_USE)"), "{text}");
    assert!(text.contains("another graspd") && text.contains("ROS driver"), "{text}");
    drop(first);
    // The variables are free when the other connection has closed.
    let until = Instant::now() + LIMIT;
    while let Err(e) = UrLink::connect(&config) {
        assert!(Instant::now() < until, "{e}");
    }
    mock.ask(&Command::InUse { names: vec!["input_double_register_30".into()] }).unwrap();
    let text = UrLink::connect(&config).unwrap_err().to_string();
    assert!(text.contains("`input_double_register_30` is held"), "{text}");
    mock.ask(&Command::ClearFaults).unwrap();
    for name in ["target_speed_fraction", "input_double_register_36"] {
        mock.ask(&Command::NotFound { names: vec![name.into()] }).unwrap();
        let text = UrLink::connect(&config).unwrap_err().to_string();
        assert!(text.contains(&format!("no variable `{name}` (NOT_FOUND)")) && text.contains("older"), "{text}");
    }
    mock.ask(&Command::ClearFaults).unwrap();
    mock.ask(&Command::WrongType { names: vec!["actual_q".into()] }).unwrap();
    let text = UrLink::connect(&config).unwrap_err().to_string();
    assert!(text.contains("`actual_q` has type DOUBLE on this controller, expected VECTOR6D"), "{text}");
}

#[test]
fn outputs_of_controller_and_tool_are_set_by_commands() {
    let (_mock, config) = mock("ur5e", 0.05);
    let mut link = UrLink::connect(&config).unwrap();
    link.bring_up(&config).unwrap();
    drive(&mut link, ArmMode::Idle, 0.0, 0, |s| s.script_state == script_state::IDLE);
    // In the controller's word tool outputs are bits 16 and 17, standard outputs bits 0 to 7.
    let on = |set: u32, clear: u32| (set | clear) << 16 | set;
    drive(&mut link, ArmMode::Idle, 0.0, on(0b1_0000_0011, 0), |s| s.digital_outputs & 0x3_00ff == 0x1_0003);
    // In motion as well, and only the outputs in the mask.
    drive(&mut link, ArmMode::Velocity, 0.1, on(0b10_0000_0000, 0b1), |s| s.digital_outputs & 0x3_00ff == 0x3_0002);
    drive(&mut link, ArmMode::Velocity, 0.1, on(0, 0b11_0000_0010), |s| s.digital_outputs & 0x3_00ff == 0);
    // A word with undefined bits is refused, and the arm stops.
    let state = drive(&mut link, ArmMode::Velocity, 0.1, 1 << 10, |s| s.script_state == script_state::FAULT);
    assert_eq!(state.script_fault, 6);
    drive(&mut link, ArmMode::Idle, 0.0, on(1, 0), |s| s.script_fault == 0 && s.digital_outputs & 1 == 1);
}

#[test]
fn every_refusal_of_a_recovery_names_its_fix() {
    type Set = Vec<Command>;
    let cases: Vec<(Set, &str, &str)> = vec![
        (vec![Command::RemoteControl { on: false }], "local control", "Remote Control on the pendant"),
        (vec![Command::EmergencyStop { system: false }], "ROBOT_EMERGENCY_STOP", "release the emergency stop"),
        (vec![Command::EmergencyStop { system: true }], "SYSTEM_EMERGENCY_STOP", "release the emergency stop"),
        (vec![Command::SafeguardStop], "SAFEGUARD_STOP", "close the safeguard"),
        (vec![Command::SafetyFailure { fault: false }], "VIOLATION", "restart the safety system"),
        (vec![Command::SafetyFailure { fault: true }], "FAULT", "restart the safety system"),
        (vec![Command::RobotMode { mode: RobotMode::ConfirmSafety }], "CONFIRM_SAFETY", "confirm the safety"),
        (vec![Command::RobotMode { mode: RobotMode::Backdrive }], "BACKDRIVE", "end backdrive"),
        (vec![Command::RobotMode { mode: RobotMode::Disconnected }], "DISCONNECTED", "restart it"),
        (vec![Command::RobotMode { mode: RobotMode::Booting }], "BOOTING", "no power after the timeout"),
        // Powering on takes a minute here.
        (vec![Command::PowerOff], "POWER", "no power after the timeout"),
        (vec![Command::RobotMode { mode: RobotMode::Idle }], "IDLE", "brakes did not open within the timeout"),
        // The unlock timeout is shorter than the controller's waiting time of five seconds.
        (vec![Command::ProtectiveStop], "5s after occurrence", "graspd status"),
        (vec![Command::Blackhole { port: Port::Dashboard, seconds: 60.0 }], "no dashboard answer", "within"),
    ];
    for (set, answer, fix) in cases {
        let (mut mock, mut config) = mock("ur5e", 60.0);
        config.timeout = Duration::from_millis(400);
        for command in &set {
            mock.ask(command).unwrap();
        }
        let text = walk_out(&config, QUICK, &mut |_| {}).unwrap_err().to_string();
        assert!(text.contains(answer) && text.contains(fix), "{set:?} gave: {text}");
    }
    let (mut mock, mut config) = mock("ur5e", 60.0);
    config.timeout = Duration::from_millis(400);
    mock.ask(&Command::Refuse { port: Port::Dashboard, on: true }).unwrap();
    let error = walk_out(&config, QUICK, &mut |_| {}).unwrap_err();
    assert!(matches!(error, ArmError::Io { .. } | ArmError::Connect { .. }), "{error}");
    drop(mock);
    let error = walk_out(&config, QUICK, &mut |_| {}).unwrap_err();
    assert!(error.to_string().contains("check the cable"), "{error}");
}

#[test]
fn messages_name_the_cause_of_a_stop_and_a_recovery_closes_popups() {
    let (mut mock, config) = mock("ur5e", 0.05);
    let mut listener = MessageListener::new(&config);
    let receive_message = |listener: &mut MessageListener, expected: MessageKind| {
        let until = Instant::now() + LIMIT;
        loop {
            if let Some(message) = listener.poll().into_iter().find(|m| m.kind == expected) {
                return message.text;
            }
            assert!(Instant::now() < until, "no message of kind {expected:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    listener.poll();
    // The mock has to accept the connection.
    std::thread::sleep(Duration::from_millis(200));
    mock.ask(&Command::Script { text: "def broken():\n  a = [1, 2]\n  b = a[7]\nend\n".into() }).unwrap();
    let text = receive_message(&mut listener, MessageKind::Program);
    assert!(text.contains("line 3"), "{text}");
    mock.ask(&Command::Script { text: "popup(\"look here\", title=\"Stop\")\n".into() }).unwrap();
    std::thread::sleep(Duration::from_millis(100));
    mock.ask(&Command::Collision { force: 80.0 }).unwrap();
    assert_eq!(receive_message(&mut listener, MessageKind::Safety), "protective stop (C153A0)");
    // A reset connection is made again.
    mock.ask(&Command::Reset { port: Port::Primary }).unwrap();
    recover(&config, 3, |_| {}).unwrap();
    std::thread::sleep(Duration::from_millis(100));
    let world = mock.stop().unwrap();
    assert!(world.robot.popup.is_none(), "a popup is left on the pendant");
}

/// Collects the records of at least `enough` cycles; returns the state of the link in each.
fn cycles(shared: &Shared, enough: usize) -> Vec<u32> {
    let (start, mut links) = (Instant::now(), Vec::new());
    while links.len() < enough {
        assert!(start.elapsed() < LIMIT, "only {} cycles", links.len());
        while let Some(cycle) = shared.records.pop() {
            links.push(cycle.link);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    links
}

#[test]
fn a_cycle_with_the_robot_as_clock_continues_without_the_robot() {
    let (mock, config) = mock("ur5e", 0.05);
    let scenario = Scenario::from_seed(1, &Options::default()).unwrap();
    let cycle = CommandCycle::new(CycleConfig {
        model: Model::Ur5e,
        dh: Dh::nominal(Model::Ur5e),
        rig: scenario.given_rig,
        gripper: scenario.gripper.gripper.clone(),
        settings: CycleSettings::default(),
    })
    .unwrap();
    let shared = Shared::default();
    std::thread::scope(|scope| {
        scope.spawn(|| CommandWorker::new(cycle, &shared).run_with_robot(2_000_000));
        assert!(cycles(&shared, 50).iter().all(|link| *link == 1), "by a timer before the robot is connected");
        let mut link = UrLink::connect(&config).unwrap();
        link.bring_up(&config).unwrap();
        shared.link_ready.put(Box::new(link));
        assert!(cycles(&shared, 600).ends_with(&[2; 400]), "with the robot");
        drop(mock);
        let until = Instant::now() + LIMIT;
        while !cycles(&shared, 50).ends_with(&[1]) {
            assert!(Instant::now() < until, "the lost link is not noticed");
        }
        assert!(cycles(&shared, 200).ends_with(&[1; 150]), "by a timer after the link is lost");
        let link = shared.link_dead.take().unwrap();
        assert!(link.fault().is_some() && link.stats().sent > 300, "{:?}", link.stats());
        shared.shutdown.store(true, std::sync::atomic::Ordering::Release);
    });
}
