//! Faults of the link and of the robot, injected into the mock controller: the code that the daemon's link and command
//! cycle must report, the time within which, and that the arm comes to rest and stays at rest.
//!
//! The rows are numbered R (link) and B (robot). The test controls the clock, so that the printed figures
//! (`--nocapture`) are exact and reproducible.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

mod cell;

use cell::{Cell, MS, bring_up, mock, while_serving};
use graspd::arm::{ArmError, LinkFault, check_model, read_identity};
use graspd_hil::controller::{Command, Port, RobotMode, RuntimeState};
use graspd_rt::cycle::{RequestKind, Why};
use graspd_rt::mode::{ModeName, Reject};

/// The RTDE port.
const RTDE: Port = Port::Rtde;
/// Time from full speed to rest at the daemon's 4 rad/s², and the delays of the guard's filter, the link and the
/// drives, ms.
const RAMP_MS: u64 = 125 + 20 + 60;

/// Codes for set-points that do not arrive.
const NO_COMMANDS: &[&str] = &["F-ARM-03", "F-ARM-11"];

/// The expected result of a fault in motion.
#[derive(Clone, Copy)]
enum Expect {
    /// A latched fault with one of these codes, reported within this time, ms.
    Fault(&'static [&'static str], u64),
    /// A hold with this code, reported within this time, ms.
    Hold(&'static str, u64),
    /// No fault: the motion reaches its goal.
    Arrives,
}

use Expect::{Arrives, Fault, Hold};

/// An injected fault and its expected result.
struct Row {
    row: &'static str,
    what: &'static str,
    commands: Vec<Command>,
    expect: Expect,
}

fn row(row: &'static str, what: &'static str, command: Command, expect: Expect) -> Row {
    Row { row, what, commands: vec![command], expect }
}

fn link_rows() -> Vec<Row> {
    let long = 5.0;
    vec![
        row("R02", "reset", Command::Reset { port: RTDE }, Fault(&["F-ARM-01"], 4)),
        row("R02", "closed", Command::Close { port: RTDE }, Fault(&["F-ARM-01"], 4)),
        row("R03", "cable out", Command::Blackhole { port: RTDE, seconds: long }, Fault(&["F-ARM-02"], 24)),
        row("R03", "no states", Command::LoseDownstream { port: RTDE, seconds: long }, Fault(&["F-ARM-02"], 24)),
        // The script on the robot may report the missing heartbeat first (F-ARM-11, script fault 4).
        row("R04", "our writes lost", Command::LoseUpstream { port: RTDE, seconds: long }, Fault(NO_COMMANDS, 56)),
        row("R04", "no echo", Command::MuteOutputs { on: true }, Fault(&["F-ARM-03"], 56)),
        row("R05", "8 to 12 ms late", Command::Delay { port: RTDE, ms: 8.0, jitter_ms: 4.0 }, Arrives),
        row("R05", "60 ms late", Command::Delay { port: RTDE, ms: 60.0, jitter_ms: 10.0 }, Fault(&["F-ARM-02"], 24)),
        row("R06", "burst after 12 ms", Command::Hold { port: RTDE, seconds: 0.012 }, Arrives),
        row("R06", "burst after 80 ms", Command::Hold { port: RTDE, seconds: 0.08 }, Fault(&["F-ARM-02"], 24)),
        row("R07", "pieces of 16 bytes", Command::Chunk { port: RTDE, bytes: 16 }, Arrives),
        // Noise may look like a package of up to 64 KiB, whose body then swallows the states that follow.
        row("R08", "noise", Command::Garbage { port: RTDE, bytes: 4000 }, Fault(&["F-ARM-01", "F-ARM-02"], 24)),
        row("R08", "impossible length", Command::WrongLength { port: RTDE }, Fault(&["F-ARM-01"], 4)),
        row("R08", "unknown type", Command::UnknownType { port: RTDE }, Fault(&["F-ARM-01"], 4)),
        row("R11", "one state of five", Command::KeepOneOf { n: 5 }, Hold("H-15", 2_010)),
        row("R11", "one state of thirty", Command::KeepOneOf { n: 30 }, Fault(&["F-ARM-02"], 62)),
        row("R12", "clock restarts", Command::ClockRestart, Fault(&["F-ARM-01", "F-ARM-13"], 4)),
        row("R12", "clock goes back", Command::ClockShift { seconds: -1.0 }, Fault(&["F-ARM-01", "F-ARM-13"], 4)),
        row("R13", "another token", Command::OutputInt { index: 27, value: 4711 }, Fault(&["F-ARM-12"], 4)),
        row("R13", "another program", other_program(), Fault(&["F-ARM-03", "F-ARM-10"], 56)),
        row("R14", "never reads", Command::StopReading { port: RTDE, seconds: long }, Fault(NO_COMMANDS, 56)),
    ]
}

