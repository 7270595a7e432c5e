//! The robot on a virtual clock: the daemon's control script, its watchdog, every stop, and the RTDE session byte by
//! byte.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::controller::{Command, RobotMode, Rule, RuntimeState, SafetyMode, Setup, Upload};
use graspd_hil::mock_arm::{MockArm, PeerError};
use graspd_hil::plant::{Kinematics, Model};
use graspd_rt::rtde::{Field, Side, Value};
use proptest::prelude::*;

const TOKEN: i32 = 77;

fn script() -> String {
    let mut text = include_str!("../../../daemon/dist/graspd_control.script").to_owned();
    for (key, value) in [
        ("TOKEN", "77"),
        ("SPEED_LIMITS", "[1, 1, 1, 1, 1, 1]"),
        ("ACCELERATION_LIMIT", "5"),
        ("STOP_ACCELERATION", "4"),
        ("POSITION_STEP", "0.05"),
        ("PATIENCE_STEPS", "10"),
        ("HANDSHAKE_STEPS", "500"),
        ("WATCHDOG_HZ", "20"),
        ("LOOKAHEAD", "0.1"),
        ("GAIN", "300"),
    ] {
        text = text.replace(&format!("{{{{{key}}}}}"), value);
    }
    text
}

fn input(name: &str) -> Field {
    Field::input(name).unwrap()
}

fn arm() -> MockArm {
    MockArm::new(Setup::new(Model::by_name("ur5e").unwrap()), Some((0.5, 4.0)))
}

struct Client {
    arm: MockArm,
    cycle: i32,
    rate: f64,
}

impl Client {
    /// A client after the handshake with the running script.
    fn ready() -> Client {
        let mut c = Client { arm: arm(), cycle: 0, rate: 0.0 };
        assert_eq!(c.arm.upload(&script()), Upload::Main);
        for _ in 0..20 {
            c.command(0, 0.0);
        }
        assert_eq!(c.arm.robot().outputs.ints[25], 2, "idle after the handshake");
        c
    }

    /// One set-point and one step.
    fn command(&mut self, mode: i32, rate: f64) {
        self.cycle += 1;
        self.rate = rate;
        let mut values = vec![
            (input("input_int_register_24"), Value::Int32(mode)),
            (input("input_int_register_25"), Value::Int32(self.cycle)),
            (input("input_int_register_26"), Value::Int32(TOKEN)),
            (input("input_int_register_27"), Value::Int32(0)),
            (input("input_double_register_30"), Value::Double(4.0)),
        ];
        for i in 0..6 {
            let v = if i == 0 { rate } else { 0.0 };
            values.push((input(&format!("input_double_register_{}", 24 + i)), Value::Double(v)));
        }
        self.arm.write_inputs(&values);
        self.arm.step();
    }

    /// Accelerates to `rate` at the stated limit, then continues for some time.
    fn run_up(&mut self, rate: f64) {
        while self.rate < rate {
            let next = (self.rate + 4.0 * 0.002).min(rate);
            self.command(1, next);
        }
        for _ in 0..50 {
            self.command(1, rate);
        }
    }
}

#[test]
fn the_daemons_script_moves_the_arm_within_the_stated_limits() {
    let mut c = Client::ready();
    let start = c.arm.robot().truth.actual_q[0];
    c.run_up(0.4);
    assert!((c.arm.robot().truth.actual_qd[0] - 0.4).abs() < 1e-3);
    assert!(c.arm.robot().truth.actual_q[0] > start + 0.04);
    assert_eq!(c.arm.robot().outputs.ints[24], c.cycle, "the heartbeat is echoed");
    assert_eq!(c.arm.summary().limit_violations, 0, "{:?}", c.arm.summary().violations);
}

