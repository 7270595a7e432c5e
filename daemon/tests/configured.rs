//! Configurations that are refused, and requests that a configured daemon refuses: real processes and the files they
//! read.
#![cfg(feature = "demo")]
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

mod cell;

use cell::{Extra, World, ask, summary};
use graspd::config::Config;
use graspd::realtime::now_ns;
use graspd_shm::control::{RequestClient, Verb};
use graspd_shm::create_node;
use rustix::process::Signal;
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

fn graspd(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_graspd")).current_dir(folder).args(args).output().unwrap()
}

fn output(out: &Output) -> String {
    String::from_utf8_lossy(&[&out.stdout[..], b" ", &out.stderr[..]].concat()).into_owned()
}

/// Waits until `done` is true for the daemon's status.
fn until(world: &World, what: &str, done: impl Fn(&Value) -> bool) -> Value {
    let end = Instant::now() + Duration::from_secs(40);
    loop {
        let (_, status) = world.verb(&["status"]);
        if done(&status) {
            return status;
        }
        assert!(Instant::now() < end, "{what}: {status}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

fn text<'a>(v: &'a Value, key: &str) -> &'a str {
    v.get(key).and_then(Value::as_str).unwrap_or("")
}

/// The files of a cell without its processes.
struct Files {
    world: World,
    good: String,
}

impl Files {
    fn new(seed: u64) -> Self {
        let world = World::new(seed);
        let good = std::fs::read_to_string(world.folder.join("graspd.toml")).unwrap();
        Self { world, good }
    }

    /// `check` and `run` both refuse `config` with a message that contains these parts, before anything starts.
    fn refused(&self, config: &str, parts: &[&str]) {
        std::fs::write(self.world.folder.join("graspd.toml"), config).unwrap();
        for verb in ["check", "run"] {
            let started = Instant::now();
            let out = graspd(&self.world.folder, &[verb, "--config", "graspd.toml"]);
            assert_eq!(out.status.code(), Some(3), "{verb}: {}", output(&out));
            for part in parts {
                assert!(output(&out).contains(part), "{verb} does not print {part}: {}", output(&out));
            }
            assert!(started.elapsed() < Duration::from_secs(5), "{verb} has started something");
        }
    }

    /// `check` accepts `config`; returns its output.
    fn accepted(&self, config: &str) -> String {
        std::fs::write(self.world.folder.join("graspd.toml"), config).unwrap();
        let out = graspd(&self.world.folder, &["check", "--config", "graspd.toml"]);
        assert_eq!(out.status.code(), Some(0), "{}", output(&out));
        output(&out)
    }
}

#[test]
fn limits_are_refused_at_load_under_their_keys_in_the_file() {
    let f = Files::new(21);
    let with = |lines: &str| format!("{}[limits]\n{lines}\n", f.good);
    f.refused(&with("joint_speed_rad_s = 3.0"), &["limits.joint_speed_rad_s", "1.6", "graspd.toml"]);
    f.refused(&with("tcp_speed_m_s = 0.6"), &["limits.tcp_speed_m_s", "0.5"]);
    f.refused(&with("joint_jerk_rad_s3 = 0.1"), &["limits.joint_jerk_rad_s3"]);
    f.refused(
        &with("joint_accel_rad_s2 = 0.1"),
        &["a stop from full speed takes", "300.0 ms", "joint_accel_rad_s2 (0.1)"],
    );
    f.refused(&with("joint_speed_rad_s = 1.15"), &["turns a joint by", "8.6 degrees"]);
    f.refused(&with("joint_speed_rad_s = 1.0\ntcp_speed_m_s = 0.5"), &["moves the gripper by", "50.0 mm"]);
    let text = f.accepted(&with("joint_accel_rad_s2 = 2.0"));
    // 125 cycles of the ramp and 2 of the filter, of 2 ms each.
    assert!(text.contains("254 ms") && text.contains("degrees a joint"), "{text}");
}

#[test]
fn the_kinematics_file_is_read_and_compared_with_the_model_at_load() {
    let f = Files::new(22);
    let arm = f.world.folder.join("world/arm.toml");
    let table = |scale: f64, angle: f64, five: bool| {
        let row = |v: [f64; 6], s: f64| {
            let n = if five { 5 } else { 6 };
            v.iter().take(n).map(|x| format!("{:?}", x * s)).collect::<Vec<_>>().join(", ")
        };
        let dh = graspd_rt::arm::Dh::nominal(graspd_rt::arm::Model::Ur5e);
        let text = format!(
            "[dh]\na = [{}]\nd = [{}]\nalpha = [{}]\ntheta = [{}]\n",
            row(dh.a, scale),
            row(dh.d, scale),
            row(dh.alpha, angle),
            row(dh.theta, angle)
        );
        std::fs::write(&arm, text).unwrap();
    };
    table(1.0, 1.0, false);
    assert!(f.accepted(&f.good).contains("arm.toml"));
    table(0.8, 1.0, false);
    f.refused(&f.good, &["arm.toml", "mm away from where a ur5e has it"]);
    table(1000.0, 1.0, false);
    f.refused(&f.good, &["arm.toml", "dh.a[1]", "not mm"]);
    table(1.0, 180.0 / std::f64::consts::PI, false);
    f.refused(&f.good, &["arm.toml", "dh.alpha[0]", "not degrees"]);
    table(1.0, 1.0, true);
    f.refused(&f.good, &["arm.toml", "six numbers"]);
    std::fs::remove_file(&arm).unwrap();
    f.refused(&f.good, &["arm.toml", "cannot be read"]);
}

#[test]
fn opening_must_reverse_closing() {
    let f = Files::new(23);
    let with = |lines: &str| format!("{}[gripper]\n{lines}\n", f.good);
    f.refused(&with("close_set = [0]\nopen_set = [0]"), &["gripper.open_set", "opening must clear"]);
    f.refused(&with("close_set = [0]\nopen_set = [1]"), &["gripper.open_set"]);
    f.accepted(&with("close_set = [0]\nopen_clear = [0]"));
    f.accepted(&with("close_set = [0]\nclose_clear = [1]\nopen_set = [1]\nopen_clear = [0]"));
    f.accepted(&with("close_set = [8]"));
}

/// The state of the gripper is read from the controller's outputs, so that a restarted daemon knows it.
#[test]
fn a_restarted_daemon_does_not_servo_with_a_closed_gripper() {
    let tables = "[gripper]\nclose_set = [0]\nopen_clear = [0]\ntime_ms = 200.0\n".to_owned();
    let world = World::with(24, Extra { tables, ..Extra::default() });
    let (mock, _scene, mut daemon) = (world.mock(), world.scene(), world.daemon());
    let status = until(&world, "tracking", |s| text(s, "state") == "tracking");
    assert_eq!(text(&status, "gripper"), "open");
    assert!(
        status["error_px"].is_null() && status["residual_px"].is_null() && status["distance_m"].is_null(),
        "{status}"
    );
    assert!(
        status["stop_from_full_speed"]["time_ms"].as_f64().is_some_and(|t| (100.0..200.0).contains(&t)),
        "{status}"
    );
    world.insist(&["gripper", "close"]);
    until(&world, "closed", |s| text(s, "gripper") == "closed");
    daemon.signal(Signal::TERM);
    let end = Instant::now() + Duration::from_secs(5);
    while daemon.alive() {
        assert!(Instant::now() < end, "the daemon does not end");
        std::thread::sleep(Duration::from_millis(10));
    }
    drop(daemon);

    let _daemon = world.daemon();
    until(&world, "tracking again", |s| text(s, "state") == "tracking");
    let (accepted, answer) = world.verb(&["setpoint", &world.path("plan.toml")]);
    assert!(accepted && text(&answer, "setpoint").len() == 16, "the answer names the set-point: {answer}");
    // Not armed: the refusal names mode and next step.
    let (accepted, answer) = world.verb(&["servo"]);
    let reason = text(&answer, "reason");
    assert!(!accepted && reason.contains("mode tracking") && reason.contains("graspd arm"), "{reason}");
    world.insist(&["arm"]);
    let end = Instant::now() + Duration::from_secs(2);
    while Instant::now() < end {
        let (accepted, answer) = world.verb(&["servo"]);
        assert!(!accepted, "it would pull at a held part: {answer}");
        std::thread::sleep(Duration::from_millis(100));
    }
    let (_, answer) = world.verb(&["servo"]);
    assert!(text(&answer, "reason").contains("open it first"), "{answer}");
    assert_eq!(text(&answer, "gripper"), "closed");
    assert_eq!(summary(&mock)["limit_violations"], 0);
    world.insist(&["gripper", "open"]);
    world.insist(&["servo"]);
    world.insist(&["stop"]);
}

/// A recovery requested while armed disarms; it is not a fault.
#[test]
fn a_recovery_while_armed_ends_idle() {
    let world = World::new(25);
    let (_mock, _scene, _daemon) = (world.mock(), world.scene(), world.daemon());
    world.insist(&["setpoint", &world.path("plan.toml")]);
    world.insist(&["arm"]);
    let out = graspd(&world.folder, &["recover", "--config", "graspd.toml"]);
    assert!(out.status.success(), "{}", output(&out));
    for _ in 0..20 {
        let (state, cause) = world.state();
        assert!(state == "idle" || state == "tracking", "{state}: {cause}");
        std::thread::sleep(Duration::from_millis(20));
    }
    let log = world.log();
    assert!(!log.contains("-> fault"), "{log}");
}

/// A request stamped in the future would never become too old: a recording of it could start a motion at any time.
#[test]
fn requests_from_the_future_and_edited_plans_are_refused() {
    let world = World::new(26);
    let (_mock, _scene, _daemon) = (world.mock(), world.scene(), world.daemon());
    until(&world, "tracking", |s| text(s, "state") == "tracking");
    let config = Config::load(&world.folder.join("graspd.toml")).unwrap();
    let node = create_node(&config.names, "test").unwrap();
    let client = RequestClient::new(&node).unwrap();
    let plan = std::fs::read_to_string(world.folder.join("plan.toml")).unwrap();
    let send = |verb, payload: &[u8], ahead_ns: u64| {
        let answer = client.ask(verb, payload, now_ns() + ahead_ns, Duration::from_secs(2)).unwrap();
        (answer.accepted, answer.json)
    };
    for (verb, payload) in [
        (Verb::Setpoint, plan.as_bytes()),
        (Verb::Arm, b""),
        (Verb::Servo, b""),
        (Verb::Gripper, b"close"),
        (Verb::Recover, b""),
    ] {
        let (accepted, json) = send(verb, payload, 3_600_000_000_000);
        assert!(!accepted && json.contains("in the future"), "{verb:?}: {json}");
    }
    assert!(send(Verb::Stop, b"", 3_600_000_000_000).0, "a stop is accepted with any stamp");
    // Every kind of value, and a comment, which does not matter.
    let edits: [(&str, &Edit); 5] = [
        ("opening", &|t| edit(t, "opening_m = ", "opening_m = 0.0123")),
        ("standoff", &|t| edit(t, "standoff_m = ", "standoff_m = 0.5")),
        ("best view", &|t| {
            let (from, to) = if t.contains("best_view = \"left\"") { ("left", "right") } else { ("right", "left") };
            t.replacen(&format!("best_view = \"{from}\""), &format!("best_view = \"{to}\""), 1)
        }),
        ("goals exchanged", &|t| {
            t.replace("pregrasp", "\u{1}")
                .replace("[grasp", "[pregrasp")
                .replace("[[grasp", "[[pregrasp")
                .replace('\u{1}', "grasp")
        }),
        ("no hash", &|t| t.lines().filter(|l| !l.starts_with("content")).fold(String::new(), |a, l| a + l + "\n")),
    ];
    for (what, make) in edits {
        let changed = make(&plan);
        assert_ne!(changed, plan, "{what}: the edit changed nothing");
        let (accepted, json) = send(Verb::Setpoint, changed.as_bytes(), 0);
        let why = if what == "no hash" { "written by hand" } else { "edited after it was made" };
        assert!(!accepted && json.contains(why), "{what}: {json}");
    }
    let (accepted, json) = send(Verb::Setpoint, format!("# for line 3\n{plan}").as_bytes(), 0);
    assert!(accepted, "a comment is not an edit: {json}");
    // A configuration that is edited while the daemon runs is listed.
    let file = world.folder.join("graspd.toml");
    let before = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, before + "# later\n").unwrap();
    let (_, status) = world.verb(&["status"]);
    let changed = status["configuration_changed"].as_array().unwrap();
    assert!(changed.len() == 1 && changed[0].as_str().unwrap().ends_with("graspd.toml"), "{status}");
}