/// A program of another client that does not move the arm.
fn other_program() -> Command {
    Command::Script { text: "def other():\n  while True:\n    sync()\n  end\nend\n".to_owned() }
}

fn robot_rows() -> Vec<Row> {
    let emergency = |system| Command::EmergencyStop { system };
    let failure = |fault| Command::SafetyFailure { fault };
    let mode = |mode| Command::RobotMode { mode };
    vec![
        row("B01", "protective stop", Command::ProtectiveStop, Fault(&["F-ARM-05"], 4)),
        row("B02", "button", emergency(false), Fault(&["F-ARM-06"], 4)),
        row("B02", "emergency input", emergency(true), Fault(&["F-ARM-06"], 4)),
        row("B02", "safeguard", Command::SafeguardStop, Fault(&["F-ARM-07"], 4)),
        row("B02", "violation", failure(false), Fault(&["F-ARM-08"], 4)),
        row("B02", "safety fault", failure(true), Fault(&["F-ARM-08"], 4)),
        row("B03", "brakes", mode(RobotMode::Idle), Fault(&["F-ARM-09"], 4)),
        row("B03", "backdrive", mode(RobotMode::Backdrive), Fault(&["F-ARM-09"], 4)),
        row("B03", "power off", Command::PowerOff, Fault(&["F-ARM-09"], 4)),
        row("B04", "reduced mode", Command::Reduced { on: true }, Arrives),
        row("B05", "slider at 40 %", Command::SpeedSlider { fraction: 0.4 }, Arrives),
        row("B05", "slider at 0", Command::SpeedSlider { fraction: 0.0 }, Hold("H-06", 4)),
        row("B06", "paused", Command::PauseProgram, Fault(&["F-ARM-10"], 4)),
        row("B06", "stopped", Command::StopProgram, Fault(&["F-ARM-10"], 4)),
        row("B10", "position NaN", Command::NanPosition { joint: 2 }, Fault(&["F-ARM-16"], 4)),
        row("B10", "speed NaN", Command::NanSpeed { joint: 4 }, Fault(&["F-ARM-16"], 4)),
        row("B10", "jump", Command::Jump { joint: 1, rad: 0.3, seconds: 0.2 }, Fault(&["F-ARM-16"], 4)),
        row("B11", "teleported", Command::Teleport { q: [0.0; 6] }, Fault(&["F-ARM-16"], 4)),
        row("B15", "collision", Command::Collision { force: 150.0 }, Fault(&["F-ARM-05"], 4)),
        row("B17", "joints swapped", Command::SwapJoints { a: 1, b: 2 }, Fault(&["F-ARM-16"], 4)),
    ]
}

/// Injects the fault of a row during a motion.
fn in_motion(r: &Row) {
    let label = format!("{} {}", r.row, r.what);
    let mut cell = Cell::start(&[], |_| {}).unwrap_or_else(|e| panic!("{label}: {e}"));
    cell.move_off();
    let injected = cell.now;
    for command in &r.commands {
        cell.inject(command.clone());
    }
    match r.expect {
        Arrives => arrives(&mut cell, &label, r),
        Fault(codes, bound) => stops(&mut cell, &label, codes, bound, injected, true),
        Hold(code, bound) => stops(&mut cell, &label, &[code], bound, injected, false),
    }
    let seen = cell.server.world.judge.summary();
    assert_eq!(seen.limit_violations, 0, "{label}: {:?}", seen.violations);
}

fn arrives(cell: &mut Cell, label: &str, r: &Row) {
    let from = cell.now;
    let reduced = matches!(r.commands[..], [Command::Reduced { on: true }]);
    let cap = 0.4 * 0.5;
    while cell.cycle.mode().name() != ModeName::Converged {
        let out = cell.cycle(None, false);
        assert!(cell.cycle.mode().drives(), "{label}: {:?} {:?}", cell.cycle.mode(), cell.ended);
        assert!(out.event.is_none_or(|e| e.to == ModeName::Converged), "{label}: {:?}", out.event);
        let since = (cell.now - from) / MS;
        if reduced && since > 160 {
            assert!(out.command.rates.iter().all(|r| r.abs() <= cap + 1e-9), "{label}: {:?}", out.command.rates);
        }
        assert!(since < 40_000, "{label}: not there after {since} ms");
    }
    println!("{label:<28} arrives after {} ms", (cell.now - from) / MS);
}