#[test]
fn the_arm_stops_within_watchdog_and_ramp_when_the_client_dies_in_motion() {
    let mut slowest = 0.0f64;
    for k in 0..100u32 {
        // A hundred times and speeds, spread by the golden ratio.
        let spread = f64::from(k) * 0.618_033_988_75 % 1.0;
        let (steps, rate) = ((spread * 83.0) as u32, 0.1 + 0.4 * f64::from(k) / 99.0);
        let mut c = Client::ready();
        c.run_up(rate);
        for _ in 0..steps {
            c.command(1, rate);
        }
        // The client sends nothing more.
        assert!(c.arm.step_until(1.0, |r| r.at_rest()), "the arm still moves after 1 s");
        let last = *c.arm.summary().episodes.last().unwrap();
        let bound = 0.050 + rate / 4.0 + 0.030; // the drives trail their targets by a few hundredths
        let took = last.stop_ns().unwrap() as f64 * 1e-9;
        slowest = slowest.max(took - rate / 4.0);
        assert!(took <= bound, "{last:?}");
        assert!(!c.arm.step_until(0.5, |r| !r.at_rest()), "the arm moved again");
        // The watchdog also ended the program.
        assert_eq!(c.arm.robot().runtime, RuntimeState::Stopped);
    }
    println!("slowest of 100: {:.1} ms beyond the ramp", slowest * 1e3);
}

#[test]
fn speedj_without_a_watchdog_continues_without_end() {
    // The reason for the watchdog.
    let mut arm = arm();
    arm.upload("def f():\n  while True:\n    speedj([0.2, 0, 0, 0, 0, 0], 2, get_steptime())\n  end\nend\n");
    arm.step_until(3.0, |_| false);
    assert!((arm.robot().truth.actual_qd[0] - 0.2).abs() < 1e-3);
    arm.robot_mut().stop_program();
    assert!(arm.step_until(0.2, |r| r.at_rest()));
}