/// An edit of a plan.
type Edit = dyn Fn(&str) -> String;

/// Replaces the first line that begins with `key` by `line`.
fn edit(text: &str, key: &str, line: &str) -> String {
    let mut done = false;
    text.lines().fold(String::new(), |all, l| {
        let hit = !done && l.starts_with(key);
        done |= hit;
        all + if hit { line } else { l } + "\n"
    })
}

/// The arm is identified also when its kinematics come from a file.
#[test]
fn another_model_is_refused_with_a_kinematics_file_as_well() {
    let world = World::new(27);
    let mock = world.mock();
    ask(&mock, r#"{"cmd":"claim_robot_type","number":2}"#);
    let (_scene, _daemon) = (world.scene(), world.daemon());
    let status = until(&world, "refused", |s| text(s, "robot").contains("robot type 2"));
    assert!(text(&status, "robot").contains("set arm.model"), "{status}");
    let (accepted, answer) = world.verb(&["arm"]);
    assert!(!accepted, "{answer}");
}

/// Without images the refusal of `arm` names the missing images.
#[test]
fn a_refusal_of_arm_names_the_state_of_the_images() {
    let world = World::new(28);
    let (_mock, _daemon) = (world.mock(), world.daemon());
    until(&world, "link up", |s| text(s, "robot") == "up");
    let (accepted, answer) = world.verb(&["arm"]);
    let reason = text(&answer, "reason");
    assert!(!accepted && reason.contains("no usable image has arrived yet"), "{reason}");
}

#[test]
fn a_plan_does_not_overwrite_its_inputs() {
    let world = World::new(29);
    let f = &world.folder;
    std::fs::hard_link(f.join("left.png"), f.join("again.png")).unwrap();
    let click = ["--select-left", "600,500", "--select-right", "600,500"];
    let base = [
        "plan",
        "--left",
        "left.png",
        "--right",
        "right.png",
        "--rig",
        "world/rig.toml",
        "--gripper",
        "world/gripper.toml",
    ];
    for (option, file, input) in [
        ("--out", "world/rig.toml", "--rig"),
        ("--out", "world/../world/gripper.toml", "--gripper"),
        ("--overlay", "again.png", "--left"),
        ("--report", "right.png", "--right"),
    ] {
        let before = std::fs::read(f.join(file)).unwrap();
        let out = graspd(f, &[&base[..], &click[..], &[option, file]].concat());
        assert_eq!(out.status.code(), Some(2), "{}", output(&out));
        assert!(output(&out).contains(option) && output(&out).contains(input), "{}", output(&out));
        assert_eq!(std::fs::read(f.join(file)).unwrap(), before, "{file} was overwritten");
    }
    let out = graspd(f, &["reconstruct", "world/rig.toml", "--out", "world/rig.toml"]);
    assert_eq!(out.status.code(), Some(2), "{}", output(&out));
}

/// A relative root is the same folder for programs that are started in different folders, however the path is written.
#[test]
fn a_relative_root_is_the_same_folder_for_every_program() {
    let world = World::new(30);
    let (parent, name) = (world.folder.parent().unwrap(), world.folder.file_name().unwrap().to_str().unwrap());
    let from_parent = format!("{name}/graspd.toml");
    let by_dots = format!("{name}/world/../graspd.toml");
    let by_sub = world.folder.join("world");
    for (folder, config) in [(parent, &from_parent[..]), (parent, &by_dots), (&by_sub, "../graspd.toml")] {
        let out = graspd(folder, &["check", "--config", config]);
        assert!(out.status.success(), "{config}: {}", output(&out));
        let out = graspd(folder, &["status", "--config", config, "--timeout", "0.2"]);
        assert!(output(&out).contains("no daemon"), "{config}: {}", output(&out));
    }
    let out = graspd(parent, &["status", "--shm-root", &format!("{name}/shm"), "--cell", "kill", "--timeout", "0.2"]);
    assert!(output(&out).contains("no daemon"), "{}", output(&out));
}