/// Reported within its bound, at rest within its bound, and still at rest when the cause is removed.
fn stops(cell: &mut Cell, label: &str, codes: &[&str], bound: u64, injected: u64, latched: bool) {
    let mut reported = None;
    let mut rest = None;
    while cell.now < injected + (bound + RAMP_MS) * MS {
        let out = cell.cycle(None, false);
        let after = (cell.now - injected) / MS;
        let code = out.event.and_then(|e| match e.why {
            Why::Fault(cause) => Some((cause.code(), cause.to_string())),
            Why::Hold(cause) => Some((cause.code(), cause.to_string())),
            _ => None,
        });
        reported = reported.or(code.map(|c| (c, after)));
        rest = if cell.arm_speed() < 1e-3 { rest.or(Some(after)) } else { None };
    }
    let ((code, text), after) = reported.unwrap_or_else(|| panic!("{label}: not reported"));
    assert!(codes.contains(&code), "{label}: {code} {text}, expected {codes:?}");
    assert!(after <= bound, "{label}: {code} only after {after} ms");
    let rest = rest.unwrap_or_else(|| panic!("{label}: still at {} rad/s", cell.arm_speed()));
    let why = cell.ended.map_or(String::new(), |f| format!("; link: {f}"));
    println!("{label:<28} {code} after {after:>2} ms, at rest after {rest:>3} ms: {text}{why}");
    // The causes are removed: the arm does not move by itself, and the first cause is kept.
    for command in
        [Command::ClearFaults, Command::SpeedSlider { fraction: 1.0 }, Command::ClearSafety, Command::Restore]
    {
        cell.inject(command);
    }
    for _ in 0..250 {
        cell.cycle(None, false);
        assert!(cell.arm_speed() < 1e-3, "{label}: moves again by itself");
    }
    if latched {
        assert_eq!(cell.cycle.mode().fault().unwrap().cause.code(), code, "{label}");
        assert_eq!(
            cell.cycle(Some(RequestKind::Servo), false).reply.unwrap().result,
            Err(Reject::WrongMode),
            "{label}"
        );
    } else {
        assert_eq!(cell.cycle.mode().name(), ModeName::Armed, "{label}");
    }
}

#[test]
fn link_faults_in_motion() {
    link_rows().iter().for_each(in_motion);
}

#[test]
fn robot_faults_in_motion() {
    robot_rows().iter().for_each(in_motion);
}

/// R16, and R15 when the watchdog has no effect: without commands the arm stops by itself.
#[test]
fn the_arm_stops_when_the_client_sends_nothing() {
    for no_watchdog in [false, true] {
        let mut cell = Cell::start(&[Command::NoWatchdog { on: no_watchdog }], |_| {}).unwrap();
        cell.move_off();
        let from = cell.now;
        cell.silent = true;
        let mut rest = None;
        while cell.now < from + 1_000 * MS {
            cell.cycle(None, false);
            rest = if cell.arm_speed() < 1e-3 { rest.or(Some((cell.now - from) / MS)) } else { None };
        }
        let rest = rest.expect("still moving a second later");
        println!("{} silent client: at rest after {rest} ms", if no_watchdog { "R15 no watchdog," } else { "R16" });
        assert!(rest <= 50 + RAMP_MS, "{rest} ms");
        // The watchdog ends the program; without it the script keeps waiting for a heartbeat.
        let runtime = cell.server.world.robot.runtime;
        assert_eq!(runtime == RuntimeState::Stopped, !no_watchdog, "{runtime:?}");
    }
}