#[test]
fn every_stop_brings_the_arm_to_rest_and_keeps_it_at_rest() {
    type Act = (&'static str, Command, f64);
    let acts: [Act; 8] = [
        ("protective", Command::ProtectiveStop, 0.1),
        ("collision", Command::Collision { force: 120.0 }, 0.1),
        ("emergency", Command::EmergencyStop { system: false }, 0.1),
        ("safeguard", Command::SafeguardStop, 0.3),
        ("violation", Command::SafetyFailure { fault: false }, 0.1),
        ("mode", Command::RobotMode { mode: RobotMode::Idle }, 0.1),
        ("pause", Command::PauseProgram, 0.3),
        ("stop", Command::StopProgram, 0.2),
    ];
    for (name, command, bound) in acts {
        let mut c = Client::ready();
        c.run_up(0.4);
        c.arm.command(command).unwrap();
        let mut steps = 0;
        while !c.arm.robot().at_rest() {
            c.command(1, 0.4);
            steps += 1;
            assert!(f64::from(steps) * 0.002 <= bound, "{name}: {:?}", c.arm.robot().truth.actual_qd);
        }
        for _ in 0..500 {
            c.command(1, 0.4);
            assert!(c.arm.robot().at_rest(), "{name}: moves although stopped");
        }
        assert!(!c.arm.robot().is_program_running(), "{name}");
    }
}

#[test]
fn a_stopped_robot_refuses_programs_with_a_reason() {
    let mut a = arm();
    a.command(Command::ProtectiveStop).unwrap();
    assert!(
        matches!(a.upload("movej([0,0,0,0,0,0])\n"), Upload::Refused(reason) if reason.contains("PROTECTIVE_STOP"))
    );
    a.command(Command::Restore).unwrap();
    a.command(Command::RemoteControl { on: false }).unwrap();
    assert!(matches!(a.upload("movej([0,0,0,0,0,0])\n"), Upload::Refused(reason) if reason.contains("local control")));
    a.command(Command::RemoteControl { on: true }).unwrap();
    assert!(matches!(a.upload("def f(:\nend\n"), Upload::Refused(reason) if reason.contains("line 1")));
}

#[test]
fn report_faults_change_the_report_and_not_the_robot() {
    let mut a = arm();
    a.step();
    let q = a.robot().truth.actual_q;
    a.command(Command::NanPosition { joint: 2 }).unwrap();
    a.step();
    assert!(a.robot().report.actual_q[2].is_nan() && a.robot().truth.actual_q == q);
    a.command(Command::ClearFaults).unwrap();
    a.command(Command::Jump { joint: 1, rad: 0.3, seconds: 0.01 }).unwrap();
    a.step();
    assert!((a.robot().report.actual_q[1] - q[1] - 0.3).abs() < 1e-12);
    a.step_until(0.02, |_| false);
    assert_eq!(a.robot().report.actual_q, q);
    a.command(Command::Drift { joint: 3, rate: 0.05 }).unwrap();
    a.step_until(1.0, |_| false);
    assert!((a.robot().truth.actual_qd[3] - 0.05).abs() < 0.005 && !a.robot().at_rest());
    assert!(a.command(Command::Drift { joint: 6, rate: 0.05 }).is_err());
}

#[test]
fn a_stuck_joint_leads_to_a_protective_stop() {
    let mut c = Client::ready();
    c.arm.command(Command::Stuck { joint: 0 }).unwrap();
    for _ in 0..400 {
        c.command(1, 0.4);
    }
    assert_eq!(c.arm.robot().safety, SafetyMode::ProtectiveStop);
}

#[test]
fn the_judge_detects_a_client_that_exceeds_its_limits() {
    let mut c = Client::ready();
    c.command(1, 0.3);
    assert_eq!(c.arm.summary().violations[0].rule, Rule::Accel);
    let mut c = Client::ready();
    c.run_up(0.6);
    assert!(c.arm.summary().violations.iter().any(|v| v.rule == Rule::Rate));
}

#[test]
fn calibrated_kinematics_determine_the_tool_pose() {
    let nominal = arm();
    let mut setup = Setup::new(Model::by_name("ur5e").unwrap());
    setup.kinematics = Kinematics {
        rows: setup.kinematics.rows.map(|mut r| {
            r.a *= 1.001;
            r
        }),
    };
    let own = MockArm::new(setup, None);
    let d = (own.robot().truth.actual_tcp_pose[2] - nominal.robot().truth.actual_tcp_pose[2]).abs();
    assert!(d > 2e-4 && d < 2e-3, "{d}");
}

#[test]
fn the_mocks_kinematics_agree_with_the_daemons() {
    // Two independent implementations.
    let q = [0.3, -1.2, 1.4, -0.9, 1.1, 0.5];
    for model in Model::all() {
        let other = graspd_rt::arm::Model::from_name(model.name).unwrap();
        let (a, b) = (model.nominal().forward(&q), other.dh().base_from_flange(&q));
        assert!((a.translation.vector - b.translation.vector).norm() < 1e-12, "{}", model.name);
        assert!(a.rotation.angle_to(&b.rotation) < 1e-9, "{}", model.name);
    }
}

/// Bytes of one package.
fn package(kind: u8, body: &[u8]) -> Vec<u8> {
    let mut out = ((body.len() + 3) as u16).to_be_bytes().to_vec();
    out.push(kind);
    out.extend_from_slice(body);
    out
}

/// Packages of a stream: kind and body.
fn packages(mut bytes: &[u8]) -> Vec<(u8, Vec<u8>)> {
    let mut out = Vec::new();
    while let Some((head, _)) = bytes.split_first_chunk::<3>() {
        let n = usize::from(u16::from_be_bytes([head[0], head[1]]));
        out.push((head[2], bytes[3..n].to_vec()));
        bytes = &bytes[n..];
    }
    out
}

fn answers(arm: &mut MockArm, client: u64, bytes: &[u8]) -> Vec<(u8, Vec<u8>)> {
    arm.send(client, bytes).unwrap();
    packages(&arm.receive(client))
}

fn outputs(names: &str, hz: f64) -> Vec<u8> {
    package(79, &[&hz.to_be_bytes()[..], names.as_bytes()].concat())
}

#[test]
fn all_outputs_have_their_type_and_length() {
    let mut a = arm();
    let c = a.connect();
    a.send(c, &package(86, &[0, 2])).unwrap();
    a.receive(c);
    let names: Vec<String> = Field::all(Side::Output).map(|f| f.to_string()).collect();
    let types: Vec<&str> = Field::all(Side::Output).map(|f| f.kind().name()).collect();
    let reply = answers(&mut a, c, &outputs(&names.join(","), 500.0));
    assert_eq!((reply[0].0, &reply[0].1[1..]), (79, types.join(",").as_bytes()));
    a.send(c, &package(83, &[])).unwrap();
    a.step();
    let data = packages(&a.receive(c));
    let size: usize = Field::all(Side::Output).map(|f| f.kind().size()).sum();
    assert_eq!((data[0].0, data[0].1.clone(), data[1].0, data[1].1.len()), (83, vec![1], 85, size + 1));
}

#[test]
fn start_pause_start_does_not_double_the_rate() {
    let mut a = arm();
    let c = a.connect();
    a.send(c, &package(86, &[0, 2])).unwrap();
    a.send(c, &outputs("timestamp", 500.0)).unwrap();
    for kind in [83, 80, 83] {
        a.send(c, &package(kind, &[])).unwrap();
    }
    a.receive(c);
    for _ in 0..100 {
        a.step();
    }
    assert_eq!(packages(&a.receive(c)).len(), 100);
    a.send(c, &outputs("timestamp", 125.0)).unwrap();
    a.receive(c);
    for _ in 0..100 {
        a.step();
    }
    assert_eq!(packages(&a.receive(c)).len(), 25);
}

#[test]
fn inputs_are_owned_by_one_client_until_it_disconnects() {
    let mut a = arm();
    let (one, two) = (a.connect(), a.connect());
    let setup = package(73, b"input_int_register_24,input_double_register_24,");
    assert_eq!(answers(&mut a, one, &setup), [(73, b"\x01INT32,DOUBLE".to_vec())]);
    assert_eq!(answers(&mut a, two, &setup), [(73, b"\x00IN_USE,IN_USE".to_vec())]);
    // The owner may use the same variable in a second recipe.
    assert_eq!(answers(&mut a, one, &package(73, b"input_int_register_24")), [(73, b"\x02INT32".to_vec())]);
    let unknown = package(73, b"input_int_register_25,nonsense");
    assert_eq!(answers(&mut a, two, &unknown), [(73, b"\x00INT32,NOT_FOUND".to_vec())]);
    // A failed recipe owns nothing.
    assert_eq!(answers(&mut a, one, &package(73, b"input_int_register_25")), [(73, b"\x03INT32".to_vec())]);
    a.send(one, &package(85, &[2, 0, 0, 0, 9])).unwrap();
    assert_eq!(a.robot().inputs.ints[24], 9, "written without a start");
    a.disconnect(one);
    assert_eq!(a.robot().inputs.ints[24], 9, "the last value stays");
    assert_eq!(answers(&mut a, two, &setup), [(73, b"\x01INT32,DOUBLE".to_vec())]);
}

#[test]
fn masks_select_the_outputs_that_a_package_sets() {
    let mut a = arm();
    let c = a.connect();
    a.send(
        c,
        &package(73, b"standard_digital_output_mask,standard_digital_output,speed_slider_mask,speed_slider_fraction"),
    )
    .unwrap();
    let slider = |mask: u32, v: f64| [&mask.to_be_bytes()[..], &v.to_be_bytes()].concat();
    a.send(c, &package(85, &[&[1, 0b11, 0b01][..], &slider(0, 0.2)].concat())).unwrap();
    assert_eq!((a.robot().signals.digital_out, a.robot().slider), (1, 1.0));
    a.send(c, &package(85, &[&[1, 0b10, 0b11][..], &slider(1, 0.2)].concat())).unwrap();
    assert_eq!((a.robot().signals.digital_out, a.robot().slider), (3, 0.2));
}

#[test]
fn version_1_and_refusals() {
    let mut a = arm();
    let c = a.connect();
    assert_eq!(answers(&mut a, c, &package(86, &[0, 9])), [(86, vec![0])]);
    assert_eq!(answers(&mut a, c, &package(79, b"timestamp,robot_mode")), [(79, b"DOUBLE,INT32".to_vec())]);
    a.send(c, &package(83, &[])).unwrap();
    a.receive(c);
    a.step();
    assert_eq!(packages(&a.receive(c))[0].1.len(), 12, "no recipe id in version 1");
    a.command(Command::RefuseV2 { on: true }).unwrap();
    assert_eq!(answers(&mut a, c, &package(86, &[0, 2])), [(86, vec![0])]);
    assert_eq!(answers(&mut a, c, &package(200, b"?"))[0].0, 77, "an unknown type is answered by a text");
    assert_eq!(a.send(c, &[0, 1, 85]), Err(PeerError::Framing(graspd_rt::rtde::FrameError::TooShort { size: 1 })));
    assert_eq!(a.send(c, &[0]), Err(PeerError::NotConnected(c)));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(std::env::var("GRASPD_FUZZ_CASES").ok().and_then(|v| v.parse().ok()).unwrap_or(300)))]

    /// Arbitrary bytes: no panic, and the result does not depend on how they are split.
    #[test]
    fn arbitrary_bytes_have_the_same_effect_however_they_are_split(
        bytes in proptest::collection::vec(any::<u8>(), 0..400),
        well_formed in proptest::collection::vec((prop_oneof![Just(86u8), Just(79), Just(73), Just(83), Just(80), Just(85), Just(77), any::<u8>()],
            proptest::collection::vec(any::<u8>(), 0..60)), 0..8),
        cut in 1usize..40,
    ) {
        let mut stream: Vec<u8> = well_formed.iter().flat_map(|(k, b)| package(*k, b)).collect();
        stream.extend_from_slice(&bytes);
        let run = |cut: usize| {
            let mut a = arm();
            let c = a.connect();
            let mut end = None;
            let mut out = Vec::new();
            for part in stream.chunks(cut) {
                let result = a.send(c, part);
                out.extend(a.receive(c));
                if let Err(e) = result {
                    end = Some(e);
                    break;
                }
            }
            (end, a.robot().inputs.ints, a.robot().outputs.ints, out)
        };
        let (whole, pieces) = (run(stream.len().max(1)), run(cut));
        prop_assert_eq!(whole.0, pieces.0);
        prop_assert_eq!(whole.1, pieces.1);
    }

    /// Arbitrary text as a script: an answer, no panic, and the robot keeps running.
    #[test]
    fn arbitrary_scripts_leave_the_robot_alive(text in "[a-z0-9_()\\[\\]=+,.:# \n\"]{0,200}") {
        let mut a = arm();
        let _ = a.upload(&text);
        for _ in 0..20 {
            a.step();
        }
        prop_assert!(a.robot().truth.actual_q.iter().all(|q| q.is_finite()));
    }
}

