//! The UR link and the control script against the mock controller, over loopback TCP: identity, upload, motion, a
//! heartbeat that stops, a protective stop and the recovery from it. Every wait is bounded.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic
#![cfg(feature = "demo")]

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use graspd::arm::{ArmLink, Motion, UrConfig, UrLink, check_model, read_identity, recover};
use graspd::realtime::now_ns;
use graspd_hil::controller::{Command, Robot, Server, Setup, World};
use graspd_rt::arm::{ArmCommand, ArmMode, Model, RobotState};
use graspd_rt::rtde::script_state;

const LIMIT: Duration = Duration::from_secs(20);

/// A mock controller on a separate loopback address, and the configuration of its client.
struct Mock {
    config: UrConfig,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

static NEXT: AtomicU8 = AtomicU8::new(1);

impl Mock {
    fn start(before: Option<Command>) -> Mock {
        let id = std::process::id();
        let n = NEXT.fetch_add(1, Ordering::Relaxed);
        let address = Ipv4Addr::new(127, 64 + (id >> 8) as u8 % 128, id as u8, n);
        let setup = Setup { power_time_s: 0.05, ..Setup::new(graspd_hil::plant::Model::by_name("ur5e").unwrap()) };
        let mut world = World::new(Robot::new(setup), None, None);
        if let Some(command) = before {
            world.command(command, now_ns()).unwrap();
        }
        let mut server = Server::bind(world, IpAddr::V4(address), 0, None).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = Some(std::thread::spawn(move || server.run(&stopped)));
        // A stalled host must not look like a dead client; another test uses the default watchdog.
        let config = UrConfig { watchdog_ms: 500.0, ..UrConfig::new(address.to_string(), Model::Ur5e) };
        Mock { config, stop, thread }
    }
}

impl Drop for Mock {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Sends a command for each of the robot's packages until `done`.
fn drive(link: &mut UrLink, mode: ArmMode, rate: f64, outputs: u32, done: impl Fn(&RobotState) -> bool) -> RobotState {
    let start = Instant::now();
    let mut cycle = link.state().map_or(0, |s| s.echo);
    while start.elapsed() < LIMIT {
        link.wait(now_ns() + 20_000_000);
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
        link.wait(now_ns() + 20_000_000);
        if let Some(state) = link.poll(now_ns()).state.filter(&done) {
            return state;
        }
    }
    panic!("not reached within {LIMIT:?}: {:?}", link.state());
}

fn at_rest(s: &RobotState) -> bool {
    s.qd.iter().chain(&s.target_qd).all(|v| v.abs() < 1e-3)
}

#[test]
fn both_motions_drive_the_arm_and_a_lost_heartbeat_stops_it() {
    for motion in [Motion::Velocity, Motion::Position] {
        let mut mock = Mock::start(None);
        mock.config.motion = motion;
        let identity = read_identity(&mock.config).unwrap();
        check_model(&identity, Model::Ur5e).unwrap();
        assert!(check_model(&identity, Model::Ur10e).is_err());

        let mut link = UrLink::connect(&mock.config).unwrap();
        link.bring_up(&mock.config).unwrap();
        // A command to move before the handshake must not move the arm.
        let q0 = link.state().unwrap().q[5];
        let mut steps = 0;
        while steps < 50 {
            link.wait(now_ns() + 20_000_000);
            steps += link.poll(now_ns()).packages;
            let command = ArmCommand { mode: ArmMode::Velocity, rates: [0.3; 6], heartbeat: steps as i32, outputs: 0 };
            link.send(&command).unwrap();
        }
        assert!((link.state().unwrap().q[5] - q0).abs() < 1e-3);

        drive(&mut link, ArmMode::Idle, 0.0, 0, |s| s.script_state == script_state::IDLE);
        let moved = drive(&mut link, ArmMode::Velocity, 0.4, 0, |s| s.q[5] - q0 > 0.1);
        assert_eq!(moved.script_fault, 0);
        assert!(moved.qd[5] > 0.2, "{motion:?}: {}", moved.qd[5]);
        let stopped = drive(&mut link, ArmMode::Stop, 0.0, 0x0001_0001, |s| at_rest(s) && s.digital_outputs & 1 == 1);
        assert_eq!(stopped.script_state, script_state::STOPPING);

        // The heartbeat ends in full motion: the arm comes to rest by itself, and the program ends.
        drive(&mut link, ArmMode::Velocity, 0.4, 0x0001_0001, |s| s.qd[5] > 0.2);
        let rest = receive(&mut link, |s| at_rest(s) && s.robot_status_bits & 2 == 0);
        assert!(rest.digital_outputs & 1 == 1);
        // New commands do not move the arm: the script has ended and has to be uploaded again.
        for _ in 0..20 {
            link.wait(now_ns() + 20_000_000);
            link.poll(now_ns());
            link.send(&ArmCommand { mode: ArmMode::Velocity, rates: [0.3; 6], heartbeat: 1, outputs: 0 }).unwrap();
        }
        assert!(at_rest(link.state().unwrap()));
    }
}

#[test]
fn a_new_session_follows_a_lost_one() {
    let mock = Mock::start(None);
    let mut tokens = Vec::new();
    for _ in 0..3 {
        let mut link = UrLink::connect(&mock.config).unwrap();
        link.bring_up(&mock.config).unwrap();
        drive(&mut link, ArmMode::Idle, 0.0, 0, |s| s.script_state == script_state::IDLE);
        drive(&mut link, ArmMode::Velocity, 0.2, 0, |s| s.qd[5] > 0.1);
        tokens.push(link.state().unwrap().script_token);
    }
    tokens.dedup();
    assert_eq!(tokens.len(), 3);
}

#[test]
fn recovery_leads_from_a_protective_stop_to_an_idle_script() {
    let mock = Mock::start(Some(Command::ProtectiveStop));
    let mut link = UrLink::connect(&mock.config).unwrap();
    let refused = link.bring_up(&mock.config).unwrap_err();
    assert!(refused.to_string().contains("graspd recover"), "{refused}");
    let mut steps = Vec::new();
    recover(&mock.config, link.token(), |step| steps.push(step.command)).unwrap();
    assert!(steps.contains(&"unlock protective stop") && steps.last() == Some(&"upload"), "{steps:?}");
    let token = link.token();
    let state = receive(&mut link, |s| s.script_token == token);
    assert!(at_rest(&state) && state.safety_status_bits & 0b100 == 0);
    let state = drive(&mut link, ArmMode::Idle, 0.0, 0, |s| s.script_state == script_state::IDLE);
    assert_eq!(state.script_fault, 0);
}

#[test]
fn recovery_powers_up_but_does_not_clear_an_emergency_stop() {
    let mock = Mock::start(Some(Command::PowerOff));
    recover(&mock.config, 5, |_| {}).unwrap();
    drop(mock);
    let mock = Mock::start(Some(Command::EmergencyStop { system: false }));
    let error = recover(&mock.config, 5, |_| {}).unwrap_err();
    assert!(error.to_string().to_uppercase().contains("EMERGENCY"), "{error}");
}