/// R01, R09, R15, B03: faults before the link is up are refused with a reason.
#[test]
fn faults_before_the_link_is_up_are_refused_with_their_reason() {
    let names = || vec!["input_double_register_25".to_owned()];
    let outputs = || vec!["actual_qd".to_owned()];
    let rows: [(&str, Command, &[&str]); 9] = [
        ("R01 refused", Command::Refuse { port: RTDE, on: true }, &["RTDE", "connection"]),
        ("R09 in use", Command::InUse { names: names() }, &["input_double_register_25", "another RTDE client"]),
        ("R09 unknown input", Command::NotFound { names: names() }, &["input_double_register_25"]),
        ("R09 unknown output", Command::NotFound { names: outputs() }, &["actual_qd"]),
        ("R09 other type", Command::WrongType { names: outputs() }, &["actual_qd"]),
        ("R15 outputs mute", Command::MuteOutputs { on: true }, &["script"]),
        ("B01 stopped already", Command::ProtectiveStop, &["not ready", "graspd recover"]),
        ("B03 brakes on", Command::RobotMode { mode: RobotMode::Idle }, &["not ready", "graspd recover"]),
        ("B03 local control", Command::RemoteControl { on: false }, &["Remote Control"]),
    ];
    for (label, command, parts) in rows {
        let (server, mut config) = mock(&[command]);
        config.timeout = std::time::Duration::from_secs(2);
        let (_server, link) = while_serving(server, || bring_up(&config));
        let error = link.err().unwrap_or_else(|| panic!("{label}: the link came up")).to_string();
        println!("{label:<28} {error}");
        for part in parts {
            assert!(error.to_lowercase().contains(&part.to_lowercase()), "{label}: {error} does not contain {part}");
        }
    }
}

/// R10: a controller that supports protocol version 1 only.
#[test]
fn an_old_controller_is_used_with_protocol_version_1() {
    let mut cell = Cell::start(&[Command::RefuseV2 { on: true }], |_| {}).unwrap();
    cell.move_off();
    let r = row("R10", "version 1", Command::Ping, Arrives);
    arrives(&mut cell, "R10 version 1", &r);
    assert_eq!(cell.server.world.judge.summary().limit_violations, 0);
}

/// R15: a control script of another version is refused.
#[test]
fn a_script_of_another_version_is_refused() {
    let (server, config) = mock(&[]);
    let (mut server, link) = while_serving(server, || graspd::arm::UrLink::connect(&config));
    let mut link = link.unwrap();
    // A robot whose script echoes the token and reports version 9.
    let token = graspd::arm::ArmLink::token(&link);
    for command in [
        Command::MuteOutputs { on: true },
        Command::OutputInt { index: 25, value: 1 },
        Command::OutputInt { index: 27, value: token },
        Command::OutputInt { index: 28, value: 9 },
    ] {
        server.world.command(command, 0).unwrap();
    }
    let (_server, result) = while_serving(server, || link.bring_up(&config));
    assert!(matches!(result, Err(ArmError::ScriptVersion { found: 9, .. })), "{result:?}");
}

/// B17: another model than configured.
#[test]
fn another_model_is_refused() {
    let (server, config) = mock(&[Command::ClaimRobotType { number: 2 }]);
    let (_server, identity) = while_serving(server, || read_identity(&config));
    let refused = check_model(&identity.unwrap(), graspd_rt::arm::Model::Ur5e).unwrap_err().to_string();
    println!("B17 another arm              {refused}");
    assert!(refused.contains("robot type 2") && refused.contains("arm.model"), "{refused}");
}

/// B09: the arm moves slowly while it is armed and commanded to rest. B08: it does not follow its set-points.
#[test]
fn an_arm_that_does_not_follow_its_commands_is_a_fault() {
    let mut cell = Cell::start(&[], |_| {}).unwrap();
    cell.run(600);
    cell.cycle(None, true);
    assert_eq!(cell.cycle(Some(RequestKind::Arm), false).reply.unwrap().result, Ok(()));
    cell.run(300);
    let from = cell.now;
    cell.inject(Command::Drift { joint: 2, rate: 0.05 });
    while cell.cycle.mode().fault().is_none() && cell.now < from + 1_000 * MS {
        cell.cycle(None, false);
    }
    let fault = cell.cycle.mode().fault().expect("the motion was not detected");
    let after = (fault.at_ns - from) / MS;
    println!("B09 creeps                   {} after {after} ms: {}", fault.cause.code(), fault.cause);
    assert_eq!(fault.cause.code(), "F-ARM-15");
    assert!(after <= 50, "{after} ms");

    for (what, slow) in [("stuck", false), ("lags", true)] {
        let mut cell = Cell::start(&[], |_| {}).unwrap();
        cell.move_off();
        let rates = cell.sent.last().unwrap().1;
        let joint = (0..6).fold(0, |m, i| if rates[i].abs() > rates[m].abs() { i } else { m });
        let from = cell.now;
        cell.inject(if slow { Command::Lag { seconds: 3.0 } } else { Command::Stuck { joint } });
        while cell.cycle.mode().drives() && cell.now < from + 4_000 * MS {
            cell.cycle(None, false);
        }
        let fault = *cell.cycle.mode().fault().unwrap_or_else(|| panic!("{what}: {:?}", cell.cycle.mode()));
        let after = (fault.at_ns - from) / MS;
        println!("B08 {what:<24} {} after {after} ms: {}", fault.cause.code(), fault.cause);
        // The images may show it before the joints do.
        let known = ["F-ARM-14", "F-ARM-05", "F-MRK-01", "F-MRK-02", "F-LAW-01"];
        assert!(known.contains(&fault.cause.code()), "{:?}", fault.cause);
        cell.inject(Command::ClearFaults);
        cell.run(400);
        assert!(cell.arm_speed() < 1e-3, "{what}: still moving");
    }
}