#[test]
fn a_stream_at_the_limits_passes_and_every_violation_is_detected() {
    // Up and down with exactly 4 rad/s2 to exactly 0.5 rad/s, as RTDE packages.
    let mut c = Client::ready();
    for sign in [1.0, -1.0] {
        for k in 0..=62 {
            c.command(1, sign * (f64::from(k) * 0.008).min(0.5));
        }
        for k in (0..=62).rev() {
            c.command(1, sign * (f64::from(k) * 0.008).min(0.5));
        }
    }
    c.command(0, 0.0);
    let seen = c.arm.summary();
    assert_eq!(seen.limit_violations, 0, "{:?}", seen.violations);
    assert!((seen.max_setpoint_rate - 0.496).abs() < 5e-3 && (seen.max_setpoint_accel - 4.0).abs() < 1e-6);

    let rules = |act: &dyn Fn(&mut Client)| {
        let mut c = Client::ready();
        act(&mut c);
        let mut rules: Vec<Rule> = c.arm.summary().violations.iter().map(|v| v.rule).collect();
        rules.dedup();
        rules
    };
    // Slightly beyond each limit: the acceleration has a tolerance of 1 % for rounding, the rate has none.
    assert_eq!(rules(&|c| c.command(1, 0.008 * 1.005)), []);
    assert_eq!(rules(&|c| c.command(1, 0.008 * 1.02)), [Rule::Accel]);
    assert_eq!(
        rules(&|c| {
            c.run_up(0.5);
            c.command(1, 0.5 * (1.0 + 1e-6));
        }),
        [Rule::Rate]
    );
    assert_eq!(rules(&|c| c.command(1, f64::NAN)), [Rule::Finite]);
    assert_eq!(rules(&|c| c.command(0, 0.004)), [Rule::ZeroUnlessVelocity]);
    // A client that has just connected starts from rest.
    assert_eq!(
        rules(&|c| {
            c.run_up(0.3);
            c.arm.connect();
            c.command(1, 0.3);
        }),
        [Rule::Accel]
    );
    // The arm itself.
    assert_eq!(
        rules(&|c| {
            c.arm.command(Command::Drift { joint: 4, rate: 3.2 }).unwrap();
            c.command(0, 0.0);
        }),
        [Rule::ArmRate]
    );
    let far = [6.3, 0.0, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(
        rules(&|c| {
            c.arm.command(Command::Teleport { q: far }).unwrap();
            c.command(0, 0.0);
        }),
        [Rule::ArmPosition]
    );
}