/// B07 and B11: a path that ends at a joint limit or at a singularity is refused before the arm moves.
#[test]
fn a_path_out_of_range_is_refused_before_it_begins() {
    // The goal of the third joint is outside its configured range.
    let mut cell = Cell::start(&[], |s| s.limits.position_min_rad[2] = graspd_rt::arm::READY[2] + 0.06).unwrap();
    assert_eq!(cell.ask_servo(), Err(Reject::OutOfReach), "B07");
    cell.run(200);
    assert!(cell.arm_speed() < 1e-3);
    // With this threshold every pose of the arm counts as singular.
    let mut cell = Cell::start(&[], |s| s.rates.hard_sigma = 10.0).unwrap();
    assert_eq!(cell.ask_servo(), Err(Reject::OutOfReach), "B11");
    cell.run(200);
    assert!(cell.arm_speed() < 1e-3);
}

/// R06: of delayed states only the newest is used, and each cycle sends one command.
#[test]
fn a_backlog_is_not_replayed() {
    let mut cell = Cell::start(&[], |_| {}).unwrap();
    cell.move_off();
    cell.inject(Command::Hold { port: RTDE, seconds: 0.014 });
    let mut packages = Vec::new();
    for _ in 0..12 {
        let before = cell.link.as_ref().map(graspd::arm::ArmLink::stats).unwrap();
        cell.cycle(None, false);
        let after = cell.link.as_ref().map(graspd::arm::ArmLink::stats).unwrap();
        packages.push((after.received - before.received, after.sent - before.sent));
    }
    assert!(packages.iter().any(|(received, _)| *received >= 5), "no burst: {packages:?}");
    assert!(packages.iter().all(|(_, sent)| *sent == 1), "one command a cycle, burst or not: {packages:?}");
}

/// The link's text for each of its faults.
#[test]
fn a_link_that_ends_reports_its_fault() {
    for (command, part) in [
        (Command::Close { port: RTDE }, "closed"),
        (Command::WrongLength { port: RTDE }, "framing"),
        (Command::UnknownType { port: RTDE }, "protocol"),
        (Command::ClockRestart, "restarted"),
    ] {
        let mut cell = Cell::start(&[], |_| {}).unwrap();
        cell.run(20);
        cell.inject(command);
        cell.run(20);
        let fault: LinkFault = cell.ended.expect("the link is still up");
        assert!(fault.to_string().contains(part), "{fault}");
    }
}

/// With wrong kinematics the gripper's speed differs from the computed one. The tool speed that the controller reports
/// shows it, for any tool point. A controller that does not report it is supported.
#[test]
fn wrong_kinematics_are_detected_by_the_controllers_tool_speed() {
    let tool = Command::Tcp { pose: [0.02, -0.03, 0.17, 0.1, 0.2, -0.3] };
    for (factor, detected) in [(0.8, true), (1.25, true), (1.0, false)] {
        let mut cell = Cell::start(std::slice::from_ref(&tool), |_| {}).unwrap();
        cell.scale_lengths(factor);
        cell.run(600);
        assert_eq!(cell.ask_servo(), Ok(()), "{factor}");
        let from = cell.now;
        while cell.cycle.mode().drives()
            && cell.cycle.mode().name() != ModeName::Converged
            && cell.now < from + 30_000 * MS
        {
            cell.cycle(None, false);
        }
        let code = cell.cycle.mode().fault().map(|f| (f.cause.code(), f.cause.to_string()));
        println!("B17 lengths x {factor:<14} {code:?} after {} ms", (cell.now - from) / MS);
        assert_eq!(code.map(|c| c.0), detected.then_some("F-ARM-17"), "{factor}");
    }
    let mut cell = Cell::start(&[Command::NotFound { names: vec!["tcp_offset".to_owned()] }], |_| {}).unwrap();
    assert!(cell.link.as_ref().unwrap().state().unwrap().tool.is_none());
    cell.move_off();
    arrives(&mut cell, "B17 no tool point", &row("B17", "no tool point", Command::Ping, Arrives));
}
